"use strict";
/* The live page: one connection, one clock, and a view of the run. */
import {LiveRun} from "./run.js";
import {Panels, Crazyflies} from "./panels.js";

const MODES = {
  realtime: "real time", lockstep: "lockstep", udp: "on a network", serial: "by serial modems", crazyradio: "by Crazyradios",
};
const LISTENER = "As a listener on the network knows it: positions are those of the last frames, flown on until the next; ages are the listener's. Not known here: receivers of a frame, what the agents believe, whether they agree, and where they truly are. A slot in which nothing was heard counts as idle.";
const FRAME_MS = 30, SLOW_MS = 90, LAG_S = 0.12, CHARTS_MS = 1000;
sharpness.ratio = Math.min(2, devicePixelRatio || 1);
const root = document.getElementById("page"), main = el("main");
const live = {on: false, play: false, drawn: 0, charted: 0, socket: null, answers: [], view: null, crazyflies: null};
globalThis.dtsa = {live, clock}; // for tests, and for the curious; live.view: {run, panels, node, show}
const scene = {yaw: -0.9, pitch: 0.62, zoom: 1, paths: false, names: true, targets: true, buttons: {}, scenes: [], draw() { this.scenes.forEach(one => one.context && one.draw(clock.time)); }};

/* ---- head ---- */
const title = el("h1", {}, "Waiting for a run"), lede = el("p", {class: "lede"}), status = el("span", {class: "status", role: "status"}, "connecting");
root.append(el("header", {}, el("div", {}, el("p", {class: "kicker"}, "Live view ", status), title, lede), el("span", {class: "options"}, themeButton())), main);

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
  if (now - before < FRAME_MS || !live.view) return;
  const passed = Math.min(0.25, (now - before) / 1000), run = live.view.run, newest = run.time, grown = run.dirty;
  before = now;
  if (grown) { slider.min = Math.min(newest, run.oldest); DURATION = Math.max(0.001, newest); player.slot_s = run.slot_s; }
  if (now - live.charted > CHARTS_MS && grown) {
    live.charted = now;
    run.dirty = false;
    redrawAll();
  }
  if (live.play && newest > 0.2) { live.play = false; if (!clock.playing) toggle.call(clock); }
  if (live.on) { // as even as the moments allow, never far behind them
    const behind = newest - clock.time - LAG_S;
    setClock.call(clock, Math.abs(behind) > 0.5 ? newest - LAG_S : Math.min(newest, clock.time + passed * (1 + behind)));
    play.textContent = "❚❚";
    live.drawn++;
  } else if (grown) clock.tell();
  if (clock.playing) live.drawn++;
}
requestAnimationFrame(tick);

/* ---- the run ---- */
function makeView(run) {
  const panels = new Panels(run, DATA.control && run.control ? content => send({command: content}) : null, agent => send({ghosts: agent}));
  const chart = (name, what, ...rest) => el("section", {class: "half"}, el("h2", {}, name), el("p", {class: "what"}, what), ...rest);
  const strip = new SlotLine(run), color = ["success", "collision", "idle"].map(name => () => theme.color(name));
  const series = (data, colors, most, unit, label, digits, suffix, limits = []) => lineChart({time: data.time, unit, label, digits, suffix, limits, height: 180, high: most,
    series: data.names.map((name, k) => ({name, values: data.values[k], color: colors[k], width: 1.6}))});
  const legend = el("div", {class: "reasons"});
  onRedraw(main, () => legend.replaceChildren(...reasonLegend(REASONS.filter(name => run.reasons.includes(name)),
    [["collision", theme.color("collision"), "two or more sent"], ["idle", theme.color("idle"), "no agent sent"]])));
  const node = el("div", {class: "run"}, run.listener ? el("p", {class: "what listener"}, LISTENER) : null, panels.figures,
    el("div", {class: "stagebox"}, el("div", {class: "stagecolumn"}, el("section", {class: "flight"}, new Scene(run, scene).node), panels.control), el("div", {class: "side"}, panels.agents, panels.events)),
    el("section", {}, el("h2", {}, "Slots"), el("p", {class: "what"}, "Who sends in which slot, and why. The strip on top says what becomes of each slot. Click to go there."), strip.node, legend),
    el("div", {class: "charts"},
      chart("Distances", "Between the two that are closest.", series(run.distance, [() => theme.color("ink")], () => Math.max(1, Math.min(3, run.distance.most)), "distance (m)", "Distance of the closest pair over time", 3, "m", [{name: `crash (${num(run.collision_m, 2, "m")})`, value: run.collision_m, color: "collision"}])),
      chart("Age", "Slots since the others last heard each moving agent.", series(run.ages, [LINES[0], LINES[1]], () => run.ages.most, "age (slots)", "Age over time", 1, "slots")),
      chart("Channel use", "Shares of the slots of the last second, and of the slots in which all take the same agent for the sender.", series(run.shares, [...color, LINES[2]], () => 1, "share", "Channel use over time", 2, ""))));
  // While time passes, strip and figures are drawn less often than the scene: nobody could read them faster.
  strip.draw = slower(time => SlotLine.prototype.draw.call(strip, time));
  return {run, panels, node, show: slower(time => panels.show(time))};
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

function begin(info) {
  if (live.view) { location.reload(); return; } // another run: everything anew
  const run = new LiveRun(info), view = live.view = makeView(run);
  if (live.crazyflies) view.node.querySelector(".side").prepend(live.crazyflies.node);
  main.replaceChildren(view.node);
  title.textContent = run.name;
  document.title = `${run.name} – DTSA`;
  lede.textContent = `${run.agents} agents, ${run.moving.filter(Boolean).length} moving, policy ${run.policy}, estimator ${run.estimator}, avoider ${run.avoider}, ${MODES[run.mode] ?? run.mode}`;
  if (run.agents > 40) { scene.names = false; (scene.buttons.names ?? []).forEach(node => node.setAttribute("aria-pressed", "false")); }
  follow(Boolean(run.live));
  redrawAll();
  live.play = !run.live; // as soon as there is something
  document.documentElement.dataset.ready = "";
}
/* Beside a run where there is one; alone before it begins. */
function showVehicles(message) {
  if (!live.crazyflies) {
    live.crazyflies = new Crazyflies(DATA.control ? content => send({command: content}) : null);
    (live.view ? live.view.node.querySelector(".side") : main).prepend(live.crazyflies.node);
  }
  live.crazyflies.show(message.rows, message.answer);
}
clock.listen(time => { if (live.view) live.view.show(time); });

/* ---- the connection ---- */
function send(content) { if (live.socket && live.socket.readyState === WebSocket.OPEN) live.socket.send(JSON.stringify(content)); }
function say(text, kind) { status.textContent = text; status.dataset.kind = kind; }
const RECEIVE = {
  begin: message => begin(message.info),
  moments: message => live.view && live.view.run.take(message.first, message.moments),
  ghosts: message => { if (live.view) { live.view.run.takeGhosts(message); if (!clock.playing && !live.on) clock.tell(); } },
  vehicles: showVehicles,
  state: message => { say(message.text || "live", message.text ? "plain" : "good"); if (live.view) live.view.run.dirty = true; },
  answer: message => { live.answers.push(message.text); live.answers.splice(0, live.answers.length - 20); if (live.view && live.view.panels.answer) live.view.panels.answer.textContent = message.text; },
};
function connect() {
  const address = new URL("stream", location.href);
  address.protocol = "ws:";
  const socket = live.socket = new WebSocket(address);
  socket.onopen = () => say("connected", "good");
  socket.onmessage = event => { const message = JSON.parse(event.data); RECEIVE[message.kind](message); };
  socket.onclose = event => {
    live.socket = null;
    const over = event.code === 1001; // the server has ended
    say(over ? "over; what has come stays here" : "not connected; what has come stays here", over ? "plain" : "bad");
    if (!over) setTimeout(connect, 3000);
  };
}
connect();
