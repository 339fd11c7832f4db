// Elements from plain values, without HTML in text. `el("p", {class: "note"}, "words", child)`.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

export function el(name, attributes, ...children) {
  return fill(document.createElement(name), attributes, children);
}

export function svg(name, attributes, ...children) {
  return fill(document.createElementNS(SVG, name), attributes, children);
}

// The element of an SVG that the server drew; its colours are those of the page's style.
export function picture(text) {
  return document.importNode(new DOMParser().parseFromString(text, "image/svg+xml").documentElement, true);
}

// A state that fills a page or a card: loading, empty or failed.
export function loading(words) {
  return el("div", { class: "state loading", role: "status" }, el("span", { class: "pulse", "aria-hidden": "true" }), words);
}

export function empty(title, words, ...more) {
  return el("div", { class: "state empty" }, el("h2", {}, title), el("p", {}, words), ...more);
}

export function failed(error, retry) {
  return el(
    "div",
    { class: "state failed", role: "alert" },
    el("h2", {}, "This did not work"),
    el("p", {}, error.message),
    retry && el("button", { type: "button", onclick: retry }, "Try again"),
  );
}
