"use strict";
/* What all parts of the page share: data, time, colours, small helpers. */
const RUNS = JSON.parse(document.getElementById("data").textContent).runs;

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out.buffer;
}

/* An element: el("div", {class: "a", onclick: f}, child, "text"). Text is never read as HTML. */
function el(name, attributes, ...children) {
  const svg = ["svg", "g", "path", "line", "rect", "text", "polyline"].includes(name);
  const node = svg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes || {})) {
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) node.setAttribute(key, value);
  }
  for (const child of children.flat()) if (child !== null && child !== undefined) node.append(child);
  return node;
}

/* ---- theme ---- */
const theme = {
  set(name) { document.documentElement.dataset.theme = name; this.cache = {}; },
  color(name) {
    this.cache[name] ??= getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
    return this.cache[name];
  },
  get dark() { return document.documentElement.dataset.theme === "dark"; },
  cache: {},
};
theme.set(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");

/* Reasons have the same colour in all runs. */
const REASONS = [...new Set(RUNS.flatMap(run => run.decisions ? run.decisions.names : []))];
const HUES = ["#4878a8", "#e08a3c", "#5ba06c", "#b065a0", "#c9a227", "#4fa7b0", "#a3674a", "#7d78c6", "#d1707f", "#7a9a3a"];
function reasonColor(name) {
  if (name === "nobody" || name === undefined) return theme.color("idle");
  return HUES[REASONS.filter(other => other !== "nobody").indexOf(name) % HUES.length];
}
const LINES = ["#2f74b5", "#d9772b", "#3b9468", "#a4509a", "#b38f17", "#3a97a3"];
const runColor = index => LINES[index % LINES.length];
function agentColor(index, count, moving, light) {
  if (!moving) return theme.dark ? "#7f8b98" : "#98a3af";
  return `hsl(${(205 + 360 * index / count) % 360} 52% ${light ?? (theme.dark ? 62 : 48)}%)`;
}
/* From light to strong; dark themes start dark. */
function heatColor(level) {
  const stops = theme.dark
    ? [[24, 36, 50], [36, 84, 120], [58, 148, 150], [196, 190, 96], [250, 238, 170]]
    : [[240, 244, 248], [176, 207, 226], [94, 152, 190], [66, 92, 150], [60, 34, 92]];
  const place = Math.min(0.9999, Math.max(0, level)) * (stops.length - 1), low = Math.floor(place), part = place - low;
  return stops[low].map((value, i) => Math.round(value + part * (stops[low + 1][i] - value)));
}

/* ---- time: one clock for all runs ---- */
const DURATION = Math.max(0.001, ...RUNS.map(run => run.duration_s));
const clock = {
  time: 0, playing: false, speed: 1, listeners: [],
  set(time) { this.time = Math.min(DURATION, Math.max(0, time)); this.tell(); },
  tell() { for (const listener of this.listeners) listener(this.time); },
  listen(listener) { this.listeners.push(listener); listener(this.time); },
  toggle() {
    this.playing = !this.playing;
    if (!this.playing) { this.tell(); return; }
    if (this.time >= DURATION) this.time = 0;
    let before = performance.now();
    const step = now => {
      if (!this.playing) return;
      const time = this.time + this.speed * (now - before) / 1000;
      before = now;
      if (time >= DURATION) this.playing = false;
      this.set(time);
      if (this.playing) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  },
};

/* ---- redrawing: on new sizes, themes and before printing ---- */
const redraws = [];
function onRedraw(node, draw) {
  let width = 0;
  const run = () => { width = node.clientWidth; if (width) draw(width); };
  redraws.push(run);
  new ResizeObserver(() => requestAnimationFrame(() => { if (node.clientWidth !== width) run(); })).observe(node);
}
const redrawAll = () => redraws.forEach(draw => draw());
function setTheme(name) { theme.set(name); redrawAll(); clock.tell(); }
let beforePrint = null;
addEventListener("beforeprint", () => { beforePrint = document.documentElement.dataset.theme; setTheme("light"); });
addEventListener("afterprint", () => { if (beforePrint) setTheme(beforePrint); });

function prepare(canvas, width, height) {
  const ratio = Math.max(2, devicePixelRatio || 1);
  canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
  canvas.style.aspectRatio = `${width} / ${height}`;
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return context;
}

/* ---- numbers ---- */
function num(value, digits = 2, unit = "") {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  return value.toLocaleString("en", {minimumFractionDigits: digits, maximumFractionDigits: digits}) + (unit ? "\u202f" + unit : "");
}
const whole = value => num(value, 0);
const percent = (value, digits = 1) => value === null || value === undefined ? "–" : num(100 * value, digits, "%");
const length = metres => !Number.isFinite(metres) ? "–" : Math.abs(metres) < 0.1 ? num(1000 * metres, 1, "mm") : num(metres, 3, "m");
function ticks(low, high, count) {
  const raw = (high - low) / Math.max(1, count), power = 10 ** Math.floor(Math.log10(raw || 1));
  const step = [1, 2, 5, 10].map(factor => factor * power).find(candidate => candidate >= raw * 0.999) || power;
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(+(k * step).toPrecision(12));
  return found;
}
const tickText = (value, all) => {
  const step = all.length > 1 ? all[1] - all[0] : 1;
  return num(value, Math.max(0, Math.min(6, -Math.floor(Math.log10(step) + 1e-9))));
};

/* ---- tooltip ---- */
const tip = el("div", {class: "tip", hidden: ""});
document.body.append(tip);
function showTip(event, text) {
  tip.textContent = text; tip.hidden = false;
  const box = tip.getBoundingClientRect();
  tip.style.left = Math.max(4, Math.min(event.clientX + 14, innerWidth - box.width - 6)) + "px";
  tip.style.top = (event.clientY + 16 + box.height > innerHeight ? event.clientY - box.height - 12 : event.clientY + 16) + "px";
}
const hideTip = () => { tip.hidden = true; };
