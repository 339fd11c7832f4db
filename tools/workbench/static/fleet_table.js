// The table of all cars. Only the rows in sight are elements, so that a thousand cars cost little.
// The frame of the table takes arrow keys, Home, End, Page Up, Page Down and Enter.

import { el } from "./dom.js";
import { duration, HIGH_RISK, LOW_RISK, number, risk } from "./format.js";

const ROW_PX = 38;
const SPARE = 4;
const NARROW = "(max-width: 48rem)";
const LEAST_KWH = 0.05;

const CAR = { key: "car", title: "Car", value: (socket, row) => socket.names[row], text: true };
const ERROR = { key: "off", title: "Error", unit: "%", wide: true, value: errorOf, show: (value) => number(value) };
const STATE = { key: "state", title: "State", text: true, value: stateOf, show: (value, socket, row) => (value === "silent" ? `silent ${duration(socket.value("age", row))}` : value) };
const TROUBLE = { key: "reserve_risk", value: troubleOf };
// What some columns show beyond their declaration.
const SPECIAL = {
  soc_pct: { bar: true },
  reserve_risk: { show: (value) => risk(value), tone: (value) => (value > HIGH_RISK ? "bad" : value >= LOW_RISK ? "warn" : "") },
  ride_distance_km: { show: (value, socket, row) => (socket.is("riding", row) ? number(value, 1) : "–") },
};
const SHOWN = { all: "All cars", riding: "In a ride", charging: "Charging", risky: "At risk", silent: "Silent", "shift over": "Shift over" };

// Whether a car is at risk; a silent one is if it was more likely than not to end below its reserve.
export function isAtRisk(socket, row) {
  return socket.value("reserve_risk", row) >= (socket.is("silent", row) ? HIGH_RISK : LOW_RISK);
}

// How much a car needs attention: its risk in whole percent, so that rows keep their places while it hardly changes.
function troubleOf(socket, row) {
  if (socket.is("silent", row) && !isAtRisk(socket, row)) return socket.is("riding", row) ? LOW_RISK : 0;
  const share = socket.value("reserve_risk", row);
  return share >= LOW_RISK ? Math.round(100 * share) / 100 : 0;
}

function errorOf(socket, row) {
  const measured = socket.value("ride_energy_measured_kwh", row);
  return measured > LEAST_KWH ? (100 * (socket.value("ride_energy_predicted_kwh", row) - measured)) / measured : NaN;
}

function stateOf(socket, row) {
  if (socket.is("over", row) && !socket.is("riding", row)) return "shift over";
  if (socket.is("silent", row)) return "silent";
  if (socket.is("charging", row)) return "charging";
  return socket.is("riding", row) ? "riding" : "idle";
}

function showInterval(name, digits) {
  return (value, socket, row) => {
    const [low, high] = [socket.value(`${name}_p05`, row), socket.value(`${name}_p95`, row)];
    if (!Number.isFinite(value) || !Number.isFinite(low)) return number(value, digits);
    return [number(value, digits), el("span", { class: "soft" }, ` ${number(low, digits)}–${number(high, digits)}`)];
  };
}

// The columns of the table: the declared ones, those for narrow windows first and those of the ride after the outlook.
function makeColumns(declared) {
  const shown = declared.filter(({ title }) => title).map(({ name, title, unit, digits, narrow, isInterval }) => ({
    key: name, title, unit, wide: !narrow,
    show: isInterval ? showInterval(name, digits) : (value) => number(value, digits), ...SPECIAL[name],
  }));
  const place = ({ key, wide }) => (wide ? 1 + key.startsWith("ride_") + 2 * ["speed", "faults"].includes(key) : 0);
  shown.sort((a, b) => place(a) - place(b));
  shown.splice(shown.findLastIndex(({ key }) => key.startsWith("ride_")) + 1, 0, ERROR);
  return [CAR, ...shown, STATE];
}

const byName = (a, b) => a.localeCompare(b, "en", { numeric: true });
const valueOf = (column, socket, row) => (column.value ? column.value(socket, row) : socket.value(column.key, row));

export function makeFleetTable(socket, context) {
  return new FleetTable(socket, context);
}

class FleetTable {
  constructor(socket, context) {
    this.socket = socket;
    this.context = context;
    this.all = makeColumns(context.session.columns);
    this.state = {};
    this.order = [];
    this.narrow = matchMedia(NARROW);
    this.count = el("span", { class: "badge" });
    this.filter = el("input", { type: "search", placeholder: "Name of a car", "aria-label": "Filter by name", autocomplete: "off",
      oninput: () => context.navigate({ filter: this.filter.value }, { replace: true }) });
    this.shown = el("select", { "aria-label": "Cars to show", onchange: () => context.navigate({ show: this.shown.value }, { replace: true }) },
      Object.entries(SHOWN).map(([key, words]) => el("option", { value: key }, words)));
    this.head = el("tr", { "aria-rowindex": 1 });
    this.body = el("tbody");
    this.table = el("table", { class: "fleet-table" },
      el("caption", { class: "hidden" }, "All cars with their newest values"), el("thead", {}, this.head), this.body);
    this.frame = el("div", { class: "table-frame fleet-frame", tabindex: 0, role: "region",
      "aria-label": "Cars. Arrow keys choose a car, Enter opens it." }, this.table);
    this.frame.addEventListener("scroll", () => this.fill(), { passive: true });
    this.frame.addEventListener("keydown", (event) => this.press(event));
    this.narrow.addEventListener("change", () => this.build());
    this.element = el("section", { class: "card flush span-12 table-card", "aria-labelledby": "table-title" },
      el("div", { class: "card-head table-head" },
        el("h2", { id: "table-title" }, "Cars ", this.count), el("div", { class: "row" }, this.filter, this.shown)),
      this.frame);
    this.build();
  }

  get columns() {
    return this.narrow.matches ? this.all.filter((column) => !column.wide) : this.all;
  }

  // Without a choice, cars at risk come first and all others follow by name.
  get sort() {
    return this.all.find((column) => column.key === this.state.sort) ?? TROUBLE;
  }

  build() {
    this.head.replaceChildren(...this.columns.map((column) => el("th", { scope: "col", class: column.text ? null : "number", "data-key": column.key },
      el("button", { type: "button", class: "quiet sort", onclick: () => this.sortBy(column) },
        column.title, el("span", { class: "unit" }, el("span", { class: "arrow", "aria-hidden": "true" }), column.unit ?? "")))));
    this.body.replaceChildren();
    this.update(this.state);
  }

  sortBy(column) {
    const isSame = this.state.sort === column.key;
    const order = isSame ? (this.isFalling ? "up" : "down") : column.key === "reserve_risk" || column.key === "off" ? "down" : "up";
    this.context.navigate({ sort: column.key, order }, { replace: true });
    this.context.announce(`Sorted by ${column.title}, ${order === "down" ? "largest first" : "smallest first"}`);
  }

  get isFalling() {
    return this.sort === TROUBLE || this.state.order === "down";
  }

  update(state) {
    this.state = state;
    if (document.activeElement !== this.filter) this.filter.value = state.filter ?? "";
    this.shown.value = state.show in SHOWN ? state.show : "all";
    for (const cell of this.head.children) {
      const isSorted = this.sort !== TROUBLE && cell.dataset.key === this.sort.key;
      if (isSorted) cell.setAttribute("aria-sort", this.isFalling ? "descending" : "ascending");
      else cell.removeAttribute("aria-sort");
    }
    this.toReveal = state.car;
    this.draw();
  }

  isShown(row) {
    const { socket, state } = this;
    if (state.filter && !socket.names[row].toLowerCase().includes(state.filter.toLowerCase())) return false;
    if (!state.show || state.show === "all") return true;
    return state.show === "risky" ? isAtRisk(socket, row) : stateOf(socket, row) === state.show;
  }

  draw() {
    const { socket, sort } = this;
    const rows = [];
    for (let row = 0; row < socket.size; row++) if (this.isShown(row)) rows.push(row);
    const values = new Map(rows.map((row) => [row, valueOf(sort, socket, row)]));
    const sign = this.isFalling ? -1 : 1;
    rows.sort((a, b) => {
      const [x, y] = [values.get(a), values.get(b)];
      if (sort.text) return sign * byName(x, y) || a - b;
      return Number.isNaN(x) - Number.isNaN(y) || sign * (x - y) || byName(socket.names[a], socket.names[b]);
    });
    this.order = rows;
    this.count.textContent = rows.length === socket.size ? number(rows.length) : `${number(rows.length)} of ${number(socket.size)}`;
    this.table.setAttribute("aria-rowcount", rows.length + 1);
    this.fill();
    if (this.toReveal) this.reveal();
  }

  // Write the rows in sight; spacers stand for those above and below.
  fill() {
    const inSight = Math.ceil(this.frame.clientHeight / ROW_PX) + 2 * SPARE;
    const first = Math.max(0, Math.min(Math.floor(this.frame.scrollTop / ROW_PX) - SPARE, this.order.length - inSight));
    const rows = this.order.slice(first, first + inSight);
    this.pad("above", first * ROW_PX);
    while (this.lines.length > rows.length) this.lines.at(-1).remove();
    while (this.lines.length < rows.length) this.body.insertBefore(this.makeLine(), this.spacer("below"));
    this.pad("below", Math.max(0, this.order.length - first - rows.length) * ROW_PX);
    const { lines } = this;
    rows.forEach((row, i) => this.write(lines[i], row, first + i));
    if (!this.order.length) this.showNothing();
    else this.body.querySelector(".nothing")?.remove();
  }

  get lines() {
    return [...this.body.querySelectorAll("tr.car")];
  }

  spacer(place) {
    let line = this.body.querySelector(`tr.${place}`);
    if (!line) {
      line = el("tr", { class: `spacer ${place}`, "aria-hidden": "true" }, el("td", { colspan: this.all.length }));
      if (place === "above") this.body.prepend(line);
      else this.body.append(line);
    }
    return line;
  }

  pad(place, height) {
    const cell = this.spacer(place).firstChild;
    cell.style.height = `${height}px`;
    cell.parentElement.hidden = height === 0;
  }

  makeLine() {
    const line = el("tr", { class: "car", onclick: (event) => {
      if (event.target.tagName !== "A") this.context.navigate({ car: line.dataset.car }, { replace: true });
    } });
    line.append(...this.columns.map((column) => el("td", { class: column.text ? null : "number" },
      column.key === "car" ? el("a", {}) : column.bar ? [el("span", { class: "meter", "aria-hidden": "true" }, el("span")), el("span")] : null)));
    return line;
  }

  write(line, row, place) {
    const { socket } = this;
    const car = socket.names[row];
    if (line.dataset.car !== car) {
      line.dataset.car = car;
      const link = line.firstChild.firstChild;
      link.textContent = car;
      link.href = this.context.link({ page: "car", path: car });
    }
    line.setAttribute("aria-rowindex", place + 2);
    line.classList.toggle("chosen", car === this.state.car);
    this.columns.forEach((column, i) => {
      if (column.key === "car") return;
      const cell = line.children[i];
      const value = valueOf(column, socket, row);
      const shown = column.show(value, socket, row);
      const target = column.bar ? cell.lastChild : cell;
      if (Array.isArray(shown)) target.replaceChildren(...shown);
      else if (target.textContent !== shown) target.textContent = shown;
      if (column.bar) {
        cell.firstChild.firstChild.style.width = `${Math.max(0, Math.min(100, value || 0))}%`;
        cell.firstChild.className = `meter ${value < 20 ? "low" : value < 40 ? "middle" : ""}`;
      }
      if (column.tone) cell.className = `number ${column.tone(value)}`;
    });
  }

  showNothing() {
    if (this.body.querySelector(".nothing")) return;
    const words = this.socket.size ? "No car matches. Clear the filter to see all." : "No car has sent anything yet.";
    this.body.prepend(el("tr", { class: "nothing" }, el("td", { colspan: this.all.length, class: "soft" }, words)));
  }

  reveal() {
    const place = this.order.findIndex((row) => this.socket.names[row] === this.state.car);
    if (place < 0) return;
    this.toReveal = null;
    const top = place * ROW_PX;
    const { scrollTop, clientHeight } = this.frame;
    if (top < scrollTop) this.frame.scrollTop = top;
    else if (top + 2 * ROW_PX > scrollTop + clientHeight) this.frame.scrollTop = top + 2 * ROW_PX - clientHeight;
    this.fill();
  }

  press(event) {
    if (event.target !== this.frame || !this.order.length) return;
    const place = this.order.findIndex((row) => this.socket.names[row] === this.state.car);
    const page = Math.max(1, Math.floor(this.frame.clientHeight / ROW_PX) - 2);
    const last = this.order.length - 1;
    const goals = {
      ArrowDown: place + 1, ArrowUp: place < 0 ? last : place - 1, PageDown: place + page, PageUp: place - page, Home: 0, End: last,
    };
    if (event.key === "Enter" && this.state.car) this.context.navigate({ page: "car", path: this.state.car });
    else if (event.key in goals) {
      const goal = Math.min(last, Math.max(0, goals[event.key]));
      this.context.navigate({ car: this.socket.names[this.order[goal]] }, { replace: true });
    } else return;
    event.preventDefault();
  }
}
