"use strict";
/* The flight in three dimensions: a small perspective camera over a 2-D canvas. */
const TRAIL_S = 3;

class Scene {
  constructor(run, shared) {
    const data = run.scene;
    this.run = run; this.shared = shared; this.record = recordingOf(run);
    this.count = data.ids.length; this.ids = data.ids; this.target = data.target;
    this.bounds();
    this.canvas = el("canvas", {tabindex: "0", role: "img", "aria-label": "Flight in three dimensions; drag to turn, wheel to zoom"});
    this.label = el("span", {class: "clock"});
    const button = (name, key) => el("button", {type: "button", "aria-pressed": String(shared[key]), onclick: event => {
      shared[key] = !shared[key];
      shared.buttons[key].forEach(node => node.setAttribute("aria-pressed", String(shared[key])));
      shared.draw(); event.preventDefault();
    }}, name);
    const buttons = [["paths", "paths"], ["names", "names"], ["targets", "targets"]].map(([name, key]) => {
      const node = button(name, key);
      (shared.buttons[key] ??= []).push(node);
      return node;
    });
    const views = [["3D", -0.9, 0.62], ["top", -Math.PI / 2, Math.PI / 2 - 1e-3], ["side", -Math.PI / 2, 0.04]].map(([name, yaw, pitch]) =>
      el("button", {type: "button", onclick: () => { shared.yaw = yaw; shared.pitch = pitch; shared.zoom = 1; shared.draw(); }}, name));
    this.node = el("div", {class: "scene"}, el("div", {class: "bar"}, this.label, el("span", {class: "options"}, ...views), el("span", {class: "options"}, ...buttons)), this.canvas);
    this.steer();
    shared.scenes.push(this);
    onRedraw(this.node, width => {
      this.width = width; this.height = Math.round(Math.min(560, Math.max(300, width * 0.64)));
      this.context = prepare(this.canvas, this.width, this.height);
      this.draw(clock.time);
    });
    clock.listen(time => this.context && this.draw(time));
  }

  bounds() {
    const [low, high] = this.record.box ?? [[1e9, 1e9, 1e9], [-1e9, -1e9, -1e9]], n = this.count, {places, scale, frames} = this.record;
    for (let i = 0; i < 3 * n * frames; i++) {
      const axis = Math.floor(i / n) % 3, value = places[i] * scale;
      if (value < low[axis]) low[axis] = value;
      if (value > high[axis]) high[axis] = value;
    }
    this.middle = low.map((value, axis) => (value + high[axis]) / 2);
    this.reach = Math.max(0.8, Math.hypot(high[0] - low[0], high[1] - low[1]) / 2);
    const size = this.reach;
    this.step = ticks(-size, size, 8)[1] - ticks(-size, size, 8)[0];
    this.floor = Math.min(low[2] - 0.25 * size, -0.3);
    this.box = [0, 1].map(axis => [Math.floor(low[axis] / this.step + 0.2) * this.step, Math.ceil(high[axis] / this.step - 0.2) * this.step]);
    this.middle[2] = this.floor - 0.02 * size;
  }

  steer() {
    const held = new Map();
    let spread = 0;
    this.canvas.addEventListener("pointerdown", event => { this.canvas.setPointerCapture(event.pointerId); held.set(event.pointerId, event); spread = 0; });
    this.canvas.addEventListener("pointermove", event => {
      const before = held.get(event.pointerId);
      if (!before) return;
      held.set(event.pointerId, event);
      const shared = this.shared;
      if (held.size === 2) {
        const [a, b] = [...held.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) shared.zoom = Math.min(6, Math.max(0.4, shared.zoom * now / spread));
        spread = now;
      } else {
        shared.yaw -= (event.clientX - before.clientX) * 0.008;
        shared.pitch = Math.min(Math.PI / 2 - 1e-3, Math.max(-0.2, shared.pitch + (event.clientY - before.clientY) * 0.008));
      }
      shared.draw();
    });
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, event => held.delete(event.pointerId));
    this.canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.shared.zoom = Math.min(6, Math.max(0.4, this.shared.zoom * Math.exp(-event.deltaY * 0.0012)));
      this.shared.draw();
    }, {passive: false});
  }

  camera() {
    const {yaw, pitch, zoom} = this.shared, away = this.reach * 3.85;
    const forward = [Math.cos(pitch) * Math.cos(yaw + Math.PI), Math.cos(pitch) * Math.sin(yaw + Math.PI), -Math.sin(pitch)];
    const right = [-Math.sin(yaw), Math.cos(yaw), 0];
    const up = [right[1] * forward[2] * -1, right[0] * forward[2], right[1] * forward[0] - right[0] * forward[1]].map(value => -value);
    const eye = this.middle.map((value, axis) => value - forward[axis] * away);
    const focal = Math.min(this.width, this.height * 1.5) * 1.2 * zoom;
    this.project = (px, py, pz) => {
      const dx = px - eye[0], dy = py - eye[1], dz = pz - eye[2];
      const depth = Math.max(0.05, dx * forward[0] + dy * forward[1] + dz * forward[2]);
      return [this.width / 2 + focal * (dx * right[0] + dy * right[1]) / depth,
        this.height / 2 - focal * (dx * up[0] + dy * up[1] + dz * up[2]) / depth, depth, focal / depth];
    };
  }

  /* Positions at a time, straight between two recorded moments. */
  at(time, out) {
    const {times, places, scale, frames} = this.record, n = this.count;
    if (!frames) return 0;
    const low = Math.max(0, after(times, time, frames) - 1);
    const next = Math.min(low + 1, frames - 1), gap = times[next] - times[low];
    const part = gap > 0 ? Math.min(1, Math.max(0, (time - times[low]) / gap)) : 0;
    for (let i = 0; i < 3 * n; i++) out[i] = (places[3 * n * low + i] * (1 - part) + places[3 * n * next + i] * part) * scale;
    return low;
  }

  drawFloor(c) {
    const [[x0, x1], [y0, y1]] = this.box, z = this.floor, middle = [(x0 + x1) / 2, (y0 + y1) / 2];
    const line = (a, b) => { const p = this.project(...a), q = this.project(...b); c.beginPath(); c.moveTo(p[0], p[1]); c.lineTo(q[0], q[1]); c.stroke(); };
    c.lineWidth = 1; c.strokeStyle = theme.color("floor");
    for (let x = x0; x <= x1 + 1e-6; x += this.step) line([x, y0, z], [x, y1, z]);
    for (let y = y0; y <= y1 + 1e-6; y += this.step) line([x0, y, z], [x1, y, z]);
    // Numbers stand at the two edges that are nearer to the eye.
    const near = (a, b) => this.project(...a)[2] < this.project(...b)[2];
    const edgeY = near([middle[0], y0, z], [middle[0], y1, z]) ? [y0, -1] : [y1, 1];
    const edgeX = near([x0, middle[1], z], [x1, middle[1], z]) ? [x0, -1] : [x1, 1];
    const gap = 0.13 * this.reach;
    c.fillStyle = theme.color("faint"); c.font = `11px ${theme.color("sans")}`; c.textAlign = "center"; c.textBaseline = "middle";
    const write = (text, px, py) => { const p = this.project(px, py, z); c.fillText(text, p[0], p[1]); };
    const xs = ticks(x0, x1, (x1 - x0) / this.step), ys = ticks(y0, y1, (y1 - y0) / this.step);
    for (const x of xs) write(tickText(x, xs), x, edgeY[0] + edgeY[1] * gap);
    for (const y of ys) write(tickText(y, ys), edgeX[0] + edgeX[1] * gap, y);
    c.fillStyle = theme.color("soft");
    write("x (m)", middle[0], edgeY[0] + edgeY[1] * 2.5 * gap);
    write("y (m)", edgeX[0] + edgeX[1] * 2.6 * gap, middle[1]);
  }

  drawTrails(c, time, row) {
    const n = this.count, {times, places, scale, frames} = this.record, point = (frame, agent) => {
      const base = 3 * n * frame + agent;
      return this.project(places[base] * scale, places[base + n] * scale, places[base + 2 * n] * scale);
    };
    c.lineJoin = "round"; c.lineCap = "butt";
    const trace = (agent, from, to, stride) => { // broken where nobody knows where it was
      let drawn = false;
      for (let frame = from; frame <= to; frame += stride) {
        const p = point(frame, agent);
        if (Number.isNaN(p[0])) { drawn = false; continue; }
        drawn ? c.lineTo(p[0], p[1]) : c.moveTo(p[0], p[1]);
        drawn = true;
      }
    };
    for (let agent = 0; agent < n; agent++) {
      if (!this.moves(agent)) continue;
      if (this.shared.paths) {
        const stride = Math.max(1, Math.floor(frames / 220));
        c.beginPath();
        trace(agent, 0, frames - 1, stride);
        c.setLineDash(this.dash(agent)); c.strokeStyle = this.color(agent); c.globalAlpha = n > 30 ? 0.2 : 0.38; c.lineWidth = 1; c.stroke(); c.setLineDash([]);
      }
      let first = row;
      while (first > 0 && times[first] > time - TRAIL_S) first--;
      const parts = 5, length = row - first, head = [this.now[agent], this.now[agent + n], this.now[agent + 2 * n]];
      for (let k = 0; k < parts && length > 0; k++) {
        const from = first + Math.floor(length * k / parts), to = first + Math.floor(length * (k + 1) / parts);
        c.beginPath();
        trace(agent, from, to, 1);
        if (k === parts - 1) { const p = this.project(...head); c.lineTo(p[0], p[1]); }
        c.setLineDash(this.dash(agent)); c.strokeStyle = this.color(agent); c.globalAlpha = 0.25 + 0.75 * (k + 1) / parts; c.lineWidth = n > 30 ? 1.5 : 2.2; c.stroke(); c.setLineDash([]);
      }
    }
    c.globalAlpha = 1;
  }

  moves(agent) { return this.run.moving[this.ids[agent] - 1] !== false && !this.run.lost?.has(this.ids[agent]); }
  color(agent) { return agentColor(this.ids[agent], this.moves(agent)); }
  dash(agent) { return PALETTE.dashes[agentTurn(this.ids[agent])].map(length => 2 * length); }

  /* Who sent lately: 1 now, falling to 0 within a few slots; negative for frames that collided. */
  senders(time) {
    const glow = new Map(), record = this.record, slots = this.run.slot_s, current = Math.floor(time / slots + 1e-6), fade = Math.max(1, Math.ceil(0.12 / slots));
    for (let i = after(record.slot, current, record.sent) - 1; i >= 0 && record.slot[i] > current - fade; i--) {
      const level = 1 - (current - record.slot[i]) / fade;
      if (!glow.has(record.sender[i])) glow.set(record.sender[i], record.outcome[i] === 2 ? -level : level);
    }
    return glow;
  }

  draw(time) {
    const c = this.context, n = this.count;
    c.clearRect(0, 0, this.width, this.height);
    this.now ??= new Float64Array(3 * n);
    const row = this.at(time, this.now), now = this.now;
    this.camera(); this.drawFloor(c); this.drawTrails(c, time, row);
    const radius = Math.max(0.1, this.reach * 0.022), glow = this.senders(time), order = [];
    if (this.shared.targets) for (let agent = 0; agent < n; agent++) {
      if (!this.moves(agent)) continue;
      const p = this.project(...this.target[this.ids[agent] - 1]), size = radius * p[3] * 0.75;
      c.strokeStyle = this.color(agent); c.globalAlpha = 0.6; c.lineWidth = 1.2;
      c.beginPath(); c.moveTo(p[0] - size, p[1] - size); c.lineTo(p[0] + size, p[1] + size); c.moveTo(p[0] + size, p[1] - size); c.lineTo(p[0] - size, p[1] + size); c.stroke();
    }
    for (let agent = 0; agent < n; agent++) {
      if (Number.isNaN(now[agent])) continue;
      const p = this.project(now[agent], now[agent + n], now[agent + 2 * n]), foot = this.project(now[agent], now[agent + n], this.floor);
      c.strokeStyle = theme.color("faint"); c.globalAlpha = 0.28; c.lineWidth = 1;
      c.beginPath(); c.moveTo(p[0], p[1]); c.lineTo(foot[0], foot[1]); c.stroke();
      c.fillStyle = theme.color("faint"); c.globalAlpha = 0.3;
      c.beginPath(); c.ellipse(foot[0], foot[1], radius * foot[3] * 0.8, radius * foot[3] * 0.8 * Math.max(0.12, Math.sin(this.shared.pitch)), 0, 0, 7); c.fill();
      order.push([p, agent]);
    }
    c.globalAlpha = 1;
    order.sort((a, b) => b[0][2] - a[0][2]);
    const ghosts = this.run.ghosts ? this.run.ghosts(time) : null;
    if (ghosts) this.drawGhosts(c, ghosts, radius);
    for (const [p, agent] of order) this.drawAgent(c, p, agent, radius * p[3], glow.get(this.ids[agent]) || 0);
    if (this.shared.names) for (const [p, agent] of order) this.drawName(c, p, agent, radius * p[3]);
    this.run.crashes.forEach((crash, index) => this.drawCrash(c, crash, time, radius, index));
    const slot = Math.floor(time / this.run.slot_s + 1e-6);
    this.label.textContent = this.record.count ? `slot ${whole(Math.min(slot, this.record.first + this.record.count - 1))}` : "";
  }

  drawAgent(c, p, agent, size, level) {
    if (level) {
      c.strokeStyle = level > 0 ? theme.color("lost") : theme.color("collision");
      c.globalAlpha = Math.abs(level); c.lineWidth = level > 0 ? 2.2 : 3.2; c.setLineDash(level > 0 ? [] : [3, 3]);
      c.beginPath(); c.arc(p[0], p[1], size * (1.35 + 0.9 * (1 - Math.abs(level))), 0, 7); c.stroke(); c.globalAlpha = 1; c.setLineDash([]);
    }
    const color = this.color(agent), shade = c.createRadialGradient(p[0] - size * 0.35, p[1] - size * 0.4, size * 0.1, p[0], p[1], size);
    shade.addColorStop(0, mixed(color, "#ffffff", 0.45)); shade.addColorStop(0.55, color); shade.addColorStop(1, mixed(color, "#000000", 0.22));
    c.fillStyle = shade; this.outline(c, p, size, this.moves(agent) ? agentTurn(this.ids[agent]) : 0); c.fill();
    c.strokeStyle = theme.dark ? "#0b0f14" : mixed(color, "#000000", 0.45); c.lineWidth = 0.8; c.stroke();
  }

  /* What a chosen agent believes: where it takes the others to be, joined to where they are, with the age in slots. */
  drawGhosts(c, ghosts, radius) {
    const n = this.count, now = this.now;
    c.font = `11px ${theme.color("sans")}`; c.textAlign = "left"; c.textBaseline = "top"; c.lineWidth = 1.2;
    for (let agent = 0; agent < n; agent++) {
      if (!ghosts.known(agent)) continue;
      const p = this.project(ghosts.place[agent], ghosts.place[agent + n], ghosts.place[agent + 2 * n]), q = this.project(now[agent], now[agent + n], now[agent + 2 * n]);
      const size = radius * p[3] * 0.9;
      c.strokeStyle = this.color(agent); c.globalAlpha = 0.9; c.setLineDash([3, 2.5]);
      c.beginPath(); c.moveTo(q[0], q[1]); c.lineTo(p[0], p[1]); c.stroke();
      c.beginPath(); c.arc(p[0], p[1], size, 0, 7); c.stroke(); c.setLineDash([]);
      c.globalAlpha = 1; c.fillStyle = theme.color("soft"); c.fillText(whole(ghosts.age[agent]), p[0] + size * 0.75, p[1] + size * 0.6);
    }
  }

  /* Agents whose colours come again have another shape. */
  outline(c, p, size, turn) {
    c.beginPath();
    if (!turn) { c.arc(p[0], p[1], size, 0, 7); return; }
    const corners = [0, [0, 4, 1.25], [Math.PI / 4, 4, 1.2], [0, 3, 1.3]][turn];
    for (let k = 0; k < corners[1]; k++) {
      const angle = corners[0] - Math.PI / 2 + 2 * Math.PI * k / corners[1];
      c.lineTo(p[0] + corners[2] * size * Math.cos(angle), p[1] + corners[2] * size * Math.sin(angle));
    }
    c.closePath();
  }

  /* A cross in a ring where two have come too close: pale before, with its text from then on. */
  drawCrash(c, crash, time, radius, index) {
    const p = this.project(...crash.place), size = Math.max(9, 1.7 * radius * p[3]), past = time >= crash.time_s - 1e-6, arm = size * 0.72;
    c.globalAlpha = past ? 1 : 0.4;
    const cross = () => {
      c.beginPath(); c.arc(p[0], p[1], size, 0, 7); c.stroke();
      c.beginPath(); c.moveTo(p[0] - arm, p[1] - arm); c.lineTo(p[0] + arm, p[1] + arm); c.moveTo(p[0] + arm, p[1] - arm); c.lineTo(p[0] - arm, p[1] + arm); c.stroke();
    };
    c.strokeStyle = theme.color("card"); c.lineWidth = 5; cross();
    c.strokeStyle = theme.color("collision"); c.lineWidth = 2.2; cross();
    c.globalAlpha = 1;
    if (!past || index > 3) return;
    const text = `crash ${crash.ids.join("–")}, ${num(crash.time_s, 2, "s")}`;
    c.font = `600 12.5px ${theme.color("sans")}`; c.textBaseline = "middle";
    // Texts stand above the flight, one below the other: none hides a dot or another one.
    const wide = c.measureText(text).width + 12, x = 12, y = 20 + 27 * index;
    c.strokeStyle = theme.color("collision"); c.lineWidth = 1; c.globalAlpha = 0.7;
    c.beginPath(); c.moveTo(x + wide, y); c.lineTo(p[0] - size * 0.7, p[1] - size * 0.7); c.stroke(); c.globalAlpha = 1;
    c.fillStyle = theme.color("card"); c.fillRect(x, y - 11, wide, 22); c.strokeRect(x, y - 11, wide, 22);
    c.fillStyle = theme.color("ink"); c.textAlign = "left"; c.fillText(text, x + 6, y + 0.5);
  }

  drawName(c, p, agent, size) {
    c.font = `600 ${Math.max(9, Math.min(13, size * 1.15))}px ${theme.color("sans")}`;
    c.textAlign = "center"; c.textBaseline = "bottom"; c.lineWidth = 2.5; c.lineJoin = "round";
    c.strokeStyle = theme.color("card"); c.strokeText(this.ids[agent], p[0], p[1] - size - 1);
    c.fillStyle = theme.color("ink"); c.fillText(this.ids[agent], p[0], p[1] - size - 1);
  }
}
