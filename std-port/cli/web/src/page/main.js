// Joins the parts: messages of the server, the theme, the keyboard, and the banner that says when nothing is new.

import { $, flag, forgetColours, span, text } from "./dom.js";
import * as alarms from "./alarms.js";
import * as api from "./api.js";
import * as charts from "./charts.js";
import * as map from "./map.js";
import * as nodes from "./nodes.js";
import * as stop from "./stop.js";
import { may, now, ROLES, state, take, trouble } from "./state.js";

// Between two attempts to reach the server again.
const RETRY = 1000;
// The tables are drawn so often, and the map with each message.
const DRAW = 250;

// A connection on which nothing came for so long is given up.
const SILENT = 5000;
// A page that was hidden for so long follows nothing: all pages of a browser share a few connections.
const HIDDEN = 10000;
// Between two attempts whether a stop would pass. They keep a connection open that has shown the token.
const PREPARE = 10000;

// The buttons of surveys of the network, and where it is told of them.
const SURVEYS = [["doctor", "doctor-about"], ["managers-look", "managers-about"]];

const wait = (ms) => new Promise((go) => setTimeout(go, ms));
let connection = new AbortController();
let isOpen = false;
async function listen() {
  for (;;) {
    while (document.hidden && state.heard !== null) await wait(DRAW);
    connection = new AbortController();
    try {
      await api.follow(heard, opened, connection.signal);
    } catch (error) {
      if (error.isForStop) {
        await wait(2 * RETRY);
        continue;
      }
      if (error.status === 401) {
        await login();
        continue;
      }
      state.broken = error.message;
      if (state.heard === null) shout("No connection to cara web.", error.message);
    }
    await wait(RETRY);
  }
}

// A stop gets the connection that this page, or another one of the browser, would follow what changes with.
const pages = new BroadcastChannel("cara-stop");
const makeWay = () => connection.abort(Object.assign(new Error("a stop needs the connection"), { isForStop: true }));
pages.onmessage = makeWay;
const stopAll = (what) => stop.all(what, () => { pages.postMessage(what); makeWay(); });

// What is scrolled to, by the keyboard too, comes to stand below the bar and not under it.
const barHeight = new ResizeObserver(([bar]) => {
  document.documentElement.style.scrollPaddingTop = `${Math.ceil(bar.target.getBoundingClientRect().height)}px`;
});

async function prepare() {
  for (;;) await wait(await stop.prepare() ? PREPARE : RETRY);
}

function opened() {
  if (!isOpen) prepare();
  isOpen = true;
  $("login").close();
  api.map().then((background) => background && map.lay(background)).catch(() => {});
}

function heard(message) {
  take(message);
  state.broken = null;
  map.redraw();
}

// Until a token was given.
function login() {
  if (api.token()) text($("login-error"), "This token is not the right one.");
  if (!$("login").open) $("login").showModal();
  return new Promise((go) => {
    $("login-form").onsubmit = (event) => {
      event.preventDefault();
      api.keepToken($("token").value);
      $("token").value = "";
      go();
    };
  });
}

function shout(what, why) {
  const banner = $("banner");
  banner.hidden = false;
  if (banner.firstChild?.textContent !== what || banner.lastChild?.textContent !== why) {
    banner.replaceChildren(what, Object.assign(document.createElement("small"), { textContent: why }));
  }
}

function drawLink() {
  const wrong = trouble();
  const banner = $("banner");
  flag(document.body, "stale", wrong);
  if (wrong) {
    // Only what is new is read aloud: the age counts on the map and in the pill.
    shout(`${wrong.what}. What is shown is old.`, wrong.why);
    text($("link"), `old: ${span(wrong.age)} ago`);
  } else if (state.heard !== null) {
    const refusal = stop.refusal();
    if (refusal) shout("STOP ALL does not work on this page.", refusal);
    else banner.hidden = true;
    text($("link"), "live");
  }
  stop.note(wrong);
  flag($("link"), "bad", wrong);
  flag($("link"), "good", !wrong && state.heard !== null);
  $("me").hidden = !state.me?.name;
  if (state.me?.name) text($("me"), `${state.me.name} ${ROLES[state.me.role] ?? state.me.role}`);
  for (const [button, about] of SURVEYS) $(button).disabled = state.surveys[about]?.runs || !may("see");
  const unit = state.unit[""];
  if (unit) {
    text($("unit"), `${unit.name}/${unit.id}`);
    text($("unit-more"), `fleet ${unit.fleet}, ${unit.mode ?? ""}`);
    document.title = `${wrong ? "OLD – " : ""}${unit.name} – CARA`;
  }
  if (wrong) map.redraw();
  if (performance.now() - (state.heard ?? performance.now()) > SILENT) connection.abort(new Error("the server says nothing any more"));
}

const THEMES = ["system", "light", "dark"];
function theme(next) {
  const chosen = next ?? localStorage.getItem("cara-theme") ?? "system";
  localStorage.setItem("cara-theme", chosen);
  if (chosen === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = chosen;
  text($("theme"), `Theme: ${chosen}`);
  recolour();
}
function recolour() {
  forgetColours();
  map.redraw(true);
  charts.draw();
}
const nextTheme = () => theme(THEMES[(THEMES.indexOf(localStorage.getItem("cara-theme") ?? "system") + 1) % THEMES.length]);

const KEYS = {
  "/": () => $("filter").focus(), "?": () => $("help").showModal(), t: nextTheme, j: () => nodes.step(1), k: () => nodes.step(-1),
  f: () => document.querySelector("#functions summary")?.focus(),
};

function keyboard(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || event.isComposing) return;
  if (event.target.closest("input, textarea, select")) {
    if (event.key === "Escape") event.target.blur();
    return;
  }
  if (event.shiftKey && event.key === "S" && !event.repeat) return void stopAll("stop");
  if (KEYS[event.key] && !document.querySelector("dialog[open]")) {
    event.preventDefault();
    KEYS[event.key]();
  }
}

async function survey(about, path, seconds) {
  if (state.surveys[about]?.runs) return;
  state.surveys[about] = { text: `listens for ${seconds} s …`, runs: true };
  let failure = null;
  try {
    for await (const line of api.ask(path, {})) {
      if (line.answer === "failed") failure = line.text;
    }
  } catch (error) {
    failure = `not reached: ${error.message}`;
  }
  state.surveys[about] = failure && { text: failure, runs: false, at: now() };
}

api.token();
theme();
barHeight.observe(document.querySelector(".bar"));
map.start(nodes.choose);
$("theme").onclick = nextTheme;
$("stop-all").onclick = () => stopAll("stop");
$("stop-close").onclick = () => { $("stop-panel").hidden = true; };
$("node-stop").onclick = () => stop.one("stop");
$("node-reset").onclick = () => stop.one("reset");
$("reset-all").onclick = () => $("confirm").showModal();
$("confirm-no").onclick = () => $("confirm").close();
$("confirm-yes").onclick = () => { $("confirm").close(); stopAll("reset"); };
$("help-open").onclick = () => $("help").showModal();
$("help-close").onclick = () => $("help").close();
$("doctor").onclick = () => survey("doctor-about", "api/doctor", 6);
$("managers-look").onclick = () => survey("managers-about", "api/managers", 2);
$("alarms-all").onclick = () => alarms.acknowledge();
$("filter").oninput = () => nodes.draw();
// A token is not to be passed by: without it nothing is shown.
$("login").addEventListener("cancel", (event) => event.preventDefault());
document.addEventListener("keydown", keyboard);
document.addEventListener("visibilitychange", () => {
  if (document.hidden) setTimeout(() => { if (document.hidden) connection.abort(new Error("this page was hidden")); }, HIDDEN);
});
// An address with a key, opened where the page is already.
addEventListener("hashchange", () => location.reload());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", recolour);
setInterval(() => { drawLink(); if (state.heard !== null) { alarms.look(); nodes.draw(); } }, DRAW);
setInterval(charts.sample, 1000);
listen();
