// A map of cars on canvas: raster tiles if there are any, the density of the fleet's traces, and the cars.
// It pans and zooms by pointer, wheel and keys. The table beside it is its text alternative.

import { el } from "./dom.js";

const TAU = 2 * Math.PI;
const EARTH_M = 40_075_016.7;
const TILE = 256;
const NICE = [1, 2, 5];

export const toX = (longitude) => longitude / 360 + 0.5;
export const toY = (latitude) => {
  const sine = Math.sin((latitude * Math.PI) / 180);
  return 0.5 - Math.log((1 + sine) / (1 - sine)) / (4 * Math.PI);
};
const toLatitude = (y) => (Math.atan(Math.sinh(Math.PI * (1 - 2 * y))) * 180) / Math.PI;

export class FleetMap {
  // `options`: label, tiles ({least_zoom, most_zoom, attribution} or null), onselect(row).
  constructor(options) {
    this.options = options;
    this.canvas = el("canvas", {
      class: "map", tabindex: 0, role: "application", "aria-roledescription": "map", "aria-label": options.label,
    });
    const button = (sign, words, act) => el("button", { type: "button", "aria-label": words, title: words, onclick: act }, sign);
    this.controls = el("div", { class: "map-controls" },
      button("+", "Zoom in", () => this.zoom(2)),
      button("\u2212", "Zoom out", () => this.zoom(0.5)),
      button("\u2922", "Show the whole fleet", () => this.fit()));
    this.element = el("div", { class: "map-frame" }, this.canvas, this.controls);
    this.points = []; // {x, y, color, shape, big, name}
    this.density = null;
    this.selected = null;
    this.view = null; // {x, y, scale}: centre in the unit square of Mercator, and pixels per unit
    this.moved = false;
    this._tiles = new Map();
    this._pointers = new Map();
    this._observer = new ResizeObserver(() => this._resize());
    this._observer.observe(this.element);
    this._theme = () => { this._traces = null; this.draw(); };
    document.addEventListener("themechange", this._theme);
    this._listen();
  }

  close() {
    this._observer.disconnect();
    document.removeEventListener("themechange", this._theme);
  }

  setDensity(density) {
    if (!density.count.length) return;
    const most = Math.max(...density.count);
    const levels = Array.from({ length: 6 }, () => []);
    const places = [];
    for (let i = 0; i < density.count.length; i++) {
      const level = Math.min(5, Math.floor((6 * Math.log1p(density.count[i])) / Math.log1p(most)));
      const latitude = density.y[i] * density.cell;
      places.push([toX((density.x[i] + 0.5) * density.cell), toY(latitude), density.count[i]]);
      levels[level].push([toX(density.x[i] * density.cell), toY(latitude + density.cell), toY(latitude)]);
    }
    this.density = { levels, places, width: density.cell / 360 };
    this._traces = null;
    if (!this.moved) this.fit(false);
    this.draw();
  }

  setPoints(points) {
    this.points = points;
    if (!this.view) this.fit(false);
    this.draw();
  }

  // Show everything: the traces, or the cars where there are none.
  fit(isWanted = true) {
    const places = this.density ? this.density.places : this.points.map(({ x, y }) => [x, y, 1]);
    if (!places.length || !this.width) return;
    const [left, right] = bounds(places, 0);
    const [top, bottom] = bounds(places, 1);
    const scale = Math.min(this.width / Math.max(right - left, 1e-6), this.height / Math.max(bottom - top, 1e-6)) * 0.9;
    this.view = { x: (left + right) / 2, y: (top + bottom) / 2, scale: Math.min(scale, 2 ** 26) };
    if (isWanted) this.moved = false;
    this._traces = null;
    this.draw();
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    if (!this.view) return;
    const scale = Math.min(Math.max(this.view.scale * factor, TILE), 2 ** 28);
    const real = scale / this.view.scale;
    this.view.x += ((x - this.width / 2) * (1 - 1 / real)) / this.view.scale;
    this.view.y += ((y - this.height / 2) * (1 - 1 / real)) / this.view.scale;
    this.view.scale = scale;
    this._move();
  }

  pan(dx, dy) {
    if (!this.view) return;
    this.view.x -= dx / this.view.scale;
    this.view.y -= dy / this.view.scale;
    this._move();
  }

  showPoint(point) {
    if (!this.view || !point) return;
    const [x, y] = this._place(point.x, point.y);
    if (x > 30 && y > 30 && x < this.width - 30 && y < this.height - 30) return;
    this.view.x = point.x;
    this.view.y = point.y;
    this._move();
  }

  draw() {
    if (this._due) return;
    this._due = requestAnimationFrame(() => { this._due = null; this._draw(); });
  }

  _move() {
    this.moved = true;
    this._traces = null;
    this.draw();
  }

  _resize() {
    const box = this.element.getBoundingClientRect();
    this.ratio = Math.min(2, window.devicePixelRatio || 1);
    this.width = box.width;
    this.height = box.height;
    this.canvas.width = Math.round(box.width * this.ratio);
    this.canvas.height = Math.round(box.height * this.ratio);
    this._traces = null;
    if (!this.moved) this.fit(false);
    this.draw();
  }

  _place(x, y) {
    return [(x - this.view.x) * this.view.scale + this.width / 2, (y - this.view.y) * this.view.scale + this.height / 2];
  }

  _draw() {
    const context = this.canvas.getContext("2d");
    const style = getComputedStyle(this.element);
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    if (!this.view || !this.width) return;
    if (this.options.tiles) this._drawTiles(context);
    if (this.density) {
      this._traces ??= this._drawTraces(style.getPropertyValue("--map-trace"));
      context.drawImage(this._traces, 0, 0, this.width, this.height);
    }
    this._drawPoints(context, style);
    this._drawScale(context, style);
  }

  _drawTraces(color) {
    const layer = document.createElement("canvas");
    layer.width = this.canvas.width;
    layer.height = this.canvas.height;
    const context = layer.getContext("2d");
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    const width = Math.max(1.2, this.density.width * this.view.scale);
    this.density.levels.forEach((cells, level) => {
      context.fillStyle = `rgba(${color}, ${0.22 + 0.13 * level})`;
      for (const [x, top, bottom] of cells) {
        const [left, high] = this._place(x, top);
        if (left > -width && left < this.width && high > -width && high < this.height) {
          context.fillRect(left, high, width, Math.max(1.2, (bottom - top) * this.view.scale));
        }
      }
    });
    return layer;
  }

  _drawTiles(context) {
    const { least_zoom: least, most_zoom: most } = this.options.tiles;
    const zoom = Math.min(most, Math.max(least, Math.round(Math.log2(this.view.scale / TILE))));
    const count = 2 ** zoom;
    const size = this.view.scale / count;
    const first = [this.view.x - this.width / 2 / this.view.scale, this.view.y - this.height / 2 / this.view.scale];
    const last = [this.view.x + this.width / 2 / this.view.scale, this.view.y + this.height / 2 / this.view.scale];
    for (let x = Math.max(0, Math.floor(first[0] * count)); x <= Math.min(count - 1, Math.floor(last[0] * count)); x++) {
      for (let y = Math.max(0, Math.floor(first[1] * count)); y <= Math.min(count - 1, Math.floor(last[1] * count)); y++) {
        const image = this._tile(`/tiles/${zoom}/${x}/${y}`);
        const [left, top] = this._place(x / count, y / count);
        if (image.complete && image.naturalWidth) context.drawImage(image, left, top, size + 0.5, size + 0.5);
      }
    }
  }

  _tile(path) {
    let image = this._tiles.get(path);
    if (!image) {
      image = new Image();
      image.onload = () => this.draw();
      image.src = path;
      this._tiles.set(path, image);
      if (this._tiles.size > 400) this._tiles.delete(this._tiles.keys().next().value);
    }
    return image;
  }

  _drawPoints(context, style) {
    const halo = style.getPropertyValue("--surface");
    const ink = style.getPropertyValue("--ink");
    const seen = [];
    if (this.points.length <= 60) {
      for (const point of this.points) {
        const [x, y] = this._place(point.x, point.y);
        if (point.name === this.selected || seen.some(([left, top]) => Math.abs(left - x) < 70 && Math.abs(top - y) < 14)) continue;
        seen.push([x, y]);
        this._label(context, point.name, x + 10, y + 4, ink, halo, 11);
      }
    }
    for (const point of this.points) {
      const [x, y] = this._place(point.x, point.y);
      if (x < -20 || y < -20 || x > this.width + 20 || y > this.height + 20) continue;
      const radius = (this.points.length > 400 ? 4 : 6.5) * (point.big ? 1 : 0.75);
      context.beginPath();
      trace(context, point.shape, x, y, radius);
      context.fillStyle = style.getPropertyValue(point.color);
      context.fill();
      context.lineWidth = 1.75;
      context.strokeStyle = halo;
      context.stroke();
    }
    const chosen = this.points.find((point) => point.name === this.selected);
    if (chosen) {
      const [x, y] = this._place(chosen.x, chosen.y);
      context.beginPath();
      context.arc(x, y, 12, 0, TAU);
      context.lineWidth = 3;
      context.strokeStyle = style.getPropertyValue("--accent");
      context.stroke();
      this._label(context, chosen.name, x + 17, y + 5, ink, halo, 13, 700);
    }
  }

  _label(context, words, x, y, ink, halo, size, weight = 500) {
    context.font = `${weight} ${size}px system-ui, "DejaVu Sans", sans-serif`;
    context.textAlign = "left";
    context.lineJoin = "round";
    context.lineWidth = 3.5;
    context.strokeStyle = halo;
    context.strokeText(words, x, y);
    context.fillStyle = ink;
    context.fillText(words, x, y);
  }

  _drawScale(context, style) {
    const metres = (EARTH_M * Math.cos((toLatitude(this.view.y) * Math.PI) / 180)) / this.view.scale;
    const rough = metres * 110;
    const power = 10 ** Math.floor(Math.log10(rough));
    const length = power * NICE.filter((factor) => factor * power <= rough).pop();
    const pixels = length / metres;
    const [x, y] = [14, this.height - 14];
    const halo = style.getPropertyValue("--surface");
    for (const [width, color] of [[5, halo], [2, style.getPropertyValue("--ink")]]) {
      context.beginPath();
      context.moveTo(x, y - 6);
      context.lineTo(x, y);
      context.lineTo(x + pixels, y);
      context.lineTo(x + pixels, y - 6);
      context.lineWidth = width;
      context.strokeStyle = color;
      context.stroke();
    }
    const words = length >= 1000 ? `${length / 1000} km` : `${length} m`;
    this._label(context, words, x + 6, y - 7, style.getPropertyValue("--ink"), halo, 12, 600);
    const from = this.options.tiles?.attribution?.replace(/<[^>]*>/g, "");
    if (from) this._label(context, from, x + pixels + 16, y, style.getPropertyValue("--ink"), halo, 11);
  }

  _listen() {
    const { canvas } = this;
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(2 ** (-event.deltaY / 300), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("dblclick", (event) => this.zoom(2, event.offsetX, event.offsetY));
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this._pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
      this._travel = 0;
    });
    canvas.addEventListener("pointermove", (event) => this._drag(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => {
        if (name === "pointerup" && this._pointers.size === 1 && this._travel < 6) this._pick(event.offsetX, event.offsetY);
        this._pointers.delete(event.pointerId);
      });
    }
    canvas.addEventListener("keydown", (event) => this._press(event));
  }

  _drag(event) {
    const before = this._pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY];
    this._travel += Math.hypot(now[0] - before[0], now[1] - before[1]);
    const other = [...this._pointers].find(([id]) => id !== event.pointerId)?.[1];
    if (other) {
      const factor = Math.hypot(now[0] - other[0], now[1] - other[1]) / Math.max(1, Math.hypot(before[0] - other[0], before[1] - other[1]));
      this.zoom(factor, (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    } else if (this._travel >= 6) {
      this.pan(now[0] - before[0], now[1] - before[1]);
    }
    this._pointers.set(event.pointerId, now);
  }

  _pick(x, y) {
    let best = null;
    let least = 18;
    for (const point of this.points) {
      const [px, py] = this._place(point.x, point.y);
      const distance = Math.hypot(px - x, py - y);
      if (distance < least) [best, least] = [point, distance];
    }
    if (best) this.options.onselect?.(best.name);
  }

  _press(event) {
    const acts = {
      ArrowLeft: () => this.pan(60, 0), ArrowRight: () => this.pan(-60, 0),
      ArrowUp: () => this.pan(0, 60), ArrowDown: () => this.pan(0, -60),
      "+": () => this.zoom(1.5), "=": () => this.zoom(1.5), "-": () => this.zoom(1 / 1.5), 0: () => this.fit(),
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
  }
}

function trace(context, shape, x, y, radius) {
  if (shape === "diamond") {
    context.moveTo(x, y - radius * 1.35);
    context.lineTo(x + radius * 1.35, y);
    context.lineTo(x, y + radius * 1.35);
    context.lineTo(x - radius * 1.35, y);
    context.closePath();
  } else if (shape === "square") {
    context.rect(x - radius * 0.9, y - radius * 0.9, radius * 1.8, radius * 1.8);
  } else {
    context.arc(x, y, radius, 0, TAU);
  }
}

// Return the range of x (axis 0) or y (axis 1) without the outermost hundredth of the fixes, so that wrong ones do not
// hide the city. A place is [x, y, number of fixes].
function bounds(places, axis) {
  const sorted = [...places].sort((a, b) => a[axis] - b[axis]);
  const cut = sorted.reduce((sum, place) => sum + place[2], 0) / 200;
  const first = (list) => {
    let left = cut;
    return list.find((place) => (left -= place[2]) < 0)[axis];
  };
  return [first(sorted), first(sorted.reverse())];
}
