// A form for each function of the chosen node, made from its signature. What is typed is checked as it is typed, and again by the
// server and the node.

import { $, make, span, text } from "./dom.js";
import { ask, beat } from "./api.js";
import { may, state } from "./state.js";

// A page that holds says so four times in the length of the lease, and often enough for the server, which gives up after 1.5 s.
// Nothing else renews it.
const BEAT = [50, 400];
// Of these messages so many may be on their way.
const BEATS = 3;
// Fields of their own for so many elements; more are written as a list.
const FIELDS = 8;
let about = { key: null, epoch: null, count: null, asked: 0 };

export function show(one) {
  $("functions").replaceChildren();
  $("node-outcome").hidden = true;
  about = { key: null };
  if (one) refresh(one);
}

// Asks for the functions again where the node has started again or has published others.
export async function refresh({ key, node }) {
  if (!node.connected) {
    if (about.key !== key) $("functions").replaceChildren(make("p", { className: "faint" }, "Not connected: its functions are told once it is."));
    about = { ...about, key, epoch: null };
    return;
  }
  if (about.key === key && about.epoch === node.epoch && about.count === node.functions) return;
  const mine = { key, epoch: node.epoch, count: node.functions };
  about = mine;
  const found = [];
  try {
    for await (const line of ask("api/functions", { node: key })) {
      if (line.answer === "function") found.push(line.function);
      if (line.answer === "failed") throw new Error(line.text);
    }
  } catch (error) {
    if (about === mine) $("functions").replaceChildren(make("p", { className: "error" }, `Its functions are not told: ${error.message}`));
    return;
  }
  if (about !== mine) return;
  const list = found.filter((info) => info.stream_ms === undefined);
  $("functions").replaceChildren(...(list.length ? list.map((info) => form(key, info)) : [make("p", { className: "faint" }, "It has published none to this unit.")]));
}

// How attributes without a value are shown; one that is not here is shown by its name.
const FLAGS = { stop: ["stops", "bad"], reset: ["resets", ""] };

function badges(info) {
  const all = Object.keys(info).filter((key) => info[key] === true).map((key) => FLAGS[key] ?? [key, ""]);
  if (info.lease_us) all.push([`lease ${span(info.lease_us / 1000)}`, ""]);
  if (info.priority && info.priority !== "normal") all.push([info.priority, ""]);
  return all.map(([word, kind]) => make("span", { className: `badge ${kind}` }, word));
}

function form(node, info) {
  const fields = info.inputs === null ? [wholeCall()] : info.inputs.map((input) => field(info.name, input));
  const options = optionsOf(info);
  const outcome = make("p", { className: "outcome", role: "status", hidden: true });
  const call = make("button", { type: "submit", className: "primary" }, `Call ${info.name}`);
  const needed = info.reset ? "reset" : info.stop && !info.lease_us ? "stop" : "operate";
  call.disabled = !may(needed);
  const refusal = call.disabled && make("p", { className: "faint" }, `Your role, ${state.me.role}, may not call this: it needs ${needed}.`);
  const running = { abort: null };
  const made = make("form", { noValidate: true, autocomplete: "off" }, make("p", { className: "faint code" }, info.signature),
    info.help ? make("p", { className: "help" }, info.help) : null, ...fields.map((one) => one.element), options.element, call, refusal, outcome);
  made.addEventListener("submit", (event) => {
    event.preventDefault();
    if (running.abort) return running.abort.abort();
    const wrong = fields.filter((one) => one.check() !== null);
    if (wrong.length) return wrong[0].focus();
    const values = info.inputs === null ? fields[0].value() : fields.map((one) => one.value());
    run({ node, function: info.name, arguments: values, ...options.value() }, { call, outcome, running, info });
  });
  return make("details", { className: "function" }, make("summary", {}, info.name, ...badges(info)), made);
}

async function run(question, { call, outcome, running, info }) {
  running.abort = new AbortController();
  text(call, question.hold ? "Release" : "Give up");
  tell(outcome, "", question.hold ? "asked …" : "waits for the answer …");
  let timer = null;
  let has = false;
  let beats = 0;
  const isHere = (hold) => {
    if (document.hidden || beats >= BEATS) return;
    beats += 1;
    beat(hold).catch(() => {}).finally(() => { beats -= 1; });
  };
  try {
    for await (const line of ask("api/call", question, running.abort.signal)) {
      if (line.answer === "held") timer = setInterval(isHere, Math.min(BEAT[1], Math.max(BEAT[0], info.lease_us / 4000)), line.hold);
      else if (line.answer === "called") { has = true; called(outcome, line, question, info); }
      else if (line.answer === "ended") tell(outcome, line.expired ? "bad" : "good", line.expired ? "It stopped there: the node was lost, or stopped it." : "finished");
      else if (line.answer === "failed") { has = true; tell(outcome, "bad", failure(line)); }
    }
    if (!has) tell(outcome, "bad", "It ended without an answer.");
  } catch (error) {
    const mine = running.abort.signal.aborted;
    tell(outcome, mine ? "" : "bad", mine ? (question.hold ? "released" : "given up") : `Not known whether it arrived: ${error.message}`);
  }
  clearInterval(timer);
  running.abort = null;
  text(call, `Call ${info.name}`);
}

export const failure = ({ error, kind, code, text: why, values = [] }) => {
  const more = [kind, code === null || code === undefined ? null : `code ${code}`].filter(Boolean).join(", ");
  return `${error}${more ? ` (${more})` : ""}: ${why}${values.map((value) => `\n${value.name} = ${shown(value)}`).join("")}`;
};

function called(outcome, { results, call, error, took_us }, question, info) {
  if (error) return tell(outcome, "bad", failure(error));
  const took = `after ${span(took_us / 1000)}`;
  if (question.asynchronous) return tell(outcome, "good", `accepted as call ${call}, ${took}; a failure would be told among the events`);
  const values = results.map((result) => `${result.name} = ${shown(result)}`).join("\n");
  const held = question.hold ? "; held, as long as this page is shown" : info.lease_us ? `; it goes on for the length of its lease, ${span(info.lease_us / 1000)}` : "";
  tell(outcome, "good", `${values || "done"}\n${took}${held}`);
}

// Lists and records are text: no digit of theirs goes through a number of this page.
function shown({ type, value, size }) {
  if (type === "string") return JSON.stringify(value);
  if (type === "bytes") return value === "" ? "(no bytes)" : `0x${value}`;
  if (Array.isArray(value)) return size === 1 ? String(value[0]) : `[${value.join(", ")}]`;
  return typeof value === "string" ? value : JSON.stringify(value, null, 1);
}

function tell(outcome, kind, what) {
  outcome.className = `outcome ${kind}`;
  outcome.hidden = false;
  text(outcome, what);
}

function optionsOf(info) {
  const check = (label, title) => {
    const box = make("input", { type: "checkbox" });
    return [box, make("label", { title }, box, label)];
  };
  const timeout = make("input", { inputMode: "numeric", placeholder: "of the unit" });
  const priority = make("select", {}, make("option", { value: "" }, "of the function"), ...["emergency", "high", "normal", "low"].map((word) => make("option", {}, word)));
  const [hold, holdLabel] = check("hold: keep the lease until it has finished, or this page is hidden or closed", "as cara call --hold");
  const [later, laterLabel] = check("do not wait for results", "as cara call --async");
  const [best, bestLabel] = check("in one datagram, now or never", "as cara call --best-effort");
  const [over, overLabel] = check("take over what another unit moves", "as cara call --take-over");
  best.disabled = true;
  hold.disabled = !info.lease_us;
  hold.onchange = () => { later.disabled = hold.checked; };
  later.onchange = () => { best.disabled = !later.checked; hold.disabled = later.checked || !info.lease_us; if (!later.checked) best.checked = false; };
  const element = make("details", {}, make("summary", { className: "faint" }, "Options"), make("div", { className: "options" },
    make("label", {}, "Time-out in ms", timeout), make("label", {}, "Priority", priority), ...(info.lease_us ? [holdLabel] : []), laterLabel, bestLabel, overLabel));
  const value = () => ({
    asynchronous: later.checked, best_effort: best.checked, take_over: over.checked, hold: hold.checked,
    timeout_ms: /^\d+$/.test(timeout.value.trim()) ? Number(timeout.value) : null, priority: priority.value || null,
  });
  return { element, value };
}

let serial = 0;

// The arguments of a function whose signature this version cannot read.
function wholeCall() {
  const made = frame("arguments", "", "as on the control socket: a list of name, size, type and value");
  const area = made.add(make("textarea", { rows: 4, className: "long", value: "[]" }));
  const check = () => { try { return Array.isArray(JSON.parse(area.value)) ? null : "a list in [ ]"; } catch (error) { return error.message; } };
  return made.done(check, () => area.value);
}

// Label, inputs and the place for what is wrong, joined for screen readers.
function frame(name, type, more) {
  const id = `field-${serial += 1}`;
  const error = make("div", { className: "error", id: `${id}-error` });
  const inputs = make("div", { className: "inputs" });
  const label = make("span", { className: "label", id }, name, " ", make("span", {}, [type, more].filter(Boolean).join(", ")));
  const element = make("div", { className: "field", role: "group" }, label, inputs, error);
  element.setAttribute("aria-labelledby", id);
  const all = [];
  return {
    add(input, position = null) {
      input.setAttribute("aria-describedby", `${id}-error`);
      input.setAttribute("aria-label", position === null ? name : `${name}, element ${position + 1}`);
      all.push(input);
      inputs.append(input);
      return input;
    },
    say(what) { text(error, what); },
    done(check, value) {
      const look = () => {
        const wrong = check();
        text(error, wrong ?? "");
        all.forEach((input) => input.setAttribute("aria-invalid", String(wrong !== null)));
        return wrong;
      };
      all.forEach((input) => input.addEventListener("input", look));
      return { element, check: look, value, focus: () => all[0].focus() };
    },
  };
}

const INT = [-(2n ** 63n), 2n ** 63n - 1n];
const READ = {
  int(written) {
    if (!/^[+-]?\d+$/.test(written)) return [null, `“${written}” is no whole number`];
    const value = BigInt(written.replace("+", ""));
    return value < INT[0] || value > INT[1] ? [null, `“${written}” does not fit into 64 bits`] : [String(value), null];
  },
  float(written) {
    if (/^(nan|[+-]?inf)$/i.test(written)) return [{ nan: "NaN", inf: "inf", "+inf": "inf", "-inf": "-inf" }[written.toLowerCase()], null];
    return /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(written) && Number.isFinite(Number(written)) ? [Number(written), null] : [null, `“${written}” is no number`];
  },
  bool(written) {
    const found = { true: true, false: false }[written.toLowerCase()];
    return found === undefined ? [null, `“${written}” is neither true nor false`] : [found, null];
  },
};

function field(name, input) {
  const { type, size, unit: more } = input;
  if (type === "string" || type === "bytes") return textField(input, more);
  if (type === "bool" && size <= FIELDS) return truths(input, more);
  if (READ[type]) return numbers(input, more);
  return anything(input, more);
}

const argument = ({ name, type, size }, value) => ({ name, type, size, value });

function numbers(input, more) {
  const { name, type, size } = input;
  const made = frame(name, size === 1 ? type : `${type}[${size}]`, more);
  const single = size <= FIELDS;
  const all = single
    ? Array.from({ length: size }, (_, at) => made.add(make("input", { inputMode: type === "int" ? "numeric" : "decimal" }), size === 1 ? null : at))
    : [made.add(make("textarea", { className: "long", rows: 3, placeholder: `${size} values, with spaces or commas between` }))];
  const words = () => (single ? all.map((one) => one.value.trim()) : all[0].value.split(/[\s,]+/).filter(Boolean));
  const check = () => {
    const found = words();
    if (found.length !== size) return `${size} values, and there are ${found.length}`;
    const empty = found.indexOf("");
    if (empty >= 0) return size === 1 ? `a ${type} is missing` : `element ${empty + 1} is missing`;
    return found.map((word) => READ[type](word)[1]).find((wrong) => wrong !== null) ?? null;
  };
  return made.done(check, () => argument(input, words().map((word) => READ[type](word)[0])));
}

function truths(input, more) {
  const made = frame(input.name, input.size === 1 ? "bool" : `bool[${input.size}]`, more);
  const all = Array.from({ length: input.size }, (_, at) => made.add(make("input", { type: "checkbox" }), input.size === 1 ? null : at));
  return made.done(() => null, () => argument(input, all.map((one) => one.checked)));
}

function textField(input, more) {
  const { name, type, size } = input;
  const made = frame(name, type, [`at most ${size} bytes`, type === "bytes" ? "in hexadecimal" : "", more].filter(Boolean).join(", "));
  const one = made.add(make(size > 80 && type === "string" ? "textarea" : "input", { className: "long", spellcheck: false }));
  const digits = () => one.value.replace(/^0x/i, "").replace(/\s/g, "").toLowerCase();
  const check = () => {
    if (type === "bytes" && !/^([0-9a-f]{2})*$/.test(digits())) return "two hexadecimal digits for each byte";
    const bytes = type === "bytes" ? digits().length / 2 : new TextEncoder().encode(one.value).length;
    return bytes > size ? `${bytes} bytes, and at most ${size} fit` : null;
  };
  return made.done(check, () => argument(input, type === "bytes" ? digits() : one.value));
}

// A type that this page has no fields for, as lists and records: its value as JSON, which the server reads.
function anything(input, more) {
  const optional = input.type === "list" && input.size === 1;
  const type = optional ? "optional" : `${input.type}${input.size > 1 ? `[${input.size}]` : ""}`;
  const made = frame(input.name, type, ["as JSON", more].filter(Boolean).join(", "));
  const area = made.add(make("textarea", { className: "long code", rows: 3, spellcheck: false }));
  const written = () => (optional && area.value.trim() === "" ? "null" : area.value);
  const check = () => { try { JSON.parse(written()); return null; } catch (error) { return error.message; } };
  return made.done(check, () => argument(input, ["list", "record"].includes(input.type) ? written() : JSON.parse(written())));
}
