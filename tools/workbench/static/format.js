// Numbers, times and units as text. A dash stands for what is unknown.

const MINUS = "\u2212";
const NARROW = "\u202f";

export function number(value, digits = 0) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = Math.abs(value).toLocaleString("en-GB", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return value < 0 && Number(text.replaceAll(",", "")) !== 0 ? MINUS + text : text;
}

// A number with its noun in the singular or the plural.
export function count(value, noun) {
  return `${number(value)} ${noun}${value === 1 ? "" : "s"}`;
}

export function quantity(value, unit, digits = 0) {
  const text = number(value, digits);
  return text === "–" ? text : `${text}${NARROW}${unit}`;
}

export function signed(value, digits = 0) {
  const text = number(value, digits);
  return value > 0 && text !== "–" ? `+${text}` : text;
}

export function interval(mean, low, high, unit, digits = 0) {
  if (!Number.isFinite(mean)) return "–";
  return `${quantity(mean, unit, digits)} (${number(low, digits)} to ${number(high, digits)})`;
}

// The zone of all times that a person reads; addresses, files and JSON hold UTC.
const BROWSER = Intl.DateTimeFormat().resolvedOptions().timeZone || "UTC";
let zone = BROWSER;
let parts = makeParts();

function makeParts() {
  const digits = { year: "numeric", month: "2-digit", day: "2-digit", hour: "2-digit", minute: "2-digit", second: "2-digit" };
  return new Intl.DateTimeFormat("en-CA", { timeZone: zone, hourCycle: "h23", timeZoneName: "short", ...digits });
}

export function setZone(name) {
  try {
    Intl.DateTimeFormat("en", { timeZone: name || BROWSER });
    zone = name || BROWSER;
  } catch { zone = "UTC"; }
  parts = makeParts();
}

export const getZone = () => zone;

const read = (seconds) => Object.fromEntries(parts.formatToParts(seconds * 1000).map((part) => [part.type, part.value]));

// Name of the zone at a time, such as EST.
export function zoneName(seconds) {
  return zone === "UTC" ? "UTC" : read(Number.isFinite(seconds) && seconds !== null ? seconds : 0).timeZoneName;
}

// Time of day.
export function clock(seconds, withSeconds = false) {
  if (!Number.isFinite(seconds) || seconds === null) return "–";
  const { hour, minute, second } = read(seconds);
  return `${hour}:${minute}${withSeconds ? `:${second}` : ""}`;
}

export function day(seconds) {
  if (!Number.isFinite(seconds) || seconds === null) return "–";
  const now = read(seconds);
  return `${now.year}-${now.month}-${now.day}`;
}

export function duration(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  const minutes = Math.round(seconds / 60);
  if (seconds < 90) return `${Math.round(seconds)}${NARROW}s`;
  if (minutes < 90) return `${minutes}${NARROW}min`;
  return `${Math.floor(minutes / 60)}${NARROW}h ${String(minutes % 60).padStart(2, "0")}${NARROW}min`;
}

// A change in percent with its sign.
export const signedShare = (share) => `${signed(100 * share, 1)}${NARROW}%`;

// Probabilities of falling below the reserve from which a car is at risk, and at high risk.
export const LOW_RISK = 0.05;
export const HIGH_RISK = 0.5;

// A probability in percent, never as certainty.
export function risk(share) {
  if (share === null || share === undefined || !Number.isFinite(share)) return "–";
  if (share < 0.01) return `<1${NARROW}%`;
  return share > 0.99 ? `>99${NARROW}%` : `${Math.round(100 * share)}${NARROW}%`;
}
