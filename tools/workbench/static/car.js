// The page of a car: charge so far and the fan to the end of the shift, plan, ride in progress, quality, and questions.
// State in the address: km, min, up, down of a question.

import { chart } from "./chart.js";
import { el, empty, failed, loading } from "./dom.js";
import { clock, day, duration, getZone, HIGH_RISK, interval, LOW_RISK, number, quantity, risk, signed, zoneName } from "./format.js";
import { LegSchedule, makeClockMarks } from "./leg_schedule.js";
import { makePlayerBar } from "./player.js";
import { FleetSocket } from "./socket.js";

const REFRESH_MS = { replay: 1000, live: 2500 };
const QUESTION = { km: "distance_km", min: "duration_s", up: "gained_m", down: "lost_m" };
const CAUSES = {
  repaired_time: "times repaired", rejected_speed: "speeds rejected", duplicate: "duplicates", gap: "gaps", out_of_range: "values out of range",
};
const TONES = { YES: "good", NO: "bad" };

export function mount(root, state, context) {
  if (!context.session.fleet || !state.path) {
    root.replaceChildren(empty("No car to show", "Choose a car on the page Fleet.", el("a", { class: "button", href: "#/fleet" }, "Go to Fleet")));
    return { update() {}, unmount() {} };
  }
  return new CarPage(root, state, context);
}

class CarPage {
  constructor(root, state, context) {
    this.context = context;
    this.state = state;
    this.car = state.path;
    this.socket = new FleetSocket();
    this.player = makePlayerBar(this.socket, context);
    this.body = el("div", {}, loading(`Loading ${this.car}`));
    root.append(this.player.bar, this.body);
    this.onFrame = () => this.refresh();
    this.socket.addEventListener("frame", this.onFrame);
    this.refresh();
  }

  update(state) {
    this.state = state;
    this.form?.fill(state);
    this.ask();
  }

  unmount() {
    this.isGone = true;
    clearTimeout(this.timer);
    this.player.stop();
    this.socket.close();
    for (const each of Object.values(this.charts ?? {})) each.destroy();
  }

  // Load the record, at most once per interval.
  refresh() {
    if (this.isGone || this.timer || document.hidden) return;
    const mode = this.socket.source?.mode ?? "replay";
    this.timer = setTimeout(() => { this.timer = null; if (this.isStale) this.refresh(); this.isStale = false; }, REFRESH_MS[mode]);
    this.load();
  }

  async load() {
    try {
      const record = await this.context.get(`/cars/${encodeURIComponent(this.car)}`);
      if (this.isGone) return;
      if (!this.parts) this.build();
      this.draw(record);
      if (!this.hasAsked) { this.hasAsked = true; this.ask(); }
    } catch (error) {
      if (this.isGone || error.name === "AbortError") return;
      if (!this.parts) {
        this.body.replaceChildren(error.status === 404
          ? empty(`${this.car} has sent nothing so far`, "A car appears here with its first sample. Play on, or choose another car.",
            el("a", { class: "button", href: "#/fleet" }, "Go to Fleet"))
          : failed(error, () => this.load()));
      }
    }
  }

  build() {
    this.parts = Object.fromEntries(["chips", "figures", "fan", "fanWords", "legs", "ride", "terms", "quality", "rides"].map((name) => [name, el("div")]));
    const { parts } = this;
    parts.figures = el("dl", { class: "figures" });
    this.form = makeQuestion(this.state, (given) => this.context.navigate(given));
    this.answer = el("div", { class: "answer", "aria-live": "polite" });
    const card = (title, span, ...children) => el("section", { class: `card ${span}`, "aria-label": title }, el("h2", {}, title), children);
    this.body.replaceChildren(
      el("div", { class: "page-head car-head" },
        el("a", { href: this.context.link({ page: "fleet", car: this.car }) }, "← Fleet"), el("h1", {}, this.car), parts.chips),
      el("div", { class: "grid" },
        el("section", { class: "card", "aria-label": "Newest values" }, parts.figures),
        el("div", { class: "stack span-8" },
          card("Charge until the end of the shift", "", parts.fan, parts.fanWords),
          card("Plan", "", parts.legs)),
        el("div", { class: "stack span-4" },
          card("Can it take a ride?", "", this.form.element, this.answer),
          card("Repaired or rejected in this ride", "", parts.quality)),
        card("Ride in progress", "span-7", parts.ride),
        card("Predicted energy by term", "span-5", parts.terms),
        card("Rides that have ended", "", parts.rides)));
    this.charts = { fan: chart(parts.fan, null), ride: chart(parts.ride, null) };
  }

  draw(record) {
    const { parts } = this;
    const { values, outlook } = record;
    const age = record.age_s;
    const state = record.is_shift_over && !values.riding ? ["", "shift over"] : age > 600 ? ["warn", `silent ${duration(age)}`] : values.charging ? ["good", "charging"] : values.riding ? ["", "in a ride"] : ["", "between rides"];
    parts.chips.className = "row";
    parts.chips.replaceChildren(
      el("span", { class: `chip ${state[0]}` }, state[1]), record.vehicle_model ? el("span", { class: "chip" }, record.vehicle_model) : "",
      record.ride_id ? el("span", { class: "chip" }, `ride ${record.ride_id}`) : "");
    this.drawFigures(values, outlook);
    this.drawFan(record);
    parts.legs.replaceChildren(this.makeLegs(record));
    this.drawRide(record);
    parts.terms.replaceChildren(makeTerms(record, this.socket.source?.mode));
    parts.quality.replaceChildren(el("dl", { class: "figures small-figures" }, Object.entries(CAUSES).map(([key, words]) =>
      el("div", {}, el("dt", {}, words), el("dd", {}, number(record.quality[key] ?? 0))))));
    parts.rides.replaceChildren(makeRides(record.rides));
  }

  drawFigures(values, outlook) {
    const figure = (words, text, tone, detail) => el("div", {}, el("dt", {}, words, detail && el("span", {}, ` ${detail}`)), el("dd", { class: tone }, text));
    const declared = this.context.session.columns.filter(({ label }) => label).sort((a, b) => b.narrow - a.narrow);
    const tone = values.reserve_risk > HIGH_RISK ? "bad" : values.reserve_risk >= LOW_RISK ? "warn" : "";
    const special = {
      soc_pct: (label) => figure(label, quantity(values.soc_pct, "%", 1), "", values.soc_sd_pct ? `(± ${number(2 * values.soc_sd_pct, 1)})` : ""),
      reserve_risk: (label) => figure(label, risk(values.reserve_risk), tone),
    };
    this.parts.figures.replaceChildren(
      ...declared.map(({ name, label, unit, digits, isInterval }) => special[name]?.(label) ?? figure(
        label, quantity(values[name], unit, digits), "", isInterval ? range(values[`${name}_p05`], values[`${name}_p95`], digits) : "")),
      figure(`shift ends, ${zoneName(outlook?.shift_end_s ?? values.time)}`, clock(outlook?.shift_end_s)),
      figure("usable capacity", quantity(outlook?.usable_capacity_kwh, "kWh", 1)));
  }

  drawFan({ history, outlook, values, why_no_outlook: whyNot }) {
    if (this.charts.fan.active) return; // a person reads its values
    const known = history.time.length > 0;
    if (!known && !outlook) {
      this.parts.fanWords.replaceChildren(el("p", { class: "soft" }, whyNot ?? "No forecast so far."));
      return;
    }
    const ahead = outlook ? new LegSchedule(outlook, Boolean(values.riding)) : null;
    const last = ahead?.points.at(-1)?.time ?? history.time.at(-1);
    const domain = [history.time[0] ?? outlook.time_s, Math.max(last, (history.time.at(-1) ?? outlook.time_s) + 600)];
    const layers = [];
    if (ahead) {
      const { points } = ahead;
      const column = (name) => points.map((point) => point[name]);
      for (const charge of ahead.charges) layers.push({ type: "span", from: charge.from, to: charge.to, colour: "--green", name: charge === ahead.charges[0] ? "planned charge" : undefined });
      layers.push(
        { type: "area", x: column("time"), y: column("mean"), low: column("low"), high: column("high"), colour: "--sky", opacity: 0.32, name: "nine outcomes in ten" },
        { type: "line", x: column("time"), y: column("mean"), colour: "--blue", dash: "6 4", name: "expected" },
        { type: "means", x: column("time"), y: column("mean"), colour: "--blue", size: 3.5, tell: (i) => tellPoint(points[i]) });
    }
    layers.push(
      { type: "line", x: history.time, y: history.soc_pct, colour: "--blue", thick: 2.5, name: "charge so far" });
    if (outlook) {
      layers.push(
        { type: "rule", y: outlook.reserve_soc_pct, colour: "--vermilion", dash: "2 4", thick: 2, name: "reserve" },
        { type: "rule", x: outlook.time_s, colour: "--line-strong" });
    }
    const end = outlook?.soc_end_of_shift_pct;
    const summary = `Charge now ${quantity(values.soc_pct, "%", 1)}.` + (end ? ` At the end of the shift at ${clock(outlook.shift_end_s)} ${zoneName(outlook.shift_end_s)}: ${interval(end.mean, end.p05, end.p95, "%")}. Reserve ${quantity(outlook.reserve_soc_pct, "%")}.` : "");
    this.charts.fan.update({
      title: "Charge of the car over time", summary, height: 330, layers,
      x: { label: `time of day, ${zoneName(domain[0])}`, domain, marks: (room) => makeClockMarks(domain, room) }, y: { label: "state of charge", unit: "%", domain: [0, 100] },
    });
    const why = whyNot ?? outlook?.why_not;
    this.parts.fanWords.replaceChildren(...(why ? [el("p", { class: "note small" }, `End of the shift not known: ${why}.`)] : []));
  }

  makeLegs({ outlook, values }) {
    const waiting = outlook?.waiting_energy_kwh ?? null;
    const besides = outlook?.next_charge ? "waiting, heating and empty ways to the next charge" : "waiting, heating, empty ways and the way home";
    if (!outlook?.legs.length) {
      const rest = waiting === null ? "" : ` Ahead are ${quantity(waiting, "kWh", 2)} for ${besides}.`;
      return el("p", { class: "soft" }, `No leg of a plan is ahead.${rest}`);
    }
    const ahead = new LegSchedule(outlook, Boolean(values.riding));
    const rows = outlook.legs.map((leg, i) => {
      const isCharge = leg.charge_to_soc_pct !== undefined && leg.charge_to_soc_pct !== null;
      return el("tr", {}, el("td", { class: "number" }, number(i + 1)), el("td", {}, isCharge ? `charge to ${quantity(leg.charge_to_soc_pct, "%")}` : "ride"),
        el("td", { class: "number" }, `≈ ${clock(ahead.begins[i])}`),
        el("td", { class: "number" }, isCharge ? "–" : number(leg.distance_km, 1)), el("td", { class: "number" }, number(leg.duration_s / 60)),
        el("td", { class: "number" }, bounded(leg.energy_kwh, 2)), el("td", { class: "number" }, bounded(leg.soc_pct, 0)));
    });
    if (waiting !== null) {
      rows.push(el("tr", {}, el("td", {}), el("td", { colspan: 4 }, besides),
        el("td", { class: "number" }, number(waiting, 2)), el("td", {})));
    }
    return el("div", {}, el("div", { class: "table-frame legs-frame", tabindex: 0, role: "region", "aria-label": "Legs of the plan" }, el("table", {},
      el("thead", {}, el("tr", {}, ["", "Leg", `Begins, ${zoneName(outlook.time_s)}`, "km", "min", "Energy, kWh", "Charge after, %"].map((words, i) =>
        el("th", { scope: "col", class: i === 1 ? null : "number" }, words || el("span", { class: "hidden" }, "Number"))))), el("tbody", {}, rows))),
    el("p", { class: "note small" }, "A plan does not say when legs begin: the waits are spread evenly. The risk counts them; the range is that of driving on without a pause. In brackets: nine outcomes in ten."));
  }

  drawRide({ history, values }) {
    if (this.charts.ride.active) return;
    const now = history.ride.at(-1);
    const rows = history.time.map((_, i) => i).filter((i) => history.ride[i] === now && history.ride_energy_predicted_kwh[i] !== null);
    if (!values.riding || rows.length < 1) {
      this.charts.ride.destroy();
      this.charts.ride = chart(this.parts.ride, null);
      this.parts.ride.replaceChildren(el("p", { class: "soft" }, "The car is between rides."));
      this.hasRide = false;
      return;
    }
    if (!this.hasRide) {
      this.charts.ride.destroy();
      this.charts.ride = chart(this.parts.ride, null);
      this.hasRide = true;
    }
    const begin = values.time - values.ride_duration_s;
    const minutes = [0, ...rows.map((i) => (history.time[i] - begin) / 60)];
    const tell = (name) => (i) => [name, `${quantity([0, ...rows.map((at) => history[`ride_energy_${name}_kwh`][at])][i], "kWh", 2)} after ${number(minutes[i], 1)} min`];
    this.charts.ride.update({
      title: "Energy of the ride in progress", height: 250,
      summary: `Predicted ${quantity(values.ride_energy_predicted_kwh, "kWh", 2)}, measured ${quantity(values.ride_energy_measured_kwh, "kWh", 2)} after ${duration(values.ride_duration_s)} and ${quantity(values.ride_distance_km, "km", 1)}.`,
      x: { label: "since the ride began", unit: "min", zero: true }, y: { label: "energy", unit: "kWh", zero: true },
      layers: [
        { type: "line", x: minutes, y: [0, ...rows.map((i) => history.ride_energy_measured_kwh[i])], colour: "--ink-soft", thick: 2.5, name: "measured" },
        { type: "line", x: minutes, y: [0, ...rows.map((i) => history.ride_energy_predicted_kwh[i])], colour: "--blue", dash: "6 4", name: "predicted" },
        { type: "means", x: minutes.slice(-1), y: [values.ride_energy_predicted_kwh], colour: "--blue", tell: () => tell("predicted")(minutes.length - 1) },
        { type: "means", x: minutes.slice(-1), y: [values.ride_energy_measured_kwh], colour: "--ink-soft", tell: () => tell("measured")(minutes.length - 1) },
      ],
    });
  }

  async ask() {
    if (!this.parts) return;
    const given = Object.fromEntries(Object.entries(QUESTION).map(([key, name]) => [name, this.state[key]]));
    if (given.duration_s) given.duration_s = String(60 * Number(given.duration_s));
    if (!Object.values(given).some(Boolean)) {
      this.answer.replaceChildren();
      return;
    }
    const parameters = new URLSearchParams([...Object.entries(given).filter(([, value]) => value), ["zone", getZone()]]);
    try {
      const answer = await this.context.get(`/cars/${encodeURIComponent(this.car)}/answer?${parameters}`);
      this.answer.replaceChildren(
        el("p", { class: "answer-line" }, el("span", { class: `chip ${TONES[answer.word] ?? "warn"}` }, answer.word), ` ${answer.sentence}.`),
        el("dl", { class: "pairs" }, answer.figures.map(({ name, text }) => [el("dt", {}, name), el("dd", {}, text)])),
        ...(answer.command ? [el("p", { class: "note small" }, "The same on the command line:"), el("code", { class: "command" }, answer.command)]
          : [el("p", { class: "note small" }, "On the command line, socast ask answers for a live service only.")]));
    } catch (error) {
      if (error.name !== "AbortError") this.answer.replaceChildren(el("p", { class: "bad", role: "alert" }, error.message));
    }
  }
}

function range(low, high, digits) {
  return low === null ? "" : `(${number(low, digits)} to ${number(high, digits)})`;
}

function bounded(value, digits) {
  if (!value) return "–";
  return [number(value.mean, digits), el("span", { class: "soft" }, ` (${number(value.p05, digits)} to ${number(value.p95, digits)})`)];
}

function tellPoint(point) {
  return [point.words, interval(point.mean, point.low, point.high, "%"), `${clock(point.time)} ${zoneName(point.time)}`];
}

// The form of a question; its fields are part of the address.
function makeQuestion(state, onask) {
  const field = (key, words, unit, most, required) => {
    const id = `question-${key}`;
    return el("div", { class: "field" }, el("label", { for: id }, `${words} [${unit}]`),
      el("input", { id, name: key, type: "number", inputmode: "decimal", min: 0, max: most, step: "any", required, autocomplete: "off" }));
  };
  const element = el("form", { class: "question", onsubmit: (event) => {
    event.preventDefault();
    onask(Object.fromEntries(new FormData(element)));
  } },
  el("div", { class: "question-fields" }, field("km", "Distance", "km", 1000, true), field("min", "Duration", "min", 1440, true),
    field("up", "Climb", "m", 5000), field("down", "Descent", "m", 5000)),
  el("button", { type: "submit", class: "primary" }, "Ask"));
  const fill = (given) => {
    for (const key of Object.keys(QUESTION)) element.elements[key].value = given[key] ?? "";
  };
  fill(state);
  return { element, fill };
}

function makeTerms({ parts, values }, mode) {
  if (!parts) {
    return el("p", { class: "soft" }, mode === "live" ? "A live service publishes the total only; replay its recording to see the terms." : "The car is between rides.");
  }
  const rows = [...Object.entries(parts).map(([name, energy]) => [name.replaceAll("_", " "), energy, "term"]),
    ["predicted", values.ride_energy_predicted_kwh, "sum"], ["measured", values.ride_energy_measured_kwh, "measured"]];
  const known = rows.map(([, energy]) => energy).filter(Number.isFinite);
  const low = Math.min(0, ...known);
  const span = Math.max(0.01, Math.max(0, ...known) - low);
  const bar = (energy, kind) => {
    const mark = el("span", { class: `term-bar ${kind}` });
    mark.style.left = `${(100 * (Math.min(0, energy ?? 0) - low)) / span}%`;
    mark.style.width = `${(100 * Math.abs(energy ?? 0)) / span}%`;
    return el("td", { class: "term-cell", "aria-hidden": "true" }, el("span", { class: "term-track" }, mark));
  };
  return el("table", { class: "terms" }, el("caption", { class: "hidden" }, "Energy of the ride in progress by term of the model"),
    el("thead", { class: "hidden" }, el("tr", {}, el("th", { scope: "col" }, "Term"), el("th", { scope: "col" }, "Energy, kWh"))),
    el("tbody", {}, rows.map(([name, energy, kind]) => el("tr", { class: kind }, el("th", { scope: "row" }, name),
      el("td", { class: "number" }, quantity(energy, "kWh", 2)), bar(energy, kind)))));
}

function makeRides(rides) {
  if (!rides.length) return el("p", { class: "soft" }, "No ride has ended so far.");
  const rows = [...rides].reverse().map((ride) => el("tr", {}, el("td", {}, `${day(ride.start_s)} ${clock(ride.start_s)}`), el("td", {}, ride.ride_id ?? "–"),
    el("td", { class: "number" }, number(ride.distance_km, 1)), el("td", { class: "number" }, number(ride.duration_s / 60)),
    el("td", { class: "number" }, number(ride.predicted_kwh, 2)), el("td", { class: "number" }, number(ride.energy_kwh, 2)),
    el("td", { class: "number" }, signed(ride.error_pct)), el("td", { class: "soft" }, (ride.unfit_reason ?? "").replaceAll("_", " "))));
  return el("div", { class: "table-frame rides-frame", tabindex: 0, role: "region", "aria-label": "Rides that have ended" }, el("table", {},
    el("thead", {}, el("tr", {}, [`Start, ${zoneName(rides[0]?.start_s)}`, "Ride", "km", "min", "Predicted, kWh", "Measured, kWh", "Error, %", "Unfit for training"].map((words, i) =>
      el("th", { scope: "col", class: i > 1 && i < 7 ? "number" : null }, words)))), el("tbody", {}, rows)));
}
