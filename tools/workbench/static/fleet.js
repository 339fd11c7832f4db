// The page "Fleet": the replay or live bar, figures, the map, alarms, and the table of all cars.
// State in the address: sort, order, filter, show, color, car.

import { el, empty, failed } from "./dom.js";
import { isAtRisk, makeFleetTable } from "./fleet_table.js";
import { HIGH_RISK, LOW_RISK, number, quantity, risk } from "./format.js";
import { nextStep } from "./loop.js";
import { FleetMap, toX, toY } from "./map.js";
import { makePlayerBar } from "./player.js";
import { FleetSocket } from "./socket.js";

const COLORS = {
  soc: {
    title: "State of charge",
    classes: [
      { upTo: 20, color: "--vermilion", words: "under 20 %" },
      { upTo: 40, color: "--orange", words: "20 to 40 %" },
      { upTo: 60, color: "--green", words: "40 to 60 %" },
      { upTo: Infinity, color: "--blue", words: "over 60 %" },
    ],
    of: (socket, row) => socket.value("soc_pct", row),
  },
  risk: {
    title: "Risk of ending below the reserve",
    classes: [
      { upTo: LOW_RISK, color: "--blue", words: "under 5 %" },
      { upTo: HIGH_RISK, color: "--orange", words: "5 to 50 %" },
      { upTo: Infinity, color: "--vermilion", words: "over 50 %" },
    ],
    of: (socket, row) => socket.value("reserve_risk", row),
  },
};
const UNKNOWN = { color: "--line-strong", words: "unknown" };

export function mount(root, state, context) {
  if (!context.session.fleet) {
    root.replaceChildren(empty(
      "No fleet to show",
      "Start the workbench with a recording to replay it, or with --live to watch a running service.",
      context.session.given.length ? nextStep("tables were given; see how well a model predicts", "#/rides", "their rides") : "",
      el("code", { class: "command" }, "socast serve recordings/shift.mcap"),
      el("code", { class: "command" }, "socast serve --live --connect tcp/127.0.0.1:7447")));
    return { update() {}, unmount() {} };
  }
  return new FleetPage(root, state, context);
}

class FleetPage {
  constructor(root, state, context) {
    this.context = context;
    this.state = state;
    this.socket = new FleetSocket();
    this.player = makePlayerBar(this.socket, context);
    this.figures = makeFigures();
    this.map = new FleetMap({
      label: "Map of the fleet. Arrow keys pan, plus and minus zoom, 0 shows the whole fleet. The table lists the same cars.",
      tiles: context.session.tiles,
      onselect: (car) => this.select(car),
    });
    this.legend = el("ul", { class: "legend" });
    this.colors = el("div", { class: "segments", role: "group", "aria-label": "Colour of the cars on the map" },
      Object.entries({ soc: "Charge", risk: "Risk" }).map(([key, words]) => el("button", {
        type: "button", "data-color": key, onclick: () => context.navigate({ color: key }, { replace: true }),
      }, words)));
    this.alarms = el("ul", { class: "alarms" });
    this.alarmCount = el("span", { class: "badge" });
    this.table = makeFleetTable(this.socket, context);
    this.live = el("p", { class: "hidden", "aria-live": "polite" });
    root.append(
      el("h1", { class: "hidden" }, "Fleet"),
      this.player.bar,
      el("div", { class: "grid fleet-grid" },
        el("section", { class: "card span-8 map-card", "aria-labelledby": "map-title" },
          el("div", { class: "card-head" }, el("h2", { id: "map-title" }, "Map"), this.colors),
          this.map.element, this.legend),
        el("div", { class: "span-4 stack side" },
          el("section", { class: "card", "aria-label": "Figures of the fleet" }, this.figures.element),
          el("section", { class: "card alarm-card", "aria-labelledby": "alarm-title" },
            el("div", { class: "card-head" }, el("h2", { id: "alarm-title" }, "Alarms and findings"), this.alarmCount),
            el("div", { class: "alarm-frame", tabindex: 0, role: "region", "aria-labelledby": "alarm-title" }, this.alarms)),
          context.session.given.length > 0 && nextStep("see how well the model predicts", "#/rides", "the rides")),
        this.table.element),
      this.live);
    this.handlers = { frame: () => this.drawFrame(), alarms: () => this.drawAlarms() };
    for (const [name, act] of Object.entries(this.handlers)) this.socket.addEventListener(name, act);
    this.drawAlarms();
    this.loadDensity();
    this.update(state);
  }

  update(state) {
    const before = this.state;
    this.state = state;
    for (const button of this.colors.children) {
      button.setAttribute("aria-pressed", button.dataset.color === this.color);
    }
    this.legend.replaceChildren(...[...COLORS[this.color].classes, UNKNOWN].map(({ color, words }) =>
      el("li", {}, el("span", { class: `swatch swatch${color}`, "aria-hidden": "true" }), words)),
      el("li", {}, el("span", { class: "swatch swatch-square", "aria-hidden": "true" }), "charging"),
      el("li", {}, el("span", { class: "swatch swatch-diamond", "aria-hidden": "true" }), "high risk"));
    this.table.update(state);
    this.drawFrame();
    if (state.car && state.car !== before.car) this.describeSelected();
  }

  unmount() {
    clearTimeout(this.again);
    this.player.stop();
    this.socket.close();
    this.map.close();
  }

  get color() {
    return this.state.color in COLORS ? this.state.color : "soc";
  }

  select(car) {
    this.context.navigate({ car }, { replace: true });
  }

  describeSelected() {
    const row = this.socket.rows.get(this.state.car);
    if (row === undefined) return;
    const value = (name) => this.socket.value(name, row);
    this.live.textContent = `${this.state.car}: charge ${quantity(value("soc_pct"), "%", 1)}, at the end of the shift ` +
      `${quantity(value("soc_end_of_shift_pct"), "%")}, risk ${risk(value("reserve_risk"))}, range ${quantity(value("range_km"), "km")}`;
    this.map.showPoint(this.map.points.find((point) => point.name === this.state.car));
  }

  drawFrame() {
    const { socket } = this;
    const { classes, of } = COLORS[this.color];
    const points = [];
    for (let row = 0; row < socket.size; row++) {
      const latitude = socket.value("latitude", row);
      if (!Number.isFinite(latitude)) continue;
      const value = of(socket, row);
      const chosen = Number.isFinite(value) ? classes.find((each) => value < each.upTo) : UNKNOWN;
      const isBad = socket.value("reserve_risk", row) > HIGH_RISK;
      points.push({
        name: socket.names[row],
        x: toX(socket.value("longitude", row)),
        y: toY(latitude),
        color: chosen.color,
        shape: isBad ? "diamond" : socket.is("charging", row) ? "square" : "circle",
        big: socket.is("riding", row) || isBad,
      });
    }
    this.map.selected = this.state.car ?? null;
    this.map.setPoints(points);
    this.figures.draw(socket);
    this.table.draw();
  }

  drawAlarms() {
    const { alarms } = this.socket;
    this.alarmCount.textContent = number(alarms.total);
    this.alarmCount.hidden = !alarms.total;
    const items = alarms.list.map((alarm) => el("li", { class: `alarm alarm-${alarm.kind}` },
      el("span", { class: `chip ${alarm.level}` }, describeValue(alarm)),
      el("span", { class: "alarm-words" },
        alarm.car ? el("a", { href: this.context.link({ page: "car", path: alarm.car }) }, alarm.car) : null,
        alarm.car ? " " : null, alarm.words)));
    if (alarms.total > items.length) items.push(el("li", { class: "soft small" }, `and ${number(alarms.total - items.length)} more: show "At risk" or "Silent" in the table`));
    this.alarms.replaceChildren(...(items.length ? items : [el("li", { class: "soft" },
      "None now. Cars that may end below their reserve, cars that fall silent in a ride, and findings of the nightly diagnosis appear here.")]));
  }

  async loadDensity() {
    try {
      const density = await this.context.get("/fleet/density");
      this.map.setDensity(density);
      const isGrowing = this.socket.source?.mode !== "replay" || !density.count.length;
      if (isGrowing) this.again = setTimeout(() => this.loadDensity(), density.count.length ? 60_000 : 1000);
    } catch (error) {
      if (error.name !== "AbortError") this.legend.after(failed(error));
    }
  }
}

function describeValue({ kind, value }) {
  if (kind === "reserve") return `risk ${risk(value)}`;
  if (kind === "silent") return `silent ${number(value)} min`;
  return `finding, ${risk(value)} sure`;
}

function makeFigures() {
  const names = { cars: "cars", riding: "in a ride", charging: "charging", risky: "at risk", lowest: "lowest" };
  const values = Object.fromEntries(Object.keys(names).map((key) => [key, el("dd", {}, "–")]));
  const element = el("dl", { class: "figures small-figures" },
    Object.entries(names).map(([key, words]) => el("div", {}, el("dt", {}, words), values[key])));
  return {
    element,
    draw(socket) {
      const counts = { cars: socket.size, riding: 0, charging: 0, risky: 0 };
      let lowest = Infinity;
      for (let row = 0; row < socket.size; row++) {
        counts.riding += socket.is("riding", row);
        counts.charging += socket.is("charging", row);
        counts.risky += isAtRisk(socket, row);
        const soc = socket.value("soc_pct", row);
        if (soc < lowest) lowest = soc;
      }
      for (const [key, count] of Object.entries(counts)) values[key].textContent = number(count);
      values.lowest.textContent = quantity(lowest, "%");
      values.risky.classList.toggle("bad", counts.risky > 0);
    },
  };
}
