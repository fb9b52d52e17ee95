// Alarms: what an operator has to know of, from when it began until it has ended and somebody has seen it. They are in the memory
// of this page alone: another page has its own, and a page that is loaded again begins anew.

import { $, flag, make, rows, span, text } from "./dom.js";
import { clock, fullName, nodes, now, state, trouble } from "./state.js";

// So many are kept. The oldest gives way, one that has ended first.
const MOST = 100;
// A counter that has not grown for so long, or a node that was refused longer ago, is in order again.
const QUIET = 30000;

// Counters of a link that an operator should know of, in words.
const MATTER = {
  KeepAlivesMissed: "keep-alives missed", CallsTimedOut: "calls timed out", LeasesExpired: "leases expired",
  RequestsBusy: "refused as busy", RequestsForbidden: "forbidden", RequestsExpired: "too old", SendRefused: "sends refused",
  RepliesLate: "late replies", RepliesDropped: "replies lost", DatagramsForged: "forged datagrams", ProofsFailed: "proofs failed",
  FramesRefused: "frames refused", RequestsRejected: "requests rejected", SubscriptionsRefused: "subscriptions refused",
};

let alarms = [];
let serial = 0;
// By node and name: the count when it was in order last, the newest one, and when that came.
const counted = new Map();

// What is wrong now, by what it is about.
function wrong() {
  const found = new Map();
  for (const { node, name } of nodes()) {
    if (node.expected && !node.connected) found.set(`node ${name}`, [name, node.since === null ? "has not joined" : "is lost"]);
    if (node.connected && node.clock?.trouble) found.set(`clock ${name}`, [name, node.clock.trouble]);
  }
  for (const order of Object.values(state.orders).filter((one) => one.inhibited)) {
    const { by, reason } = order.inhibited;
    found.set(`order ${fullName({ name: order.node, id: order.id })} ${order.function}`,
      [`${order.node}/${order.id}`, `${order.function} is stopped ${by ? `by unit ${by}` : `by itself, reason ${reason}`}`]);
  }
  for (const [address, { node, reason, at }] of Object.entries(state.refused)) {
    if (now() - at < QUIET) found.set(`refused ${address}`, [node ?? address, `is refused: ${reason}`]);
  }
  for (const [key, { name, word, calm, count, at }] of counted) {
    if (count > calm && now() - at < QUIET) found.set(`counter ${key}`, [name, `${count - calm} ${word}`]);
  }
  return found;
}

function count() {
  for (const [name, counters] of Object.entries(state.counters)) {
    for (const [counter, count] of Object.entries(counters)) {
      const word = MATTER[counter];
      if (!word) continue;
      const key = `${name} ${counter}`;
      const had = counted.get(key);
      // What was counted before this page came has no begin that it knows. A manager that was restarted counts from 0.
      if (!had || count < had.count) counted.set(key, { name, word, calm: count, count, at: -QUIET });
      else if (count > had.count) Object.assign(had, { calm: now() - had.at < QUIET ? had.calm : had.count, count, at: now() });
    }
  }
  for (const key of counted.keys()) if (!state.counters[counted.get(key).name]) counted.delete(key);
}

// Begins and ends them. Where nothing new is told, none does.
export function look() {
  const lost = trouble();
  const found = lost ? new Map() : (count(), wrong());
  if (lost) found.set("manager", ["", lost.what]);
  for (const alarm of alarms) {
    const still = found.get(alarm.key);
    if (alarm.end === null && still) alarm.what = still[1];
    else if (alarm.end === null && (!lost || alarm.key === "manager")) alarm.end = Date.now();
    if (alarm.end === null) found.delete(alarm.key);
  }
  for (const [key, [name, what]] of found) alarms.unshift({ key, name, what, begin: Date.now(), end: null, seen: null, serial: serial += 1 });
  alarms = alarms.filter((alarm) => alarm.end === null || alarm.seen === null);
  while (alarms.length > MOST) alarms.splice(Math.max(alarms.findLastIndex((alarm) => alarm.end !== null), 0) || MOST, 1);
  draw();
}

// What a node's row says.
export const of = (name) => alarms.filter((alarm) => alarm.name === name && !alarm.key.startsWith("node ") && !alarm.key.startsWith("order ")).map((alarm) => alarm.what);

export function acknowledge(some = alarms) {
  for (const alarm of some) alarm.seen ??= Date.now();
  look();
}

function draw() {
  const open = alarms.filter((alarm) => alarm.end === null).length;
  const unseen = alarms.filter((alarm) => alarm.seen === null).length;
  text($("alarms-about"), alarms.length ? `${open} now, ${unseen} not acknowledged` : "none");
  flag($("alarms-about"), "bad", open > 0);
  $("alarms-all").hidden = unseen === 0;
  rows($("alarms"), alarms.map((alarm) => [alarm.serial, alarm]), (_, alarm) => make("li", {},
    make("button", { type: "button", className: "small", onclick: () => acknowledge([alarm]) }, "Acknowledge"),
    make("strong", {}), make("div", { className: "faint" })), (row, alarm) => {
    const [button, what, when] = row.children;
    button.hidden = alarm.seen !== null;
    text(what, `${alarm.name} ${alarm.what}`.trim());
    flag(what, "bad", alarm.end === null);
    text(when, `${clock(alarm.begin)}, ${alarm.end === null ? `for ${span(Date.now() - alarm.begin)}` : `until ${clock(alarm.end)}`}${alarm.seen === null ? "" : `; acknowledged ${clock(alarm.seen)}`}`);
  });
}
