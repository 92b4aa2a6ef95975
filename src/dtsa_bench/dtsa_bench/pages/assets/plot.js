"use strict";
/* Charts over time as SVG: lines, stacked areas, heat maps of agents. */
const MARGIN = {left: 52, right: 14, top: 22, bottom: 34};

/* Axes, cursor, tooltip; draws what `paint(group, x, y)` adds.
   options: height, unit (of y, in the title), label, low, high, time [s], paint, read(time) -> text, yTicks, yText */
function timePlot(options) {
  const holder = el("div");
  let place = null;
  onRedraw(holder, width => {
    const height = options.height, right = width - MARGIN.right, bottom = height - MARGIN.bottom;
    const top = typeof options.high === "function" ? options.high() : options.high;
    const x = time => MARGIN.left + (right - MARGIN.left) * time / DURATION;
    const y = value => bottom - (bottom - MARGIN.top) * (value - options.low) / (top - options.low || 1);
    const svg = el("svg", {class: "plot", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": options.label});
    const rows = options.yTicks || ticks(options.low, top, (bottom - MARGIN.top) / 42);
    for (const value of rows) {
      svg.append(el("line", {class: "grid", x1: MARGIN.left, x2: right, y1: y(value), y2: y(value)}));
      const text = el("text", {x: MARGIN.left - 8, y: y(value) + 4, "text-anchor": "end"});
      text.textContent = options.yText ? options.yText(value) : tickText(value, rows);
      svg.append(text);
    }
    const group = el("g");
    svg.append(group);
    options.paint(group, x, y, {left: MARGIN.left, right, top: MARGIN.top, bottom});
    const columns = ticks(0, DURATION, width / 90);
    svg.append(el("line", {class: "axis", x1: MARGIN.left, x2: right, y1: bottom, y2: bottom}));
    for (const value of columns) {
      svg.append(el("line", {class: "axis", x1: x(value), x2: x(value), y1: bottom, y2: bottom + 4}));
      const text = el("text", {x: x(value), y: bottom + 17, "text-anchor": "middle"});
      text.textContent = tickText(value, columns);
      svg.append(text);
    }
    const xTitle = el("text", {class: "title", x: right, y: height - 3, "text-anchor": "end"});
    xTitle.textContent = "time (s)";
    const yTitle = el("text", {class: "title", x: 2, y: 11});
    yTitle.textContent = options.unit;
    const cursor = el("line", {class: "cursor", y1: MARGIN.top, y2: bottom});
    svg.append(xTitle, yTitle, cursor);
    place = time => { cursor.setAttribute("x1", x(time)); cursor.setAttribute("x2", x(time)); };
    place(clock.time);
    const timeAt = event => {
      const box = svg.getBoundingClientRect();
      return DURATION * ((event.clientX - box.left) * width / box.width - MARGIN.left) / (right - MARGIN.left);
    };
    svg.addEventListener("pointermove", event => {
      const time = timeAt(event);
      if (time < 0 || time > DURATION) { hideTip(); return; }
      if (event.buttons & 1) clock.set(time);
      const box = svg.getBoundingClientRect();
      showTip(event, `${num(time, 2, "s")}\n${options.read(time, (event.clientY - box.top) * height / box.height, y)}`);
    });
    svg.addEventListener("pointerleave", hideTip);
    svg.addEventListener("pointerdown", event => clock.set(timeAt(event)));
    holder.replaceChildren(svg);
  });
  clock.listen(time => place && place(time));
  return holder;
}

/* Index of the sample nearest to a time. */
function nearest(times, time) {
  const high = Math.min(times.length - 1, after(times, time)), low = Math.max(0, high - 1);
  return Math.abs(times[low] - time) <= Math.abs(times[high] - time) ? low : high;
}

function linePath(times, values, x, y) {
  let path = "", drawing = false;
  for (let i = 0; i < times.length; i++) {
    if (values[i] === null) { drawing = false; continue; }
    path += `${drawing ? "L" : "M"}${x(times[i]).toFixed(1)} ${y(values[i]).toFixed(1)}`;
    drawing = true;
  }
  return path;
}

/* Side by side, charts of one kind have one scale, so that they can be compared; a button undoes that. */
const scales = {common: true, most: {}, note(key, value) { this.most[key] = Math.max(this.most[key] ?? 0, value); }, of(key, own) { return key && this.common ? this.most[key] : own; }};

const legendLine = (color, dash) => el("svg", {width: 22, height: 6, "aria-hidden": "true"}, el("line", {x1: 0, x2: 22, y1: 3, y2: 3, stroke: color, "stroke-width": 2.6, "stroke-dasharray": dash}));

/* series: [{name, values, color, width, dash}], limits: [{name, value, color}], marks: crosses, [{time, value}] */
function lineChart({time, series, limits = [], marks = [], unit, label, digits = 3, height = 250, high, suffix = "", scale}) {
  const most = typeof high === "number" ? high : Math.max(1e-9, ...series.flatMap(one => one.values.filter(value => value !== null)),
    ...limits.map(limit => limit.value));
  scales.note(scale, most);
  const chart = timePlot({ // a run under way says by a function how high its values have come
    height, unit, label, low: 0, high: () => (typeof high === "function" ? high() : scales.of(scale, most)) * 1.04,
    paint(group, x, y, box) {
      for (const limit of limits) {
        group.append(el("line", {class: "limit", x1: box.left, x2: box.right, y1: y(limit.value), y2: y(limit.value), stroke: theme.color(limit.color)}));
      }
      for (const one of series) {
        group.append(el("path", {d: linePath(time, one.values, x, y), fill: "none", stroke: typeof one.color === "function" ? one.color() : one.color,
          "stroke-width": one.width || 1.6, "stroke-linejoin": "round", "stroke-dasharray": one.dash, opacity: one.opacity}));
      }
      for (const mark of marks) {
        const px = x(mark.time), py = y(mark.value);
        group.append(el("path", {class: "mark", d: `M${px - 5} ${py - 5}L${px + 5} ${py + 5}M${px + 5} ${py - 5}L${px - 5} ${py + 5}`, stroke: theme.color("collision")}));
      }
    },
    read(at) {
      const index = nearest(time, at);
      return series.map(one => `${one.name}: ${num(one.values[index], digits, suffix)}`).join("\n");
    },
  });
  const legend = el("div", {class: "legend"});
  onRedraw(chart, () => legend.replaceChildren(
    ...series.map(one => el("span", {}, legendLine(typeof one.color === "function" ? one.color() : one.color, one.dash), one.legend || one.name)),
    ...limits.map(limit => el("span", {}, el("i", {style: `background:repeating-linear-gradient(90deg,${theme.color(limit.color)} 0 5px,transparent 5px 8px)`}), limit.name))));
  return el("div", {}, chart, legend);
}

/* layers: [{name, values (shares), color: () => css}], stacked from the bottom, 0 to 100 % */
function shareChart({time, layers, line, unit, label, height = 210}) {
  const sums = layers.map(() => new Array(time.length).fill(0));
  layers.forEach((layer, k) => layer.values.forEach((value, i) => { sums[k][i] = (k ? sums[k - 1][i] : 0) + (value || 0); }));
  const chart = timePlot({
    height, unit, label, low: 0, high: 1, yTicks: [0, .25, .5, .75, 1], yText: value => `${100 * value}`,
    paint(group, x, y) {
      const half = time.length > 1 ? (time[1] - time[0]) / 2 : DURATION / 2;
      layers.forEach((layer, k) => {
        let up = "", down = "";
        time.forEach((at, i) => {
          const a = x(Math.max(0, at - half)).toFixed(1), b = x(Math.min(DURATION, at + half)).toFixed(1);
          up += `L${a} ${y(sums[k][i]).toFixed(1)}L${b} ${y(sums[k][i]).toFixed(1)}`;
          const floor = y(k ? sums[k - 1][i] : 0).toFixed(1);
          down = `L${b} ${floor}L${a} ${floor}` + down;
        });
        group.append(el("path", {d: "M" + up.slice(1) + down + "Z", fill: layer.color()}));
      });
      if (line) group.append(el("path", {d: linePath(time, line.values, x, y), fill: "none", stroke: theme.color(line.color), "stroke-width": 1.5}));
    },
    read(at) {
      const index = nearest(time, at);
      const rows = layers.map(layer => `${layer.name}: ${percent(layer.values[index])}`).reverse();
      if (line) rows.push(`${line.name}: ${percent(line.values[index])}`);
      return rows.join("\n");
    },
  });
  const legend = el("div", {class: "legend"});
  onRedraw(chart, () => legend.replaceChildren(
    ...layers.map(layer => el("span", {}, el("i", {class: "box", style: `background:${layer.color()}`}), layer.name)),
    ...(line ? [el("span", {}, el("i", {style: `background:${theme.color(line.color)}`}), line.name)] : [])));
  return el("div", {}, chart, legend);
}

/* level: Uint8Array (agents x bins), 255: nothing; top: value of level 254 */
function heatChart({time, level, agents, top, unit, label, digits, suffix, height, scale}) {
  const bins = time.length;
  scales.note(scale, top);
  const chart = timePlot({
    height: height ?? MARGIN.top + MARGIN.bottom + Math.max(90, Math.min(240, 11 * agents)), unit, label,
    low: agents + 0.5, high: 0.5, yTicks: ticks(1, agents, 6).filter(value => value >= 1 && value === Math.round(value)), yText: whole,
    paint(group, x, y, box) {
      const canvas = document.createElement("canvas");
      canvas.width = bins; canvas.height = agents;
      const context = canvas.getContext("2d"), image = context.createImageData(bins, agents);
      for (let i = 0; i < level.length; i++) {
        if (level[i] === 255) continue;
        const [red, green, blue] = heatColor(level[i] / 254 * top / scales.of(scale, top));
        image.data.set([red, green, blue, 255], 4 * i);
      }
      context.putImageData(image, 0, 0);
      const picture = document.createElementNS("http://www.w3.org/2000/svg", "image");
      const end = time[bins - 1] + (bins > 1 ? time[1] - time[0] : 0) / 2;
      for (const [name, value] of Object.entries({x: box.left, y: box.top, width: x(Math.min(DURATION, end)) - box.left, height: box.bottom - box.top,
        preserveAspectRatio: "none", href: canvas.toDataURL(), style: "image-rendering:pixelated"})) picture.setAttribute(name, value);
      group.append(picture);
    },
    read(at, py, y) {
      const index = nearest(time, at), agent = Math.round(agents + 0.5 + (py - y(agents + 0.5)) / (y(0.5) - y(agents + 0.5)) * -agents);
      if (agent < 1 || agent > agents) return "";
      const value = level[(agent - 1) * bins + index];
      return `agent ${agent}: ${value === 255 ? "–" : num(value / 254 * top, digits, suffix)}`;
    },
  });
  const legend = el("div", {class: "legend"});
  onRedraw(chart, () => {
    const stops = [0, .25, .5, .75, 1].map(part => `rgb(${heatColor(part).join(" ")})`).join(",");
    legend.replaceChildren(el("span", {}, "0", el("i", {class: "scale", style: `background:linear-gradient(90deg,${stops})`}), num(scales.of(scale, top), digits, suffix)));
  });
  return el("div", {}, chart, legend);
}
