"use strict";
/* Plays the flights of a step side by side: who flies where, and who sends in which slot. */
const DATA = JSON.parse(document.getElementById("data").textContent);
const ROOT = document.documentElement, SVG = "http://www.w3.org/2000/svg", RATE = 12; // slots a second
ROOT.dataset.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
document.getElementById("theme").addEventListener("click", () => { ROOT.dataset.theme = ROOT.dataset.theme === "dark" ? "light" : "dark"; });

function bytes(text) {
  const raw = atob(text), out = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
  return out.buffer;
}
const luminance = colour => [1, 3, 5].map(at => parseInt(colour.slice(at, at + 2), 16) / 255)
  .map(part => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)
  .reduce((sum, part, index) => sum + part * [0.2126, 0.7152, 0.0722][index], 0);
const colourOf = agent => DATA.colours[(agent - 1) % DATA.colours.length];

class Flight {
  constructor(node) {
    this.node = node;
    Object.assign(this, DATA.flights[node.dataset.flight]);
    this.position = new Int16Array(bytes(this.position));
    this.craft = [...node.querySelectorAll(".craft")];
    this.cells = [...node.querySelectorAll(".strip i")];
    this.view = node.querySelector(".view");
    this.waves = [];
  }

  place(slot, agent) { // in the units of the top view
    const at = slot * 2 * this.agents + agent;
    return [this.position[at], -this.position[at + this.agents]].map(value => (value / this.extent + 1) * 50);
  }

  show(slot) {
    slot = Math.min(slot, this.senders.length - 1);
    const first = slot - slot % DATA.count;
    this.cells.forEach((cell, index) => this.paint(cell, first + index, slot));
    this.node.querySelector(".from").textContent = first;
    this.node.querySelector(".to").textContent = first + DATA.count - 1;
    this.craft.forEach((craft, agent) => {
      const [x, y] = this.place(slot, agent);
      craft.setAttribute("cx", x.toFixed(2)); craft.setAttribute("cy", y.toFixed(2));
    });
    this.waves.forEach(wave => wave.remove());
    this.waves = this.senders[slot].flatMap(agent => [5, 8].map(radius => this.wave(slot, agent, radius)));
  }

  wave(slot, agent, radius) {
    const wave = document.createElementNS(SVG, "circle"), [x, y] = this.place(slot, agent - 1);
    wave.setAttribute("class", this.senders[slot].length > 1 ? "wave bad" : "wave");
    wave.setAttribute("cx", x); wave.setAttribute("cy", y); wave.setAttribute("r", radius);
    wave.style.setProperty("--c", this.moving[agent - 1] ? colourOf(agent) : "var(--soft)");
    this.view.append(wave);
    return wave;
  }

  paint(cell, slot, now) {
    const senders = this.senders[slot] || [], one = senders.length === 1;
    cell.className = !senders.length ? "none" : !one ? "both" : this.moving[senders[0] - 1] ? "" : "hover";
    if (slot > now || slot >= this.senders.length) cell.classList.add("ahead");
    if (slot === now) cell.classList.add("now");
    cell.textContent = one ? senders[0] : senders.length ? "×" : "";
    cell.title = `slot ${slot}: ${senders.join(" and ") || "nobody"}`;
    const colours = senders.map(agent => this.moving[agent - 1] ? colourOf(agent) : "var(--resting)");
    cell.style.setProperty("--c", colours[0] || ""); cell.style.setProperty("--d", colours[1] || "");
    cell.style.setProperty("--t", one && this.moving[senders[0] - 1] && luminance(colours[0]) > 0.2 ? "#10151b" : "#fff");
    if (one && !this.moving[senders[0] - 1]) { cell.style.removeProperty("--c"); cell.style.removeProperty("--t"); }
  }
}

for (const step of document.querySelectorAll(".step")) {
  const flights = [...step.querySelectorAll(".flight")].map(node => new Flight(node));
  if (!flights.length) continue;
  const [button, slider, shown] = step.querySelectorAll(".play button, .play input, .play output");
  const last = Math.max(...flights.map(flight => flight.senders.length)) - 1;
  let playing = false, at = 0;
  slider.max = last;
  const show = slot => {
    at = slot; slider.value = Math.floor(slot);
    shown.textContent = `${(Math.floor(slot) * flights[0].slot_s).toFixed(2)} s`;
    flights.forEach(flight => flight.show(Math.floor(slot)));
  };
  const play = on => {
    playing = on; button.textContent = on ? "❚❚ pause" : "▶ play";
    if (!on) return;
    if (at >= last) at = 0;
    let before = performance.now();
    const next = now => {
      if (!playing) return;
      at += RATE * (now - before) / 1000; before = now;
      show(Math.min(at, last));
      if (at >= last) play(false); else requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
  };
  button.addEventListener("click", () => play(!playing));
  slider.addEventListener("input", () => { play(false); show(+slider.value); });
}
