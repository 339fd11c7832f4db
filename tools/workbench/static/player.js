// The bar above the pages of the fleet: it controls a replay, or tells what a live service sends.

import { el } from "./dom.js";
import { clock, day, number, zoneName } from "./format.js";
import { command } from "./loop.js";

const SPEEDS = [1, 10, 60, 300, "max"];

// Draw the bar into a new element; `socket` tells the state, and commands go to POST /player.
export function makePlayerBar(socket, context) {
  const bar = el("section", { class: "player card", "aria-label": "Replay" });
  const banner = el("p", { class: "banner", role: "alert", hidden: true });
  const status = el("p", { class: "player-state small soft", role: "status" });
  const parts = {};
  let mode = null;
  let isDragging = false;

  const send = async (body) => {
    try {
      socket.source = await context.post("/player", body);
      draw();
    } catch (error) {
      status.textContent = error.message;
      status.classList.add("bad");
    }
  };

  function buildReplay() {
    const locked = context.session.read_only;
    parts.play = el("button", { type: "button", class: "primary play", disabled: locked, onclick: () => {
      send({ action: socket.source.playing ? "pause" : "play" });
    } });
    parts.time = el("output", { class: "player-time" });
    parts.slider = el("input", {
      type: "range", min: 0, max: 1000, step: 1, value: 0, "aria-label": "Time of the recording", disabled: locked,
      oninput: () => { isDragging = true; parts.time.replaceChildren(...timeWords(sliderTime())); },
      onchange: () => { isDragging = false; send({ time_s: sliderTime() }); },
    });
    parts.speed = el("select", { "aria-label": "Speed", disabled: locked, onchange: () => {
      send({ speed: parts.speed.value === "max" ? "max" : Number(parts.speed.value) });
    } }, SPEEDS.map((speed) => el("option", { value: speed }, speed === "max" ? "max" : `${speed}×`)));
    parts.command = el("div", { class: "player-command" });
    parts.model = el("p", { class: "small soft" });
    bar.replaceChildren(
      el("div", { class: "player-row" }, parts.play, parts.time, parts.slider, parts.speed), status, parts.model, parts.command);
  }

  function buildLive() {
    parts.time = el("output", { class: "player-time" });
    parts.live = el("span", { class: "chip good" }, el("span", { class: "pulse", "aria-hidden": "true" }), "Live");
    bar.setAttribute("aria-label", "Live service");
    bar.replaceChildren(el("div", { class: "player-row" }, parts.live, parts.time, status));
  }

  const sliderTime = () => {
    const { begin_s: begin, end_s: end } = socket.source;
    return begin + ((end - begin) * Number(parts.slider.value)) / 1000;
  };

  const timeWords = (seconds) => [el("strong", {}, clock(seconds, true)), el("span", { class: "soft small" }, ` ${day(seconds)} ${zoneName(seconds)}`)];

  function draw() {
    const source = socket.source;
    if (!source) return;
    if (mode !== source.mode) {
      mode = source.mode;
      (mode === "live" ? buildLive : buildReplay)();
    }
    status.classList.remove("bad");
    if (mode === "live") {
      parts.time.replaceChildren(...(source.time_s ? timeWords(source.time_s) : ["no sample yet"]));
      const refused = Object.entries(source.refused).map(([cause, count]) => `, ${number(count)} ${cause.replace("_", " ")}`);
      status.textContent = `${number(source.received)} messages from ${source.endpoint}${source.dropped ? `, ${number(source.dropped)} dropped` : ""}${refused.join("")}`;
      return;
    }
    const action = source.playing ? "Pause" : source.at_end ? "Play again" : "Play";
    if (parts.play.dataset.action !== action) {
      parts.play.dataset.action = action;
      parts.play.replaceChildren(el("span", { class: source.playing ? "sign-pause" : "sign-play", "aria-hidden": "true" }), action);
    }
    if (parts.command.dataset.words !== source.command) {
      const isOpen = parts.command.querySelector("details")?.open;
      parts.command.dataset.words = source.command;
      parts.command.replaceChildren(command(source.command));
      if (isOpen) parts.command.querySelector("details").open = true;
    }
    parts.model.textContent = source.model ? `Forecasts by the model ${source.model.split("/")[0]}. ${source.advice ?? ""}` : "";
    parts.model.title = source.model;
    const speed = String(source.speed ?? "max");
    if (parts.speed.value !== speed && document.activeElement !== parts.speed) parts.speed.value = speed;
    if (!isDragging) {
      const share = (source.time_s - source.begin_s) / Math.max(1e-9, source.end_s - source.begin_s);
      parts.slider.value = Math.round(1000 * share);
      parts.time.replaceChildren(...timeWords(source.time_s));
    }
    parts.slider.setAttribute("aria-valuetext", `${clock(source.time_s, true)} ${zoneName(source.time_s)} on ${day(source.time_s)}`);
    status.textContent = source.seeking ? "Computing the state at this time" : source.at_end ? "End of the recording" : "";
    status.hidden = !status.textContent;
  }

  function drawLink() {
    bar.classList.toggle("lost", !socket.isOpen);
    if (!socket.isOpen) {
      status.hidden = false;
      status.textContent = "The connection to the server is lost; trying again";
    } else draw();
  }

  function drawProblem() {
    banner.hidden = !socket.problem;
    banner.textContent = socket.problem ? `What is shown is old: ${socket.problem}` : "";
    if (parts.live) parts.live.hidden = !banner.hidden;
  }

  socket.addEventListener("source", draw);
  socket.addEventListener("problem", drawProblem);
  socket.addEventListener("link", drawLink);
  draw();
  drawProblem();
  return {
    bar: el("div", {}, banner, bar),
    // Seek by seconds of the recording, for keys.
    skip: (seconds) => socket.source?.mode === "replay" &&
      send({ time_s: Math.min(Math.max(socket.source.time_s + seconds, socket.source.begin_s), socket.source.end_s) }),
    stop: () => {
      socket.removeEventListener("source", draw);
      socket.removeEventListener("problem", drawProblem);
      socket.removeEventListener("link", drawLink);
    },
  };
}
