"use strict";
/* Panels beside the scene: figures of the moment, ages, events, and commands. */
import {NOT_KNOWN} from "./run.js";

/* Who sent in the last slot before a time, and why. */
function sending(run, time) {
  const record = run.record, last = after(record.slot, Math.floor(time / run.slot_s + 1e-6), record.sent) - 1;
  if (last < 0) return ["–", ""];
  const slot = record.slot[last], senders = [];
  for (let i = last; i >= 0 && record.slot[i] === slot; i--) senders.unshift(record.sender[i]);
  const why = record.reason[last] < 255 ? run.reasons[record.reason[last]] : "";
  return [senders.slice(0, 4).map(id => `cf${id}`).join(" ") + (senders.length > 4 ? " …" : ""), record.outcome[last] === 2 ? "collision" : why];
}

/* [label, value(run, row, time) -> [value, extra, class]] */
const FIGURES = [
  ["Sends", (run, row, time) => sending(run, time)],
  ["Slots with a frame, last second", (run, row, time) => {
    const load = run.load(time, 1);
    return load ? [percent(load.success, 0), `collided ${percent(load.collision, 0)}, idle ${percent(load.idle, 0)}`, load.collision > 0.02 ? "bad" : ""] : ["–", ""];
  }],
  ["Agree on the sender", (run, row) => {
    if (run.listener) return ["–", "not known to a listener"];
    const held = run.moments, first = Math.max(0, row - 20);
    let compared = 0, same = 0;
    for (let k = first; k <= row; k++) { compared += held.compared[k]; same += held.same[k]; }
    const tables = row >= 0 ? held.tables[row] : 0;
    return [compared ? percent(same / compared, 0) : "–", tables > 1 ? `${tables} different tables` : tables ? "all tables equal" : "", compared && same < compared ? "bad" : ""];
  }],
  ["Closest pair", (run, row) => row < 0 ? ["–", ""] : [num(run.moments.closest[row], 3, "m"), (run.moments.one[row] ? `cf${run.moments.one[row]} and cf${run.moments.other[row]}` : "") + (run.listener ? ", by their frames" : ""), run.moments.closest[row] < run.collision_m ? "bad" : ""]],
  ["Age, mean", (run, row) => {
    const held = run.moments, n = run.agents;
    let sum = 0, count = 0, most = 0;
    for (let k = 0; row >= 0 && k < n; k++) { const age = held.age[n * row + k]; if (age !== NOT_KNOWN) { sum += age; count++; most = Math.max(most, age); } }
    return count ? [num(sum / count / 10, 1, "slots"), `${run.listener ? "here; " : ""}worst agent ${num(most / 10, 1)}`] : ["–", ""];
  }],
  [run => run.listener ? "Frames leave late" : "Channel's lag", (run, row) => {
    if (!run.listener && run.mode !== "realtime") return ["–", "in lockstep no agent is late"];
    if (row < 0) return ["–", ""];
    const lag = run.moments.lag[row];
    return [num(lag, 1, "ms"), run.listener ? `${whole(run.moments.refused[row])} datagrams not taken in` : "", !run.listener && lag > 500 * run.slot_s ? "bad" : ""];
  }],
];

export class Panels {
  /* command(content): sends a command; null: commands are not allowed. choose(agent): whose beliefs are shown, 0: nobody's. */
  constructor(run, command, choose) {
    this.run = run; this.choose = choose; this.listed = -1;
    this.values = FIGURES.map(() => [el("div", {class: "value"}), el("div", {class: "extra"})]);
    this.figures = el("div", {class: "figures"}, ...FIGURES.map(([label], k) => el("div", {class: "figure"}, el("div", {class: "label"}, typeof label === "string" ? label : label(run)), ...this.values[k])));
    this.rows = Array.from({length: run.agents}, (_, k) => this.row(k + 1));
    this.agents = el("section", {class: "agents"}, el("h2", {}, "Agents"),
      el("p", {class: "what"}, run.listener ? "How many slots ago each one was last heard here." : "How many slots ago the others last heard each one. Choose one to see what it believes about the others: dashed, with the age in slots."),
      el("div", {class: "rows"}, ...this.rows.map(row => row.node)));
    this.list = el("ol", {class: "events"});
    this.events = el("section", {class: "log"}, el("h2", {}, "Events"), this.list);
    this.control = command ? this.commands(command) : null;
  }

  row(id) {
    const bar = el("i"), text = el("em"), color = () => agentColor(id, this.run.moving[id - 1] && !this.run.lost.has(id));
    const dot = el("span", {class: "dot"});
    const node = el("button", {type: "button", class: "agent", "aria-pressed": "false", onclick: () => this.watch(this.run.watched === id ? 0 : id)}, dot, el("b", {}, `cf${id}`), el("span", {class: "bar"}, bar), text);
    return {id, node, bar, text, dot, color, shown: ""};
  }

  watch(id) {
    this.run.watched = id;
    for (const row of this.rows) row.node.setAttribute("aria-pressed", String(row.id === id));
    this.choose(id);
    clock.tell();
  }

  commands(command) {
    const agent = el("select", {"aria-label": "agent"}, ...this.rows.map(row => el("option", {value: row.id}, `cf${row.id}`)));
    const loss = el("input", {type: "number", min: 0, max: 100, step: 1, value: 0, "aria-label": "loss in percent"});
    const half = Math.floor(this.run.agents / 2), ids = [...Array(this.run.agents).keys()].map(k => k + 1), groups = half ? JSON.stringify([ids.slice(0, half), ids.slice(half)]) : "";
    const partition = el("input", {type: "text", placeholder: groups, "aria-label": "groups of a partition", size: 16});
    const button = (text, content, name) => el("button", {type: "button", "data-command": name, onclick: () => command(content())}, text);
    return el("section", {class: "commands"}, el("h2", {}, "Control"),
      this.run.mode === "realtime" ? el("div", {class: "line"}, agent, button("Kill", () => ({kind: "kill", value: +agent.value}), "kill"), button("Start", () => ({kind: "start", value: +agent.value}), "start")) : null,
      el("div", {class: "line"}, loss, "% loss", button("Set", () => ({kind: "loss", value: Math.min(1, Math.max(0, +loss.value / 100))}), "loss")),
      el("div", {class: "line"}, button("Jam", () => ({kind: "jam", value: true}), "jam"), button("Stop jamming", () => ({kind: "jam", value: false}), "clear")),
      el("div", {class: "line"}, partition, button("Part", () => ({kind: "partition", value: partition.value || groups}), "part"), button("Join", () => ({kind: "partition", value: ""}), "join")),
      this.answer = el("output", {class: "answer"}));
  }

  show(time) {
    const run = this.run, row = run.momentAt(time), held = run.moments, n = run.agents;
    FIGURES.forEach(([, value], k) => {
      const [text, extra, kind] = value(run, row, time), [node, below] = this.values[k];
      node.className = `value ${kind || ""}`;
      if (node.textContent !== text) node.textContent = text;
      if (below.textContent !== extra) below.textContent = extra;
    });
    let most = 10;
    for (let k = 0; row >= 0 && k < n; k++) if (held.age[n * row + k] !== NOT_KNOWN) most = Math.max(most, held.age[n * row + k]);
    for (const one of this.rows) {
      const age = row >= 0 ? held.age[n * row + one.id - 1] : NOT_KNOWN, lost = run.lost.has(one.id);
      const text = lost ? "silent" : age === NOT_KNOWN ? (run.moving[one.id - 1] ? "–" : "hovers") : num(age / 10, 1), color = one.color(), key = `${text} ${most} ${color}`;
      if (key === one.shown) continue;
      one.shown = key; one.text.textContent = text; one.dot.style.background = color; one.bar.style.background = color;
      one.bar.style.width = `${lost || age === NOT_KNOWN ? 0 : 100 * age / most}%`;
      one.node.classList.toggle("gone", lost);
    }
    this.tell();
  }

  tell() {
    const events = this.run.events, last = events.length ? events[events.length - 1] : null;
    if (last === this.listed) return;
    this.listed = last;
    this.list.replaceChildren(...events.slice(-60).reverse().map(event => el("li", {class: `is-${event.kind}`}, el("button", {type: "button", onclick: () => clock.set(event.time)}, num(event.time, 2, "s")), " ", event.text)));
  }
}

const SURE_MS = 3000;

/* Crazyflies as their bridge sees them, with or without a run. */
export class Crazyflies {
  /* command(content): sends a command; null: commands are not allowed. */
  constructor(command) {
    this.rows = el("tbody");
    this.answer = el("output", {class: "answer"});
    const titles = ["", "State", "Battery", "Link"].map(name => el("th", {}, name));
    this.node = el("section", {class: "vehicles"}, el("h2", {}, "Crazyflies"), el("table", {}, el("thead", {}, el("tr", {}, ...titles)), this.rows),
      ...(command ? [el("div", {class: "line"}, el("button", {type: "button", "data-command": "land", onclick: () => command({kind: "land"})}, "Land all"), this.stop(command)), this.answer] : []));
  }

  /* To stop all motors takes two clicks within three seconds. */
  stop(command) {
    const button = el("button", {type: "button", class: "danger", "data-command": "emergency", onclick: () => {
      if (button.dataset.sure) { command({kind: "emergency", value: "stop all motors"}); calm(); return; }
      button.dataset.sure = "1"; button.textContent = "Once more: all motors stop, all fall";
      setTimeout(calm, SURE_MS);
    }}, "");
    const calm = () => { delete button.dataset.sure; button.textContent = "Emergency stop …"; };
    calm();
    return button;
  }

  /* rows: [name, state, battery (V), link quality (0 to 1), reason] of each; answer: result of the last command. */
  show(rows, answer) {
    this.rows.replaceChildren(...rows.map(([name, state, battery, link, reason]) => el("tr", {class: `is-${state.split(" ")[0]}`, title: reason},
      el("td", {}, name), el("td", {}, state, reason ? el("small", {}, reason) : null), el("td", {}, battery > 0 ? num(battery, 2, "V") : "–"), el("td", {}, percent(link, 0)))));
    this.answer.textContent = answer;
  }
}
