// Round trips and rates of streams over the last two minutes, sampled once a second. A gap is where nothing was known.

import { $, colour, context, make, span } from "./dom.js";
import { chosen, nodes, state, trouble } from "./state.js";

const SECONDS = 120;
const trips = [];
const rates = [];
let counted = null;

// Once a second.
export function sample() {
  const isOld = trouble() !== null || state.heard === null;
  const all = nodes().filter((one) => one.node.connected && one.ping?.us).map((one) => one.ping.us / 1000).sort((a, b) => a - b);
  const one = chosen();
  const own = one?.node.connected && one.ping?.us ? one.ping.us / 1000 : null;
  add(trips, isOld || !all.length ? null : { first: one ? own : all[all.length >> 1], second: all[all.length - 1] });
  const counts = new Map(Object.entries(state.values).map(([number, value]) => [number, value[0]]));
  const time = performance.now();
  if (counted && !isOld) {
    let [sum, mine] = [0, 0];
    for (const [number, count] of counts) {
      const more = Math.max(0, count - (counted.counts.get(number) ?? count));
      sum += more;
      if (state.streams[number]?.node === one?.name) mine += more;
    }
    const seconds = (time - counted.time) / 1000;
    add(rates, { first: one ? mine / seconds : sum / seconds, second: sum / seconds });
  } else add(rates, null);
  counted = { counts, time };
  draw();
}

function add(list, value) {
  list.push(value);
  if (list.length > SECONDS) list.shift();
}

export function draw() {
  const one = chosen();
  plot("rtt", trips, "Round trip", one ? one.name : "median", "slowest of all", (value) => span(value));
  plot("rate", rates, "Values of streams a second", one ? one.name : "all", "all", (value) => `${Math.round(value)}/s`);
}

function plot(id, list, title, first, second, show) {
  const canvas = $(id);
  const { drawing, width, height } = context(canvas);
  const known = list.filter(Boolean);
  const top = Math.max(...known.flatMap((one) => [one.first ?? 0, one.second]), 1e-3) * 1.15;
  drawing.clearRect(0, 0, width, height);
  drawing.strokeStyle = colour("line");
  drawing.lineWidth = 1;
  drawing.strokeRect(0.5, 0.5, width - 1, height - 1);
  const line = (name, tint, wide) => {
    drawing.beginPath();
    drawing.strokeStyle = colour(tint);
    drawing.lineWidth = wide;
    let isOpen = false;
    list.forEach((one, index) => {
      const value = one?.[name];
      if (value === null || value === undefined) { isOpen = false; return; }
      const [x, y] = [width - (list.length - 1 - index) * width / (SECONDS - 1), height - 4 - value / top * (height - 10)];
      if (isOpen) drawing.lineTo(x, y);
      else drawing.moveTo(x, y);
      isOpen = true;
    });
    drawing.stroke();
  };
  if (second !== first) line("second", "faint", 1.2);
  line("first", "accent", 2);
  const now = list.at(-1);
  const told = now ? [now.first === null ? `${first} –` : `${first} ${show(now.first)}`, ...(second !== first ? [`${second} ${show(now.second)}`] : [])].join(", ") : "not known now";
  $(`${id}-title`).replaceChildren(make("span", {}, title), make("span", {}, told));
  canvas.setAttribute("aria-label", `${title}, last two minutes: ${told}`);
}
