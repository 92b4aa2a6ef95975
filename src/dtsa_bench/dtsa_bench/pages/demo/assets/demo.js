"use strict";
/* The flights of a step side by side: who flies where, and who sends in which slot. */
const RATE = 12, VIEW = 100; // slots a second; side of a top view, in its own units
document.getElementById("theme").addEventListener("click", () => setTheme(theme.dark ? "light" : "dark"));

class Flight {
  constructor(node) {
    Object.assign(this, DATA.flights[node.dataset.flight]);
    this.last = this.senders.length - 1;
    this.svg = node.querySelector(".view"); this.craft = [...node.querySelectorAll(".craft")]; this.waves = [];
    if (this.position) this.position = new Int16Array(bytes(this.position));
  }

  /* A slot as a cell: who sent in it, and whether it is still to come. */
  paint(cell, slot, now = Infinity) {
    const senders = this.senders[slot] ?? [], [one] = senders, flies = agent => this.moving[agent - 1];
    const kind = !one ? "none" : senders.length > 1 ? "both" : flies(one) ? "" : "hover";
    cell.className = `${kind}${slot > now || slot > this.last ? " ahead" : ""}${slot === now ? " now" : ""}`;
    cell.textContent = senders.length > 1 ? "×" : one ?? "";
    cell.title = `slot ${slot}: ${senders.join(" and ") || "nobody"}`;
    const colours = senders.map(agent => flies(agent) ? agentColor(agent, true) : "var(--resting)");
    for (const [name, value] of [["--c", colours[0]], ["--d", colours[1]], ["--t", kind ? "" : PALETTE.inks[PALETTE.agents.indexOf(colours[0])]]])
      if (kind === "hover" || !value) cell.style.removeProperty(name); else cell.style.setProperty(name, value);
  }

  place(slot, agent) { // in the units of the top view
    const at = slot * 2 * this.agents + agent;
    return [this.position[at], -this.position[at + this.agents]].map(value => ((value / this.extent + 1) * VIEW / 2).toFixed(2));
  }

  /* Who is where, and who sends. */
  show(slot) {
    slot = Math.min(slot, this.last);
    this.craft.forEach((craft, agent) => { const [x, y] = this.place(slot, agent); craft.setAttribute("cx", x); craft.setAttribute("cy", y); });
    this.waves.forEach(wave => wave.remove());
    this.waves = this.senders[slot].flatMap(agent => [5, 8].map(r => {
      const [cx, cy] = this.place(slot, agent - 1), colour = this.moving[agent - 1] ? agentColor(agent, true) : "var(--soft)";
      return el("circle", {class: this.senders[slot].length > 1 ? "wave bad" : "wave", style: `--c:${colour}`, cx, cy, r});
    }));
    this.svg.append(...this.waves);
  }
}

/* A flight in a row: its top view, and a strip of slots. */
class Strip {
  constructor(node) {
    this.node = node; this.flight = new Flight(node);
    this.cells = Array.from({length: DATA.count}, () => el("i"));
    node.querySelector(".strip").append(...this.cells);
    this.fill(+node.dataset.first);
  }

  fill(first, now) {
    this.cells.forEach((cell, index) => this.flight.paint(cell, first + index, now));
    this.node.querySelector(".from").textContent = first; this.node.querySelector(".to").textContent = first + DATA.count - 1;
  }

  show(slot) {
    const now = Math.min(slot, this.flight.last);
    this.fill(now - now % DATA.count, now);
    this.flight.show(slot);
  }
}

for (const step of document.querySelectorAll(".step")) {
  for (const turns of step.querySelectorAll(".turns")) {
    const flight = new Flight(turns), {first, rounds} = turns.dataset;
    turns.querySelectorAll(".turn").forEach((turn, own) => {
      for (let round = 0; round < rounds; round++) { const cell = el("i"); flight.paint(cell, (+first + round) * flight.moving.length + own); turn.append(cell); }
    });
  }
  const strips = [...step.querySelectorAll(".flight")].map(node => new Strip(node));
  if (!strips.length) continue;
  const [button, range, shown] = step.querySelectorAll(".play button, .play input, .play output");
  const slot_s = strips[0].flight.slot_s, last = Math.max(...strips.map(strip => strip.flight.last)), time = newClock(() => last * slot_s);
  range.max = last; time.speed = RATE * slot_s;
  time.listeners.push(now => {
    const slot = Math.floor(now / slot_s + 1e-6);
    range.value = slot; shown.textContent = `${(slot * slot_s).toFixed(2)} s`; button.textContent = time.playing ? "❚❚ pause" : "▶ play";
    strips.forEach(strip => strip.show(slot));
  });
  button.addEventListener("click", () => time.toggle());
  range.addEventListener("input", () => { if (time.playing) time.toggle(); time.set(range.value * slot_s); });
}

DURATION = DATA.chart.end_s;
document.querySelector(".chart").append(lineChart({
  time: DATA.chart.time, unit: "how far off the others are thought to be (mm)", label: "Error over time", digits: 1, suffix: "mm", height: 215,
  series: DATA.chart.series.map((one, index) => ({...one, width: 2, color: () => theme.color(index ? "two" : "one")})),
}));
