"use strict";
/* Puts the page together: header, figures, sections, player. */
const single = RUNS.length === 1;
const root = document.getElementById("page"), main = el("main");
root.className = single ? "single" : "several";

function section(title, what, make, size = "", runs = RUNS) {
  const shown = runs.map((run, index) => [run, index]).filter(([run]) => make.has ? make.has(run) : true);
  if (!shown.length) return null;
  const panels = shown.map(([run, index]) => el("div", {}, single ? null : runTitle(run, index), make.draw(run, index)));
  const node = el("section", {class: size}, el("h2", {}, title), el("p", {class: "what"}, what), make.extra ? make.extra() : null, el("div", {class: "panels"}, ...panels));
  main.append(node);
  return node;
}
const runTitle = (run, index) => el("h3", {}, el("span", {class: "dot", style: `background:${runColor(index)}`}), run.name);

/* ---- header and figures ---- */
const result = run => {
  const summary = run.summary;
  if (summary.collided) return ["crashed", "bad", summary.collided_pair ? `agents ${summary.collided_pair.join(" and ")}` : ""];
  if (summary.completed) return ["completed", "good", ""];
  if (summary.timed_out) return ["timed out", "bad", ""];
  return [summary.end || "recorded", "plain", ""];
};
const FIGURES = [
  ["Result", run => result(run)[0], run => result(run)[2], run => result(run)[1]],
  ["Completion time", run => num(run.summary.completion_time_s, 2, "s"), run => `flown ${num(run.duration_s, 2, "s")}`],
  ["Smallest distance", run => num(run.summary.min_distance_m, 3, "m"), run => run.summary.min_distance_pair ? `agents ${run.summary.min_distance_pair.join(" and ")}` : "", run => run.summary.collided ? "bad" : ""],
  ["Path efficiency", run => percent(run.summary.efficiency_mean), () => "way over path, movers"],
  ["Slots", run => whole(run.summary.slots.total), run => `${(1000 * run.slot_s).toLocaleString("en", {maximumFractionDigits: 3})}\u202fms each`],
  ["Collided slots", run => whole(run.summary.slots.collision), run => percent(run.summary.slots.total ? run.summary.slots.collision / run.summary.slots.total : null), run => run.summary.slots.collision ? "bad" : ""],
  ["Idle slots", run => whole(run.summary.slots.idle), run => percent(run.summary.slots.total ? run.summary.slots.idle / run.summary.slots.total : null)],
  ["Lost to noise", run => percent(run.summary.lost_fraction, 2), () => "of all receptions"],
  ["Age", run => num(run.summary.age_mean_slots, 1, "slots"), run => `at most ${whole(run.summary.age_max_slots)}`],
  ["Pairs known", run => percent(run.summary.pairs_known_share), run => `oldest frame heard ${whole(run.summary.heard_age_max_slots)} slots ago`, null, run => run.summary.pairs_known_share != null],
  ["Age from waking on", run => num(run.summary.waking_age_mean_slots, 1, "slots"), run => `first heard after ${whole(run.summary.first_heard_95_slots)} (95 %)`],
  ["Estimate error", run => length(run.summary.estimate_error_mean_m), run => `at most ${length(run.summary.estimate_error_max_m)}`],
];
const shownFigures = FIGURES.filter(([, , , , has]) => !has || RUNS.some(has));
function lede(run) {
  const s = run.summary, config = Object.fromEntries(run.config.map(([, name, value]) => [name, value]));
  const who = `${run.agents} agents${s.moving !== undefined && s.moving !== run.agents ? `, ${s.moving} moving` : ""}`;
  const how = ["policy", "estimator", "avoider"].filter(name => config[name] !== undefined).map(name => `${name} ${config[name]}`);
  return [who, ...how, config.seed !== undefined ? `seed ${config.seed}` : null].filter(Boolean).join(", ");
}
const scaleButton = single ? null : el("button", {type: "button", "aria-pressed": "true", onclick: () => {
  scales.common = !scales.common; scaleButton.setAttribute("aria-pressed", String(scales.common)); redrawAll();
}}, "Common scales");
root.append(el("header", {},
  el("div", {}, el("p", {class: "kicker"}, single ? "Recorded run" : `${RUNS.length} recorded runs`), el("h1", {}, single ? RUNS[0].name : RUNS.map(run => run.name).join("  ·  ")),
    single ? el("p", {class: "lede"}, lede(RUNS[0])) : null),
  el("span", {class: "options"}, scaleButton, " ", themeButton(), " ", printButton())));
for (const run of RUNS) for (const note of run.notes) root.append(el("p", {class: "note"}, single ? note : `${run.name}: ${note}`));
if (single) {
  root.append(el("div", {class: "figures"}, ...shownFigures.map(([label, value, extra, kind]) => {
    const [, number, unit] = value(RUNS[0]).match(/^(.*?)(?:\u202f(.*))?$/);
    return el("div", {class: "figure"}, el("div", {class: "label"}, label),
      el("div", {class: `value ${kind ? kind(RUNS[0]) : ""}`}, number, unit ? el("small", {}, " " + unit) : null), el("div", {class: "extra"}, extra(RUNS[0])));
  })));
} else {
  main.append(el("section", {}, el("h2", {}, "Results"), el("p", {class: "what"}, "Definitions are those of summary.json."), el("div", {class: "scroll"}, el("table", {},
    el("thead", {}, el("tr", {}, el("th"), ...RUNS.map((run, index) => el("th", {}, runTitle(run, index))))),
    el("tbody", {}, el("tr", {}, el("td", {}, "Settings"), ...RUNS.map(run => el("td", {style: "white-space:normal;max-width:260px"}, lede(run)))),
      ...shownFigures.map(([label, value, extra, kind]) => el("tr", {}, el("td", {}, label), ...RUNS.map(run => el("td", {class: kind ? kind(run) : ""}, value(run))))))))));
}
root.append(main);

/* ---- sections ---- */
const shared = {yaw: -0.9, pitch: 0.62, zoom: 1, paths: true, names: Math.max(...RUNS.map(run => run.agents)) <= 40, targets: true, buttons: {}, scenes: [],
  draw() { this.scenes.forEach(scene => scene.context && scene.draw(clock.time)); }};
const crashed = RUNS.some(run => run.crashes.length), hovers = RUNS.some(run => run.moving.includes(false));
section("Flight", `Drag to turn, wheel or pinch to zoom. Rings mark senders: amber if it was heard, red and dotted if it collided. Small crosses are targets.${hovers ? " Hovering agents are grey." : ""}${crashed ? " A cross in a ring is a crash." : ""}`,
  {has: run => run.scene, draw: run => new Scene(run, shared).node}, "wide");
section("Distances", "Between all pairs of agents: the smallest of all, and the pairs that came closest.", {
  has: run => run.distances,
  draw: run => {
    const data = run.distances, span = 4 * Math.max(data.collision, data.r_min, ...data.pairs.map(pair => pair.least));
    return lineChart({
      time: data.time, unit: "distance (m)", label: "Distance of the closest pairs over time", height: single ? 350 : 300, suffix: "m", scale: "distance",
      high: Math.min(Math.max(span, 1), Math.max(...data.least.filter(value => value !== null), ...data.pairs.flatMap(pair => pair.distance.filter(value => value !== null)))),
      series: [{name: "closest of all", values: data.least.map(value => value !== null && value > span * 1.04 ? null : value), color: () => theme.color("ink"), width: 2.1},
        ...data.pairs.map((pair, index) => ({name: `${pair.ids[0]} – ${pair.ids[1]}`, legend: `${pair.ids[0]} – ${pair.ids[1]}: ${num(pair.least, 3, "m")} at ${num(pair.time, 2, "s")}`,
          values: pair.distance.map(value => value !== null && value > span * 1.04 ? null : value), color: LINES[index % LINES.length], width: 1.4, dash: ["7 3", "2 2.5", "9 3 2 3", "4 2", "1.5 1.5"][index]}))],
      marks: run.crashes.map(crash => ({time: crash.time_s, value: crash.distance_m})),
      limits: [{name: `crash (${num(data.collision, 2, "m")})`, value: data.collision, color: "collision"}],
    });
  },
}, "slim");

/* rows: [{name, value (count) or share, color}]; counts are shares of all counts */
function shareBars(rows) {
  const sum = Math.max(1, rows.reduce((total, row) => total + (row.value || 0), 0)), bars = el("div", {class: "bars"});
  onRedraw(main, () => bars.replaceChildren(...rows.flatMap(row => {
    const share = row.share ?? row.value / sum;
    return [el("b", {}, row.name), el("div", {}, el("i", {style: `width:${100 * share}%;background:${row.color()}`})),
      el("em", {}, row.value === undefined ? percent(share) : `${whole(row.value)}, ${percent(share)}`), row.text ? el("small", {}, row.text) : null].filter(Boolean);
  })));
  return bars;
}

section("Mission", "With Crazyflies, from take-off to landing, as the ground station heard it. Loss, collisions and ages on this page are simulated on the PC: the slots were kept there.", {
  has: run => run.mission,
  draw: run => el("div", {},
    run.mission.cut_short ? el("p", {class: "note"}, `Cut short: ${run.mission.cut_short}`) : null,
    el("div", {class: "scroll"}, el("table", {},
      el("thead", {}, el("tr", {}, ...["", "Battery, first", "least", "Link, least", "Log age, most", "Command latency, most", "States"].map(name => el("th", {}, name)))),
      el("tbody", {}, ...run.mission.vehicles.map(([name, first, least, quality, age, latency, states]) => el("tr", {}, el("td", {}, name), el("td", {}, num(first, 2, "V")), el("td", {}, num(least, 2, "V")),
        el("td", {}, percent(quality)), el("td", {}, num(age, 2, "s")), el("td", {}, num(latency, 1, "ms")), el("td", {style: "white-space:normal"}, states)))))),
    el("details", {}, el("summary", {}, `${run.mission.events.length} events: orders, states, safety actions`),
      el("div", {class: "scroll tall"}, el("table", {}, el("tbody", {}, ...run.mission.events.map(([time, level, text]) =>
        el("tr", {}, el("td", {}, num(time, 2, "s")), el("td", {class: level === "error" ? "bad" : ""}, level), el("td", {style: "white-space:normal;text-align:left"}, text)))))))),
}, "wide");

section("Slots", "Who sent in which slot, and why. The strip on top says what became of each slot. Click to go there.", {
  has: run => run.slots.count, draw: run => new SlotLine(run).node,
  extra: () => {
    const legend = el("div", {class: "reasons"});
    const names = REASONS.filter(name => RUNS.some(run => run.sent_for.includes(name)));
    onRedraw(main, () => legend.replaceChildren(...reasonLegend(names, [
      ...(names.length ? [] : [["sent", theme.color("success"), ""]]),
      ["collision", theme.color("collision"), "two or more sent: tall in the strip"], ["idle", theme.color("idle"), "no agent sent"],
      ["partly lost", "linear-gradient(var(--line) 60%, var(--ink) 60%)", "paler, with an edge: some did not receive it"]])));
    return legend;
  },
});
section("Channel use", "What became of the slots, as shares of a short while, and how much of what was sent was lost to noise.", {
  has: run => run.channel,
  draw: run => el("div", {}, shareBars([["success", "success"], ["collision", "collision"], ["idle", "idle"]].map(([name, color]) => ({name, value: run.summary.slots[name], color: () => theme.color(color)}))
    .concat(run.summary.slots.unknown ? [{name: "not known", value: run.summary.slots.unknown, color: () => theme.color("line")}] : [])
    .concat(run.summary.lost_fraction > 0 ? [{name: "lost to noise", share: run.summary.lost_fraction, color: () => theme.color("lost")}] : [])), shareChart({
    time: run.channel.time, unit: "share of slots (%)", label: "Channel use over time",
    layers: [{name: "success", values: run.channel.share.success, color: () => theme.color("success")}, {name: "collision", values: run.channel.share.collision, color: () => theme.color("collision")},
      {name: "idle", values: run.channel.share.idle, color: () => theme.color("idle")}],
    line: run.summary.lost_fraction > 0 ? {name: "lost to noise", values: run.channel.lost, color: "lost"} : null,
  })),
}, "half");
section("Decisions", "Why agents expected the sender that they expected: of all agents and slots.", {
  has: run => run.decisions,
  draw: run => {
    const data = run.decisions;
    const bars = shareBars(data.names.map((name, index) => ({name, value: data.total[index], color: () => reasonColor(name), text: reasonText(name)})).sort((a, b) => b.value - a.value));
    return el("div", {}, bars, shareChart({time: data.time, unit: "share of decisions (%)", label: "Reasons over time", height: 180,
      layers: data.names.map((name, index) => ({name, values: data.share[index], color: () => reasonColor(name)}))}),
      el("p", {class: "what", style: "margin:8px 0 0"}, data.disagree ? `In ${whole(data.disagree)} slots agents expected different senders.` : "In every slot all agents that expected a sender expected the same one."));
  },
}, "half");
for (const [key, title, what, unit, digits, suffix, axis] of [
  ["age", "Age", "How many slots ago the others last heard each moving agent: mean over its observers that still expect it to move.", "age (slots)", 1, "slots", "mean and most of all agents"],
  ["error", "Estimate error", "How far from each moving agent the others take it to be: mean over the same observers.", "error (m)", 4, "m", ""],
]) {
  section(title, what, {
    has: run => run.ages,
    draw: run => {
      const data = run.ages[key];
      return el("div", {},
        lineChart({time: run.ages.time, unit, label: title + " over time", height: 190, digits, suffix, scale: key,
          series: [{name: "mean of agents", values: data.mean, color: LINES[0], width: 1.9}, {name: "worst agent", values: data.most, color: LINES[1], width: 1.2}]}),
        heatChart({time: run.ages.time, level: new Uint8Array(bytes(data.heat)), agents: run.agents, top: data.top, unit: "agent", label: title + " by agent", digits, suffix, scale: `${key} by agent`}));
    },
  }, "half");
}
const COLUMNS = [["id", "agent", whole], ["sent", "frames sent", whole], ["heard", "received by", value => percent(value)], ["collided", "collided", whole], ["age_mean", "age, mean (slots)", value => num(value, 1)],
  ["age_max", "age, most (slots)", value => num(value, 1)], ["error_mean", "error, mean", length], ["error_max", "error, most", length], ["path", "path (m)", value => num(value, 2)]];
section("Agents", "Ages and errors in the slots that the results count: means over all observers of the agent, and the slot in which the mean over its observers was largest.", {
  draw: run => el("div", {class: "scroll tall"}, el("table", {},
    el("thead", {}, el("tr", {}, ...COLUMNS.map(([, title]) => el("th", {}, title)))),
    el("tbody", {}, ...run.table.map(row => el("tr", {}, ...COLUMNS.map(([key, , text]) => el("td", {}, key === "id" && row.moving === false ? `${row.id} (hovers)` : text(row[key]))))))))
}, "wide long");

function configuration() {
  const keys = new Map();
  RUNS.forEach((run, index) => run.config.forEach(([part, name, value]) => {
    const key = part + "\u0000" + name;
    if (!keys.has(key)) keys.set(key, {part, name, values: new Array(RUNS.length).fill(undefined)});
    keys.get(key).values[index] = value;
  }));
  const text = value => value === undefined ? "" : value === null ? "–" : typeof value === "object" ? JSON.stringify(value) : String(value);
  const rows = [];
  let part = null;
  for (const row of keys.values()) {
    if (row.part !== part && row.part) rows.push(el("tr", {class: "group"}, el("td", {colspan: RUNS.length + 1}, row.part)));
    part = row.part;
    const differs = new Set(row.values.map(text)).size > 1;
    rows.push(el("tr", {class: differs ? "differs" : ""}, el("td", {}, row.name), ...row.values.map(value => el("td", {class: "text mono"}, text(value)))));
  }
  return el("section", {class: "slim long"}, el("h2", {}, "Configuration"), el("p", {class: "what"}, single ? "As recorded in the bag." : "As recorded in the bags; what differs is marked."),
    el("div", {class: "scroll tall"}, el("table", {}, single ? null : el("thead", {}, el("tr", {}, el("th"), ...RUNS.map(run => el("th", {class: "text"}, run.name)))), el("tbody", {}, ...rows))));
}
main.append(configuration());
root.append(el("footer", {}, `Made from ${single ? "the bag" : "the bags"} ${RUNS.map(run => run.name).join(", ")}${RUNS[0].version ? `, recorded by version ${RUNS[0].version}` : ""}. Times count from the start of slot 0. Lengths in metres in the frame map: x and y level, z up.`));

/* Something to see at once, and in print: the moment of the closest approach. */
const start = RUNS[0].distances && RUNS[0].distances.pairs.length ? RUNS[0].distances.pairs[0].time : 0;
clock.set(Number(new URLSearchParams(location.hash.slice(1)).get("t") ?? start) || 0);
/* A page that is loaded again stands where it stood. */
addEventListener("pagehide", () => { try { history.replaceState(null, "", `#t=${clock.time.toFixed(3)}`); } catch { /* not allowed here */ } });
document.querySelectorAll(".scroll").forEach(watchScroll);
redrawAll();
document.documentElement.dataset.ready = "";
