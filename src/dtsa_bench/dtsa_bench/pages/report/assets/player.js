"use strict";
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
