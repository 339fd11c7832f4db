// Scales of charts: round ticks, text of values, and colours of the design system.

import { number } from "./format.js";

const CATEGORY_COLOURS = ["--blue", "--orange", "--green", "--vermilion", "--purple", "--sky", "--ink-soft", "--line-strong"];

// Return round values that cover a range, about `count` of them and at least three, so that they are a scale.
export function ticks(low, high, count = 6) {
  if (!(high > low)) return [low];
  for (let wanted = count; ; wanted += 1) {
    const values = spread(low, high, wanted);
    if (values.length >= 3) return values;
  }
}

function spread(low, high, count) {
  const rough = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= rough - 1e-12);
  const values = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i += 1) values.push(i * step);
  return values;
}

// Return how many digits after the point tell values of this step apart.
export function digitsOf(step) {
  if (!(step > 0)) return 0;
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return Math.abs(step * 10 ** digits - Math.round(step * 10 ** digits)) > 1e-6 ? digits + 1 : digits;
}

export function tickTexts(values) {
  const step = values.length > 1 ? values[1] - values[0] : Math.abs(values[0]) || 1;
  return values.map((value) => number(value, digitsOf(step)));
}

// Return a value with about three significant digits, small ones as 1.31×10⁻⁷.
export function plain(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size > 0 && size < 1e-3) {
    const [digits, power] = value.toExponential(2).split("e-");
    return `${digits.replace("-", "\u2212").replace(/\.?0+$/, "")}×10⁻${[...power].map((digit) => "⁰¹²³⁴⁵⁶⁷⁸⁹"[digit]).join("")}`;
  }
  if (size >= 100 || size === 0) return number(value, 0);
  return number(value, Math.min(4, Math.max(0, 2 - Math.floor(Math.log10(size)))));
}

// The same without zeros at the end, for a value that is exact.
export function bare(value) {
  const text = plain(value);
  return text.includes(".") ? text.replace(/\.?0+$/, "") : text;
}

// Return a value with half the width of its interval, to two significant digits of the half.
export function estimate(value, half) {
  if (half === null || half === undefined || !(half > 0)) return plain(value);
  if (half < 1e-5) return `${plain(value)} ± ${plain(half)}`;
  const digits = Math.min(6, Math.max(0, 1 - Math.floor(Math.log10(half))));
  return `${number(value, digits)} ± ${number(half, digits)}`;
}

export function withUnit(value, unit) {
  const text = plain(value);
  return unit && unit !== "1" && text !== "–" ? `${text}\u202f${unit}` : text;
}

// Return the smallest range of the known values, with a margin as a share of it.
export function extent(lists, { margin = 0.04, zero = false } = {}) {
  let low = Infinity;
  let high = -Infinity;
  for (const list of lists) {
    for (const value of list) {
      if (value === null || !Number.isFinite(value)) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
  }
  if (low > high) return [0, 1];
  if (zero) [low, high] = [Math.min(low, 0), Math.max(high, 0)];
  if (low === high) [low, high] = [low - 0.5, high + 0.5];
  const more = margin * (high - low);
  return [zero && low === 0 ? 0 : low - more, zero && high === 0 ? 0 : high + more];
}

export function linear([low, high], [from, to]) {
  const scale = (value) => from + ((value - low) / (high - low)) * (to - from);
  scale.invert = (place) => low + ((place - from) / (to - from)) * (high - low);
  return scale;
}

// Return the value of a custom property of the design system.
export function token(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function channels(hex) {
  return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
}

function mix(one, other, share) {
  return `rgb(${channels(one).map((c, i) => Math.round(c + (channels(other)[i] - c) * share)).join(" ")})`;
}

export function categoryToken(place) {
  return CATEGORY_COLOURS[place % CATEGORY_COLOURS.length];
}

// Return a function from a residual to its colour: blue below zero, grey at zero, vermilion above.
export function diverging(most) {
  const [below, zero, above] = ["--blue", "--line", "--vermilion"].map(token);
  return (value) => {
    const share = Math.min(1, Math.abs(value) / (most || 1));
    return mix(zero, value < 0 ? below : above, 0.15 + 0.85 * share);
  };
}

// Return a function from a number to its colour, from blue over grey to orange.
export function sequential([low, high]) {
  const [from, middle, to] = ["--blue", "--line-strong", "--orange"].map(token);
  return (value) => {
    const share = Math.min(1, Math.max(0, (value - low) / (high - low || 1)));
    return share < 0.5 ? mix(from, middle, 2 * share) : mix(middle, to, 2 * share - 1);
  };
}
