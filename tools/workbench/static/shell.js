// The shell: navigation between pages, state in the address, theme, announcements.
//
// A page is a module with `export function mount(root, state, context)`, which returns
// `{update(state), unmount()}`. `state` is {page, path, ...parameters}: `#/car/taxi-1?x=2` is
// {page: "car", path: "taxi-1", x: "2"}. To add a page, add a line to PAGES.

import * as api from "./api.js";
import { el, empty, failed, loading } from "./dom.js";
import { getZone, setZone } from "./format.js";

const PAGES = {
  fleet: { title: "Fleet", load: () => import("./fleet.js") },
  car: { title: "Car", load: () => import("./car.js"), within: "fleet" },
  rides: { title: "Rides", load: () => import("./rides.js") },
  failures: { title: "Where it fails", load: () => import("./failures.js") },
  causes: { title: "What is missing", load: () => import("./causes.js") },
  models: { title: "Models", load: () => import("./models.js") },
  condition: { title: "Condition", load: () => import("./condition.js") },
};
const FIRST = "fleet";
const THEMES = ["auto", "light", "dark"];

const main = document.getElementById("main");
const announcements = document.getElementById("announcements");
let session = null;
let current = null; // {name, path, page}
let turn = 0;
let model; // the model that was chosen last; links to other pages keep it
let before; // the model that was in use before the last step, to which a button goes back

export function readState(hash) {
  const [path, query = ""] = hash.replace(/^#\/?/, "").split("?");
  const [page, ...rest] = path.split("/").map(decodeURIComponent);
  return { ...Object.fromEntries(new URLSearchParams(query)), page: page || FIRST, path: rest.join("/") };
}

export function writeState({ page, path, ...parameters }) {
  const address = path ? `#/${page}/${encodeURIComponent(path)}` : `#/${page}`;
  return api.withParameters(address, parameters);
}

function navigate(changes, { replace = false } = {}) {
  const now = readState(location.hash);
  const leaves = changes.page !== undefined && changes.page !== now.page;
  const next = writeState(leaves ? changes : { ...now, ...changes });
  if (next === location.hash) return;
  if (replace) {
    history.replaceState(null, "", next);
    show();
  } else {
    location.hash = next;
  }
}

function announce(text) {
  announcements.textContent = "";
  requestAnimationFrame(() => { announcements.textContent = text; });
}

function makeContext(controller) {
  return {
    get: (path, options) => api.get(path, { signal: controller.signal, ...options }),
    post: api.post,
    job: api.job,
    follow: api.follow,
    navigate,
    announce,
    session,
    use,
    signal: controller.signal,
    link: (state) => writeState(state),
  };
}

// Go on with another model on every page; `previous` stays a click away.
function use(next, previous) {
  [model, before] = [next, previous];
  drawNavigation({ ...readState(location.hash), model: next });
}

function drawModelInUse() {
  const shown = document.getElementById("in-use");
  shown.hidden = !before;
  if (!before) return;
  shown.replaceChildren(el("span", { class: "soft" }, "Model "), el("strong", {}, model),
    el("button", { type: "button", class: "quiet small", title: `back to ${before}`, onclick: () => {
      const goal = before;
      use(goal, model);
      navigate({ model: goal });
    } }, `back to ${before}`));
}

function drawNavigation({ page: name, ...state }) {
  if (state.model && state.model === before) [model, before] = [before, model];
  model = state.model ?? model;
  const chosen = PAGES[name]?.within ?? name;
  const links = Object.entries(PAGES).filter(([, page]) => !page.within).map(([key, page]) =>
    el("a", { href: writeState({ page: key, model: key === FIRST ? undefined : model }), "aria-current": key === chosen ? "page" : null }, page.title));
  const bar = document.getElementById("pages");
  bar.replaceChildren(...links);
  bar.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest", inline: "nearest" }); // a narrow bar scrolls
  drawModelInUse();
}

async function show() {
  const state = readState(location.hash);
  const described = PAGES[state.page];
  drawNavigation(state);
  if (current && current.name === state.page && current.path === state.path) {
    current.page?.update?.(state);
    return;
  }
  const mine = ++turn;
  current?.controller.abort();
  current?.page?.unmount?.();
  const controller = new AbortController();
  current = { name: state.page, path: state.path, page: null, controller };
  document.title = `${described?.title ?? "Not found"}${state.path ? ` ${state.path}` : ""} · socast`;
  if (!described) {
    main.replaceChildren(empty("There is no such page", `${state.page} is not a page of the workbench.`));
    return;
  }
  main.replaceChildren(loading(`Loading ${described.title}`));
  try {
    const module = await described.load();
    if (mine !== turn) return;
    main.replaceChildren();
    main.className = `page page-${state.page}`;
    window.scrollTo(0, 0);
    current.page = module.mount(main, readState(location.hash), makeContext(controller)); // it may have changed meanwhile
    document.documentElement.dataset.page = state.page;
  } catch (error) {
    if (mine === turn) main.replaceChildren(failed(error, () => location.reload()));
  }
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  const words = `Theme: ${theme === "auto" ? "as the system" : theme}`;
  document.getElementById("theme-words").textContent = words;
  document.getElementById("theme").title = words;
  document.dispatchEvent(new CustomEvent("themechange"));
}

function startTheme() {
  let theme = "auto";
  try { theme = localStorage.getItem("theme") ?? "auto"; } catch { /* storage is off */ }
  setTheme(THEMES.includes(theme) ? theme : "auto");
  document.getElementById("theme").addEventListener("click", () => {
    const next = THEMES[(THEMES.indexOf(document.documentElement.dataset.theme) + 1) % THEMES.length];
    try { localStorage.setItem("theme", next); } catch { /* storage is off */ }
    setTheme(next);
    announce(document.getElementById("theme-words").textContent);
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
    document.dispatchEvent(new CustomEvent("themechange")));
}

// Times are in the zone of the browser, or of --time-zone; the button switches to UTC and back.
function startZone() {
  const button = document.getElementById("zone");
  let isUtc = false;
  try { isUtc = localStorage.getItem("zone") === "UTC"; } catch { /* storage is off */ }
  const apply = () => {
    setZone(isUtc ? "UTC" : session.time_zone);
    button.textContent = isUtc ? "UTC" : getZone().split("/").at(-1).replaceAll("_", " ");
    button.title = `Times in ${getZone()}; choose ${isUtc ? "local time" : "UTC"}`;
  };
  apply();
  button.hidden = false;
  button.addEventListener("click", () => {
    isUtc = !isUtc;
    try { localStorage.setItem("zone", isUtc ? "UTC" : "local"); } catch { /* storage is off */ }
    apply();
    announce(button.title);
    current?.page?.unmount?.();
    current = null;
    show();
  });
}

// A request that ended because its page was left is no error.
window.addEventListener("unhandledrejection", (event) => {
  if (event.reason?.name === "AbortError") event.preventDefault();
});

async function start() {
  startTheme();
  document.getElementById("skip").addEventListener("click", (event) => {
    event.preventDefault();
    main.focus();
  });
  drawNavigation(readState(location.hash));
  main.replaceChildren(loading("Connecting"));
  try {
    session = await api.get("/session");
  } catch (error) {
    main.replaceChildren(failed(error, () => location.reload()));
    return;
  }
  startZone();
  const badge = document.getElementById("badge");
  badge.hidden = !session.read_only;
  badge.textContent = "read-only";
  window.addEventListener("hashchange", show);
  show();
}

start();
