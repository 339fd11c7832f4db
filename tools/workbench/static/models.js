// The page "Models": the tree of versions, the history of each, comparisons, and shadows in service.

import { chart } from "./chart.js";
import { el, picture } from "./dom.js";
import { count, number, quantity, signed } from "./format.js";
import { choice, command, field, fill, heading, nextStep, openWorkspace, progress, put, query } from "./loop.js";
import { coefficients, heldOut, outcomeChip } from "./step.js";

const ORIGINS = { given: "given", fitted: "fitted to these rides", found: "from the folder" };
const VERDICTS = { better: "good", worse: "bad", undecided: "warn" };

export function mount(root, first, context) {
  let state = first;
  let plots = [];
  let workspace = null;

  const clear = () => { plots.splice(0).forEach((plot) => plot.destroy()); };

  async function draw() {
    clear();
    await fill(root, "Reading the models", context, async () => {
      workspace = await openWorkspace(root, context);
      if (!workspace) return;
      const tree = await context.get("/models");
      const name = tree.models.some((each) => each.name === state.model) ? state.model : workspace.first;
      const other = tree.models.some((each) => each.name === state.with) && state.with !== name ? state.with : null;
      const detail = el("div", { class: "span-8 stack" });
      const kept = tree.temporary
        ? "They are kept until the workbench stops. Export one to keep it, or start with --models DIR."
        : `They are kept in ${tree.folder}.`;
      put(root,
        heading("Models", `Every model is a file of coefficients with its history. ${kept}`),
        el("div", { class: "stack" },
          nextStep("choose a model to see its history, or", context.link({ page: "causes", model: name }), `ask what ${name} lacks`),
          el("div", { class: "grid top" },
            el("nav", { class: "card span-4 tree", "aria-label": "Tree of models" }, el("h2", {}, "Versions"), branch(tree.models, "", name),
              tree.models.some((each) => each.effect) && el("p", { class: "note small" }, "Error of a ride on held-out days, before → after the step.")),
            detail)));
      await fill(detail, `Reading ${name}`, context, () => (other ? drawComparison(detail, name, other, tree) : drawModel(detail, name, tree)));
    });
  }

  function branch(models, parent, chosen) {
    const names = models.map((each) => each.name);
    const own = models.filter((each) => (parent ? each.parent === parent : !names.includes(each.parent)));
    if (!own.length) return null;
    return el("ul", {}, own.map((each) => el("li", {},
      el("a", { class: "node", href: context.link({ page: "models", model: each.name }), "aria-current": each.name === chosen ? "true" : null },
        el("span", {}, el("strong", {}, each.effect ? `+ ${each.effect.replaceAll("_", " ")}` : each.name), " ", each.effect ? outcomeChip(each) : el("span", { class: "soft small" }, ORIGINS[each.origin])),
        each.effect && el("span", { class: "soft small" }, heldOut(each)),
        Object.entries(each.tried).map(([outcome, count]) => count > 0 && el("span", { class: "chip warn" }, `${count} ${outcome}`)).filter(Boolean)),
      branch(models, each.name, chosen))));
  }

  async function drawModel(host, name, tree) {
    const record = await context.get(`/models/${encodeURIComponent(name)}`);
    const node = tree.models.find((each) => each.name === name);
    const values = el("div", {});
    const said = el("div", {});
    const others = tree.models.filter((each) => each.name !== name).map((each) => [each.name, each.name]);
    const undo = el("button", {
      type: "button",
      disabled: context.session.read_only || !node.removable,
      title: node.removable ? null : "Only a model to which an effect was added here, and of which no other was made, can be undone.",
      onclick: async () => {
        try {
          const { model } = await context.post("/undo", { model: name });
          context.use(model);
          context.announce(`Undone. ${name} is removed.`);
          context.navigate({ model, with: null });
        } catch (error) { put(said, el("p", { class: "bad", role: "alert" }, error.message)); }
      },
    }, "Undo");
    put(host,
      el("section", { class: "card stack", "aria-label": "Model" },
        el("div", { class: "card-head" }, el("h2", {}, name), el("span", { class: "chip" }, `version ${record.version}`)),
        record.steps.length > 0 && el("p", {}, record.progress.replaceAll("->", "→")),
        el("div", { class: "row" },
          el("a", { class: "button primary", href: context.link({ page: "causes", model: name }) }, "Branch: add an effect to it"),
          el("button", { type: "button", onclick: () => save(name) }, "Export"),
          undo,
          others.length > 0 && field("Compare with", "with", choice([["", "choose…"], ...others], "", (value) => value && context.navigate({ model: name, with: value })))),
        said,
        record.training && el("p", { class: "note small" }, `${record.title}, fitted to ${count(record.training.rides, "ride")} from ${record.training.first_date} to ${record.training.last_date}. File: ${record.file}`)),
      el("section", { class: "card stack", "aria-label": "History" }, el("h2", {}, "History"), record.picture && picture(record.picture), drawSteps(record.steps)),
      el("section", { class: "card stack", "aria-label": "Coefficients" }, el("h2", {}, "Coefficients"), values),
      command(record.commands));
    if (record.coefficients.length) plots.push(coefficients(values, [record]));
  }

  function drawSteps(steps) {
    if (!steps.length) return el("p", { class: "note" }, "No effect has been tried yet. Ask what is missing, and add it.");
    const table = el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Steps" }, el("table", {},
      el("thead", {}, el("tr", {}, ["step", "result", "before, kWh", "after, kWh", "change, kWh"].map((words, i) => el("th", { class: i > 1 ? "number" : null, scope: "col" }, words)))),
      el("tbody", {}, steps.map((step, i) => el("tr", {},
        el("th", { scope: "row" }, `${i + 1}. ${step.effect.replaceAll("_", " ")}${step.scope.length ? ` (${step.scope.join(", ")})` : ""}`),
        el("td", {}, outcomeChip(step), " ", el("span", { class: "small soft wide-only" }, step.action === "add" ? step.words : step.reason)),
        el("td", { class: "number" }, number(step.mae_before_kwh, 4)),
        el("td", { class: "number" }, number(step.mae_after_kwh, 4)),
        el("td", { class: "number" }, `${signed(step.change_kwh?.value, 4)}${step.change_kwh?.ci95 ? ` ± ${number(step.change_kwh.ci95, 4)}` : ""}`))))));
    return [el("p", { class: "note small" }, "Mean absolute error of a ride on held-out days."), table];
  }

  async function drawComparison(host, name, other) {
    const record = await context.get(`/comparison?${query({ model: name, with: other })}`);
    const scatter = el("div", {});
    const values = el("div", {});
    const shadow = el("div", {});
    const gain = record.difference?.difference_kwh;
    const seen = [name, other].filter((each) => workspace.seen.includes(each));
    const words = record.step ? `Adding ${record.step.effect.replaceAll("_", " ")} changed the error of a ride on held-out days: ${heldOut(record.step)}.` : !gain ? "" : Math.abs(gain.value) > (gain.ci95 ?? Infinity)
      ? `${gain.value > 0 ? other : name} is better by ${number(1000 * Math.abs(gain.value), 1)} ± ${number(1000 * gain.ci95, 1)} Wh per ride.`
      : `The difference, ${number(1000 * Math.abs(gain.value), 1)} ± ${number(1000 * (gain.ci95 ?? NaN), 1)} Wh per ride, may be due to chance.`;
    const rows = [name, other].map((each) => {
      const errors = record.models[each];
      return el("tr", {}, el("th", { scope: "row" }, each), el("td", { class: "number" }, number(errors.mae_kwh.value, 4)), el("td", { class: "number wide-only" }, signed(errors.bias_kwh.value, 4)), el("td", { class: "number" }, quantity(100 * errors.relative, "%", 1)), el("td", { class: "number" }, quantity(100 * errors.within[10], "%")));
    });
    const run = el("button", { type: "button", class: "primary", id: "shadow", disabled: context.session.read_only || !workspace.recorded, onclick: start }, "Replay as in service");
    put(host,
      el("section", { class: "card stack", "aria-label": "Comparison" },
        el("div", { class: "card-head" }, el("h2", {}, `${name} and ${other}`), el("a", { class: "button", href: context.link({ page: "models", model: name }) }, "Close")),
        el("p", {}, words),
        el("p", { class: "note small" }, `The table: errors on the same ${number(record.about.rides)} rides${seen.length ? `, in sample for ${seen.join(" and ")}` : ""}.`),
        el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Errors" }, el("table", {},
          el("thead", {}, el("tr", {}, ["model", "error, kWh", "bias, kWh", "of the energy", "within ±10 %"].map((head, i) => el("th", { class: i ? `number ${i === 2 ? "wide-only" : ""}` : null, scope: "col" }, head)))),
          el("tbody", {}, rows))),
        seen.length > 0 && el("p", { class: "note small" }, "In sample: fitted to rides of these dates, on which a model looks better than on others."),
        scatter),
      el("section", { class: "card stack", "aria-label": "Shadow" },
        el("h2", {}, "Run as a shadow"),
        el("p", {}, `In service, ${other} can predict the same rides as ${name} without making forecasts, until it is clear which one is better.`),
        workspace.recorded ? run : el("p", { class: "note" }, "Tables were given; start the workbench with a recording to replay it."),
        shadow,
        command(record.live_command, "The command in service")),
      el("section", { class: "card stack", "aria-label": "Coefficients" }, el("h2", {}, "Coefficients"), values),
      command(record.command));
    const { rides } = record;
    const error = (label) => rides.predicted_kwh[label].map((value, i) => Math.abs(value - rides.measured_kwh[i]));
    const [x, y] = [error(name), error(other)];
    const most = 1.05 * Math.max(...x, ...y);
    plots.push(chart(scatter, {
      title: `Error of each ride with ${name} and with ${other}`,
      summary: `${x.filter((value, i) => y[i] < value).length} of ${x.length} rides lie below the line, where ${other} errs less.`,
      square: true,
      height: 360,
      x: { label: `Error with ${name}`, unit: "kWh", domain: [0, most] },
      y: { label: `Error with ${other}`, unit: "kWh", domain: [0, most] },
      layers: [
        { type: "line", x: [0, most], y: [0, most], colour: "--line-strong", thick: 1.5, name: "equal errors" },
        { type: "points", x, y, colour: "--blue", name: "ride", tell: (i) => [rides.key[i], `${name} ${number(x[i], 3)} kWh`, `${other} ${number(y[i], 3)} kWh`], pick: (i) => context.navigate({ page: "rides", model: other, ride: rides.key[i] }) },
      ],
    }));
    plots.push(coefficients(values, [name, other].map((each) => ({ name: each, coefficients: record.coefficients[each] }))));

    async function start() {
      run.disabled = true;
      try {
        const result = await context.job("/shadow", { model: name, with: other }, (now) => put(shadow, progress("Replaying the recordings", now)));
        put(shadow, drawShadow(result));
      } catch (error) {
        put(shadow, el("p", { class: "bad", role: "alert" }, error.message));
      } finally {
        run.disabled = false;
      }
    }
  }

  function drawShadow(result) {
    return [
      el("p", { class: "note" }, "Running error, ride by ride as in service"),
      el("div", { class: "table-frame", tabindex: "0", role: "region", "aria-label": "Running errors" }, el("table", {},
        el("thead", {}, el("tr", {}, ["model", "rides", "error, kWh", "bias, kWh", "gain over the first, Wh per ride", "verdict"].map((head, i) => el("th", { class: i && i < 5 ? `number ${i === 3 ? "wide-only" : ""}` : null, scope: "col" }, head)))),
        el("tbody", {}, result.models.map((model, i) => {
          const { gain } = model.overall;
          return el("tr", {}, el("th", { scope: "row" }, result.names[i]), el("td", { class: "number" }, number(model.overall.rides)), el("td", { class: "number" }, number(model.overall.mae_kwh, 4)), el("td", { class: "number wide-only" }, signed(model.overall.bias_kwh, 4)),
            el("td", { class: "number" }, gain ? `${signed(1000 * gain.mean_kwh, 1)} (${number(1000 * gain.lower_kwh, 1)} to ${number(1000 * gain.upper_kwh, 1)})` : "–"),
            el("td", {}, gain ? el("span", { class: `chip ${VERDICTS[gain.verdict] ?? ""}` }, gain.verdict) : "first"));
        })))),
      el("p", { class: "note small" }, "The verdict stays valid however often you look. Both models may have seen these rides; only new days in service are a test."),
      command(result.command),
    ];
  }

  async function save(name) {
    const { file, text } = await context.get(`/models/${encodeURIComponent(name)}/file`);
    const address = URL.createObjectURL(new Blob([text], { type: "application/json" }));
    const link = el("a", { href: address, download: file });
    link.click();
    setTimeout(() => URL.revokeObjectURL(address), 1000);
    context.announce(`${file} is downloaded.`);
  }

  draw();
  return {
    update(next) {
      state = next;
      draw();
    },
    unmount: clear,
  };
}
