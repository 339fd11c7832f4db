// The form "Did a repair help?" of a car on the page Condition, and its answer: what `socast before-after` says.

import { chart } from "./chart.js";
import { el } from "./dom.js";
import { count, number, quantity, signed, signedShare } from "./format.js";
import { choice, command, field, progress, put } from "./loop.js";

const EXAMPLE = "2018-11-10,2018-11-16\n2018-11-24,2018-11-30";
export const READ_ONLY = "This workbench is read-only and compares nothing; start socast serve without --read-only.";

let made = 0;

// Return {node, fill(given), destroy()} of a car; `fill` opens the form and takes {vehicles, at, what}. Of a date and
// days on, the fields of the one that is not chosen are hidden and not sent.
export function makeBeforeAfter(car, model, context) {
  let plot = null;
  let busy = false;
  made += 1;
  const readOnly = context.session.read_only;
  const label = (words, name, control) => field(words, `repair-${made}-${name}`, control);
  const input = (words, name, attributes) => label(words, name, el("input", { name, autocomplete: "off", ...attributes }));
  const text = el("textarea", { name: "days_on", rows: 4, spellcheck: "false", placeholder: EXAMPLE, "aria-describedby": `repair-${made}-help` });
  const file = el("input", { type: "file", accept: ".csv,text/csv", onchange: async () => { if (file.files.length) text.value = await file.files[0].text(); } });
  const ofDate = el("fieldset", { class: "question-fields" },
    input("Date [UTC]", "at", { type: "date" }),
    input("Last date [UTC], if not all", "until", { type: "date" }));
  const ofDays = el("fieldset", { class: "question-fields" },
    label("Days on [UTC], a line for each time", "days", text),
    label("or a file of them", "file", file),
    el("p", { class: "note small", id: `repair-${made}-help` }, "First and last day on, both included. Lines vehicle_id,begin,end below a header of these names are of single cars; then no vehicle need be named above."));
  const way = choice([["date", "since a date"], ["days", "on some days, not on others"]], "date", () => show());
  const show = () => [ofDate, ofDays].forEach((part) => {
    part.hidden = (part === ofDays) !== (way.value === "days");
    part.disabled = part.hidden;
  });
  show();
  const submit = el("button", { type: "submit", class: "primary" }, "Compare before and after");
  const answer = el("div", { class: "answer" });
  const form = el("form", { class: "question", novalidate: true, "aria-label": `Repair of ${car}`, onsubmit: (event) => {
    event.preventDefault();
    if (!busy) ask();
  } },
  el("fieldset", { class: "stack", disabled: readOnly },
    el("div", { class: "question-fields" },
      input("Vehicles, with commas", "vehicles", { value: car }),
      input("What was done", "what", { placeholder: "new tyres" }),
      label("It was done", "way", way)),
    ofDate, ofDays, submit));
  const node = el("details", { class: "same repair" }, el("summary", {}, "Did a repair help?"), readOnly && el("p", { class: "note small" }, READ_ONLY), form, answer);

  const clear = () => { plot?.destroy(); plot = null; };

  async function ask() {
    const say = (...children) => { clear(); put(answer, children); };
    busy = true;
    submit.setAttribute("aria-disabled", "true");
    try {
      const given = Object.fromEntries(new FormData(form));
      const record = await context.job("/before-after", { model, ...given }, (now) => say(progress("Comparing before and after", now)));
      if (!node.isConnected) return; // the page was left meanwhile
      say();
      drawAnswer(record);
      context.announce(record.words[0]);
    } catch (error) {
      say(el("p", { class: "bad", role: "alert" }, error.message));
    } finally {
      busy = false;
      submit.removeAttribute("aria-disabled");
    }
  }

  function drawAnswer({ report, words, placebos, commands }) {
    const { change } = report;
    const facts = !change ? [] : [
      ["change of consumption", signedShare(change.change)],
      ["90 % interval", `${signed(100 * change.ci90[0], 1)} to ${signedShare(change.ci90[1])}`],
    ];
    const place = el("div", {});
    put(answer,
      el("dl", { class: "figures small-figures" }, facts.map(([name, value]) => el("div", {}, el("dt", {}, name), el("dd", {}, value)))),
      words.map((line) => el("p", {}, line)),
      placebos && place,
      command(commands));
    if (placebos) plot = chart(place, describePlacebos(placebos, change));
  }

  return {
    node,
    fill(given) {
      way.value = "date";
      show();
      for (const name of ["vehicles", "what", "at", "until"]) form.elements[name].value = given[name] ?? "";
      clear();
      put(answer);
      node.open = true;
      submit.focus();
    },
    destroy: clear,
  };
}

function describePlacebos({ counts, edges_pct: edges }, change) {
  const ends = counts.flatMap((_, i) => [edges[i], edges[i + 1]]);
  const high = counts.flatMap((each) => [each, each]);
  const tell = (i) => {
    const at = Math.min(i, counts.length - 1);
    return [`${number(edges[at], 1)} to ${quantity(edges[at + 1], "%", 1)}`, count(counts[at], "placebo campaign")];
  };
  return {
    title: "What chance does: placebo campaigns by their estimate",
    summary: `The estimate is ${signedShare(change.change)}.`,
    heading: "What chance does",
    height: 200,
    x: { label: "Estimated change", unit: "%", domain: [edges[0], edges.at(-1)] },
    y: { label: "Placebo campaigns [1]", zero: true },
    layers: [
      { type: "area", x: ends, low: high.map(() => 0), high, colour: "--blue", opacity: 0.3 },
      { type: "stairs", x: edges, y: [...counts, counts.at(-1)], colour: "--blue", name: "placebo campaigns", thick: 1.5, tell },
      { type: "rule", x: 100 * change.change, colour: "--vermilion", dash: "5 3", thick: 2, name: "estimate" },
    ],
  };
}
