// What the page knows, and how old that is. Data that is old never looks like data that is not.

export const state = {
  unit: {}, nodes: {}, refused: {}, orders: {}, counters: {}, streams: {}, values: {}, logs: {}, pings: {}, doctor: {}, limits: {}, managers: {},
  events: [], link: null, chosen: null,
  // Surveys of the network that this page has asked for, by the place that tells of them: what to say, and since when that is so.
  surveys: {},
  // When the last message came, by the page's clock, and the server's clock then.
  heard: null, server: 0,
  // Whose token this page has: a name, or none, and a role.
  me: null,
};

// What each role may do; each may do what those before it may.
export const ROLES = { stop: "may stop", see: "may look and stop", operate: "may command and stop, not reset", reset: "may do everything" };
const RANKS = Object.keys(ROLES);
export const may = (role) => RANKS.indexOf(state.me?.role ?? "reset") >= RANKS.indexOf(role);

const KEPT = 200;
// Nothing for so long is a loss: the server says something each second, and looks twice a second.
const SILENT = 3000;
const UNANSWERED = 3000;
// A value older than this is shown as old.
export const OLD = 2000;

export function take(message) {
  state.heard = performance.now();
  state.server = message.now;
  state.link = message.link;
  state.me = message.me;
  for (const name of Object.keys(message)) {
    const table = message[name];
    if (table?.rows) {
      if (table.whole) state[name] = table.rows;
      else Object.assign(state[name], table.rows);
    }
  }
  if (message.events) state.events = message.events.reverse().concat(state.events).slice(0, KEPT);
}

// The server's clock now.
export const now = () => state.server + (state.heard === null ? 0 : performance.now() - state.heard);

// What is wrong with the way to the fleet, and how old the data is; null if nothing is.
export function trouble() {
  if (state.heard === null) return null;
  const silent = performance.now() - state.heard;
  const answered = state.link?.answered;
  const age = answered === null || answered === undefined ? null : now() - answered;
  if (silent > SILENT || state.broken) {
    return { what: "No connection to cara web", age: age ?? silent, why: state.broken ?? "it says nothing any more" };
  }
  if (!state.link.up) return { what: "The manager is lost", age, why: state.link.error ?? "" };
  if (age > UNANSWERED) return { what: "The manager does not answer", age, why: "it hangs, is stopped, or its host is busy" };
  return null;
}

export const fullName = (node) => `${node.name}/${node.id}`;
export const natural = new Intl.Collator("en", { numeric: true }).compare;

// The points of the first list in a value: records with x and y, or two numbers each.
function places(values) {
  const list = values.map(([, value, isText]) => isText && JSON.parse(value)).find(Array.isArray) ?? [];
  const all = list.map((one) => ({ x: Number(one?.x ?? one?.[0]), y: Number(one?.y ?? one?.[1]), name: String(one?.name ?? one?.id ?? "") }));
  return all.filter(({ x, y }) => Number.isFinite(x) && Number.isFinite(y));
}

// What is known of each node, in one place.
export function nodes() {
  const [poses, plans] = [new Map(), new Map()];
  for (const [number, stream] of Object.entries(state.streams)) {
    const value = state.values[number];
    if (value && (stream.name === "route" || stream.name === "stations")) {
      plans.set(stream.node, { ...plans.get(stream.node), [stream.name]: places(value[2]) });
    }
    if (stream.name === "pose" && value) {
      const [x, y] = value[2].flatMap(([, numbers]) => numbers).map(Number);
      const heading = Number(value[2].find(([name]) => name === "heading" || name === "theta")?.[1]);
      if (Number.isFinite(x) && Number.isFinite(y)) poses.set(stream.node, { x, y, heading, at: value[1] });
    }
  }
  const orders = new Map();
  for (const order of Object.values(state.orders)) {
    const name = `${order.node}/${order.id}`;
    const had = orders.get(name) ?? { runs: null, inhibited: null };
    if (order.order === "runs") had.runs = order;
    if (order.inhibited) had.inhibited = order;
    orders.set(name, had);
  }
  return Object.entries(state.nodes).map(([key, node]) => {
    const name = fullName(node);
    const { runs, inhibited } = orders.get(name) ?? {};
    const pose = poses.get(name) ?? null;
    return {
      key, node, name, pose, runs, inhibited, ...plans.get(name),
      isOld: !node.connected || (pose !== null && now() - pose.at > OLD),
      ping: state.pings[name],
    };
  }).sort((a, b) => natural(a.name, b.name));
}

// A time of the clock on the wall, with its date.
export const clock = (ms) => new Date(ms).toLocaleString("sv");

export const chosen = () => nodes().find((one) => one.key === state.chosen) ?? null;
