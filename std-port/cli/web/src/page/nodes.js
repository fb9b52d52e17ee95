// The table of nodes, the chosen one, orders, events, what the doctor found, all managers, and limits.

import { $, facts, flag, make, rows, span, text, words } from "./dom.js";
import { chosen, clock, natural, nodes, now, state, trouble } from "./state.js";
import * as alarms from "./alarms.js";
import * as forms from "./forms.js";

const about = (one) => (one.inhibited ? "stopped" : one.runs ? `${one.node.connected ? "" : "was running "}${one.runs.function}` : "–");
const offset = ({ offset_us: us, error_us: error }) => `${us < 0 ? "−" : "+"}${span(Math.abs(us) / 1000)} ± ${span(error / 1000)}`;
const since = (node) => (node.since === null ? "" : span(now() - node.since));

function stateOf({ node }) {
  // A time that is not told any more does not count on.
  if (trouble()) return node.connected ? "was connected" : "was not connected";
  if (node.connected) return `connected ${since(node)}`;
  if (node.since === null) return "has not joined";
  return node.expected ? `LOST ${since(node)} ago` : `left ${since(node)} ago`;
}

export function choose(key) {
  state.chosen = key;
  forms.show(chosen());
  draw();
}

export function step(by) {
  const all = filtered();
  const at = all.findIndex((one) => one.key === state.chosen);
  const next = all[Math.min(all.length - 1, Math.max(0, at + by))];
  if (!next) return;
  choose(next.key);
  $("nodes").known.get(next.key)?.querySelector("button").focus();
}

function filtered() {
  const wanted = $("filter").value.trim().toLowerCase().split(/\s+/).filter(Boolean);
  return nodes().filter((one) => {
    const words = `${one.name} ${one.node.role} ${stateOf(one)} ${about(one)} ${alarms.of(one.name).join(" ")} ${one.node.address ?? ""}`.toLowerCase();
    return wanted.every((word) => words.includes(word));
  });
}

export function draw() {
  const all = nodes();
  const some = filtered();
  const connected = all.filter((one) => one.node.connected).length;
  const missing = all.filter((one) => one.node.expected && !one.node.connected).length;
  text($("count"), state.unit[""] ? `${connected} of ${all.length} connected` : "");
  flag($("count"), "bad", missing > 0);
  text($("nodes-about"), some.length === all.length ? `${all.length}` : `${some.length} of ${all.length} shown`);
  // Streams may be told before the nodes that they are of.
  $("nodes-empty").hidden = some.length > 0 || !state.unit[""];
  text($("nodes-empty"), all.length ? "No node fits the filter." : "No node has joined.");
  rows($("nodes"), some.map((one) => [one.key, one]), buildRow, updateRow);
  drawChosen();
  drawOrders();
  drawEvents();
  drawLog("own-log", state.unit[""] && `${state.unit[""].name}/${state.unit[""].id}`);
  drawDoctor();
  drawManagers();
  drawLimits();
}

function buildRow(key, one) {
  const name = make("button", { type: "button", onclick: (event) => { event.stopPropagation(); choose(key); } }, one.name);
  return make("tr", { onclick: () => choose(key) }, make("td", {}, name), make("td", { className: "state" }), make("td", { className: "number" }), make("td", { className: "code" }), make("td"), make("td", { className: "warn" }));
}

function updateRow(row, one) {
  const [, state_, trip, place, order, counted] = row.children;
  flag(row, "chosen", one.key === state.chosen);
  flag(row, "lost", !one.node.connected);
  row.querySelector("button").setAttribute("aria-pressed", String(one.key === state.chosen));
  text(state_, stateOf(one));
  text(trip, one.node.connected && one.ping ? (one.ping.us === null ? "none" : span(one.ping.us / 1000)) : "–");
  text(place, one.pose ? `${one.pose.x.toFixed(2)}, ${one.pose.y.toFixed(2)}${one.isOld ? ` (${span(now() - one.pose.at)} ago)` : ""}` : "–");
  text(order, about(one));
  flag(order, "warn", one.inhibited);
  text(counted, alarms.of(one.name).join(", "));
}

function drawChosen() {
  const one = chosen();
  $("node-hint").hidden = one !== null;
  $("node-body").hidden = one === null;
  $("node-stop").hidden = $("node-reset").hidden = one === null;
  text($("node-title"), one?.name ?? "No node chosen");
  if (!one) return facts($("node-facts"), []);
  const { node } = one;
  const told = [["State", stateOf(one) + (node.left_text && !node.connected ? `: ${node.left_text}` : "")], ["Role", node.role]];
  if (node.connected) told.push(["Address", node.address ?? "–"], ["Run", node.epoch ?? "–"]);
  if (node.connected && node.clock) told.push(["Clock", offset(node.clock)]);
  if (one.inhibited) told.push(["Stopped", one.inhibited.inhibited.by ? `by unit ${one.inhibited.inhibited.by}` : `by itself, reason ${one.inhibited.inhibited.reason}`]);
  facts($("node-facts"), told);
  facts($("streams"), Object.entries(state.streams).filter(([, stream]) => stream.node === one.name).map(([number, stream]) => {
    const value = state.values[number];
    return [stream.name, value ? `${node.connected ? "" : "was "}${show(value[2])}  ·  ${span(now() - value[1])} old` : "no value yet"];
  }).sort(([a], [b]) => natural(a, b)));
  drawLog("node-log", one.name);
  facts($("counters"), Object.entries(state.counters[one.name] ?? {}).map(([name, count]) => [words(name), count.toLocaleString("en")]));
  forms.refresh(one);
}

const number = (value) => {
  const fine = Number(value);
  return Number.isInteger(fine) || Number.isNaN(fine) ? String(value) : fine.toFixed(2);
};
const show = (values) => values.map(([name, value, isText]) => {
  if (isText) return `${name} ${value}`;
  if (!Array.isArray(value)) return `${name} ${JSON.stringify(value)}`;
  return `${name} ${value.map(number).join(", ")}`;
}).join("; ");

let longest = 1;
function drawOrders() {
  const all = Object.entries(state.orders).filter(([, order]) => order.order === "runs" || order.inhibited);
  text($("orders-about"), all.length ? "" : "none runs, and nothing is stopped");
  rows($("orders"), all, () => make("tr", {}, ...Array.from({ length: 5 }, () => make("td"))), (row, order) => {
    const [node, name, what, holder, left] = row.children;
    const connected = nodeConnected(order);
    flag(row, "lost", !connected);
    text(node, `${order.node}/${order.id}`);
    text(name, order.function);
    const inhibited = order.inhibited && (order.inhibited.by ? `stopped by unit ${order.inhibited.by}` : `stopped by itself, reason ${order.inhibited.reason}`);
    text(what, order.order === "runs" ? (connected ? "runs" : "was running") : inhibited);
    flag(what, "warn", order.inhibited);
    text(holder, order.holder === null ? "–" : String(order.holder));
    if (order.ends === undefined || order.order !== "runs" || !connected) return left.replaceChildren("–");
    if (!left.firstElementChild) left.replaceChildren(make("meter", { min: 0 }), make("span", { className: "number" }));
    const ms = Math.max(0, order.ends - now());
    longest = Math.max(longest, ms);
    left.firstElementChild.max = longest;
    left.firstElementChild.value = ms;
    left.firstElementChild.setAttribute("aria-label", `time left of ${order.function}`);
    text(left.lastElementChild, ` ${ms > 0 ? span(ms) : "over, or not told yet"}`);
  });
}

const nodeConnected = (order) => Object.values(state.nodes).some((node) => node.name === order.node && node.id === order.id && node.connected);

let told = null;
function drawEvents() {
  if (told === state.events[0]) return;
  told = state.events[0];
  $("events").replaceChildren(...state.events.slice(0, 100).map((event) => make("li", {},
    make("time", { dateTime: new Date(event.unix_ms).toISOString() }, clock(event.unix_ms)), make("strong", {}, words(event.event)), " ", event.node ? `${event.node} ` : "", event.text)));
}

// Lines of a node's log, the newest first.
const drawnLogs = {};
function drawLog(id, name) {
  const lines = state.logs[name] ?? null;
  if (drawnLogs[id] === lines) return;
  drawnLogs[id] = lines;
  $(id).parentElement.hidden = lines === null;
  $(id).replaceChildren(...(lines ?? []).map(([ms, line]) => make("li", {}, make("time", { dateTime: new Date(ms).toISOString() }, clock(ms)), line)).reverse());
}

let found = null;
const looked = (at) => `looked ${span(now() - at)} ago, at ${clock(Date.now() - (now() - at))}`;
// A survey that runs or has failed, until a later one, of any page, has found something; and how old that is which is shown.
function drawSurvey(about, found) {
  const own = state.surveys[about];
  const shown = own && (own.runs || !found || found.at < own.at) ? own : null;
  text($(about), [shown?.text, found && looked(found.at)].filter(Boolean).join("; "));
  flag($(about), "bad", shown && !shown.runs);
}

function drawDoctor() {
  const doctor = state.doctor[""];
  const refused = Object.entries(state.refused);
  drawSurvey("doctor-about", doctor);
  const key = JSON.stringify([doctor, refused]);
  if (key === found) return;
  found = key;
  const items = refused.map(([address, { node, reason, text: why, at }]) => finding("error", `refused ${node ?? address}: ${reason}`, `${clock(Date.now() - (now() - at))}`, why));
  for (const { severity, id, about, found: seen, advice } of doctor?.findings ?? []) items.push(finding(severity, id + (about ? `, ${about}` : ""), seen, advice));
  if (doctor && !items.length) items.push(make("li", { className: "good" }, "Nothing strange was found."));
  $("findings").replaceChildren(...items);
}

const finding = (severity, what, seen, advice) => make("li", {},
  make("strong", { className: { error: "bad", warning: "warn" }[severity] ?? "good" }, `${severity}: ${what}`), seen ? ` ${seen}` : "", make("div", { className: "advice" }, `→ ${advice}`));

let asked = null;
function drawManagers() {
  const managers = state.managers[""];
  drawSurvey("managers-about", managers);
  if (!managers || managers === asked) return;
  asked = managers;
  $("managers").replaceChildren(...managers.rows.map(({ cells, kind }) => make("tr", { className: kind }, ...cells.map((cell, index) => make("td", { className: index === 1 ? "number" : "" }, cell)))));
  $("managers-remarks").replaceChildren(...managers.remarks.map((remark) => make("li", { className: "faint" }, remark)));
}

function drawLimits() {
  const all = state.limits[""] ?? [];
  rows($("limits"), all.map((one) => [one.name, one]), () => make("tr", {}, make("td"), ...Array.from({ length: 3 }, () => make("td", { className: "number" }))), (row, one) => {
    [one.name, one.most === null ? "" : String(one.used), one.most === null ? "" : String(one.most), String(one.refused)].forEach((value, index) => text(row.children[index], value));
    flag(row.lastElementChild, "warn", one.refused > 0);
  });
}
