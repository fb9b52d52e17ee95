// Elements, texts and numbers. What comes from the fleet becomes text and never markup.

export const $ = (id) => document.getElementById(id);

export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name in element && name !== "list") element[name] = value;
    else element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

export function text(element, value) {
  if (element.textContent !== value) element.textContent = value;
}

export function flag(element, name, on) {
  if (element.classList.contains(name) !== Boolean(on)) element.classList.toggle(name, Boolean(on));
}

// Rows by key: those that stay keep their elements, and so focus and choice.
export function rows(parent, wanted, build, update) {
  parent.known ??= new Map();
  const known = parent.known;
  const keys = new Set(wanted.map(([key]) => key));
  for (const [key, row] of known) if (!keys.has(key)) { row.remove(); known.delete(key); }
  let before = parent.firstElementChild;
  for (const [key, value] of wanted) {
    let row = known.get(key);
    if (!row) { row = build(key, value); known.set(key, row); }
    update(row, value, key);
    if (row === before) before = row.nextElementSibling;
    else parent.insertBefore(row, before);
  }
}

// Names and values; the elements stay.
export function facts(list, pairs) {
  while (list.children.length > pairs.length * 2) list.lastElementChild.remove();
  pairs.forEach(([name, value], index) => {
    if (list.children.length <= index * 2) list.append(make("dt"), make("dd"));
    text(list.children[index * 2], name);
    text(list.children[index * 2 + 1], value);
  });
}

export function span(ms) {
  if (ms === null || ms === undefined || Number.isNaN(ms)) return "–";
  if (ms < 0) ms = 0;
  if (ms < 1) return `${Math.round(ms * 1000)} µs`;
  if (ms < 10) return `${ms.toFixed(1)} ms`;
  if (ms < 1000) return `${Math.round(ms)} ms`;
  const s = ms / 1000;
  if (s < 10) return `${s.toFixed(1)} s`;
  if (s < 90) return `${Math.round(s)} s`;
  if (s < 5400) return `${Math.round(s / 60)} min`;
  return `${Math.round(s / 3600)} h`;
}

// `KeepAlivesMissed` and `keep_alives_missed` in words.
export const words = (name) => name.replaceAll("_", " ").replace(/(?<=[a-z])[A-Z]/g, (letter) => ` ${letter.toLowerCase()}`);

const probe = make("span");
probe.hidden = true;
let colours = new Map();
export const forgetColours = () => { colours = new Map(); };
// The colour that a variable of the style sheet has in the theme that is shown, for canvases.
export function colour(name) {
  if (!colours.has(name)) {
    if (!probe.isConnected) document.body.append(probe);
    probe.style.color = `var(--${name})`;
    colours.set(name, getComputedStyle(probe).color);
  }
  return colours.get(name);
}

// A canvas with as many pixels as the screen has for it. Its context is in the page's own units.
export function context(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  const ratio = window.devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const drawing = canvas.getContext("2d");
  drawing.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { drawing, width, height };
}
