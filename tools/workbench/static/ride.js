// One ride along its way: energy, power by term, conditions, and a map coloured by residual.

import { chart, legendOf } from "./chart.js";
import { el } from "./dom.js";
import { number, quantity, signed } from "./format.js";
import { choice, command, field, heading, nextStep, query } from "./loop.js";
import { categoryToken, withUnit } from "./scales.js";
import { track } from "./track.js";

const MOST_TERMS = 6;

export async function mountRide(body, { state, model, workspace, context }) {
  const trace = await context.get(`/trace?${query({ model, ride: state.ride })}`);
  const back = el("a", { class: "button", href: context.link({ page: "rides", model: state.model, filter: state.filter, sort: state.sort }) }, "← All rides");
  const plots = [];
  if (trace.untraced) {
    body.append(heading(`Ride ${state.ride}`, trace.untraced, back));
    return { draw() {}, destroy() {} };
  }
  const { ride, windows } = trace;
  const of = trace.models[model];
  let axis = "km";

  const facts = [
    ["measured", `${number(ride.energy_kwh, 3)}\u202fkWh`, ride.energy_sd_kwh ? `± ${number(2 * ride.energy_sd_kwh, 3)}` : ""],
    ["predicted", quantity(of.predicted_kwh, "kWh", 3), ""],
    ["error", `${signed(of.error_kwh, 3)}\u202fkWh`, ""],
    ["distance", quantity(ride.distance_km, "km", 1), ""],
    ["duration", quantity(ride.duration_s / 60, "min", 0), ""],
    ["outside", quantity(ride.ambient_c, "°C", 0), ""],
  ];
  const figures = el("dl", { class: "figures small-figures" }, facts.map(([name, value, note]) =>
    el("div", {}, el("dt", {}, name, note && ` ${note}`), el("dd", {}, value))));
  const words = of.words.charAt(0).toUpperCase() + of.words.slice(1);
  const charts = el("div", { class: "stack" });
  const map = el("div", {});
  const select = choice([["km", "distance"], ["min", "time"]], axis, (value) => { axis = value; drawCharts(); });

  body.append(
    heading(`Ride ${trace.key || state.ride}`, `${ride.vehicle_id}, ${ride.vehicle_model}, ${ride.date}, model ${model}`, back),
    nextStep("see whether other rides diverge in the same conditions:", context.link({ page: "failures", model: state.model }), "where the model fails"),
    el("section", { class: "card" }, figures),
    el("section", { class: `card ${of.place ? "parted" : ""}` }, el("h2", {}, "Where prediction and measurement diverge"), el("p", {}, `${words}.`), trace.notes.map((note) => el("p", { class: "note small" }, `${note}.`))),
    el("div", { class: "grid" },
      el("section", { class: "card span-8" }, el("div", { class: "card-head" }, el("h2", {}, "Along the way"), field("Along", "along", select)), charts),
      el("section", { class: "card span-4 stays" }, el("h2", {}, "The drive, by residual"), map)),
    command(trace.command),
  );

  const power = (energy) => energy.map((kwh, i) => (3.6e6 * kwh) / windows.duration_s[i] / 1000);
  const residual = power(of.energy_kwh).map((kw, i) => kw - power(windows.measured_kwh)[i]);
  let drawnMap = null;

  function drawCharts() {
    plots.splice(0).forEach((plot) => plot.destroy());
    charts.replaceChildren();
    const ends = axis === "km" ? windows.end_km : windows.end_min;
    const edges = [0, ...ends];
    const x = { label: axis === "km" ? "Distance" : "Time", unit: axis, domain: [0, edges.at(-1)] };
    const steps = (values) => [...values, values.at(-1)];
    const sums = (values, from = 0) => values.reduce((list, value) => [...list, list.at(-1) + value], [from]);
    const span = of.place && { type: "span", from: edges[of.place.first], to: edges[of.place.last + 1], colour: "--vermilion" };
    const windowAt = (value) => (value === null ? null : Math.max(0, ends.findIndex((end) => end >= value)));
    const hover = (value) => {
      plots.forEach((plot) => plot.setCursor(value));
      drawnMap?.setWindow(windowAt(value));
    };
    const add = (heading_, y, layers, height = 180) => {
      const host = el("div", {});
      charts.append(host);
      const named = span && !plots.length ? { ...span, name: "where they diverge" } : span;
      plots.push(chart(host, { title: `${heading_} along the ride`, heading: heading_, x, y, layers: [named, ...layers].filter(Boolean), height, hover }));
    };
    const measured = sums(windows.measured_kwh);
    const predicted = sums(of.energy_kwh, of.start_kwh);
    const tell = (name, list) => (i) => [`${withUnit(edges[i], axis)}`, `${name} ${withUnit(list[i], "kWh")}`];
    add("Energy since the start", { label: "Energy", unit: "kWh" }, [
      { type: "line", x: edges, y: measured, colour: "--ink", name: "measured", tell: tell("measured", measured) },
      { type: "line", x: edges, y: predicted, colour: "--blue", name: "predicted", tell: tell("predicted", predicted) },
    ], 240);
    add("Power", { label: "Power", unit: "kW" }, [
      { type: "stairs", x: edges, y: steps(power(windows.measured_kwh)), colour: "--ink", name: "measured" },
      { type: "stairs", x: edges, y: steps(power(of.energy_kwh)), colour: "--blue", name: "predicted" },
    ], 220);
    const size = (energy) => energy.reduce((sum, kwh) => sum + Math.abs(kwh), 0);
    const terms = Object.entries(of.terms).sort((a, b) => size(b[1]) - size(a[1]));
    const rest = terms.slice(MOST_TERMS).map(([, energy]) => energy);
    const shown = terms.slice(0, MOST_TERMS);
    if (rest.length) shown.push(["others", rest[0].map((_, i) => rest.reduce((sum, energy) => sum + energy[i], 0))]);
    add("Predicted power by term", { label: "Power", unit: "kW" }, shown.map(([name, energy], i) => (
      { type: "stairs", x: edges, y: steps(power(energy)), colour: categoryToken(i), name: name.replaceAll("_", " "), thick: 1.75 })), 260);
    const condition = (name, label, unit, values, colour) => {
      if (values?.some((value) => value !== null)) add(name, { label, unit }, [{ type: "stairs", x: edges, y: steps(values), colour }], 150);
    };
    condition("Speed", "Speed", "km/h", windows.distance_km.map((km, i) => (3600 * km) / windows.duration_s[i]), "--green");
    if (windows.gained_m) {
      const climbs = windows.gained_m.map((gained, i) => (gained ?? 0) - (windows.lost_m[i] ?? 0));
      add("Elevation above the start", { label: "Elevation", unit: "m" }, [{ type: "line", x: edges, y: sums(climbs), colour: "--purple" }], 150);
    }
    condition("Outside temperature", "Temperature", "°C", windows.ambient_c, "--orange");
    if (windows.wind_speed_kmh?.some((value) => value !== null)) {
      const layers = [{ type: "stairs", x: edges, y: steps(windows.wind_speed_kmh), colour: "--sky", name: "wind" }];
      if (windows.headwind_kmh) layers.push({ type: "stairs", x: edges, y: steps(windows.headwind_kmh), colour: "--vermilion", name: "headwind; negative: from behind" });
      add("Wind", { label: "Wind", unit: "km/h" }, layers, 180);
    }
  }

  return {
    draw() {
      drawCharts();
      const at = (name, i) => [windows[`latitude_${name}_deg`]?.[i], windows[`longitude_${name}_deg`]?.[i]];
      drawnMap = track(map, {
        title: `Map of the ride: ${windows.duration_s.length} windows, coloured by predicted less measured power. ${words}.`,
        windows: residual.map((value, i) => ({ from: at("start", i), to: at("end", i), value })),
        place: of.place,
        unit: "kW",
        onhover: (i) => {
          const ends = axis === "km" ? windows.end_km : windows.end_min;
          const middle = i === null ? null : (ends[i] + (ends[i - 1] ?? 0)) / 2;
          plots.forEach((plot) => plot.setCursor(middle));
          drawnMap.setWindow(i);
        },
      });
      if (of.place) map.append(legendOf([{ name: "where they diverge", shape: "box", colour: "--vermilion" }]));
    },
    destroy() {
      plots.forEach((plot) => plot.destroy());
      drawnMap?.destroy();
    },
  };
}
