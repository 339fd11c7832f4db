// What the pages of the loop share: the model in the address, waiting for jobs, commands to copy, the next step.

import { el, empty, failed, loading } from "./dom.js";

export const query = (parameters) => {
  const given = Object.entries(parameters).filter(([, value]) => value !== undefined && value !== null && value !== "");
  return new URLSearchParams(given).toString();
};

// Replace the children of a node; false, null and undefined are left out.
export function put(node, ...children) {
  node.replaceChildren(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
}

// A command line that does the same, with a button that copies it.
export function command(lines, words = "The same on the command line") {
  const text = [lines].flat().filter(Boolean).join("\n");
  if (!text) return null;
  const button = el("button", {
    type: "button",
    class: "quiet small",
    onclick: async () => {
      try {
        await navigator.clipboard.writeText(text);
        button.textContent = "Copied";
      } catch {
        getSelection().selectAllChildren(shown);
        button.textContent = "Selected; press Ctrl+C";
      }
      setTimeout(() => { button.textContent = "Copy"; }, 2000);
    },
  }, "Copy");
  const shown = el("code", {}, text);
  return el("details", { class: "same" }, el("summary", {}, words), el("div", { class: "command" }, shown, button));
}

// One line that says what to do next, with a link.
export function nextStep(words, href, link) {
  return el("p", { class: "next-step" }, el("strong", {}, "Next: "), `${words} `, href && el("a", { href }, link));
}

// The progress of a job, with a button that cancels it.
export function progress(words, { share, words: step, cancel } = {}) {
  const known = share !== null && share !== undefined;
  return el(
    "div",
    { class: "job", role: "status" },
    el("p", {}, `${words}${step ? `: ${step}` : ""}`),
    el("progress", { max: 1, value: known ? share : null, "aria-label": words }),
    cancel && el("button", { type: "button", onclick: cancel }, "Cancel"),
  );
}

// Wait until the rides are read, show how far that is, then return what was read; null where a page cannot be drawn.
export async function openWorkspace(root, context) {
  let workspace = await context.get("/workspace");
  while (!workspace.ready && !workspace.problem && workspace.job) {
    root.replaceChildren(el("div", { class: "card" }, progress("Reading the rides", workspace.job)));
    await new Promise((resolve) => setTimeout(resolve, 200));
    workspace = await context.get("/workspace");
  }
  if (workspace.ready) return workspace;
  const example = el("code", { class: "command" }, "socast serve recordings/autumn.mcap");
  const problem = workspace.problem || "The workbench was started without rides, so there is nothing to compare with measurements.";
  root.replaceChildren(empty(workspace.problem ? "The rides cannot be used" : "No rides yet", problem, el("p", {}, "Start it with a recording, or with a folder of tables:"), example));
  return null;
}

// Return a record whose work may have to be done first: the server then answers with a job.
export async function getReady(root, context, path, words) {
  let record = await context.get(path);
  while (record.job) {
    await context.follow(record.job, (now) => { root.replaceChildren(progress(words, now)); });
    record = await context.get(path);
  }
  return record;
}

// Draw a part of a page, with its states of loading and failure.
export async function fill(root, words, context, draw) {
  root.replaceChildren(loading(words));
  try {
    await draw();
  } catch (error) {
    if (error.name === "AbortError" || context.signal.aborted) return;
    root.replaceChildren(failed(error, () => fill(root, words, context, draw)));
  }
}

export function heading(title, words, ...more) {
  return el("div", { class: "page-head" }, el("div", {}, el("h1", {}, title), el("p", {}, words)), ...more);
}

// A choice of the model that the page shows, if there are several.
export function modelChoice(workspace, state, context) {
  const names = workspace.models;
  const chosen = names.includes(state.model) ? state.model : workspace.first;
  const absent = state.model && state.model !== chosen && el("span", { class: "chip warn", role: "status" }, `model ${state.model} is not here`);
  if (names.length < 2) return el("div", { class: "row" }, absent, el("span", { class: "chip" }, `model ${chosen}`));
  const select = el("select", { id: "model", onchange: () => context.navigate({ model: select.value }) },
    names.map((name) => el("option", { value: name, selected: name === chosen }, name)));
  return el("div", { class: "row" }, absent, el("label", { for: "model" }, "Model"), select);
}

export function field(words, id, control) {
  control.id = id;
  return el("div", { class: "field" }, el("label", { for: id }, words), control);
}

export function choice(options, chosen, onchange) {
  const select = el("select", { onchange: () => onchange(select.value) },
    options.map(([value, words]) => el("option", { value, selected: value === (chosen ?? "") }, words)));
  return select;
}

// The parts of a filter in the address: [{key, value}] from "ambient_c:-10..0;vehicle_id:taxi-1|taxi-2".
export function readFilter(text) {
  return (text ?? "").split(";").filter(Boolean).map((part) => {
    const at = part.indexOf(":");
    return { key: part.slice(0, at), value: part.slice(at + 1) };
  });
}

export function writeFilter(parts) {
  return parts.map(({ key, value }) => `${key}:${value}`).join(";");
}

// Return a filter with one of its parts replaced, or removed where the value is null.
export function changeFilter(text, key, value) {
  const others = readFilter(text).filter((part) => part.key !== key);
  return writeFilter(value === null ? others : [...others, { key, value }]);
}

export function nameFilter({ key, value }, columns) {
  if (key === "where") return value.split("|").map(decodeURIComponent).join(", ");
  const column = columns.find((each) => each.key === key);
  if (!column?.number) return `${column?.label ?? key}: ${value.split("|").map(decodeURIComponent).join(", ")}`;
  const [low, high] = value.split("..");
  const show = (end) => end.replace("-", "\u2212");
  const range = low && high ? `${show(low)} to ${show(high)}` : low ? `from ${show(low)}` : `up to ${show(high)}`;
  return `${column.label}: ${range} ${column.unit}`;
}

// The filter as chips that remove themselves, and a form to add a condition.
export function filterBar(text, columns, values, onchange) {
  const parts = readFilter(text);
  const chips = parts.map((part) => el("button", {
    type: "button",
    class: "chip filter-chip",
    "aria-label": `Remove the filter ${nameFilter(part, columns)}`,
    onclick: () => onchange(changeFilter(text, part.key, null)),
  }, nameFilter(part, columns), el("span", { "aria-hidden": "true" }, "✕")));
  const form = el("form", { class: "row filter-form" });
  const inputs = el("span", { class: "row" });
  const select = el("select", { id: "filter-column", "aria-label": "Column to filter by" }, columns.map((column) => el("option", { value: column.key }, column.label)));
  const drawInputs = () => {
    const column = columns.find((each) => each.key === select.value);
    if (column.number) {
      const low = el("input", { type: "number", step: "any", class: "short", placeholder: "from", "aria-label": `${column.label} from` });
      const high = el("input", { type: "number", step: "any", class: "short", placeholder: "to", "aria-label": `${column.label} to` });
      inputs.replaceChildren(low, high, el("span", { class: "soft small" }, column.unit));
      form.read = () => (low.value || high.value ? `${low.value}..${high.value}` : null);
    } else {
      const names = [...new Set(values?.[column.key] ?? [])].filter(Boolean).sort();
      const chosen = el("select", { "aria-label": column.label }, names.map((name) => el("option", { value: name }, name)));
      inputs.replaceChildren(chosen);
      form.read = () => encodeURIComponent(chosen.value);
    }
  };
  select.addEventListener("change", drawInputs);
  drawInputs();
  form.append(select, inputs, el("button", { type: "submit" }, "Filter"));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const value = form.read();
    if (value) onchange(changeFilter(text, select.value, value));
  });
  const clear = parts.length > 1 && el("button", { type: "button", class: "quiet", onclick: () => onchange("") }, "Remove all");
  return el("div", { class: "filters stack" }, form, (chips.length > 0) && el("div", { class: "row" }, chips, clear));
}
