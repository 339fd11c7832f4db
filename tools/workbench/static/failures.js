// The page "Where it fails": the residual along any column, slices, and the location of the error.

import { chart, legendOf, scaleLegend } from "./chart.js";
import { el, svg } from "./dom.js";
import { count, number, quantity, signed, signedShare } from "./format.js";
import { changeFilter, choice, command, field, fill, filterBar, getReady, heading, modelChoice, nextStep, openWorkspace, put, query } from "./loop.js";
import { categoryToken, extent, plain, sequential, token, withUnit } from "./scales.js";
import { heldOut, outcomeChip } from "./step.js";

const MOST_COLOURS = 8;
const LEVELS = [["windows", "minutes"], ["rides", "whole rides"]];

export function mount(root, first, context) {
  let state = first;
  let view = null;

  async function draw() {
    view?.destroy();
    view = null;
    await fill(root, "Reading the rides", context, async () => {
      const workspace = await openWorkspace(root, context);
      if (!workspace) return;
      const model = workspace.models.includes(state.model) ? state.model : workspace.first;
      const rides = await context.get(`/rides?${query({ model })}`);
      const { models } = await context.get("/models");
      const step = models.find((each) => each.name === model && each.effect);
      view = makeView(root, { state, model, workspace, rides, step, context });
    });
  }

  draw();
  return {
    update(next) {
      const same = view && next.model === state.model;
      state = next;
      if (same) view.update(next);
      else draw();
    },
    unmount() { view?.destroy(); },
  };
}

function makeView(root, { state: first, model, workspace, rides, step, context }) {
  let state = first;
  let plots = [];
  const located = [];
  let survey = null;
  const surveyBox = el("div", {});
  const surveyNote = el("p", { class: "note small" });
  const controls = el("div", { class: "row" });
  const charts = el("div", {});
  const filters = el("div", {});
  const slices = el("div", {});
  const location = el("div", {});
  const copied = el("div", {});
  const level = () => (state.level === "rides" ? "rides" : "windows");
  const parent = workspace.parents[model]; // the model before the step that made this one
  const pair = () => (parent && state.before !== "no" ? parent : null);

  put(root, 
    heading("Where it fails", "The residual is predicted less measured. Where its mean leaves zero, the model misses something.", modelChoice(workspace, state, context)),
    el("div", { class: "stack" },
      step && el("p", { class: "step-line" }, "Adding ", el("strong", {}, step.effect.replaceAll("_", " ")), ` to ${step.parent}: error of a ride on held-out days `, el("strong", {}, heldOut(step)), `, ${signedShare(step.mae_after_kwh / step.mae_before_kwh - 1)}. `, outcomeChip(step)),
      step && !workspace.seen.includes(parent) && el("p", { class: "note small" }, `${parent} was not fitted to these rides, and the step refitted all its terms: part of what lies between the two residuals is due to that. The errors above leave it out.`),
      nextStep("pick a chart to see the residual along that column, then ask", context.link({ page: "causes", model: state.model }), "what is missing"),
      el("section", { class: "card", "aria-label": "Survey" },
        el("div", { class: "card-head" }, el("h2", {}, "The residual along each column"), field("Mean over", "level", choice(LEVELS, level(), (value) => context.navigate({ level: value })))),
        el("p", { class: "note small" }, "Shaded: 95 % intervals of the means. Charts with means off zero come first, then those with the largest differences."),
        surveyNote,
        surveyBox),
      el("section", { class: "card", "aria-label": "Explorer", id: "explorer" }, el("div", { class: "card-head" }, el("h2", {}, "Explorer"), controls), charts, filters),
      el("section", { class: "card", "aria-label": "Slices" }, el("h2", {}, "Slices with another bias"), slices),
      el("section", { class: "card", "aria-label": "Location" }, el("h2", {}, "Location of the error"), location),
      copied),
  );

  async function drawSurvey() {
    const ask = (which) => context.get(`/survey?${query({ model: which, level: level(), filter: state.filter })}`);
    const [found, earlier] = await Promise.all([ask(model), pair() ? ask(pair()) : null]);
    survey = found;
    const was = (key) => earlier?.charts.find((each) => each.column.key === key)?.bins;
    const sizes = [...survey.charts, ...(earlier?.charts ?? [])].map(({ bins }) => Math.max(...bins.mean.filter((_, i) => bins.ci95[i] !== null).map(Math.abs))).sort((a, b) => a - b);
    const most = 1.6 * (sizes[Math.floor(0.85 * (sizes.length - 1))] ?? 1) || 1;
    const chosen = state.x ?? survey.charts[0]?.column.key;
    put(surveyNote, survey.charts.length && survey.charts.every((each) => !each.outside) && "No mean is off zero beyond chance: the location of the error, below, says between what it differs.");
    put(surveyBox, survey.charts.length
      ? el("div", { class: "survey" }, survey.charts.map((each) => el("button", {
        type: "button",
        "aria-pressed": String(each.column.key === chosen),
        onclick: () => { context.navigate({ x: each.column.key }); document.getElementById("explorer").scrollIntoView({ block: "start" }); },
      }, el("span", {}, each.column.label), sparkline(each.bins, most, was(each.column.key)), el("span", { class: "soft small" }, `${each.outside} of ${each.of} off zero`))))
      : el("p", { class: "note" }, "Too few rides pass the filter to average them."));
  }

  async function drawExplorer() {
    const known = survey.charts.map((each) => each.column);
    const x = known.some((each) => each.key === state.x) ? state.x : known[0]?.key;
    plots.forEach((plot) => plot.destroy());
    plots = [];
    if (!x) {
      put(controls);
      put(charts, el("p", { class: "note" }, "Remove a filter to see more rides."));
      return;
    }
    const ask = (which) => context.get(`/residuals?${query({ model: which, level: level(), x, colour: state.colour, facet: state.facet, filter: state.filter })}`);
    const [record, earlier] = await Promise.all([ask(model), pair() ? ask(pair()) : null]);
    for (const facet of record.facets) facet.before = earlier?.facets.find((each) => each.title === facet.title)?.bins;
    const options = record.columns.map((each) => [each.key, each.label]);
    put(controls, 
      field("Along", "x", choice(options, x, (value) => context.navigate({ x: value }))),
      field("Colour", "colour", choice([["", "none"], ...options], state.colour, (value) => context.navigate({ colour: value }))),
      field("A chart for each", "facet", choice([["", "none"], ...options], state.facet, (value) => context.navigate({ facet: value }))),
      field("Scale", "scale", choice([["", "means"], ["points", "all points"]], state.scale, (value) => context.navigate({ scale: value }))),
      parent && field("Model before", "before", choice([["", parent], ["no", "not shown"]], state.before, (value) => context.navigate({ before: value }))),
    );
    const grid = el("div", { class: record.facets.length > 1 ? "facets" : null });
    put(charts, grid);
    const shared = domains(record, state.scale === "points");
    const tints = tinter(record);
    for (const facet of record.facets) {
      const host = el("div", {});
      grid.append(host);
      plots.push(chart(host, describeChart(record, facet, shared, tints)));
    }
    if (record.facets.length > 1) charts.append(legendOf([{ name: level() === "rides" ? "ride" : "window", colour: "--sky", shape: "dot" }, ...(pair() ? [{ name: `before, ${parent}`, colour: "--line-strong", shape: "dot", open: () => true }] : []), { name: pair() ? `now, ${model}` : "mean with 95 % interval", colour: "--vermilion", shape: "dot" }]));
    if (tints.legend) charts.append(tints.legend);
    const drawn = record.every > 1 ? ` One in ${record.every} is drawn.` : "";
    charts.append(el("p", { class: "note small" }, `${number(record.rows)} ${level() === "rides" ? "rides" : "windows of about a minute"}.${drawn} Means are of about equal numbers; bars are 95 % intervals by vehicle-day. Click a point to open its ride.`));
  }

  function describeChart(record, facet, shared, tints) {
    const { bins, points } = facet;
    const { x } = record;
    const names = x.number ? null : shared.names;
    const at = (value) => (x.number ? value : names.indexOf(value));
    const say = (value) => (record.unit === "kWh" ? `${signed(value, 3)}\u202fkWh` : `${signed(value, 0)}\u202fW`);
    const spread = points.x.map((value, i) => (x.number ? value : at(value) + (((i * 7919) % 100) / 100 - 0.5) * 0.5));
    return {
      title: `Residual along ${x.label}${facet.title ? `, ${facet.title}` : ""}`,
      summary: `${bins.mean.length} means from ${say(Math.min(...bins.mean))} to ${say(Math.max(...bins.mean))}.`,
      heading: facet.title,
      height: record.facets.length > 1 ? 280 : 420,
      legend: record.facets.length > 1 ? [] : undefined,
      x: { label: x.label, unit: x.unit, names, domain: shared.x },
      y: { label: "Predicted less measured", unit: record.unit, domain: shared.y },
      layers: [
        { type: "points", x: spread, y: points.y, colour: "--sky", tints: tints.of(points), alpha: 0.5, name: level() === "rides" ? "ride" : "window", tell: (i) => [points.ride[i], `${x.label} ${x.number ? withUnit(points.x[i], x.unit) : points.x[i]}`, say(points.y[i]), "Enter or click opens the ride"], pick: (i) => context.navigate({ page: "rides", model: state.model, ride: points.ride[i] }) },
        { type: "rule", y: 0 },
        ...(facet.before ? [{ type: "means", x: facet.before.x.map(at), y: facet.before.mean, ci: facet.before.ci95, colour: "--line-strong", open: () => true, name: `before, ${parent}`, tell: (i) => [`${x.label} ${x.number ? `${plain(facet.before.low[i])} to ${withUnit(facet.before.high[i], x.unit)}` : facet.before.x[i]}`, `mean of ${parent}: ${say(facet.before.mean[i])}`] }] : []),
        { type: "means", x: bins.x.map(at), y: bins.mean, ci: bins.ci95, colour: "--vermilion", name: facet.before ? `now, ${model}` : "mean with 95 % interval", tell: (i) => [`${x.label} ${x.number ? `${plain(bins.low[i])} to ${withUnit(bins.high[i], x.unit)}` : bins.x[i]}`, `mean ${say(bins.mean[i])}${bins.ci95[i] ? ` ± ${number(bins.ci95[i], record.unit === "kWh" ? 3 : 0)}` : ""}`, `${number(bins.rows[i])} ${level()}, ${number(bins.days[i])} vehicle-days`, "Enter or click filters to it"], pick: (i) => context.navigate({ filter: changeFilter(state.filter, x.key, x.number ? `${bins.low[i].toFixed(3)}..${bins.high[i].toFixed(3)}` : encodeURIComponent(bins.x[i])) }) },
      ],
    };
  }

  async function drawDiagnosis() {
    await fill(location, "Diagnosing", context, async () => {
      const record = await getReady(location, context, `/failures?${query({ model })}`, "Diagnosing the model");
      put(slices, drawSlices(record));
      put(location, ...drawLocation(record.location));
      put(copied, command(record.command));
    });
  }

  function drawSlices(record) {
    if (!record.slices.length) {
      return el("p", { class: "note" }, "No group of rides by weather, time, speed or vehicle differs from the others, or the rides are too few. A cause that cancels out over a ride shows in its minutes: see the charts above.");
    }
    return el("div", { class: "cards" }, record.slices.map((slice) => {
      const value = slice.conditions.map(encodeURIComponent).join("|");
      return el("button", { type: "button", class: "slice", "aria-pressed": String((state.filter ?? "").includes(`where:${value}`)), onclick: () => context.navigate({ filter: changeFilter(state.filter, "where", value) }) },
        el("strong", {}, slice.where), el("span", {}, slice.words), el("span", { class: "soft small" }, `${count(slice.rides, "ride")}, 95 % interval ${signed(slice.ci95[0], 3)} to ${signed(slice.ci95[1], 3)}\u202fkWh`), el("span", { class: "chip" }, "Filter to these rides"));
    }));
  }

  function drawLocation({ sentences, shares, estimates }) {
    const parts = sentences.map((line) => el("p", {}, line));
    const names = { measurement: "measurement noise", scatter: "unexplained within rides", day: "differs from vehicle-day to vehicle-day", car: "differs from vehicle to vehicle", ride: "differs from ride to ride", driver: "differs from driver to driver", date: "differs from date to date" };
    const bars = Object.entries(shares).map(([name, share]) => {
      const bar = el("span", { class: "fill" });
      bar.style.width = `${100 * share}%`;
      return el("div", { class: "share" }, el("span", {}, names[name] ?? name), el("span", { class: "track" }, bar), el("span", { class: "number" }, quantity(100 * share, "%")));
    });
    if (bars.length) parts.push(el("h3", {}, "Shares of the squared error"), el("div", { class: "shares" }, bars));
    const plot = el("div", { class: "facets" });
    const levels = [...new Set(estimates.map((each) => each.level_name))];
    const most = Math.max(...estimates.map((each) => each.high_w ?? 0), 1);
    for (const name of levels) {
      const own = estimates.filter((each) => each.level_name === name);
      const host = el("div", {});
      plot.append(host);
      located.push(chart(host, {
        title: `How much ${name}s differ in each kind of load`,
        summary: own.map((each) => `${each.kind}: ${plain(each.size_w)} W`).join(", "),
        heading: `Between ${name}s`,
        height: 70 + 30 * own.length,
        x: { label: "Differs by, as a mean power", unit: "W", domain: [0, most * 1.05] },
        y: { label: "", names: own.map((each) => each.kind_name) },
        layers: [
          { type: "means", x: own.map((each) => (each.low_w + each.high_w) / 2), y: own.map((_, i) => i), ci: own.map((each) => (each.high_w - each.low_w) / 2), across: true, size: 0.1, colour: "--line-strong" },
          { type: "means", x: own.map((each) => each.size_w), y: own.map((_, i) => i), colour: "--blue", open: (i) => !own[i].claimed, tell: (i) => [own[i].kind_name, `${plain(own[i].size_w)} W, 95 % interval ${plain(own[i].low_w)} to ${plain(own[i].high_w)} W`, own[i].claimed ? "the data require it" : "not beyond what sampling causes"] },
        ],
      }));
    }
    if (levels.length) parts.push(el("h3", {}, "By level and kind of load"), plot, el("p", { class: "note small" }, "Filled: the data require this load. Open: no more than what sampling causes."));
    const columns = rides.columns.filter((each) => ["vehicle_id", "driver_id", "date"].includes(each.key));
    parts.push(el("div", { class: "row" }, el("span", { class: "soft" }, "See the residual by"), columns.map((each) => el("button", { type: "button", onclick: () => { context.navigate({ x: each.key, level: "rides" }); document.getElementById("explorer").scrollIntoView({ block: "start" }); } }, each.label.toLowerCase()))));
    return parts;
  }

  async function drawTop() {
    put(filters, filterBar(state.filter, rides.columns, rides.values, (filter) => context.navigate({ filter })));
    await fill(surveyBox, "Averaging the residuals", context, drawSurvey);
    if (survey) await fill(charts, "Reading the residuals", context, drawExplorer);
  }

  drawTop();
  drawDiagnosis();
  return {
    update(next) {
      const whole = next.filter !== state.filter || next.level !== state.level || next.before !== state.before;
      const moved = next.x !== state.x;
      state = next;
      if (whole) drawTop();
      else {
        if (moved) fill(surveyBox, "Averaging the residuals", context, drawSurvey);
        fill(charts, "Reading the residuals", context, drawExplorer);
      }
    },
    destroy() { [...plots, ...located].forEach((plot) => plot.destroy()); },
  };
}

// Ranges that all charts share: that of the means, or that of all points.
function domains(record, all) {
  const { x, facets } = record;
  const names = x.number ? null : [...new Set(facets.flatMap((facet) => facet.bins.x))].sort();
  const ends = facets.flatMap((facet) => [facet.bins, facet.before]).filter(Boolean).flatMap((bins) => bins.mean.flatMap((m, i) => [m - (bins.ci95[i] ?? 0), m + (bins.ci95[i] ?? 0)]));
  const most = 1.35 * Math.max(...ends.map(Math.abs), 1e-9);
  return {
    names,
    x: names ? null : extent(facets.map((facet) => facet.points.x)),
    y: all ? extent(facets.map((facet) => facet.points.y)) : [-most, most],
  };
}

// Colours of points by a column, and their legend.
function tinter(record) {
  const { colour, facets } = record;
  if (!colour) return { of: () => undefined };
  const values = facets.flatMap((facet) => facet.points.colour);
  if (colour.number) {
    const range = extent([values], { margin: 0 });
    const tint = sequential(range);
    return { of: (points) => points.colour.map((value) => (value === null ? token("--line") : tint(value))), legend: scaleLegend(colour.label, tint, range, colour.unit) };
  }
  const names = [...new Set(values)].sort();
  const of = (name) => token(categoryToken(Math.min(names.indexOf(name), MOST_COLOURS - 1)));
  const shown = names.slice(0, MOST_COLOURS).map((name, i) => ({ name: i === MOST_COLOURS - 1 && names.length > MOST_COLOURS ? "others" : name || "unknown", colour: categoryToken(i), shape: "dot" }));
  return { of: (points) => points.colour.map(of), legend: legendOf(shown) };
}

function sparkline(given, most, before) {
  const [wide, high] = [200, 64];
  const rows = given.mean.map((_, i) => i).filter((i) => given.ci95[i] !== null);
  const bins = { mean: rows.map((i) => given.mean[i]), ci95: rows.map((i) => given.ci95[i]) };
  const count = bins.mean.length;
  const x = (i) => (count > 1 ? 4 + (i / (count - 1)) * (wide - 8) : wide / 2);
  const y = (value) => Math.max(1, Math.min(high - 1, high / 2 - (value / most) * (high / 2 - 3)));
  const old = before?.mean.length === given.mean.length ? before.mean.map((value, i) => `${x(i).toFixed(1)} ${y(value).toFixed(1)}`) : [];
  const path = (values) => values.map((value, i) => `${x(i).toFixed(1)} ${y(value).toFixed(1)}`);
  const band = [...path(bins.mean.map((m, i) => m + bins.ci95[i])), ...path(bins.mean.map((m, i) => m - bins.ci95[i])).reverse()];
  return svg("svg", { viewBox: `0 0 ${wide} ${high}`, preserveAspectRatio: "none", "aria-hidden": "true" },
    svg("line", { x1: 0, x2: wide, y1: high / 2, y2: high / 2, stroke: "var(--line-strong)" }),
    svg("path", { d: `M${band.join("L")}Z`, fill: "var(--vermilion)", "fill-opacity": 0.18 }),
    old.length > 1 && svg("path", { d: `M${old.join("L")}`, fill: "none", stroke: "var(--ink-soft)", "stroke-width": 1.5, "stroke-dasharray": "3 3", "vector-effect": "non-scaling-stroke" }),
    svg("path", { d: `M${path(bins.mean).join("L")}`, fill: "none", stroke: "var(--vermilion)", "stroke-width": 2, "vector-effect": "non-scaling-stroke" }));
}
