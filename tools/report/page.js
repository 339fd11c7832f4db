"use strict";
(() => {
  const PRINTED = { wide: 670, small: 325 };
  const NARROW = 520;
  const LINE = 18;
  const NAMES = "Model";
  const plots = [];

  const isHeat = (trace) => trace.type === "heatmap";
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  /* Text, grid and axes in the colours of the page. */
  function theme(layout) {
    const ink = colour("--ink");
    const changes = { "font.color": ink, "font.family": getComputedStyle(document.querySelector(".plot")).fontFamily };
    for (const name of Object.keys(layout).filter((key) => /^[xy]axis/.test(key))) {
      changes[`${name}.gridcolor`] = colour("--grid");
      changes[`${name}.linecolor`] = ink;
      changes[`${name}.zerolinecolor`] = ink;
      changes[`${name}.tickcolor`] = ink;
    }
    (layout.shapes || []).forEach((_, i) => { changes[`shapes[${i}].line.color`] = ink; });
    changes["hoverlabel.bgcolor"] = colour("--paper");
    changes["hoverlabel.font.color"] = ink;
    return changes;
  }

  /* Where there is little room, names of models are small and speak for themselves. */
  function names(layout, width) {
    const changes = {};
    for (const name of Object.keys(layout).filter((key) => /^yaxis/.test(key))) {
      if (!layout[name].title || layout[name].title.text !== NAMES) continue;
      changes[`${name}.title.font.size`] = width < NARROW ? 1 : 12;
      changes[`${name}.title.standoff`] = width < NARROW ? 0 : 12;
      changes[`${name}.tickfont.size`] = width < NARROW ? 9 : 12;
    }
    return changes;
  }

  /* Break titles of horizontal axes into lines that fit. */
  function titles(plot, width) {
    const most = Math.max(12, Math.floor((width + 24) / 7.6));
    const changes = {};
    for (const [name, text] of Object.entries(plot.titles)) {
      const lines = [""];
      for (const word of text.split(" ")) {
        const last = lines[lines.length - 1];
        if (last && last.length + word.length >= most) lines.push(word);
        else lines[lines.length - 1] = last ? `${last} ${word}` : word;
      }
      changes[`${name}.title.text`] = lines.join("<br>");
    }
    return changes;
  }

  /* Make room below the plot for a legend and a title of whatever height they take at this width. */
  function room(plot) {
    const legend = plot.div.querySelector(".legend .bg");
    const lines = Object.keys(plot.titles).map((name) => plot.div.layout[name].title.text.split("<br>").length);
    const height = (legend ? Math.ceil(legend.getBoundingClientRect().height) + 8 : 0) + LINE * (Math.max(1, ...lines) - 1);
    return { height: plot.height + height, "margin.b": plot.bottom + height };
  }

  function fit(plot, width) {
    const wide = width ?? plot.div.clientWidth;
    const first = { ...theme(plot.div.layout), ...names(plot.div.layout, wide), width: wide };
    plot.div.style.height = "auto";
    return Plotly.relayout(plot.div, first)
      .then(() => Plotly.relayout(plot.div, titles(plot, plot.div._fullLayout._size.w)))
      .then(() => Plotly.relayout(plot.div, room(plot)))
      .then(() => (plot.div.data.some(isHeat) ? Plotly.restyle(plot.div, { "textfont.color": colour("--ink") }) : null));
  }

  function draw(figure) {
    const div = figure.querySelector(".plot");
    const { data, layout } = JSON.parse(figure.querySelector('script[type="application/json"]').textContent);
    const plot = { div, height: layout.height, bottom: layout.margin.b, small: figure.parentElement.className };
    plot.titles = Object.fromEntries(
      Object.entries(layout).filter(([key, axis]) => /^xaxis/.test(key) && axis.title).map(([key, axis]) => [key, axis.title.text]),
    );
    layout.font = { size: 12 };
    layout.legend.maxheight = 0.9;
    data.filter(isHeat).forEach((trace) => { trace.textfont = { color: colour("--ink") }; });
    layout.width = div.clientWidth;
    if (matchMedia("(pointer: coarse)").matches) layout.dragmode = false;
    plots.push(plot);
    return Plotly.newPlot(div, data, layout, { displayModeBar: false }).then(() => fit(plot));
  }

  const waitingFigures = () => [...document.querySelectorAll("figure:has(.plot):not(.drawn)")];

  function show(figure) {
    if (figure.classList.contains("drawn")) return;
    figure.classList.add("drawn");
    near.unobserve(figure);
    draw(figure);
  }

  /* A link to a folded section, or into it, opens it. */
  function unfold() {
    const goal = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    const folded = goal && (goal.querySelector(":scope > details") || goal.closest("section > details"));
    if (!folded || folded.open) return;
    folded.open = true;
    goal.scrollIntoView();
  }
  addEventListener("hashchange", unfold);
  unfold();

  let waiting = 0;
  addEventListener("resize", () => {
    clearTimeout(waiting);
    waiting = setTimeout(() => plots.forEach((plot) => fit(plot)), 150);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => plots.forEach((plot) => fit(plot)));
  addEventListener("beforeprint", () => {
    document.documentElement.classList.add("printing");
    document.querySelectorAll("section > details").forEach((folded) => { folded.open = true; });
    waitingFigures().forEach(show);
    plots.forEach((plot) => fit(plot, PRINTED[plot.small]));
  });
  addEventListener("afterprint", () => {
    document.documentElement.classList.remove("printing");
    plots.forEach((plot) => fit(plot));
  });

  /* Figures are drawn when the reader comes near them: a page may hold a hundred. */
  const near = new IntersectionObserver(
    (entries) => entries.filter((entry) => entry.isIntersecting).forEach((entry) => show(entry.target)),
    { rootMargin: "1000px 0px" },
  );
  waitingFigures().forEach((figure) => near.observe(figure));
})();
