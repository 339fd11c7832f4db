// Files of the user's own effects: read again when they change on disk; nothing is typed or executed in the browser.

import { el } from "./dom.js";
import { number } from "./format.js";
import { command, progress, put } from "./loop.js";

const EVERY_MS = 1500;

export function mountOwnEffects(root, { context, workspace, changed }) {
  let timer = null;
  let ended = false;
  let last = "";

  function draw(record, now) {
    const { files, lacking } = record;
    if (!files.length) {
      put(root, el("details", { class: "card" },
        el("summary", {}, "Your own effects"),
        el("p", {}, "An effect that the library lacks is a function in a Python file. Write it in your editor; the workbench reads it again when you save."),
        command(["socast effects new my_effects.py", `socast serve ${workspace.given.join(" ")} --effects my_effects.py`], "How to begin")));
      return;
    }
    put(root, el("section", { class: "card", "aria-label": "Your own effects" },
      el("h2", {}, "Your own effects"),
      el("p", { class: "note small" }, "Save a file in your editor; it is read again at once, and the tables are made again."),
      now && progress("Reading your effects", now),
      lacking.length > 0 && el("p", { class: "warn", role: "alert" }, `${lacking.join(", ")} is not in the given tables and is not tested. Make them again with socast tables --effects, or start the workbench with the recordings.`),
      files.map(drawFile)));
  }

  function drawFile(file) {
    const { error } = file;
    return el("div", { class: "own-file" },
      el("h3", {}, file.file, " ", error ? el("span", { class: "chip bad" }, "error") : el("span", { class: "chip good" }, "read")),
      error && el("p", { class: "bad", role: "alert" }, error.message),
      error?.lines.length > 0 && el("pre", { class: "source-lines", tabindex: "0" }, error.lines.map((line, i) => {
        const place = error.first + i;
        return el("span", { class: place === error.line ? "wrong" : null }, `${number(place).padStart(4)}  ${line}\n`);
      })),
      error && file.effects.length > 0 && el("p", { class: "note small" }, "The effects read before are kept until the file is right:"),
      el("ul", {}, file.effects.map((effect) => el("li", {}, el("a", { href: context.link({ page: "causes", effect: effect.name }) }, effect.name.replaceAll("_", " ")), " ", el("span", { class: "formula" }, effect.formula)))),
      command(file.command));
  }

  // Look at the files. Another window may have made the server read them, so what counts is the version of the tables.
  async function look() {
    let record;
    try {
      record = await context.get("/own-effects");
      if (ended) return;
      if (record.job?.name.includes("files of effects")) {
        last = "";
        draw(record, record.job);
        await context.follow(record.job, (now) => !ended && draw(record, now)).catch(() => null);
        if (!ended) look();
        return;
      }
    } catch {
      if (!ended) timer = setTimeout(look, 4 * EVERY_MS);
      return;
    }
    if (record.tables_version !== workspace.tables_version) {
      context.announce("Your effects were read again.");
      changed();
      return;
    }
    if (JSON.stringify(record) !== last) {
      last = JSON.stringify(record);
      draw(record);
      if (record.files.some((file) => file.error)) context.announce("A file of effects has an error; see the line.");
    }
    if (record.files.length) timer = setTimeout(look, EVERY_MS);
  }

  look();
  return {
    destroy() {
      ended = true;
      clearTimeout(timer);
    },
  };
}
