// The page "Condition": how each car is doing, since when, and where the energy of the fleet goes.

import { makeBeforeAfter, READ_ONLY } from "./before-after.js";
import { chart } from "./chart.js";
import { el } from "./dom.js";
import { count, number } from "./format.js";
import { command, fill, getReady, heading, modelChoice, openWorkspace, put, query } from "./loop.js";
import { extent } from "./scales.js";

const SHOWN = 12;
const DAY_MS = 86400000;
const MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];

export function mount(root, first, context) {
  let state = first;
  let plots = [];

  const clear = () => { plots.splice(0).forEach((plot) => plot.destroy()); };

  async function draw() {
    clear();
    await fill(root, "Reading the rides", context, async () => {
      const workspace = await openWorkspace(root, context);
      if (!workspace) return;
      const model = workspace.models.includes(state.model) ? state.model : workspace.first;
      const record = await getReady(root, context, `/condition?${query({ model })}`, "Assessing the condition of the cars");
      put(root,
        heading("Condition", `How each car is doing beside its siblings, by ${model}, and where the energy goes.`, modelChoice(workspace, state, context)),
        el("div", { class: "stack" },
          el("section", { class: "card stack", "aria-label": "Findings" }, record.words.map((line) => el("p", {}, line)), el("p", { class: "note small" }, record.about)),
          drawCars(record, model),
          drawTable(record.table),
          drawEnergy(record.energy),
          command(record.commands)));
    });
  }

  function drawCars({ cars, frame, note }, model) {
    let shown = SHOWN;
    const everyone = cars.map((car) => car.vehicle_id).join(",");
    const host = el("div", { class: "facets" });
    const add = (from) => cars.slice(from, shown).forEach((car) => {
      const trends = describeTrends(car, frame);
      const places = trends.map(() => el("div", {}));
      const list = el("div", {});
      const repair = makeBeforeAfter(car.vehicle_id, model, context);
      const outside = car.outside > 0 && ` Outside the charts: ${count(car.outside, "day")}.`;
      host.append(el("div", {}, el("h3", {}, car.vehicle_id), places, el("p", { class: "note small" }, car.words, outside), list, repair.node));
      const drawn = trends.map((trend, i) => chart(places[i], trend));
      plots.push(...drawn, repair);
      const choose = !context.session.read_only && (({ date, what, of_all: isOfAll }) => repair.fill({ vehicles: isOfAll ? everyone : car.vehicle_id, what, at: date }));
      if (car.events.length) list.append(listEvents(car, drawn, choose));
    });
    const more = cars.length > shown && el("button", { type: "button", onclick: () => {
      const from = shown;
      shown += SHOWN;
      add(from);
      if (shown >= cars.length) more.remove();
    } }, "Show more cars");
    requestAnimationFrame(() => add(0)); // a chart is drawn once its place has a width
    return el("section", { class: "card stack", "aria-label": "Each car" }, el("h2", {}, "Each car"),
      el("p", { class: "note small" }, note),
      el("p", { class: "note small" }, `“Did a repair help?” compares the days of a car before and after a date, or days on and off. ${context.session.read_only ? READ_ONLY : "A known event fills the form."}`), host, more);
  }

  draw();
  return {
    update(next) {
      const same = next.model === state.model;
      state = next;
      if (!same) draw();
    },
    unmount: clear,
  };
}

// The charts of a car, one below the other, with the axes that all cars have.
const PARTS = [["consumption", "--blue", "Consumption"], ["capacity", "--vermilion", "Usable capacity"]];

function describeTrends(car, frame) {
  const drawn = PARTS.filter(([key]) => car[key]);
  return (drawn.length ? drawn : PARTS.slice(0, 1)).map((part, place) => describeTrend(car, frame, part, place === 0));
}

function describeTrend(car, frame, [key, colour, name], isFirst) {
  const dates = [frame.first_date, frame.last_date];
  const events = car.events.map(({ date, what }) => ({ type: "rule", x: toDay(date), text: isFirst && (what || "event"), colour: "--ink-soft", dash: "2 3" }));
  const layers = [{ type: "rule", y: 0 }, ...events];
  const trend = car[key];
  if (trend) {
    const x = trend.dates.map(toDay);
    const half = trend.path_sd_pct.map((sd) => 1.96 * sd);
    layers.push(
      { type: "area", x, low: trend.path_pct.map((y, i) => y - half[i]), high: trend.path_pct.map((y, i) => y + half[i]), colour },
      { type: "points", x, y: trend.measured_pct, colour, alpha: 0.45 },
      { type: "line", x, y: trend.path_pct, colour },
    );
  }
  return {
    title: `${name} of ${car.vehicle_id}`,
    summary: isFirst ? [car.words, car.known].filter(Boolean).join(" ") : "",
    height: 190,
    x: { label: "Date", unit: "UTC", marks: markDates(dates), domain: extent([dates.map(toDay)]) },
    y: { label: name, unit: "%", domain: frame[key] ?? undefined },
    layers,
  };
}

// The known events of a car as buttons; one that has the focus or the pointer is marked in the charts, and `choose`
// receives the one that is pressed, where it is given.
function listEvents(car, drawn, choose) {
  const show = (day) => () => drawn.forEach((plot) => plot.setCursor(day, day !== null));
  const button = (event) => {
    const [mark, unmark] = [show(toDay(event.date)), show(null)];
    return el("button", { type: "button", title: choose && "Compare before and after", onfocus: mark, onclick: () => choose && choose(event), onpointerenter: mark, onpointerleave: unmark, onblur: unmark }, event.words);
  };
  return el("ul", { class: "events", "aria-label": `Known events of ${car.vehicle_id}` }, car.events.map((event) => el("li", {}, button(event))));
}

const toDay = (iso) => Date.parse(iso) / DAY_MS;

// Marks of an axis of days, from the first date on, as many as there is room for.
function markDates(dates) {
  return (room) => {
    const days = dates.map(toDay);
    const [low, high] = [Math.min(...days), Math.max(...days)];
    const text = (day) => {
      const date = new Date(day * DAY_MS);
      return `${date.getUTCDate()} ${MONTHS[date.getUTCMonth()]} ${String(date.getUTCFullYear()).slice(2)}`;
    };
    const number = Math.min(room, 5, Math.max(2, Math.floor(high - low)));
    const step = Math.max(1, Math.floor((high - low) / (number - 1)));
    return Array.from({ length: number }, (_, i) => low + i * step).filter((day) => day <= high).map((value) => ({ value, text: text(value) }));
  };
}

function drawTable({ title, columns, numeric, rows, notes }) {
  const head = (words, i) => el("th", { scope: "col", class: numeric[i] && "number" }, words[0].toUpperCase() + words.slice(1));
  const row = ([name, ...cells]) => el("tr", {}, el("th", { scope: "row" }, name), cells.map((text, i) => el("td", { class: numeric[i + 1] && "number" }, text)));
  return el("section", { class: "card stack", "aria-label": "All cars" }, el("h2", {}, title),
    el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Table of all cars" },
      el("table", {}, el("thead", {}, el("tr", {}, columns.map(head))), el("tbody", {}, rows.map(row)))),
    notes.map((words) => el("p", { class: "note small" }, words)));
}

function drawEnergy(energy) {
  const most = Math.max(...energy.shares.map((share) => Math.abs(share.per_100km_kwh.value)), 1e-9);
  const bar = ({ what, per_100km_kwh: amount, share }) => {
    const part = el("span", { class: `fill${amount.value < 0 ? " returned" : ""}` });
    part.style.width = `${(100 * Math.abs(amount.value)) / most}%`;
    return el("div", { class: "share" },
      el("span", {}, what),
      el("span", { class: "track", "aria-hidden": "true" }, part),
      el("span", { class: "number" }, `${number(amount.value, 2)}${amount.ci95 ? ` ± ${number(amount.ci95, 2)}` : ""}`, el("span", { class: "hidden" }, ` kWh per 100 km, ${number(100 * share)} %`)));
  };
  return el("section", { class: "card stack", "aria-label": "Where the energy goes" },
    el("h2", {}, "Where the energy goes"),
    el("p", {}, `${number(energy.measured.energy_kwh.value, 1)} kWh over ${number(energy.distance_km)} km: ${number(energy.measured.per_100km_kwh.value, 2)} kWh/100 km. Of this, in kWh/100 km:`),
    el("div", { class: "shares" }, energy.shares.map(bar)),
    el("p", { class: "note small" }, `Negative: given back to the motion or to the battery. The parts add up to the measured energy.${energy.shares.some((share) => share.per_100km_kwh.ci95) ? " ±: half of the 95 % interval." : ""}`));
}
