// Stop and reset, of one node or of all. Each acknowledgement is shown, and so is each that does not come.

import { $, flag, make, span, text } from "./dom.js";
import { ask } from "./api.js";
import { failure } from "./forms.js";
import { may, nodes, state } from "./state.js";

// A vehicle that has not acknowledged by then is shown as such, though its answer may still come.
const LATE = 1000;
// A browser has few connections to one server. A stop that has none by then takes those that follow what changes, of all pages.
const NO_WAY = 300;
// How long the attempt of a stop may take.
const ATTEMPT = 5000;
let run = 0;
let refused = null;
let isReady = false;

// Tries with a request that does nothing, and that has to pass all that a stop has to pass. Whether a stop can be asked for.
export async function prepare() {
  try {
    for await (const _ of ask("api/ready", {}, AbortSignal.timeout(ATTEMPT))) { /* it has no answer */ }
    refused = null;
  } catch (error) {
    // A server that is not reached now, or that is busy, may be reached when it matters: then the stop itself says if not.
    if (!(error.status < 500)) return isReady;
    refused = error;
  }
  isReady = refused === null;
  $("stop-all").disabled = !isReady;
  $("reset-all").disabled = !isReady || !may("reset");
  return isReady;
}

// Why a stop would not pass, as far as the server has said that; null if it would.
export function refusal() {
  if (!refused) return null;
  return refused.status === 403 ? `${refused.message} (here: --origin ${location.origin}${location.pathname})` : refused.message;
}

export function note(isCutOff) {
  // Every role stops.
  const title = may("reset") ? "" : `needs the role reset; yours is ${state.me.role}`;
  $("reset-all").disabled = !isReady || !may("reset");
  $("node-reset").disabled = !may("reset");
  for (const button of ["reset-all", "node-reset"]) if ($(button).title !== title) $(button).title = title;
  const started = isReady ? "" : "this page has not started";
  text($("stop-note"), refused ? "refused by the server" : isCutOff ? "no connection" : started);
}

export async function all(what, makeWay) {
  const mine = run += 1;
  const isStop = what === "stop";
  const panel = $("stop-panel");
  panel.hidden = false;
  panel.className = "card stop-panel";
  text($("stop-title"), isStop ? "Stop of all" : "Reset of all");
  const begun = performance.now();
  const items = new Map();
  $("stop-list").replaceChildren();
  for (const one of nodes().filter((one) => one.node.expected)) item(items, one.name);
  const seen = { answers: 0, good: 0, last: 0, error: null, ended: false };
  const tell = () => { if (mine === run) summary(seen, items, isStop, performance.now() - begun); };
  tell();
  const timers = [setTimeout(tell, LATE), setTimeout(makeWay, NO_WAY)];
  try {
    for await (const line of ask(`api/${what}`, { node: null }, undefined, "high")) {
      clearTimeout(timers[1]);
      if (mine !== run) break;
      if (line.answer === "called") acknowledged(seen, item(items, `${line.node}/${line.id}`), line);
      if (line.answer === "failed") seen.error = failure(line);
      if (line.answer === "done") seen.ended = true;
      tell();
    }
    if (!seen.ended) seen.error ??= "the answer broke off: the server or the manager has ended";
  } catch (error) {
    seen.error = `the server of this page was not reached: ${error.message}`;
  }
  timers.forEach(clearTimeout);
  seen.ended = true;
  tell();
}

function item(items, name) {
  if (!items.has(name)) {
    const made = make("li", {}, make("strong", {}, name), " ", make("span", {}, "asked …"));
    items.set(name, made);
    $("stop-list").append(made);
  }
  return items.get(name);
}

function acknowledged(seen, element, { error, took_us }) {
  seen.answers += 1;
  const told = element.lastElementChild;
  flag(element, "bad", error);
  flag(element, "good", !error);
  if (error) return text(told, error.error === "NotConnected" ? `NOT REACHED: ${error.text}` : failure(error));
  seen.good += 1;
  seen.last = Math.max(seen.last, took_us);
  text(told, `acknowledged after ${span(took_us / 1000)}`);
}

function summary(seen, items, isStop, elapsed) {
  const word = isStop ? "stopped" : "reset";
  const count = Math.max(items.size, seen.answers);
  const list = [`${seen.good} of ${count} acknowledged${seen.good ? `, the last after ${span(seen.last / 1000)}` : ""}.`];
  const fine = seen.ended && !seen.error && seen.good === count && count > 0;
  if (seen.ended && count === 0 && !seen.error) list.push(`No vehicle is known: nothing was ${word}.`);
  if (seen.error) list.unshift(`${isStop ? "THE STOP FAILED" : "The reset failed"}: ${seen.error}.`);
  const open = [...items.values()].filter((element) => !element.classList.contains("good") && !element.classList.contains("bad"));
  if (seen.ended || elapsed > LATE) {
    for (const element of open) {
      flag(element, "bad", seen.ended);
      text(element.lastElementChild, "NO ACKNOWLEDGEMENT");
    }
  }
  if (isStop && seen.ended && !fine) list.push("Use the vehicles’ own emergency stop.");
  text($("stop-summary"), list.join(" "));
  $("stop-summary").className = fine ? "good" : seen.ended || elapsed > LATE ? "bad" : "";
  flag($("stop-panel"), "done", fine);
}

export async function one(what) {
  const node = state.chosen;
  const outcome = $("node-outcome");
  const tell = (kind, said) => {
    outcome.hidden = false;
    outcome.className = `outcome ${kind}`;
    text(outcome, said);
  };
  tell("", `${what} asked …`);
  try {
    for await (const line of ask(`api/${what}`, { node })) {
      if (state.chosen !== node) return;
      if (line.answer === "called" && line.error) tell("bad", `The ${what} failed. ${failure(line.error)}`);
      else if (line.answer === "called") tell("good", `${what} acknowledged after ${span(line.took_us / 1000)}`);
      if (line.answer === "failed") tell("bad", `The ${what} failed. ${failure(line)}`);
    }
  } catch (error) {
    tell("bad", `The ${what} did not reach the server of this page: ${error.message}`);
  }
}
