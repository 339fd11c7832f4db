// Charts with axes, on SVG, with thousands of points on a canvas beneath.
//
// `chart(host, spec)` draws and returns {update(spec), setCursor(x), destroy()}. A spec has
//   title, summary      what the chart shows, in words, for those who do not see it
//   x, y                {label, unit, domain?, names?, zero?, marks?}; `names` makes an axis of categories, `marks(room)`
//                       returns [{value, text}] in place of round numbers
//   layers              [{type, x, y, name?, colour?}], drawn in order; colours are custom properties such as "--blue"
//     line, stairs      y over x; `dash`
//     area              between low and high over x
//     points            y over x; `tints` (a colour of each), `size`, `tell(i)`, `pick(i)`, `faint` (a set of places)
//     means             y over x with half widths `ci`; `tell(i)`, `pick(i)`
//     rule              a line at `x` or `y`; `text` stands above a line at `x` where there is room
//     span              a band between `from` and `to` along x
//   square, height      size; a square chart has equal scales
//   brush               function that receives {x: [low, high], y: [low, high]} or null
//   hover               function that receives x, or null
//   legend              [{name, colour, shape}] or a node; by default the named layers

import { el, svg } from "./dom.js";
import { extent, linear, plain, ticks, tickTexts, token } from "./scales.js";

const NEAR = 24; // pixels within which a pointer finds a point
const ROW = 16; // height of a row of texts above the plot
const MOST_ROWS = 3;
let count = 0;

export function chart(host, spec) {
  const made = new Chart(host);
  made.update(spec);
  return made;
}

class Chart {
  constructor(host) {
    count += 1;
    this.number = count;
    this.active = null;
    this.canvas = el("canvas", { class: "chart-points", "aria-hidden": "true" });
    this.figure = svg("svg", { class: "chart", tabindex: "0", role: "group" });
    this.tip = el("div", { class: "chart-tip", hidden: true });
    this.voice = el("div", { class: "hidden", role: "status" });
    this.plot = el("div", { class: "chart-plot" }, this.canvas, this.figure, this.tip);
    this.legend = el("div", { class: "chart-legend" });
    this.root = el("figure", { class: "chart-frame" }, this.plot, this.legend, this.voice);
    host.replaceChildren(this.root);
    this.listen();
    this.observer = new ResizeObserver(() => {
      const width = Math.round(this.root.clientWidth);
      if (width && width !== this.width) this.draw();
    });
    this.observer.observe(this.root);
    this.onTheme = () => this.draw();
    document.addEventListener("themechange", this.onTheme);
  }

  destroy() {
    this.observer.disconnect();
    document.removeEventListener("themechange", this.onTheme);
    this.root.remove();
  }

  update(spec) {
    this.spec = spec;
    this.active = null;
    this.hideTip();
    this.draw();
  }

  // Layers whose points can be reached one by one.
  get reachable() {
    return this.spec.layers.filter((layer) => layer.tell);
  }

  draw() {
    const { spec } = this;
    if (!spec || !this.root.isConnected) return;
    const width = Math.round(this.root.clientWidth);
    if (!width) return;
    this.width = width;
    const left = spec.y.names ? Math.min(190, 0.4 * width) : 66;
    const right = 14;
    const bottom = 46;
    let top = spec.heading ? 26 : 10;
    const wide = width - left - right;
    const high = spec.square ? Math.min(wide, spec.height ?? 620) : (spec.height ?? 300) - top - bottom;
    this.frame = { left, top, wide: spec.square ? high : wide, high };
    this.setScales();
    const texts = this.placeTexts();
    if (texts.length) {
      top += ROW * (1 + Math.max(...texts.map(({ row }) => row)));
      this.frame.top = top;
      this.setScales();
    }
    const height = high + top + bottom;
    this.figure.replaceChildren();
    this.figure.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.figure.setAttribute("width", width);
    this.figure.setAttribute("height", height);
    const keys = this.reachable.length ? " Arrow keys move over the values." : "";
    this.figure.setAttribute("aria-label", `${spec.title}. ${spec.summary ?? ""}${keys}`);
    this.drawAxes(height);
    const clip = `clip-${this.number}`;
    const { left: x0, top: y0, wide: w, high: h } = this.frame;
    this.figure.append(svg("clipPath", { id: clip }, svg("rect", { x: x0 - 5, y: y0 - 5, width: w + 10, height: h + 10 })));
    const body = svg("g", { "clip-path": `url(#${clip})` });
    this.figure.append(body);
    this.drawCanvas(width, height);
    for (const layer of spec.layers) this.drawLayer(body, layer);
    for (const { at, row, text, anchor } of texts) {
      this.figure.append(
        svg("line", { class: "axis", x1: at, x2: at, y1: top, y2: top - ROW * row - 14 }),
        svg("text", { x: at + (anchor === "start" ? 4 : -4), y: top - 5 - ROW * row, "text-anchor": anchor }, text),
      );
    }
    if (spec.heading) this.figure.append(svg("text", { x: x0, y: 14, class: "title" }, spec.heading));
    this.cursor = svg("line", { class: "chart-cursor", y1: y0, y2: y0 + h, visibility: "hidden" });
    this.mark = svg("circle", { class: "chart-mark", r: 7, visibility: "hidden" });
    this.selection = svg("rect", { class: "chart-brush", visibility: "hidden" });
    this.figure.append(this.cursor, this.selection, this.mark);
    if (spec.selected) this.showSelection(spec.selected);
    this.drawLegend();
  }

  // Texts of vertical rules, in rows from the plot upwards; one without room in any row is left out. The rightmost text
  // is lowest, so that the lines of the others pass to the left of it.
  placeTexts() {
    const rows = Array.from({ length: MOST_ROWS }, () => []);
    const rules = this.spec.layers.filter((layer) => layer.type === "rule" && layer.text);
    return rules.sort((a, b) => b.x - a.x).flatMap((layer) => {
      const at = this.x(layer.x);
      const free = Math.floor((this.width - at - 8) / 6.6);
      const fits = free >= Math.min(10, layer.text.length);
      const text = short(layer.text, fits ? Math.min(free, 26) : 26);
      const broad = 6.6 * text.length + 8;
      const low = fits ? at : at - broad;
      const row = rows.findIndex((taken) => taken.every(([from, to]) => low >= to || low + broad <= from));
      if (row < 0) return [];
      rows[row].push([low, low + broad]);
      return [{ at, row, text, anchor: fits ? "start" : "end" }];
    });
  }

  setScales() {
    const { spec, frame } = this;
    const across = spec.layers.filter((layer) => layer.type !== "span");
    const xs = across.flatMap((layer) => {
      if (layer.across) return [layer.x.map((x, i) => x - (layer.ci?.[i] ?? 0)), layer.x.map((x, i) => x + (layer.ci?.[i] ?? 0))];
      return [layer.x];
    }).filter(Array.isArray);
    const ys = across.flatMap((layer) => {
      if (layer.ci && !layer.across) return [layer.y.map((y, i) => y - (layer.ci[i] ?? 0)), layer.y.map((y, i) => y + (layer.ci[i] ?? 0))];
      return [layer.y, layer.low, layer.high];
    }).filter(Array.isArray);
    const rules = across.filter((layer) => layer.type === "rule" && layer.y !== undefined).map((layer) => [layer.y]);
    const domain = (axis, lists) => {
      if (axis.names) return [-0.5, axis.names.length - 0.5];
      return axis.domain ?? extent(lists, { zero: axis.zero });
    };
    let xDomain = domain(spec.x, xs);
    let yDomain = domain(spec.y, [...ys, ...rules]);
    if (spec.square && !spec.x.domain) {
      xDomain = [Math.min(xDomain[0], yDomain[0]), Math.max(xDomain[1], yDomain[1])];
      yDomain = xDomain;
    }
    this.x = linear(xDomain, [frame.left, frame.left + frame.wide]);
    const ends = [frame.top + frame.high, frame.top];
    this.y = linear(yDomain, spec.y.names ? ends.reverse() : ends);
    this.domains = { x: xDomain, y: yDomain };
  }

  drawAxes(height) {
    const { left, top, wide, high } = this.frame;
    const { x, y } = this.spec;
    const bottom = top + high;
    const draw = (name, axis, scale, room) => {
      const marks = axis.marks?.(room);
      const given = marks?.map((mark) => mark.value) ?? (axis.names ? axis.names.map((_, i) => i) : ticks(...this.domains[name], room));
      const step = axis.names && name === "x" ? Math.ceil((given.length * 62) / wide) : 1;
      const texts = marks?.map((mark) => mark.text) ?? axis.names ?? tickTexts(given);
      given.forEach((value, i) => {
        if (i % step) return;
        const at = scale(value);
        if (name === "x") {
          this.figure.append(
            svg("line", { class: "gridline", x1: at, x2: at, y1: top, y2: bottom }),
            svg("text", { x: at, y: bottom + 17, "text-anchor": "middle" }, short(texts[i], axis.names ? Math.max(9, Math.floor((wide * step) / given.length / 6.8)) : 20)),
          );
        } else {
          this.figure.append(
            svg("line", { class: "gridline", x1: left, x2: left + wide, y1: at, y2: at }),
            svg("text", { x: left - 8, y: at + 4, "text-anchor": "end" }, short(texts[i], axis.names ? Math.floor(left / 7) : 20)),
          );
        }
      });
    };
    const room = Math.max(3, Math.floor(wide / 80));
    draw("x", x, this.x, room);
    draw("y", y, this.y, this.spec.square ? room : Math.max(3, Math.floor(high / 44)));
    this.figure.append(svg("line", { class: "axis", x1: left, x2: left + wide, y1: bottom, y2: bottom }));
    if (x.label) {
      const half = 3.2 * label(x).length;
      const at = Math.max(half, Math.min(left + wide / 2, this.width - half));
      this.figure.append(svg("text", { x: at, y: height - 8, "text-anchor": "middle" }, label(x)));
    }
    if (y.label && !y.names) {
      const at = top + high / 2;
      this.figure.append(svg("text", { x: 13, y: at, "text-anchor": "middle", transform: `rotate(-90 13 ${at})` }, label(y)));
    }
  }

  drawCanvas(width, height) {
    const scale = window.devicePixelRatio || 1;
    this.canvas.width = width * scale;
    this.canvas.height = height * scale;
    this.canvas.style.width = `${width}px`;
    this.canvas.style.height = `${height}px`;
    const brush = this.canvas.getContext("2d");
    brush.scale(scale, scale);
    const { left, top, wide, high } = this.frame;
    brush.beginPath();
    brush.rect(left - 5, top - 5, wide + 10, high + 10);
    brush.clip();
    for (const layer of this.spec.layers.filter((each) => each.type === "points")) {
      const own = token(layer.colour ?? "--blue");
      const size = layer.size ?? (layer.x.length > 2000 ? 1.6 : layer.x.length > 400 ? 2.4 : 3.6);
      const order = [...layer.x.keys()].sort((a, b) => (layer.faint?.has(b) ?? 0) - (layer.faint?.has(a) ?? 0));
      for (const i of order) {
        if (layer.x[i] === null || layer.y[i] === null) continue;
        const faint = layer.faint?.has(i);
        brush.globalAlpha = faint ? 0.16 : (layer.alpha ?? 0.75);
        brush.fillStyle = layer.tints?.[i] ?? own;
        brush.beginPath();
        brush.arc(this.x(layer.x[i]), this.y(layer.y[i]), size, 0, 2 * Math.PI);
        brush.fill();
      }
    }
  }

  drawLayer(body, layer) {
    const stroke = `var(${layer.colour ?? "--blue"})`;
    const at = (i, y = layer.y) => [this.x(layer.x[i]), this.y(y[i])];
    const known = (i, y = layer.y) => layer.x[i] !== null && y[i] !== null && Number.isFinite(y[i]);
    if (layer.type === "line" || layer.type === "stairs") {
      let path = "";
      let open = false;
      layer.x.forEach((_, i) => {
        if (!known(i)) { open = false; return; }
        const [px, py] = at(i);
        if (layer.type === "stairs" && open) path += `H${px.toFixed(1)}V${py.toFixed(1)}`;
        else path += `${open ? "L" : "M"}${px.toFixed(1)} ${py.toFixed(1)}`;
        open = true;
      });
      body.append(svg("path", { d: path, fill: "none", stroke, "stroke-width": layer.thick ?? 2, "stroke-dasharray": layer.dash, "stroke-linejoin": "round" }));
    } else if (layer.type === "area") {
      const rows = layer.x.map((_, i) => i).filter((i) => known(i, layer.low) && known(i, layer.high));
      const ahead = rows.map((i) => at(i, layer.high).map((v) => v.toFixed(1)).join(" "));
      const back = rows.map((i) => at(i, layer.low).map((v) => v.toFixed(1)).join(" ")).reverse();
      if (rows.length) body.append(svg("path", { d: `M${[...ahead, ...back].join("L")}Z`, fill: stroke, "fill-opacity": layer.opacity ?? 0.16, stroke: "none" }));
    } else if (layer.type === "means") {
      layer.x.forEach((_, i) => {
        if (!known(i)) return;
        const [px, py] = at(i);
        const half = layer.ci?.[i];
        const ends = layer.across
          ? half && [this.x(layer.x[i] - half), this.x(layer.x[i] + half)]
          : half && [this.y(layer.y[i] - half), this.y(layer.y[i] + half)];
        if (ends && layer.across) body.append(svg("line", { x1: ends[0], x2: ends[1], y1: py, y2: py, stroke, "stroke-width": 2 }));
        else if (ends) body.append(svg("line", { x1: px, x2: px, y1: ends[0], y2: ends[1], stroke, "stroke-width": 2 }));
        const fill = layer.open?.(i) ? "var(--surface)" : stroke;
        body.append(svg("circle", { cx: px, cy: py, r: layer.size ?? 4.5, fill, stroke, "stroke-width": 2 }));
      });
    } else if (layer.type === "rule") {
      const { left, top, wide, high } = this.frame;
      const place = layer.x !== undefined ? { x1: this.x(layer.x), x2: this.x(layer.x), y1: top, y2: top + high } : { x1: left, x2: left + wide, y1: this.y(layer.y), y2: this.y(layer.y) };
      body.append(svg("line", { ...place, stroke: `var(${layer.colour ?? "--line-strong"})`, "stroke-width": layer.thick ?? 1.5, "stroke-dasharray": layer.dash }));
    } else if (layer.type === "span") {
      const from = this.x(layer.from);
      body.append(svg("rect", { x: from, y: this.frame.top, width: Math.max(2, this.x(layer.to) - from), height: this.frame.high, fill: stroke, "fill-opacity": 0.14 }));
    }
  }

  drawLegend() {
    const given = this.spec.legend;
    if (given instanceof Node) {
      this.legend.replaceChildren(given);
      return;
    }
    const named = given ?? this.spec.layers.filter((layer) => layer.name);
    this.legend.replaceChildren(...(named.length ? [legendOf(named)] : []));
  }

  listen() {
    const place = (event) => {
      const box = this.figure.getBoundingClientRect();
      return [event.clientX - box.left, event.clientY - box.top];
    };
    this.figure.addEventListener("pointermove", (event) => {
      const [px, py] = place(event);
      if (this.dragged) {
        this.dragged.to = [px, py];
        this.drawBrush();
        return;
      }
      this.spec.hover?.(this.inside(px, py) ? this.x.invert(px) : null);
      this.activate(this.findNear(px, py));
    });
    this.figure.addEventListener("pointerleave", () => {
      if (this.dragged) return;
      this.spec.hover?.(null);
      this.activate(null);
    });
    this.figure.addEventListener("pointerdown", (event) => {
      const [px, py] = place(event);
      if (!this.spec.brush || event.button !== 0 || event.pointerType === "touch" || !this.inside(px, py)) return;
      this.dragged = { from: [px, py], to: [px, py] };
      this.figure.setPointerCapture(event.pointerId);
    });
    this.figure.addEventListener("pointerup", (event) => {
      const [px, py] = place(event);
      const { dragged } = this;
      this.dragged = null;
      if (dragged && Math.hypot(px - dragged.from[0], py - dragged.from[1]) > 6) {
        this.spec.brush(this.readBrush(dragged));
        return;
      }
      this.selection?.setAttribute("visibility", "hidden");
      const near = this.findNear(px, py);
      if (near) near.layer.pick?.(near.i);
      else if (dragged) this.spec.brush(null);
    });
    this.figure.addEventListener("keydown", (event) => this.press(event));
    this.figure.addEventListener("blur", () => this.activate(null));
  }

  press(event) {
    const layers = this.reachable;
    if (!layers.length) return;
    const all = layers.flatMap((layer) => layer.x.map((_, i) => ({ layer, i })).filter(({ i }) => this.isShown(layer, i)));
    all.sort((a, b) => a.layer.x[a.i] - b.layer.x[b.i] || a.layer.y[a.i] - b.layer.y[b.i]);
    const now = this.active ? all.findIndex((each) => each.layer === this.active.layer && each.i === this.active.i) : -1;
    const steps = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1, PageDown: 10, PageUp: -10 };
    let next = null;
    if (event.key in steps) next = Math.min(all.length - 1, Math.max(0, now + steps[event.key]));
    else if (event.key === "Home") next = 0;
    else if (event.key === "End") next = all.length - 1;
    else if (event.key === "Enter" && this.active) { this.active.layer.pick?.(this.active.i); return; }
    else if (event.key === "Escape") { this.activate(null); this.spec.brush?.(null); return; }
    if (next === null || !all.length) return;
    event.preventDefault();
    this.activate(all[next]);
    this.voice.textContent = this.tip.textContent;
  }

  isShown(layer, i) {
    if (layer.x[i] === null || layer.y[i] === null || layer.faint?.has(i)) return false;
    return this.inside(this.x(layer.x[i]), this.y(layer.y[i]));
  }

  inside(px, py) {
    const { left, top, wide, high } = this.frame;
    return px >= left - 1 && px <= left + wide + 1 && py >= top - 1 && py <= top + high + 1;
  }

  findNear(px, py) {
    let best = null;
    let least = NEAR;
    for (const layer of this.reachable) {
      for (let i = 0; i < layer.x.length; i += 1) {
        if (!this.isShown(layer, i)) continue;
        const far = Math.hypot(this.x(layer.x[i]) - px, this.y(layer.y[i]) - py);
        if (far < least) [best, least] = [{ layer, i }, far];
      }
    }
    return best;
  }

  activate(found) {
    this.active = found;
    if (!found) { this.hideTip(); return; }
    const { layer, i } = found;
    const [px, py] = [this.x(layer.x[i]), this.y(layer.y[i])];
    this.mark?.setAttribute("cx", px);
    this.mark?.setAttribute("cy", py);
    this.mark?.setAttribute("visibility", "visible");
    this.figure.classList.toggle("pickable", Boolean(layer.pick));
    const lines = layer.tell(i);
    this.tip.replaceChildren(...lines.map((line, place) => el(place ? "span" : "strong", {}, line, " ")));
    this.tip.hidden = false;
    const most = this.width - this.tip.offsetWidth - 4;
    this.tip.style.left = `${Math.max(0, Math.min(most, px + 14))}px`;
    this.tip.style.top = `${Math.max(0, py - this.tip.offsetHeight - 12)}px`;
  }

  hideTip() {
    this.tip.hidden = true;
    this.mark?.setAttribute("visibility", "hidden");
    this.figure.classList.remove("pickable");
  }

  setCursor(x, strong = false) {
    if (!this.cursor) return;
    this.cursor.classList.toggle("strong", strong);
    const known = x !== null && x >= this.domains.x[0] && x <= this.domains.x[1];
    this.cursor.setAttribute("visibility", known ? "visible" : "hidden");
    if (!known) return;
    this.cursor.setAttribute("x1", this.x(x));
    this.cursor.setAttribute("x2", this.x(x));
  }

  drawBrush() {
    const { from, to } = this.dragged;
    this.showBox(from[0], from[1], to[0], to[1]);
  }

  showSelection({ x, y }) {
    const { left, top, wide, high } = this.frame;
    const [x0, x1] = x ? x.map(this.x) : [left, left + wide];
    const [y0, y1] = y ? y.map(this.y) : [top, top + high];
    this.showBox(x0, y0, x1, y1);
  }

  showBox(x0, y0, x1, y1) {
    const { left, top, wide, high } = this.frame;
    const clip = (value, low, size) => Math.min(low + size, Math.max(low, value));
    const [a, b] = [clip(Math.min(x0, x1), left, wide), clip(Math.max(x0, x1), left, wide)];
    const [c, d] = [clip(Math.min(y0, y1), top, high), clip(Math.max(y0, y1), top, high)];
    for (const [name, value] of Object.entries({ x: a, y: c, width: b - a, height: d - c, visibility: "visible" })) this.selection.setAttribute(name, value);
  }

  readBrush({ from, to }) {
    const sort = (values) => values.sort((a, b) => a - b);
    return { x: sort([this.x.invert(from[0]), this.x.invert(to[0])]), y: sort([this.y.invert(from[1]), this.y.invert(to[1])]) };
  }
}

function label({ label: words, unit }) {
  return unit && unit !== "1" ? `${words} [${unit}]` : words;
}

function short(text, most) {
  return text.length > most ? `${text.slice(0, most - 1)}…` : text;
}

// A legend of names with their colours. A shape is "line", "dash", "dot" or "box".
export function legendOf(named) {
  const shape = ({ type, shape: given, colour, dash, tint, open }) => {
    const paint = tint ?? `var(${colour ?? "--blue"})`;
    const kind = given ?? (type === "points" || type === "means" ? "dot" : type === "area" || type === "span" ? "box" : "line");
    const drawn = kind === "dot" ? svg("circle", open?.(0) ? { cx: 11, cy: 7, r: 4, fill: "none", stroke: paint, "stroke-width": 2 } : { cx: 11, cy: 7, r: 5, fill: paint })
      : kind === "box" ? svg("rect", { x: 1, y: 1, width: 20, height: 12, rx: 2, fill: paint, "fill-opacity": tint ? 1 : 0.3 })
        : svg("line", { x1: 0, x2: 22, y1: 7, y2: 7, stroke: paint, "stroke-width": 3, "stroke-dasharray": dash });
    return svg("svg", { width: 22, height: 14, "aria-hidden": "true" }, drawn);
  };
  return el("ul", { class: "legend" }, named.map((each) => el("li", {}, shape(each), each.name)));
}

// A legend of a scale of colours, with its two ends.
export function scaleLegend(name, tint, [low, high], unit) {
  const steps = 24;
  const boxes = Array.from({ length: steps }, (_, i) => svg("rect", { x: i * 5, y: 1, width: 5.5, height: 12, fill: tint(low + ((i + 0.5) / steps) * (high - low)) }));
  return el("div", { class: "legend" }, el("span", {}, `${name}:`), el("span", {}, plain(low)), svg("svg", { width: steps * 5, height: 14, "aria-hidden": "true" }, boxes), el("span", {}, `${plain(high)}${unit ? `\u202f${unit}` : ""}`));
}
