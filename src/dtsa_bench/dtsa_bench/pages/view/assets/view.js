"use strict";
/* The live page: one connection, one clock, and a view of each run. */
import {Bodies} from "./bodies.js";
import {LiveRun} from "./run.js";
import {Panels} from "./panels.js";
import {Crazyflies} from "./crazyflies.js";

const MODES = {
  realtime: "real time", lockstep: "lockstep", udp: "on a network", serial: "by serial modems", crazyradio: "by Crazyradios",
};
const LISTENER = "As one who listens on the network knows it: positions are those of the last frames, flown on until the next; ages are the listener's. Not known here: who received a frame, what the agents believe, whether they agree, and where they truly are. A slot in which nothing was heard counts as idle.";
const FRAME_MS = 30, SLOW_MS = 90, LAG_S = 0.12, CHARTS_MS = 1000;
sharpness.ratio = Math.min(2, devicePixelRatio || 1);
Scene.bodies = Bodies.make;
const root = document.getElementById("report"), main = el("main");
const views = []; // of each run: {run, panels, lines, node}
const live = {on: false, play: false, drawn: 0, charted: 0, socket: null, answers: []};
globalThis.dtsa = {views, live, clock}; // for tests, and for the curious
const scene = {yaw: -0.9, pitch: 0.62, zoom: 1, paths: false, names: true, targets: true, buttons: {}, scenes: [], draw() { this.scenes.forEach(one => one.context && one.draw(clock.time)); }};

/* ---- head ---- */
const title = el("h1", {}, "Waiting for a run"), lede = el("p", {class: "lede"}), status = el("span", {class: "status", role: "status"}, "connecting");
const themeButton = el("button", {type: "button", onclick: () => { setTheme(theme.dark ? "light" : "dark"); themeButton.textContent = theme.dark ? "Light" : "Dark"; }}, theme.dark ? "Light" : "Dark");
root.append(el("header", {}, el("div", {}, el("p", {class: "kicker"}, "Live view ", status), title, lede), el("span", {class: "options"}, themeButton)), main);

/* ---- time: with the newest moment, or wherever the user has gone ---- */
const liveButton = el("button", {type: "button", class: "live", "aria-pressed": "false", onclick: () => follow(true)}, "Live");
document.querySelector(".player > div").prepend(liveButton);
const setClock = clock.set;
clock.set = function (time) { follow(false); setClock.call(clock, Math.max(+slider.min, time)); };
function follow(on) {
  if (on && clock.playing) clock.toggle();
  live.on = on; live.play = false; liveButton.setAttribute("aria-pressed", String(on));
}
const toggle = clock.toggle;
clock.toggle = function () { if (live.on) { follow(false); clock.tell(); return; } toggle.call(clock); };

/* Draws at most so often; a hidden page is not drawn at all. */
let before = performance.now();
function tick(now) {
  requestAnimationFrame(tick);
  if (now - before < FRAME_MS) return;
  const passed = Math.min(0.25, (now - before) / 1000);
  before = now;
  const shown = views.filter(Boolean), newest = Math.max(0, ...shown.map(view => view.run.time)), grown = shown.some(view => view.run.dirty);
  if (grown) { slider.min = Math.min(newest, ...shown.map(view => view.run.oldest)); DURATION = Math.max(0.001, newest); player.slot_s = shown[0].run.slot_s; }
  if (now - live.charted > CHARTS_MS && grown) {
    live.charted = now;
    for (const view of shown) view.run.dirty = false;
    redrawAll();
  }
  if (live.play && newest > 0.2) { live.play = false; if (!clock.playing) toggle.call(clock); }
  if (live.on && shown.length) { // as even as the moments allow, never far behind them
    const behind = newest - clock.time - LAG_S;
    setClock.call(clock, Math.abs(behind) > 0.5 ? newest - LAG_S : Math.min(newest, clock.time + passed * (1 + behind)));
    play.textContent = "❚❚";
    live.drawn++;
  } else if (grown) clock.tell();
  if (clock.playing) live.drawn++;
}
requestAnimationFrame(tick);

/* ---- runs ---- */
function makeView(run) {
  const panels = new Panels(run, DATA.control && run.control ? content => send({order: content}) : null, agent => send({ghosts: agent, run: run.index}));
  const chart = (name, what, ...rest) => el("section", {class: "half"}, el("h2", {}, name), el("p", {class: "what"}, what), ...rest);
  const lines = {reasons: true, lines: []}, strip = new SlotLine(run, lines), drawn = new Scene(run, scene);
  const color = ["success", "collision", "idle"].map(name => () => theme.color(name));
  const series = (data, colors, most, unit, label, digits, suffix, limits = []) => lineChart({time: data.time, unit, label, digits, suffix, limits, height: 180, high: most,
    series: data.names.map((name, k) => ({name, values: data.values[k], color: colors[k], width: 1.6}))});
  const node = el("div", {class: "run"}, el("h3", {class: "runname"}, el("span", {class: "dot", style: `background:${runColor(run.index)}`}), run.name), run.listener ? el("p", {class: "what listener"}, LISTENER) : null, panels.figures,
    el("div", {class: "stagebox"}, el("div", {class: "stagecolumn"}, el("section", {class: "flight"}, drawn.node), panels.control), el("div", {class: "side"}, panels.agents, panels.events)),
    el("section", {}, el("h2", {}, "Slots"), el("p", {class: "what"}, "Who sends in which slot, and why. The strip on top says what becomes of each slot. Click to go there."), strip.node, reasonLegend(run)),
    el("div", {class: "charts"},
      chart("Distances", "Between the two that are closest.", series(run.distance, [() => theme.color("ink")], () => Math.max(1, Math.min(3, run.distance.most)), "distance (m)", "Distance of the closest pair over time", 3, "m", [{name: `crash (${num(run.collision_m, 2, "m")})`, value: run.collision_m, color: "collision"}])),
      chart("Age", "Slots since the others last heard each moving agent.", series(run.ages, [LINES[0], LINES[1]], () => run.ages.most, "age (slots)", "Age over time", 1, "slots")),
      chart("Channel use", "Shares of the slots of the last second, and of the slots in which all take the same agent for the sender.", series(run.shares, [...color, LINES[2]], () => 1, "share", "Channel use over time", 2, ""))));
  // While time passes, strip and figures are drawn less often than the scene: nobody could read them faster.
  strip.draw = slower((time) => SlotLine.prototype.draw.call(strip, time));
  return {run, panels, strip, scene: drawn, node, show: slower(time => panels.show(time))};
}

function slower(draw) {
  let last = 0;
  return time => {
    const now = performance.now();
    if ((clock.playing || live.on) && now - last < SLOW_MS) return;
    last = now;
    draw(time);
  };
}

function reasonLegend(run) {
  const legend = el("div", {class: "reasons"});
  onRedraw(main, () => legend.replaceChildren(...REASONS.filter(name => run.reasons.includes(name)).map(name => [name, reasonColor(name), reasonText(name)])
    .concat([["collision", theme.color("collision"), "two or more sent"], ["idle", theme.color("idle"), "nobody sent"]])
    .map(([name, color, text]) => el("span", {}, el("i", {class: "box", style: `background:${color}`}), el("b", {}, name), text ? " " + text : ""))));
  return legend;
}

function begin(message) {
  const run = new LiveRun(message.info, message.run), at = message.run;
  if (views[at]) { location.reload(); return; } // another run: everything anew
  const view = makeView(run);
  views[at] = view;
  if (crazyflies[at]) view.node.querySelector(".side").prepend(crazyflies[at].node);
  main.replaceChildren(...views.filter(Boolean).map(one => one.node));
  root.classList.toggle("several", message.runs > 1);
  title.textContent = views.filter(Boolean).map(one => one.run.name).join("  ·  ");
  document.title = `${title.textContent} – DTSA`;
  lede.textContent = message.runs === 1 ? `${run.agents} agents, ${run.moving.filter(Boolean).length} moving, policy ${run.policy}, estimator ${run.estimator}, avoider ${run.avoider}, ${MODES[run.mode] ?? run.mode}` : "";
  if (run.agents > 40) { scene.names = false; (scene.buttons.names ?? []).forEach(node => node.setAttribute("aria-pressed", "false")); }
  follow(Boolean(run.live));
  redrawAll();
  live.play = !run.live; // as soon as there is something
  document.documentElement.dataset.ready = "";
}
/* Beside a run where there is one; alone before it begins. */
const crazyflies = [];
function showVehicles(message) {
  const at = message.run;
  if (!crazyflies[at]) {
    crazyflies[at] = new Crazyflies(DATA.control ? content => send({order: content}) : null);
    (views[at] ? views[at].node.querySelector(".side") : main).prepend(crazyflies[at].node);
  }
  crazyflies[at].show(message.told, message.answer);
}
clock.listen(time => { for (const view of views) if (view) view.show(time); });

/* ---- the connection ---- */
function send(content) { if (live.socket && live.socket.readyState === WebSocket.OPEN) live.socket.send(JSON.stringify(content)); }
function say(text, kind) { status.textContent = text; status.dataset.kind = kind; }
function connect() {
  const address = new URL("stream", location.href);
  address.protocol = "ws:";
  const socket = live.socket = new WebSocket(address);
  socket.onopen = () => say("connected", "good");
  socket.onmessage = event => {
    const message = JSON.parse(event.data), view = views[message.run];
    if (message.kind === "begin") begin(message);
    else if (message.kind === "moments" && view) view.run.take(message.first, message.moments);
    else if (message.kind === "ghosts" && view) { view.run.takeGhosts(message); if (!clock.playing && !live.on) clock.tell(); }
    else if (message.kind === "vehicles") showVehicles(message);
    else if (message.kind === "state" && view) { view.run.state = message.text; view.run.dirty = true; say(message.text || "live", message.text ? "plain" : "good"); }
    else if (message.kind === "answer") { live.answers.push(message.text); live.answers.splice(0, live.answers.length - 20); for (const one of views) if (one && one.panels.answer) one.panels.answer.textContent = message.text; }
  };
  socket.onclose = event => {
    live.socket = null;
    const over = event.code === 1001; // the server has ended
    say(over ? "over; what has come stays here" : "not connected; what has come stays here", over ? "plain" : "bad");
    if (!over) setTimeout(connect, 3000);
  };
}
connect();
