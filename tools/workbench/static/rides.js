// The page "Rides": predicted against measured energy of every ride, and one ride along its way.

import { chart } from "./chart.js";
import { el } from "./dom.js";
import { count, number, quantity, signed } from "./format.js";
import { changeFilter, command, fill, filterBar, heading, modelChoice, nextStep, openWorkspace, put, query } from "./loop.js";
import { mountRide } from "./ride.js";
import { plain, withUnit } from "./scales.js";

const BAND = 0.1;
const LISTED = 12;
const SORTS = [["error", "largest error"], ["relative", "largest relative error"], ["date", "date"], ["distance_km", "distance"]];

export function mount(root, first, context) {
  let state = first;
  let view = null;
  let workspace = null;

  async function draw() {
    view?.destroy();
    view = null;
    await fill(root, "Reading the rides", context, async () => {
      workspace = await openWorkspace(root, context);
      if (!workspace) return;
      const model = workspace.models.includes(state.model) ? state.model : workspace.first;
      const body = el("div", { class: "stack" });
      if (state.ride) {
        view = await mountRide(body, { state, model, workspace, context });
      } else {
        view = await mountRides(body, { state, model, workspace, context });
      }
      put(root, body);
      view.draw();
    });
  }

  draw();
  return {
    update(next) {
      const same = next.model === state.model && next.ride === state.ride && view;
      state = next;
      if (same && view.update) view.update(state);
      else draw();
    },
    unmount() { view?.destroy(); },
  };
}

async function mountRides(body, { state, model, workspace, context }) {
  const record = await context.get(`/rides?${query({ model })}`);
  let now = state;
  let kept = null;
  let shown = LISTED;
  let plot = null;
  const { values, keys, columns } = record;

  const figures = el("dl", { class: "figures" });
  const filters = el("div", {});
  const scatter = el("div", {});
  const list = el("div", {});

  const setFilter = (filter) => context.navigate({ filter });
  const open = (i) => context.navigate({ ride: keys[i] });
  const tell = (i) => [
    keys[i],
    `measured ${withUnit(values.measured_kwh[i], "kWh")}, predicted ${withUnit(values.predicted_kwh[i], "kWh")}`,
    `error ${signed(values.error_kwh[i], 3)} kWh`,
    `${plain(values.distance_km?.[i])} km at ${plain(values.ambient_c?.[i])} °C`,
    "Enter or click opens the ride",
  ];

  function drawScatter() {
    const faint = kept ? new Set(keys.map((_, i) => i).filter((i) => !kept.has(i))) : undefined;
    const most = Math.max(...values.measured_kwh, ...values.predicted_kwh);
    const least = Math.min(0, ...values.measured_kwh, ...values.predicted_kwh);
    const ends = [least - 0.03 * (most - least), most * 1.04];
    const line = [ends[0], 0, ends[1]];
    const spec = {
      title: `Predicted against measured energy of ${keys.length} rides`,
      summary: "A point on the line is a perfect prediction.",
      square: true,
      height: 560,
      x: { label: "Measured energy", unit: "kWh", domain: ends },
      y: { label: "Predicted energy", unit: "kWh", domain: ends },
      layers: [
        { type: "area", x: line, low: line.map((v) => v - BAND * Math.abs(v)), high: line.map((v) => v + BAND * Math.abs(v)), colour: "--green", name: "within ±10 %" },
        { type: "line", x: ends, y: ends, colour: "--line-strong", thick: 1.5, name: "prediction equals measurement" },
        { type: "points", x: values.measured_kwh, y: values.predicted_kwh, colour: "--blue", name: "ride", faint, tell, pick: open },
      ],
      brush: (box) => {
        if (!box) {
          setFilter(changeFilter(changeFilter(now.filter, "measured_kwh", null), "predicted_kwh", null));
          return;
        }
        const range = ([low, high]) => `${low.toFixed(3)}..${high.toFixed(3)}`;
        setFilter(changeFilter(changeFilter(now.filter, "measured_kwh", range(box.x)), "predicted_kwh", range(box.y)));
      },
    };
    if (plot) plot.update(spec);
    else plot = chart(scatter, spec);
  }

  function drawFigures(selection) {
    const { errors } = selection;
    if (!errors) {
      put(figures, el("div", {}, el("dt", {}, "rides"), el("dd", {}, "0")));
      return;
    }
    const one = (name, value, note) => el("div", {}, el("dt", {}, name, note && el("span", { class: "soft" }, ` ${note}`)), el("dd", {}, value));
    const half = (estimate) => (estimate.ci95 === null ? "" : `± ${number(estimate.ci95, 3)}`);
    put(figures, 
      one("rides", number(errors.rides)),
      one(`mean absolute error of a ride${workspace.seen.includes(model) ? ", in sample" : ""}`, quantity(errors.mae_kwh.value, "kWh", 3), half(errors.mae_kwh)),
      one("of the energy", quantity(100 * errors.relative, "%", 1)),
      one("bias", `${signed(errors.bias_kwh.value, 3)}\u202fkWh`, half(errors.bias_kwh)),
      one("within ±10 %", quantity(100 * errors.within[10], "%", 0)),
      one("measurement noise alone", quantity(selection.noise_floor_kwh, "kWh", 3)),
    );
  }

  function drawList() {
    const sort = now.sort ?? "error";
    const key = {
      error: (i) => -Math.abs(values.error_kwh[i]),
      relative: (i) => -Math.abs(values.error_pct[i] ?? 0),
      date: (i) => values.date?.[i] ?? "",
      distance_km: (i) => -values.distance_km[i],
    }[sort] ?? (() => 0);
    const rows = keys.map((_, i) => i).filter((i) => !kept || kept.has(i));
    rows.sort((a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : 0));
    const choose = el("select", { id: "sort", onchange: () => context.navigate({ sort: choose.value }) },
      SORTS.map(([value, words]) => el("option", { value, selected: value === sort }, words)));
    const most = Math.max(...values.error_kwh.map(Math.abs));
    const table = el("table", { class: "errors" },
      el("thead", {}, el("tr", {}, el("th", {}, "ride"), el("th", { class: "wide-only" }, "day"), el("th", { class: "number wide-only" }, "km"), el("th", { class: "number wide-only" }, "°C"), el("th", { class: "number" }, "measured, kWh"), el("th", { class: "number" }, "error, kWh"))),
      el("tbody", {}, rows.slice(0, shown).map((i) => {
        const error = values.error_kwh[i];
        const bar = el("span", { class: `error-bar ${error < 0 ? "below" : "above"}`, "aria-hidden": "true" });
        bar.style.width = `${(36 * Math.abs(error)) / most}px`;
        return el("tr", {},
          el("td", {}, el("a", { href: context.link({ page: "rides", model: now.model, filter: now.filter, ride: keys[i] }) }, keys[i])),
          el("td", { class: "wide-only" }, values.date?.[i] ?? record.about.first_date),
          el("td", { class: "number wide-only" }, number(values.distance_km?.[i], 1)),
          el("td", { class: "number wide-only" }, number(values.ambient_c?.[i], 0)),
          el("td", { class: "number" }, number(values.measured_kwh[i], 3)),
          el("td", { class: "number" }, bar, signed(error, 3)));
      })));
    put(list, 
      el("div", { class: "card-head" }, el("h2", {}, "Rides by error"), el("div", { class: "row" }, el("label", { for: "sort" }, "Sort by"), choose)),
      rows.length ? el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Rides" }, table) : el("p", { class: "note" }, "No ride passes the filter."),
      rows.length > shown && el("button", { type: "button", class: "quiet", onclick: () => { shown += 50; drawList(); } }, `Show more of ${number(rows.length)} rides`),
    );
  }

  async function select() {
    put(filters, filterBar(now.filter, columns, values, setFilter));
    const asked = now;
    const selection = await context.get(`/selection?${query({ model, filter: now.filter })}`);
    if (asked.filter !== now.filter) return; // another filter was chosen meanwhile
    kept = now.filter ? new Set(selection.kept) : null;
    drawFigures(selection);
    drawScatter();
    drawList();
    if (now.filter) context.announce(`${selection.kept.length} of ${keys.length} rides pass the filter.`);
  }

  const { about } = record;
  const words = `${count(about.rides, "ride")} of ${count(about.vehicles, "car")}, ${about.first_date} to ${about.last_date}. Each point is a ride: how much energy it took, and how much the model predicted.`;
  body.append(
    heading("Rides", words, modelChoice(workspace, state, context)),
    nextStep("open a ride that is far off the line, or find out", context.link({ page: "failures", model: state.model }), "where the model fails"),
    workspace.notes.length > 0 && el("p", { class: "note" }, workspace.notes.join(" ")),
    el("section", { class: "card", "aria-label": "Errors" }, figures,
      workspace.seen.includes(model) && el("p", { class: "note small" }, `In sample: ${model} was fitted to rides of these dates, on which it looks better than on others. The page Models has its errors on held-out days.`)),
    el("div", { class: "grid" },
      el("section", { class: "card span-6" }, el("h2", {}, "Predicted against measured"), scatter, el("p", { class: "note small" }, "Drag a box to select rides; click a point to open its ride."), filters),
      el("section", { class: "card span-6" }, list)),
    command(record.command),
  );
  const draw = () => fill(list, "Measuring the errors", context, select);
  return {
    draw,
    update(next) {
      const sorted = next.filter === now.filter;
      now = next;
      if (sorted) drawList();
      else draw();
    },
    destroy() { plot?.destroy(); },
  };
}
