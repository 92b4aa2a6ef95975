"use strict";
/* What all parts of a page that plays a run share: data, time, colours, small helpers. */
const DATA = JSON.parse(document.getElementById("data").textContent), RUNS = DATA.runs, PALETTE = DATA.palette;

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out.buffer;
}

/* What a scene and a slot line read of a run: arrays, and how much of them is filled. A live run has the same fields. */
class Recording {
  constructor({scene, slots}) {
    if (scene) {
      this.scale = scene.scale; this.box = null; // the places tell
      this.times = new Float32Array(bytes(scene.time)); this.places = new Int16Array(bytes(scene.position));
      // Nobody knows where it was: what is not a number is not drawn.
      if (this.places.includes(-32768)) this.places = Float32Array.from(this.places, place => place === -32768 ? NaN : place);
      this.frames = this.times.length;
    }
    this.first = slots.first; this.count = slots.count;
    this.slot = new Uint32Array(bytes(slots.slot)); this.sender = new Uint16Array(bytes(slots.sender));
    this.outcome = new Uint8Array(bytes(slots.outcome)); this.reason = new Uint8Array(bytes(slots.reason));
    this.received = new Uint8Array(bytes(slots.received));
    this.sent = this.slot.length;
  }
}
const recordingOf = run => run.record ??= new Recording(run);

/* Index of the first of some ascending values that is greater than one; how many there are if none is. */
function after(values, value, count = values.length) {
  let low = 0, high = count;
  while (low < high) { const middle = (low + high) >> 1; if (values[middle] <= value) low = middle + 1; else high = middle; }
  return low;
}

/* Reasons have the same colour in all runs; the most frequent ones have those that are farthest apart. */
const REASONS = (() => {
  const counts = new Map();
  for (const run of RUNS) if (run.decisions) run.decisions.names.forEach((name, index) => counts.set(name, (counts.get(name) || 0) + run.decisions.total[index]));
  return [...counts.keys()].filter(name => name !== "nobody").sort((a, b) => counts.get(b) - counts.get(a));
})();
const LINES = PALETTE.series, HUES = [...LINES, ...PALETTE.agents];
const reasonColor = name => REASONS.includes(name) ? HUES[REASONS.indexOf(name) % HUES.length] : theme.color("idle");
const reasonText = name => DATA.reasons[name] || "";
/* What colours of slots mean: reasons, and [name, colour, text] of what else there is. */
const reasonLegend = (reasons, more) => reasons.map(name => [name, reasonColor(name), reasonText(name)]).concat(more)
  .map(([name, color, text]) => el("span", {}, el("i", {class: "box", style: `background:${color}`}), el("b", {}, name), text ? " " + text : ""));
const runColor = index => HUES[index % HUES.length];
/* An agent has one colour in page, pictures and layouts, by its id; who hovers is grey. */
const agentColor = (id, moving) => moving ? PALETTE.agents[(id - 1) % PALETTE.agents.length] : PALETTE.hovering;
const agentTurn = id => Math.floor((id - 1) / PALETTE.agents.length) % PALETTE.shapes.length;
/* A colour with some of another one in it, "#rrggbb" both; part: 0 to 1. */
function mixed(color, other, part) {
  const of = (text, place) => parseInt(text.slice(place, place + 2), 16);
  return "#" + [1, 3, 5].map(place => Math.round(of(color, place) * (1 - part) + of(other, place) * part).toString(16).padStart(2, "0")).join("");
}
/* From light to strong; dark themes start dark. */
function heatColor(level) {
  const stops = theme.dark
    ? [[24, 36, 50], [36, 84, 120], [58, 148, 150], [196, 190, 96], [250, 238, 170]]
    : [[240, 244, 248], [176, 207, 226], [94, 152, 190], [66, 92, 150], [60, 34, 92]];
  const place = Math.min(0.9999, Math.max(0, level)) * (stops.length - 1), low = Math.floor(place), part = place - low;
  return stops[low].map((value, i) => Math.round(value + part * (stops[low + 1][i] - value)));
}

/* ---- time ---- */
/* A clock that can be played; end: says where it ends. */
const newClock = end => ({
  time: 0, playing: false, speed: 1, listeners: [], turn: 0,
  set(time) { this.time = Math.min(end(), Math.max(0, time)); this.tell(); },
  tell() { for (const listener of this.listeners) listener(this.time); },
  listen(listener) { this.listeners.push(listener); listener(this.time); },
  get over() { return this.time >= end() - 1e-9; },
  /* Goes on from where it stands; only from the very end it begins again. */
  toggle() {
    this.playing = !this.playing;
    const turn = ++this.turn; // ends the loop of an earlier play
    if (!this.playing) { this.tell(); return; }
    if (this.over) this.time = 0;
    let before = performance.now();
    const step = now => {
      if (!this.playing || turn !== this.turn) return;
      // A hidden page is not drawn: then time stands still.
      const time = this.time + this.speed * Math.min(0.25, Math.max(0, now - before) / 1000);
      before = now;
      if (time >= end()) this.playing = false;
      this.set(time);
      if (this.playing) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  },
});
let DURATION = Math.max(0.001, ...RUNS.map(run => run.duration_s)); // grows while a run is under way
const clock = newClock(() => DURATION); // one for all runs

/* ---- redrawing: on new sizes, themes and before printing ---- */
const redraws = [];
function onRedraw(node, draw) {
  let width = 0;
  const run = () => { width = node.clientWidth; if (width) draw(width); };
  redraws.push(run);
  new ResizeObserver(() => requestAnimationFrame(() => { if (node.clientWidth !== width) run(); })).observe(node);
}
const redrawAll = () => redraws.forEach(draw => draw());
theme.changed = () => { redrawAll(); clock.tell(); };

const sharpness = {ratio: Math.max(2, devicePixelRatio || 1)}; // pixels drawn for one of the page
function prepare(canvas, width, height) {
  const ratio = sharpness.ratio, across = Math.round(width * ratio), down = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  if (canvas.width !== across || canvas.height !== down) {
    canvas.width = across; canvas.height = down;
    canvas.style.aspectRatio = `${width} / ${height}`;
  }
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
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

/* The player at the foot of the page: play, time, speed. */
const player = {slot_s: RUNS.length ? RUNS[0].slot_s : 0.01}; // s, what shift and an arrow key move by
const slider = el("input", {type: "range", min: 0, max: DURATION, step: "any", value: 0, "aria-label": "time", oninput: () => clock.set(+slider.value)});
const play = el("button", {class: "play", type: "button", "aria-label": "play or pause", onclick: () => clock.toggle()}, "▶");
const speed = el("select", {"aria-label": "speed", onchange: () => { clock.speed = +speed.value; }}, ...[0.1, 0.25, 0.5, 1, 2, 5].map(value => el("option", {value, selected: value === 1 ? "" : null}, `${value}×`)));
const output = el("output");
document.body.append(el("div", {class: "player"}, el("div", {}, play, slider, output, speed)));
clock.listen(time => { slider.max = DURATION; slider.value = time; output.textContent = `${num(time, 2)} of ${num(DURATION, 2, "s")}`; play.textContent = clock.playing ? "❚❚" : clock.over ? "↻" : "▶"; });
addEventListener("keydown", event => {
  if (event.target instanceof HTMLSelectElement || event.ctrlKey || event.metaKey || event.altKey) return;
  const step = event.shiftKey ? player.slot_s : DURATION / 50;
  if (event.key === " ") { clock.toggle(); event.preventDefault(); }
  else if (event.key === "ArrowRight") { clock.set(clock.time + step); event.preventDefault(); }
  else if (event.key === "ArrowLeft") { clock.set(clock.time - step); event.preventDefault(); }
});
