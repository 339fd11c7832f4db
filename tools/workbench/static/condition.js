// The page "Condition": how each car is doing, since when, and where the energy of the fleet goes.

import { makeBeforeAfter, READ_ONLY } from "./before-after.js";
import { chart } from "./chart.js";
import { el } from "./dom.js";
import { count, number, quantity, signed } from "./format.js";
import { command, fill, getReady, heading, modelChoice, openWorkspace, put, query } from "./loop.js";
import { extent } from "./scales.js";

const SHOWN = 12;
const DAY_MS = 86400000;
const CLEAR = "As expected, within the interval.";
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
          el("section", { class: "card stack", "aria-label": "Findings" }, record.words.map((line) => el("p", {}, line)), about(record.about)),
          drawCars(record.cars, model),
          drawTable(record.cars),
          drawEnergy(record.energy),
          command(record.commands)));
    });
  }

  function drawCars(cars, model) {
    let shown = SHOWN;
    const everyone = cars.map((car) => car.vehicle_id).join(",");
    const host = el("div", { class: "facets" });
    const add = (from) => cars.slice(from, shown).forEach((car) => {
      const place = el("div", {});
      const list = el("div", {});
      const repair = makeBeforeAfter(car.vehicle_id, model, context);
      host.append(el("div", {}, el("h3", {}, car.vehicle_id), place, el("p", { class: "note small" }, car.words || CLEAR), list, repair.node));
      const plot = chart(place, describeTrend(car));
      plots.push(plot, repair);
      const choose = !context.session.read_only && (({ date, what, of_all: isOfAll }) => repair.fill({ vehicles: isOfAll ? everyone : car.vehicle_id, what, at: date }));
      if (car.events.length) list.append(listEvents(car, plot, choose));
    });
    const more = cars.length > shown && el("button", { type: "button", onclick: () => {
      const from = shown;
      shown += SHOWN;
      add(from);
      if (shown >= cars.length) more.remove();
    } }, "Show more cars");
    requestAnimationFrame(() => add(0)); // a chart is drawn once its place has a width
    return el("section", { class: "card stack", "aria-label": "Each car" }, el("h2", {}, "Each car"),
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

function about({ rides, car_days: days, first_date: first, last_date: last, day_sd_pct: sd }) {
  return el("p", { class: "note small" }, `${count(rides, "ride")} on ${count(days, "car-day")} from ${first} to ${last}. `
    + `On a usual day, the consumption of a car differs from its level by ${quantity(sd, "%", 1)} (standard deviation). Bands: 95 % intervals of the level.`);
}

function describeTrend(car) {
  const parts = [[car.consumption, "--blue", "consumption"], [car.capacity, "--vermilion", "usable capacity"]].filter(([trend]) => trend);
  const events = car.events.map(({ date, what }) => ({ type: "rule", x: toDay(date), text: what || "event", colour: "--ink-soft", dash: "2 3" }));
  const dates = [...parts.flatMap(([trend]) => trend.dates), ...car.events.map(({ date }) => date)];
  const layers = [{ type: "rule", y: 0 }, ...events];
  for (const [trend, colour, name] of parts) {
    const x = trend.dates.map(toDay);
    const half = trend.path_sd_pct.map((sd) => 1.96 * sd);
    layers.push(
      { type: "area", x, low: trend.path_pct.map((y, i) => y - half[i]), high: trend.path_pct.map((y, i) => y + half[i]), colour },
      { type: "points", x, y: trend.measured_pct, colour, alpha: 0.45, name: `${name}, day` },
      { type: "line", x, y: trend.path_pct, colour, name },
    );
  }
  return {
    title: `Condition of ${car.vehicle_id}`,
    summary: [car.words || CLEAR, ...car.events.map(({ words }) => `Known: ${words}.`)].join(" "),
    height: 230,
    x: { label: "Date", unit: "UTC", marks: markDates(dates), domain: events.length && dates.length ? extent([dates.map(toDay)]) : undefined },
    y: { label: "Beside expected", unit: "%" },
    layers,
  };
}

// The known events of a car as buttons; one that has the focus or the pointer is marked in the chart, and `choose`
// receives the one that is pressed, where it is given.
function listEvents(car, plot, choose) {
  const show = (day) => () => plot.setCursor(day, day !== null);
  const button = (event) => {
    const [mark, unmark] = [show(toDay(event.date)), show(null)];
    return el("button", { type: "button", title: choose && "Compare before and after", onfocus: mark, onclick: () => choose && choose(event), onpointerenter: mark, onpointerleave: unmark, onblur: unmark }, event.words);
  };
  return el("ul", { class: "events", "aria-label": `Known events of ${car.vehicle_id}` }, car.events.map((event) => el("li", {}, button(event))));
}

const toDay = (iso) => Date.parse(iso) / DAY_MS;

// Marks of an axis of days: the beginnings of months, as many as there is room for; else the first and the last date.
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

function drawTable(cars) {
  const between = (value, ends) => (value === null || value === undefined || !ends ? "–" : `${signed(value, 1)} (${signed(ends[0], 1)} to ${signed(ends[1], 1)})`);
  const list = (trend, what) => (trend?.steps ?? []).map((step) => `${step.since} ${what}${signed(step.change_pct, 1)} %`);
  const row = ({ vehicle_id: name, consumption, capacity, usable_kwh: usable, nominal_kwh: nominal }) => el("tr", {},
    el("th", { scope: "row" }, name),
    el("td", { class: "number" }, between(consumption?.level_pct, consumption?.ci95_pct)),
    el("td", { class: "number" }, between(consumption?.rate_pct, consumption?.rate_ci95_pct)),
    el("td", {}, [...list(consumption, ""), ...list(capacity, "battery ")].join(", ") || "–"),
    el("td", { class: "number" }, usable === null ? "–" : `${number(usable, 1)} of ${number(nominal, 1)}`),
    el("td", { class: "number" }, between(capacity?.rate_pct, capacity?.rate_ci95_pct)));
  const heads = ["Car", "Consumption, %", "Rate, %/year", "Changed", "Usable, kWh", "Battery rate, %/year"];
  return el("section", { class: "card stack", "aria-label": "All cars" }, el("h2", {}, "All cars"),
    el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Table of all cars" },
      el("table", {}, el("thead", {}, el("tr", {}, heads.map((head) => el("th", { scope: "col", class: head.includes(",") && "number" }, head)))), el("tbody", {}, cars.map(row)))),
    el("p", { class: "note small" }, "Beside the mean of the other cars of the vehicle model on the same dates. In parentheses: 95 % intervals. A dash: the dates are too few, or nothing changed suddenly."));
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
