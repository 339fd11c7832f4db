// The step that adding an effect takes: error before and after, its picture, and the coefficients.

import { chart } from "./chart.js";
import { el, picture } from "./dom.js";
import { number, quantity, signed, signedShare } from "./format.js";
import { put } from "./loop.js";
import { bare, estimate, plain } from "./scales.js";

const HELD_OUT = [
  ["on_days", "held-out days, all refitted"],
  ["on_vehicles", "held-out vehicles, all refitted"],
  ["final", "final hold-out days"],
];

export const unitOf = (unit) => (unit === "1" ? "" : (unit ?? "").replaceAll("^2", "²").replaceAll("^3", "³").replaceAll("*", "·"));

// The errors of a ride before and after a step, on held-out days: the one pair of numbers by which every page tells it.
export function heldOut({ mae_before_kwh: before, mae_after_kwh: after }) {
  if (!Number.isFinite(before) || !Number.isFinite(after)) return "not known";
  return `${number(before, 4)} → ${quantity(after, "kWh", 4)}`;
}

// What became of an effect that was tried, and the colour of it.
export function outcomeOf({ action, outcome, forced }) {
  if (action === "add") return forced ? [outcome === "undecided" ? "added, undecided" : "added although not accepted", "warn"] : ["added", "good"];
  return [action ?? outcome, "warn"];
}

export function outcomeChip(step) {
  const [words, colour] = outcomeOf(step);
  return el("span", { class: `chip ${colour}` }, words);
}

// A table of the errors before and after by other ways to hold rides out, which check the step.
export function errorTable(trial) {
  const rows = HELD_OUT.filter(([key]) => trial[key]).map(([key, words]) => {
    const one = trial[key];
    return el("tr", {},
      el("th", { scope: "row" }, words),
      el("td", { class: "number wide-only" }, number(one.rides)),
      el("td", { class: "number" }, number(one.mae_before_kwh, 4)),
      el("td", { class: "number" }, number(one.mae_after_kwh, 4)),
      el("td", { class: "number" }, `${signed(one.change_kwh.value, 4)} ± ${number(one.change_kwh.ci95, 4)}`),
      el("td", { class: "number" }, signed(-100 * one.fall, 1)));
  });
  const head = ["evaluated on", "rides", "before, kWh", "after, kWh", "change, kWh", "%"];
  return el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Errors before and after" }, el("table", { class: "errors" },
    el("thead", {}, el("tr", {}, head.map((words, i) => el("th", { class: i ? `number ${i === 1 ? "wide-only" : ""}` : null, scope: "col" }, words)))),
    el("tbody", {}, rows)));
}

// Coefficients of one or two models with their intervals.
export function coefficients(host, models) {
  const names = [...new Set(models.flatMap((model) => model.coefficients.map((each) => each.term)))];
  const find = (model, name) => model.coefficients.find((each) => each.term === name);
  const unit = (name) => unitOf(models.map((model) => find(model, name)?.unit).find(Boolean));
  const show = (one) => {
    if (!one) return "–";
    return one.ci95 === null && one.low !== null ? `${plain(one.value)} (${plain(one.low)} to ${plain(one.high)})` : estimate(one.value, one.ci95);
  };
  const ranges = (name) => models.map((model) => find(model, name)?.range).find(Boolean);
  const near = names.filter(ranges);
  const place = (name, value) => Math.max(-0.08, Math.min(1.08, (value - ranges(name)[0]) / (ranges(name)[1] - ranges(name)[0])));
  const layers = models.map((model, m) => {
    const own = near.map((name, i) => [find(model, name), i]).filter(([one]) => one);
    const low = own.map(([one, i]) => place(near[i], one.low ?? one.value));
    const high = own.map(([one, i]) => place(near[i], one.high ?? one.value));
    const y = own.map(([, i]) => i + (models.length > 1 ? 0.32 * (m - 0.5) : 0));
    const colour = m === models.length - 1 ? "--blue" : "--line-strong";
    return [
      { type: "means", across: true, x: low.map((v, i) => (v + high[i]) / 2), y, ci: low.map((v, i) => (high[i] - v) / 2), size: 0.1, colour },
      { type: "means", x: own.map(([one, i]) => place(near[i], one.value)), y, colour, open: () => m < models.length - 1, name: model.name, tell: (i) => [own[i][0].term, model.name, `${show(own[i][0])} ${unitOf(own[i][0].unit)}`] },
    ];
  }).flat();
  const plot = el("div", {});
  const table = el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Coefficients" }, el("table", {},
    el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "coefficient"), models.map((model) => el("th", { class: "number", scope: "col" }, model.name)), el("th", { class: "number wide-only", scope: "col" }, "plausible"))),
    el("tbody", {}, names.map((name) => el("tr", {},
      el("th", { scope: "row" }, `${name.replaceAll("_", " ")}${unit(name) ? ` [${unit(name)}]` : ""}`),
      models.map((model) => {
        const one = find(model, name);
        return el("td", { class: `number ${one && !one.plausible ? "bad" : ""}` }, show(one), one && !one.plausible && " not plausible");
      }),
      el("td", { class: "number wide-only" }, ranges(name) ? `${bare(ranges(name)[0])} to ${bare(ranges(name)[1])}` : "–"))))));
  put(host, plot, table);
  return chart(plot, {
    title: `Coefficients of ${models.map((model) => model.name).join(" and ")}`,
    summary: "The table below has the values.",
    height: 80 + 30 * near.length,
    x: { label: "Place in the plausible range, 95 % interval", domain: [-0.1, 1.1] },
    y: { label: "", names: near.map((name) => name.replaceAll("_", " ")) },
    layers: [{ type: "rule", x: 0 }, { type: "rule", x: 1 }, ...layers],
  });
}

// The result of a trial: whether it helps, why, and the pictures.
export function drawStep(host, record, { actions, live }) {
  const { trial } = record;
  const helps = record.accepted;
  const undecided = trial.outcome === "undecided";
  const name = trial.effect.replaceAll("_", " ");
  const title = helps ? `${name} was added` : record.added ? `${name} was added ${undecided ? "though undecided" : "by force"}` : undecided ? `${name} is undecided` : `${name} was refused`;
  const lead = !undecided ? "" : `These rides do not show whether ${name} helps${record.added ? "" : ", so nothing was added"}: `;
  const reason = lead ? trial.reason : `${trial.reason.charAt(0).toUpperCase()}${trial.reason.slice(1)}`;
  const values = el("div", {});
  const fall = -100 * (trial.of_effect?.fall ?? 0);
  put(host, el("section", { class: "card stack step", "aria-label": "Step" },
    el("div", { class: `verdict ${helps ? "good" : "warn"}`, role: "status" },
      el("h2", {}, title),
      el("p", {}, `${lead}${reason}.`),
      record.added && el("p", {}, `${trial.words.charAt(0).toUpperCase()}${trial.words.slice(1)}.`)),
    el("p", { class: "big-step" },
      heldOut(trial),
      el("span", { class: "soft small" }, `mean absolute error of a ride on held-out days, ${signedShare(fall / 100)}; measurement noise alone ${quantity(trial.noise_floor_kwh, "kWh", 4)}`)),
    el("div", { class: "row" }, actions),
    (trial.warnings ?? []).map((line) => el("p", { class: "warn" }, line.replace(/^\*: /, ""))),
    el("div", {}, el("h3", {}, helps ? "The error falls towards the noise" : "Error before and after each step"), record.after.picture && picture(record.after.picture)),
    el("details", { class: "same" }, el("summary", {}, "Checks: all terms refitted, other vehicles, final hold-out days"), el("p", { class: "note small" }, "Mean absolute error of a ride, by other ways to hold rides out."), errorTable(trial), el("p", { class: "note small" }, "In the numbers above, the coefficient of the effect is fitted without the held-out days. ± is half of the 95 % interval. The final hold-out days decide nothing.")),
    record.added && el("div", {}, el("h3", {}, "Coefficients before and after"), values),
    live));
  return record.added ? [coefficients(values, [record.before, record.after])] : [];
}
