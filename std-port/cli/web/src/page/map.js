// The map: cells of the background, and each node that sends a stream `pose` at its newest value. Nothing is drawn ahead of what
// was told.

import { $, colour, context, span, text } from "./dom.js";
import { OLD, nodes, now, state, trouble } from "./state.js";

const canvas = $("map");
const calm = matchMedia("(prefers-reduced-motion: reduce)");
// How long a vehicle takes on the screen from one value to the next.
const GLIDE = 120;
const shown = new Map();
let background = null;
let cells = null;
// Where the middle of the canvas is, in the vehicles' units, and pixels to a unit. Null: what fits.
let view = null;
let wanted = true;
let choose = () => {};

export function start(onChoose) {
  choose = onChoose;
  listen();
  requestAnimationFrame(frame);
}

// The cells below the vehicles.
export function lay(cellsOf) {
  background = cellsOf;
  redraw(true);
}

export function redraw(newColours = false) {
  wanted = true;
  if (newColours) cells = null;
}

function frame() {
  if (wanted && !document.hidden) wanted = draw();
  requestAnimationFrame(frame);
}

// y points down on a map of cells, as its rows do, and up on one in metres, and without one.
const down = () => (background && !background.metres ? 1 : -1);

// How far it is from cell to cell, and where the map's left and lowest, or topmost, edges are.
const cell = () => background.metres ?? 1;
const corner = () => (background.metres ? background.origin : [-0.5, -0.5]);

function bounds(all) {
  if (background) {
    const [x, y] = corner();
    return [x, y, x + background.width * cell(), y + background.height * cell()];
  }
  const xs = all.map((one) => one.pose.x);
  const ys = all.map((one) => one.pose.y);
  if (!xs.length) return [-5, -5, 5, 5];
  const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  // Steps, so that the map does not change its scale all the time.
  const step = Math.max(5, 2 ** Math.ceil(Math.log2(Math.max(x1 - x0, y1 - y0, 1))) / 4);
  return [Math.floor(x0 / step - 0.5) * step, Math.floor(y0 / step - 0.5) * step, Math.ceil(x1 / step + 0.5) * step, Math.ceil(y1 / step + 0.5) * step];
}

function fitting(all, width, height) {
  const [x0, y0, x1, y1] = bounds(all);
  const scale = Math.min((width - 24) / (x1 - x0), (height - 24) / (y1 - y0));
  return { x: (x0 + x1) / 2, y: (y0 + y1) / 2, scale };
}

let last = { x: 0, y: 0, scale: 1, width: 1, height: 1 };
const toScreen = (x, y) => [last.width / 2 + (x - last.x) * last.scale, last.height / 2 + down() * (y - last.y) * last.scale];
const toWorld = (px, py) => [last.x + (px - last.width / 2) / last.scale, last.y + down() * (py - last.height / 2) / last.scale];

// Whether something still moves on the screen.
function draw() {
  const all = nodes().filter((one) => one.pose);
  const { drawing, width, height } = context(canvas);
  if (!width) return true;
  last = { ...(view ?? fitting(all, width, height)), width, height };
  drawing.clearRect(0, 0, width, height);
  drawBackground(drawing);
  $("map-empty").hidden = all.length > 0 || background !== null;
  let moves = false;
  [labels, taken] = [[], []];
  // The chosen one last, so that it lies above the others; its name has precedence over theirs.
  all.sort((a, b) => (a.key === state.chosen) - (b.key === state.chosen));
  for (const one of all) drawPlan(drawing, one, all.length);
  for (const one of all) moves = drawNode(drawing, one, all.length) || moves;
  labels.reverse().forEach((write) => write());
  for (const key of shown.keys()) if (!all.some((one) => one.key === key)) shown.delete(key);
  about(all);
  return moves;
}

function about(all) {
  const lost = all.filter((one) => one.isOld).length;
  const [x, y] = toWorld(last.width / 2, last.height / 2).map(Math.round);
  const size = background ? `${background.width} × ${background.height} cells${background.metres ? ` of ${background.metres} m` : ""}` : `a line each ${gridStep()} units`;
  text($("map-about"), `${all.length} vehicle${all.length === 1 ? "" : "s"}, ${size}`);
  canvas.setAttribute("aria-label", `Map of ${all.length} vehicles, ${lost} of them lost or old, around ${x}, ${y}. The table of nodes has their positions.`);
  const wrong = trouble();
  $("map-stale").hidden = !wrong;
  if (wrong) text($("map-stale"), `as it was ${span(wrong.age)} ago`);
}

const gridStep = () => [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 5000].find((step) => step * last.scale >= 28) ?? 10000;

function drawBackground(drawing) {
  if (background) {
    cells ??= paintCells();
    const [x, y] = topLeft();
    drawing.imageSmoothingEnabled = false;
    drawing.drawImage(cells, x, y, background.width * cell() * last.scale, background.height * cell() * last.scale);
    if (last.scale * cell() < 10) return;
  }
  const step = background ? cell() : gridStep();
  // Lines lie between cells.
  const [left, low] = background ? corner() : [0, 0];
  const [x0, y0] = toWorld(0, 0);
  const [x1, y1] = toWorld(last.width, last.height);
  drawing.save();
  if (background) {
    drawing.beginPath();
    drawing.rect(...topLeft(), background.width * step * last.scale, background.height * step * last.scale);
    drawing.clip();
  }
  drawing.strokeStyle = colour("line");
  drawing.lineWidth = 1;
  drawing.beginPath();
  for (let x = left + Math.ceil((x0 - left) / step) * step; x <= x1; x += step) {
    const at = Math.round(toScreen(x, 0)[0]) + 0.5;
    drawing.moveTo(at, 0);
    drawing.lineTo(at, last.height);
  }
  for (let y = low + Math.ceil((Math.min(y0, y1) - low) / step) * step; y <= Math.max(y0, y1); y += step) {
    const at = Math.round(toScreen(0, y)[1]) + 0.5;
    drawing.moveTo(0, at);
    drawing.lineTo(last.width, at);
  }
  drawing.stroke();
  drawing.restore();
  if (!background) drawNumbers(drawing, step, x0, x1, y0, y1);
}

function topLeft() {
  const [x, y] = corner();
  return toScreen(x, background.metres ? y + background.height * background.metres : y);
}

function drawNumbers(drawing, step, x0, x1, y0, y1) {
  drawing.fillStyle = colour("faint");
  drawing.font = "11px system-ui, sans-serif";
  for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) drawing.fillText(String(x), toScreen(x, 0)[0] + 4, last.height - 5);
  for (let y = Math.ceil(Math.min(y0, y1) / step) * step; y <= Math.max(y0, y1); y += step) drawing.fillText(String(y), 4, toScreen(0, y)[1] - 4);
}

function paintCells() {
  const painted = new OffscreenCanvas(background.width, background.height);
  const drawing = painted.getContext("2d");
  drawing.fillStyle = colour("card");
  drawing.fillRect(0, 0, background.width, background.height);
  drawing.fillStyle = colour("wall");
  background.rows.forEach((row, y) => [...row].forEach((cell, x) => {
    if (!".GSE".includes(cell)) drawing.fillRect(x, y, 1, 1);
  }));
  return painted;
}

function glide(one) {
  const time = performance.now();
  let place = shown.get(one.key);
  if (!place || place.to.x !== one.pose.x || place.to.y !== one.pose.y) {
    const from = place ? at(place, time) : one.pose;
    const far = Math.hypot(from.x - one.pose.x, from.y - one.pose.y) > 3;
    place = { from: far ? one.pose : from, to: one.pose, begun: time };
    shown.set(one.key, place);
  }
  return { ...at(place, time), moves: !calm.matches && time - place.begun < GLIDE };
}

function at({ from, to, begun }, time) {
  const part = calm.matches ? 1 : Math.min(1, (time - begun) / GLIDE);
  return { x: from.x + (to.x - from.x) * part, y: from.y + (to.y - from.y) * part };
}

// The route and the stations that a vehicle publishes. Those of one that is gone are no plan any more.
function drawPlan(drawing, one, count) {
  if (one.isOld) return;
  drawing.strokeStyle = colour(one.key === state.chosen ? "accent" : "faint");
  drawing.lineWidth = one.key === state.chosen ? 2.5 : 1.2;
  drawing.beginPath();
  for (const [index, { x, y }] of (one.route ?? []).entries()) drawing[index ? "lineTo" : "moveTo"](...toScreen(x, y));
  drawing.stroke();
  for (const { x, y, name } of one.stations ?? []) {
    const [px, py] = toScreen(x, y);
    drawing.strokeRect(px - 5, py - 5, 10, 10);
    if (name && count <= 40) labels.unshift(() => write(drawing, name, px, py, 5, "faint"));
  }
}

function drawNode(drawing, one, count) {
  const { x, y, moves } = glide(one);
  const [px, py] = toScreen(x, y);
  const radius = Math.max(background ? 3 : 6, Math.min(12, last.scale * 0.38));
  const isChosen = one.key === state.chosen;
  if (isChosen) {
    drawing.beginPath();
    drawing.arc(px, py, radius + 5, 0, 7);
    drawing.strokeStyle = colour("accent");
    drawing.lineWidth = 2.5;
    drawing.stroke();
  }
  drawing.beginPath();
  if (one.isOld) {
    drawing.arc(px, py, radius, 0, 7);
    drawing.fillStyle = colour("card");
    drawing.strokeStyle = colour("faint");
    drawing.lineWidth = 2;
    drawing.fill();
    drawing.stroke();
    drawing.moveTo(px - radius * 0.6, py - radius * 0.6);
    drawing.lineTo(px + radius * 0.6, py + radius * 0.6);
    drawing.moveTo(px + radius * 0.6, py - radius * 0.6);
    drawing.lineTo(px - radius * 0.6, py + radius * 0.6);
    drawing.stroke();
  } else {
    drawing.fillStyle = colour(one.inhibited ? "warn" : one.runs ? "moving" : "accent");
    if (one.inhibited) drawing.rect(px - radius * 0.85, py - radius * 0.85, radius * 1.7, radius * 1.7);
    else drawing.arc(px, py, radius, 0, 7);
    drawing.fill();
    if (Number.isFinite(one.pose.heading)) {
      drawing.beginPath();
      drawing.moveTo(px, py);
      drawing.lineTo(px + Math.cos(one.pose.heading) * radius, py + down() * Math.sin(one.pose.heading) * radius);
      drawing.strokeStyle = colour("card");
      drawing.lineWidth = 2;
      drawing.stroke();
    }
  }
  if (isChosen || (count <= 40 && last.scale > 6)) labels.push(() => label(drawing, one, px, py, radius));
  return moves;
}

// Names to write behind all vehicles, and where there are some: one that would lie on another is left out.
let [labels, taken] = [[], []];

function label(drawing, one, px, py, radius) {
  const age = now() - one.pose.at;
  const said = one.isOld && age > OLD ? `${one.node.name}, ${span(age)} ago` : one.node.name;
  write(drawing, said, px, py, radius, one.isOld ? "faint" : "text");
}

// Above its place, else below it or beside it, where nothing is written yet.
function write(drawing, said, px, py, radius, tint) {
  drawing.font = "600 12px system-ui, sans-serif";
  const long = drawing.measureText(said).width;
  const inside = (x) => Math.min(Math.max(2, x), last.width - long - 2);
  const spots = [[inside(px - long / 2), py - radius - 8], [inside(px - long / 2), py + radius + 16], [px + radius + 6, py + 4], [px - radius - 6 - long, py + 4]];
  const isFree = ([x, y]) => x >= 2 && x + long + 2 <= last.width && y >= 12 && y <= last.height - 4
    && !taken.some(([left, right, base]) => x < right + 4 && x + long + 4 > left && Math.abs(base - y) < 14);
  const spot = spots.find(isFree);
  if (!spot) return;
  const [x, y] = spot;
  taken.push([x, x + long, y]);
  drawing.lineWidth = 3;
  drawing.strokeStyle = colour("floor");
  drawing.strokeText(said, x, y);
  drawing.fillStyle = colour(tint);
  drawing.fillText(said, x, y);
}

function zoom(factor, px = last.width / 2, py = last.height / 2) {
  const [x, y] = toWorld(px, py);
  const scale = Math.min(200, Math.max(0.2, last.scale * factor));
  view = { scale, x: x - (px - last.width / 2) / scale, y: y - down() * (py - last.height / 2) / scale };
  redraw();
}

function pan(dx, dy) {
  view = { x: last.x - dx / last.scale, y: last.y - down() * dy / last.scale, scale: last.scale };
  redraw();
}

function fit() {
  view = null;
  redraw();
}

function listen() {
  $("map-in").onclick = () => zoom(1.5);
  $("map-out").onclick = () => zoom(1 / 1.5);
  $("map-fit").onclick = fit;
  new ResizeObserver(() => redraw()).observe(canvas);
  const fingers = new Map();
  let moved = 0;
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (fingers.size === 1) moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const [dx, dy] = [event.offsetX - before[0], event.offsetY - before[1]];
    moved += Math.abs(dx) + Math.abs(dy);
    if (fingers.size === 2) {
      const other = [...fingers].find(([finger]) => finger !== event.pointerId)[1];
      const far = (place) => Math.max(1, Math.hypot(place[0] - other[0], place[1] - other[1]));
      zoom(far([event.offsetX, event.offsetY]) / far(before), other[0], other[1]);
    } else if (moved > 4) pan(dx, dy);
    fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      if (end === "pointerup" && moved <= 4 && fingers.size === 1) pick(event.offsetX, event.offsetY);
      fingers.delete(event.pointerId);
    });
  }
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(event.deltaY < 0 ? 1.15 : 1 / 1.15, event.offsetX, event.offsetY);
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const step = 40;
    const keys = {
      ArrowLeft: () => pan(step, 0), ArrowRight: () => pan(-step, 0), ArrowUp: () => pan(0, step), ArrowDown: () => pan(0, -step),
      "+": () => zoom(1.3), "-": () => zoom(1 / 1.3), 0: fit,
    };
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
  });
}

function pick(px, py) {
  const far = (one) => {
    const [x, y] = toScreen(one.pose.x, one.pose.y);
    return Math.hypot(x - px, y - py);
  };
  const near = nodes().filter((one) => one.pose && far(one) < 24).sort((a, b) => far(a) - far(b))[0];
  if (near) choose(near.key);
}
