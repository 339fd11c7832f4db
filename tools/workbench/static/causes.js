// The page "What is missing": candidates with their probabilities, what each is, and the step that adds one.

import { chart } from "./chart.js";
import { el } from "./dom.js";
import { count, number, quantity, signed } from "./format.js";
import { command, fill, getReady, heading, modelChoice, nextStep, openWorkspace, progress, put, query } from "./loop.js";
import { mountOwnEffects } from "./own-effects.js";
import { bare, plain } from "./scales.js";
import { drawStep, heldOut, unitOf } from "./step.js";

const LIKELY = 0.005;
const WORDS = { "not there": "the data do not show it", "not identifiable beside the model": "the model can imitate it", "not in the data": "its signal was not recorded", "not in the tables": "the tables lack its column", "zero in these drives": "it is zero in these drives" };

export function mount(root, first, context) {
  let state = first;
  let view = null;

  async function draw() {
    view?.destroy();
    view = null;
    await fill(root, "Reading the rides", context, async () => {
      const workspace = await openWorkspace(root, context);
      if (!workspace) return;
      view = makeView(root, { state, workspace, context, redraw: draw });
      await view.draw();
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

function makeView(root, { state: first, workspace, context, redraw }) {
  let state = first;
  const model = workspace.models.includes(state.model) ? state.model : workspace.first;
  const readOnly = context.session.read_only;
  let record = null;
  let all = false;
  let plots = [];
  let busy = false;
  const next = el("div", {});
  const step = el("div", {});
  const verdict = el("section", { class: "card", "aria-label": "Result" });
  const list = el("div", {});
  const detail = el("div", {});
  const cars = el("div", {});
  const own = el("div", {});
  const copied = el("div", {});
  const diagnosis = el("div", { class: "stack" }, verdict,
    el("div", { class: "grid top" },
      el("section", { class: "card span-5", "aria-label": "Candidates" }, el("h2", {}, "Candidates"), list),
      el("section", { class: "card span-7", "aria-label": "Candidate" }, detail)),
    cars);
  const ownView = mountOwnEffects(own, { context, workspace, changed: redraw });

  put(root, 
    heading("What is missing", "Every effect of the library is judged for itself. The probability says how likely the model lacks it, whatever else it lacks.", modelChoice(workspace, state, context)),
    el("div", { class: "stack" }, next, step, diagnosis, own, copied),
  );

  const nameOf = (cause) => cause.words ?? cause.name.replaceAll("_", " ");
  const isKnown = (name) => record.causes.some((cause) => cause.name === name);
  const chosen = () => (isKnown(state.effect) ? state.effect : null) ?? record.recommended ?? record.causes.find((cause) => cause.effect)?.name;
  const addable = () => !busy && !readOnly;

  function drawNext() {
    if (record.recommended && readOnly) put(next, nextStep(`read why ${record.recommended.replaceAll("_", " ")} is named.`));
    else if (record.recommended) put(next, nextStep(`read why ${record.recommended.replaceAll("_", " ")} is named, then press “Add ${record.recommended.replaceAll("_", " ")}”.`));
    else put(next, nextStep(record.next.join(" "), context.link({ page: "models", model: state.model }), "See the models"));
  }

  function drawVerdict() {
    const lines = record.verdict_sentences;
    put(verdict, 
      el("h2", {}, record.title),
      lines.map((line) => el("p", {}, line)),
      el("p", {}, record.next.join(" ")),
      record.held_out.rides > 0 && el("p", { class: "note small" }, `${count(record.held_out.rides, "ride")} of ${count(record.held_out.dates.length, "date")} are set aside; an added effect is evaluated on them.`),
      el("details", { class: "same" }, el("summary", {}, "What remains"), record.remainder.map((line) => el("p", { class: "small" }, line.replaceAll("->", "→")))),
    );
  }

  function drawList() {
    const likely = record.causes.filter((cause) => cause.probability >= LIKELY || cause.credible || cause.name === chosen());
    const shown = all ? record.causes : likely;
    const rows = shown.map((cause) => {
      const bar = el("span", { class: "fill" });
      bar.style.width = `${100 * (cause.probability ?? 0)}%`;
      const share = cause.probability === null ? "–" : cause.probability < LIKELY ? `<1\u202f%` : quantity(100 * cause.probability, "%");
      return el("button", {
        type: "button",
        class: cause.credible ? "credible" : null,
        "aria-pressed": cause.effect ? String(cause.name === chosen()) : null,
        disabled: !cause.effect,
        title: cause.tried ? `${cause.tried.outcome}: ${cause.tried.reason}` : (WORDS[cause.status] ?? cause.status),
        onclick: () => context.navigate({ effect: cause.name }),
      }, el("span", {}, nameOf(cause), cause.tried && el("span", { class: "chip warn" }, cause.tried.outcome)), el("span", { class: "track" }, bar), el("span", { class: "value" }, share));
    });
    put(list, 
      el("p", { class: "note small" }, record.missing.length ? "Blue: missing effects, and those that would explain the same." : "Blue: no effect is named."),
      el("div", { class: "bars" }, rows),
      el("button", { type: "button", class: "quiet", "aria-expanded": String(all), onclick: () => { all = !all; drawList(); } }, all ? "Show the likely ones only" : `Show all ${record.causes.length}`),
    );
  }

  // Cars that deviate from their siblings or changed: a cause that is missing in some cars, or since some day.
  function drawCars() {
    if (!record.deviations.length) return;
    put(cars, el("section", { class: "card stack", "aria-label": "Cars and changes" },
      el("h2", {}, "Cars and changes"),
      record.deviations.map((one) => el("div", { class: "card-head" },
        el("div", {}, one.sentences.map((line, i) => el("p", { class: i ? "note small" : null }, line)), command(one.command)),
        one.name && el("button", { type: "button", disabled: !addable(), onclick: () => add(one.name, one.scope) }, `Add ${one.name.replaceAll("_", " ")} for ${one.who}`)))));
  }

  async function drawDetail() {
    const name = chosen();
    if (!name) {
      put(detail, el("p", { class: "note" }, "There is no candidate."));
      return;
    }
    await fill(detail, `Reading ${name}`, context, async () => {
      const found = await context.get(`/effects/${encodeURIComponent(name)}?${query({ model })}`);
      plots.forEach((plot) => plot.destroy());
      plots = [];
      const { effect } = found;
      const cause = record.causes.find((each) => each.name === effect.name || each.name === name) ?? {};
      const missing = record.missing.find((each) => each.effect === name);
      const inModel = cause.status === "in the model";
      const button = el("button", { type: "button", class: name === record.recommended ? "primary" : null, id: "add", disabled: !addable() || inModel, onclick: () => add(missing?.name ?? name, missing?.scope ?? []) }, `Add ${name.replaceAll("_", " ")}`);
      const picture = el("div", {});
      const unit = unitOf(effect.unit);
      const fact = (words, value) => value && [el("dt", {}, words), el("dd", {}, value)];
      const link = (other) => [el("a", { href: context.link({ ...state, page: "causes", effect: other }) }, other.replaceAll("_", " ")), " "];
      put(detail, 
        el("div", { class: "card-head" }, el("h2", {}, name.replaceAll("_", " ")), button),
        readOnly && el("p", { class: "note small" }, "This workbench is read-only; start socast serve without --read-only to add an effect."),
        el("p", {}, effect.summary.split(": P = ")[0], ". ", missing && missing.sentences[0].charAt(0).toUpperCase() + missing.sentences[0].slice(1) + "."),
        cause.tried && el("p", { class: "warn" }, `Tried before, ${cause.tried.outcome}: ${cause.tried.reason}.`),
        picture,
        el("dl", { class: "facts" },
          fact("formula", el("span", { class: "formula" }, effect.formula)),
          fact("how it works", found.about),
          fact("coefficient", missing ? `${plain(missing.coefficient.value)} ${unit}, 95 % interval ${plain(missing.coefficient.ci95[0])} to ${plain(missing.coefficient.ci95[1])}; ${missing.coefficient.plausible ? "plausible" : "NOT plausible: it may stand for another cause"}` : null),
          fact("plausible range", `${bare(effect.plausible[0])} to ${bare(effect.plausible[1])} ${unit} (${effect.coefficient})`),
          fact("explains", missing ? `${quantity(100 * missing.gain, "%", 1)} of the squared error on held-out days (95 % interval ${number(100 * missing.gain_ci95[0], 1)} to ${number(100 * missing.gain_ci95[1], 1)}\u202f%)` : null),
          fact("as much as", missing?.equivalents.join(", ")),
          fact("in the ranking", WORDS[cause.status]),
          fact("source", effect.source),
          fact("confused with", effect.confused_with.length ? effect.confused_with.map(link) : null),
          fact("shown by", effect.shown_by)),
        command([found.command, missing?.command ?? found.add_command]),
      );
      if (found.partial_residual) plots.push(drawPartial(picture, found.partial_residual, name));
      else put(picture, el("p", { class: "note" }, `No picture: ${found.undrawn}.`));
    });
  }

  async function add(name, scope, also = {}) {
    busy = true;
    document.getElementById("add")?.setAttribute("disabled", "");
    put(step, el("section", { class: "card" }, progress(`Adding ${name} to ${model}`)));
    step.scrollIntoView({ block: "center" });
    try {
      const result = await context.job("/add", { model, effect: name, scope, ...also }, (now) => {
        put(step, el("section", { class: "card" }, progress(`Adding ${name} to ${model}`, now)));
      });
      if (context.signal.aborted) return;
      if (result.added) context.use(result.model, model); // first, as it changes the height of the head
      showStep(result, name, scope);
      context.announce(result.added ? `${name} was added; error of a ride on held-out days ${heldOut(result.trial)}.` : `${name} is ${result.trial.outcome}, and was not added: ${result.trial.reason}.`);
    } catch (error) {
      put(step, el("section", { class: "card" }, el("p", { class: "bad", role: "alert" }, error.message), el("button", { type: "button", onclick: () => put(step) }, "Close")));
    } finally {
      busy = false;
      document.getElementById("add")?.removeAttribute("disabled");
    }
  }

  function showStep(result, name, scope) {
    const actions = result.added
      ? [
        el("a", { class: "button primary", href: context.link({ page: "causes", model: result.model }) }, "Is another effect missing?"),
        el("a", { class: "button", href: context.link({ page: "failures", model: result.model }) }, "See where it failed"),
        el("a", { class: "button", href: context.link({ page: "rides", model: result.model }) }, "See the rides"),
        el("a", { class: "button", href: context.link({ page: "models", model: model, with: result.model }) }, "Compare"),
        el("button", { type: "button", onclick: () => undo(result.model) }, "Undo"),
      ]
      : [
        el("button", { type: "button", onclick: () => { put(step); redraw(); } }, "Choose another"),
        result.trial.outcome === "undecided"
          ? el("button", { type: "button", onclick: () => add(name, scope, { even_if_undecided: true }) }, "Add even so")
          : el("button", { type: "button", class: "quiet", onclick: () => add(name, scope, { force: true }) }, "Add it by force"),
      ];
    const live = [result.live_command && command(result.live_command, "Run it as a shadow in service"), command(result.command)];
    drawStep(step, result, { actions, live });
    diagnosis.hidden = result.added; // it is that of the model before the step
    put(next, result.added
      ? nextStep("every page now shows the new model. See whether", context.link({ page: "causes", model: result.model }), "another effect is missing")
      : nextStep(result.trial.outcome === "undecided" ? "the model stays as it is. Give more rides, choose another candidate, or add it even so." : "the effect does not help, so the model stays as it is. Choose another candidate."));
    step.scrollIntoView({ block: "start" });
  }

  async function undo(name) {
    try {
      const { model: before } = await context.post("/undo", { model: name });
      context.use(before);
      put(step, el("section", { class: "card" }, el("p", { role: "status" }, `Undone: ${name} is removed, and ${before} is as it was.`)));
      diagnosis.hidden = false;
      drawNext();
      context.announce(`Undone. The model is ${before} again.`);
    } catch (error) {
      step.prepend(el("p", { class: "bad", role: "alert" }, error.message));
    }
  }

  return {
    async draw() {
      await fill(verdict, "Diagnosing", context, async () => {
        record = await getReady(verdict, context, `/causes?${query({ model })}`, "Comparing the causes");
        drawNext();
        drawVerdict();
        drawList();
        drawCars();
        put(copied, command(record.command));
      });
      if (record) await drawDetail();
    },
    update(changed) {
      state = changed;
      if (!record) return;
      drawList();
      drawDetail();
    },
    destroy() {
      plots.forEach((plot) => plot.destroy());
      ownView.destroy();
    },
  };
}

function drawPartial(host, partial, name) {
  const unit = partial.per === "km" ? "Wh/km" : "W";
  const words = name.replaceAll("_", " ");
  const ends = [Math.min(0, ...partial.x), Math.max(0, ...partial.x)];
  const say = (values) => (i) => [`${signed(values[i], 1)}\u202f${unit}`, `± ${plain(partial.ci95[i])}`, `${count(partial.windows[i], "window")} on ${count(partial.days[i], "vehicle-day")}`];
  return chart(host, {
    title: `Measured less predicted against the energy of ${words}`,
    summary: `The slope is the coefficient, ${plain(partial.slope)} ${unitOf(partial.unit)}. After it is added, no slope remains.`,
    height: 330,
    x: { label: `Energy of ${words}`, unit: `${unit}${partial.unit === "1" ? "" : ` per ${unitOf(partial.unit)}`}` },
    y: { label: "Measured less predicted", unit },
    layers: [
      { type: "rule", y: 0 },
      { type: "line", x: ends, y: ends.map((x) => x * partial.slope), colour: "--blue", dash: "6 4", name: `slope ${plain(partial.slope)} ${unitOf(partial.unit)}` },
      { type: "means", x: partial.x, y: partial.before, ci: partial.ci95, colour: "--blue", name: "without it", tell: say(partial.before) },
      { type: "means", x: partial.x, y: partial.after, ci: partial.ci95, colour: "--orange", open: () => true, name: "after it is added", tell: say(partial.after) },
    ],
  });
}
