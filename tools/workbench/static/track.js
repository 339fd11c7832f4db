// The way of a ride on a small map, each window coloured by its residual.

import { el, svg } from "./dom.js";
import { scaleLegend } from "./chart.js";
import { diverging } from "./scales.js";

const KM_PER_DEGREE = 111.2;

// Draw windows [{from: [lat, lon], to: [lat, lon], value}] and return {setWindow(i), destroy()}.
export function track(host, { title, windows, place, unit, onhover }) {
  const known = windows.filter((each) => [...each.from, ...each.to].every(Number.isFinite));
  if (!known.length) {
    host.replaceChildren(el("p", { class: "note" }, "This ride has no positions, so it has no map."));
    return { setWindow() {}, destroy() {} };
  }
  const figure = svg("svg", { class: "chart track", role: "img", "aria-label": title });
  const legend = el("div", {});
  host.replaceChildren(figure, legend);
  const all = known.flatMap((each) => [each.from, each.to]);
  const latitude = all.reduce((sum, each) => sum + each[0], 0) / all.length;
  const toKm = ([lat, lon]) => [lon * KM_PER_DEGREE * Math.cos((latitude * Math.PI) / 180), -lat * KM_PER_DEGREE];
  const points = all.map(toKm);
  const [west, north] = [0, 1].map((i) => Math.min(...points.map((p) => p[i])));
  const [east, south] = [0, 1].map((i) => Math.max(...points.map((p) => p[i])));
  const width = 480;
  const margin = 22;
  const extent = Math.max(east - west, 0.2);
  const tall = Math.max(south - north, 0.2);
  const perKm = Math.min((width - 2 * margin) / extent, 380 / tall);
  const height = Math.max(140, tall * perKm + 2 * margin + 22);
  const shift = (width - extent * perKm) / 2;
  const at = (place_) => {
    const [x, y] = toKm(place_);
    return [shift + (x - west) * perKm, margin + (y - north) * perKm];
  };
  const most = Math.max(...known.map((each) => Math.abs(each.value)), 1);

  function draw() {
    const tint = diverging(most);
    figure.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const lines = windows.map((each, i) => {
      if (![...each.from, ...each.to].every(Number.isFinite)) return null;
      const [[x1, y1], [x2, y2]] = [at(each.from), at(each.to)];
      const inside = place && i >= place.first && i <= place.last;
      const under = inside && svg("line", { x1, y1, x2, y2, class: "track-place" });
      const line = svg("line", { x1, y1, x2, y2, class: "track-leg", stroke: tint(each.value) });
      const target = svg("line", { x1, y1, x2, y2, class: "track-target" });
      target.addEventListener("pointerenter", () => onhover?.(i));
      target.addEventListener("pointerleave", () => onhover?.(null));
      return [under, line, target];
    }).filter(Boolean);
    const flat = lines.flat().filter(Boolean);
    const of = (name) => flat.filter((each) => each.classList.contains(name));
    const [sx, sy] = at(known[0].from);
    const [ex, ey] = at(known.at(-1).to);
    const bar = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100].filter((km) => km * perKm < width / 3).at(-1) ?? 0.1;
    const y = height - 10;
    figure.replaceChildren(
      ...of("track-place"), ...of("track-leg"), ...of("track-target"),
      svg("circle", { cx: sx, cy: sy, r: 6, class: "track-start" }),
      svg("rect", { x: ex - 5.5, y: ey - 5.5, width: 11, height: 11, class: "track-end" }),
      svg("text", { x: sx + 9, y: sy - 7 }, "start"),
      svg("text", { x: ex + 9, y: ey + 16 }, "end"),
      svg("path", { d: `M${margin} ${y - 5}v5h${bar * perKm}v-5`, class: "track-scale" }),
      svg("text", { x: margin + bar * perKm + 6, y }, `${bar} km`),
      svg("circle", { class: "chart-mark", r: 8, visibility: "hidden" }),
    );
    legend.replaceChildren(scaleLegend("Residual", tint, [-most, most], unit));
  }
  draw();
  document.addEventListener("themechange", draw);
  return {
    setWindow(i) {
      const mark = figure.querySelector(".chart-mark");
      const one = i === null ? null : windows[i];
      if (!one || !one.from.every(Number.isFinite) || !one.to.every(Number.isFinite)) {
        mark.setAttribute("visibility", "hidden");
        return;
      }
      const [[x1, y1], [x2, y2]] = [at(one.from), at(one.to)];
      mark.setAttribute("cx", (x1 + x2) / 2);
      mark.setAttribute("cy", (y1 + y2) / 2);
      mark.setAttribute("visibility", "visible");
    },
    destroy() { document.removeEventListener("themechange", draw); },
  };
}
