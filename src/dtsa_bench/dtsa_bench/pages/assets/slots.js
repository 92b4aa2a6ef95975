"use strict";
/* The slot time line: the whole run above, some slots around the current time below. */
const WINDOW = 120, LEFT = 52, RIGHT = 14;

class SlotLine {
  constructor(run) {
    this.run = run; this.record = recordingOf(run);
    this.whole = el("canvas", {role: "img", "aria-label": "Who sent, over the whole run"});
    this.part = el("canvas", {role: "img", "aria-label": "Who sent, slot by slot"});
    this.node = el("div", {}, this.whole, this.part);
    this.row = Math.max(2, Math.min(9, 300 / run.agents)); this.rowPart = Math.max(3.2, Math.min(15, 420 / run.agents));
    onRedraw(this.node, width => { this.width = width; this.cache = null; this.draw(clock.time); });
    clock.listen(time => this.width && this.draw(time));
    this.point(this.whole, () => [this.record.first, this.record.count]); this.point(this.part, () => [this.from, this.shown]);
  }

  color(index) {
    if (this.record.outcome[index] === 2) return theme.color("collision");
    return this.record.reason[index] < 255 ? reasonColor(this.run.decisions.names[this.record.reason[index]]) : theme.color("success");
  }

  /* Share of the receivers that received a frame; null: not known. */
  received(index) { const level = this.record.received[index]; return level === 255 ? null : level / 254; }

  point(canvas, range) {
    const slotAt = event => {
      const box = canvas.getBoundingClientRect(), [first, count] = range();
      const place = ((event.clientX - box.left) * this.width / box.width - LEFT) / (this.width - LEFT - RIGHT);
      return place < 0 || place > 1 ? null : Math.min(first + count - 1, Math.floor(first + place * count));
    };
    canvas.addEventListener("pointermove", event => {
      const slot = slotAt(event);
      if (slot === null) { hideTip(); return; }
      if (event.buttons & 1 && canvas === this.whole) clock.set((slot + 0.5) * this.run.slot_s);
      showTip(event, this.describe(slot));
    });
    canvas.addEventListener("pointerdown", event => { const slot = slotAt(event); if (slot !== null) clock.set((slot + 0.5) * this.run.slot_s); });
    canvas.addEventListener("pointerleave", hideTip);
    canvas.style.cursor = "crosshair";
  }

  /* Index of the first frame in a slot or later. */
  find(slot) { return after(this.record.slot, slot - 1, this.record.sent); }

  describe(slot) {
    const rows = [`slot ${whole(slot)}, ${num(slot * this.run.slot_s, 3, "s")}`];
    for (let i = this.find(slot); i < this.record.sent && this.record.slot[i] === slot; i++) {
      const why = this.record.reason[i] < 255 ? this.run.decisions.names[this.record.reason[i]] : "";
      rows.push(`agent ${this.record.sender[i]}: ${this.record.outcome[i] === 2 ? "collision, " : ""}received by ${percent(this.received(i), 0)}`);
      if (why) rows.push(`  ${why}${reasonText(why) ? ": " + reasonText(why) : ""}`);
    }
    if (rows.length === 1) rows.push(this.run.slots?.unknown?.includes(slot) ? "not known whether an agent sent" : "no agent sent");
    return rows.join("\n");
  }

  draw(time) {
    this.whole.hidden = this.part.hidden = !this.record.count;
    if (!this.record.count) return; // no slot is known yet
    const current = Math.min(this.record.first + this.record.count - 1, Math.floor(time / this.run.slot_s + 1e-6));
    this.shown = Math.min(this.record.count, WINDOW, Math.max(30, Math.floor((this.width - LEFT - RIGHT) / 5.5))); // fewer on a phone
    this.from = Math.max(this.record.first, Math.min(this.record.first + this.record.count - this.shown, current - Math.floor(this.shown / 2)));
    this.drawWhole(current); this.drawPart(current);
  }

  drawWhole(current) {
    const height = 26 + this.row * this.run.agents + 22;
    if (!this.cache) {
      this.cache = document.createElement("canvas");
      const c = prepare(this.cache, this.width, height);
      this.frame(c, this.record.first, this.record.count, this.row, height, "whole run");
      this.context = prepare(this.whole, this.width, height);
    }
    const c = this.context, x = slot => LEFT + (this.width - LEFT - RIGHT) * (slot - this.record.first) / this.record.count;
    c.clearRect(0, 0, this.width, height);
    c.drawImage(this.cache, 0, 0, this.width, height);
    c.fillStyle = theme.color("accent"); c.globalAlpha = 0.13; c.fillRect(x(this.from), 20, x(this.from + this.shown) - x(this.from), height - 40); c.globalAlpha = 1;
    c.strokeStyle = theme.color("accent"); c.lineWidth = 1; c.strokeRect(x(this.from), 20, x(this.from + this.shown) - x(this.from), height - 40);
    c.fillStyle = theme.color("ink"); c.fillRect(x(current + 0.5) - 0.5, 18, 1, height - 36);
  }

  drawPart(current) {
    const height = 26 + this.rowPart * this.run.agents + 34, c = prepare(this.part, this.width, height);
    this.frame(c, this.from, this.shown, this.rowPart, height, `slots ${whole(this.from)} to ${whole(this.from + this.shown - 1)}`, true);
    const wide = (this.width - LEFT - RIGHT) / this.shown;
    c.strokeStyle = theme.color("ink"); c.globalAlpha = 0.75; c.lineWidth = 1.2;
    c.strokeRect(LEFT + (current - this.from) * wide, 19, wide, height - 52); c.globalAlpha = 1;
  }

  /* Frames of some slots: one row an agent, and a strip above that says what became of each slot. */
  frame(c, first, count, row, height, title, axis) {
    const inner = this.width - LEFT - RIGHT, wide = inner / count, top = 26, agents = this.run.agents;
    c.font = `11.5px ${theme.color("sans")}`; c.fillStyle = theme.color("soft"); c.textBaseline = "alphabetic";
    c.textAlign = "left"; c.fillText("agent", 2, 12); c.fillText(title, LEFT, 12);
    c.fillStyle = theme.color("grid");
    if (row >= 4.5) for (let agent = 0; agent < agents; agent += 2) c.fillRect(LEFT, top + agent * row, inner, row);
    else c.fillRect(LEFT, top, inner, agents * row);
    c.fillStyle = theme.color("idle"); c.fillRect(LEFT, 19, inner, 4);
    for (const slot of this.run.slots?.unknown ?? []) if (slot >= first && slot < first + count) c.clearRect(LEFT + (slot - first) * wide, 18, Math.max(1, wide), 6);
    const slim = Math.max(1, wide - (wide > 4 ? 1 : 0)), tall = Math.max(1.6, row - (row > 5 ? 1.2 : 0));
    for (let pass = 0; pass < 2; pass++) { // collisions last: a single one must not vanish under its neighbours
      for (let i = this.find(first); i < this.record.sent && this.record.slot[i] < first + count; i++) {
        if ((this.record.outcome[i] === 2) !== (pass === 1)) continue;
        const x = LEFT + (this.record.slot[i] - first) * wide;
        c.fillStyle = this.color(i);
        c.globalAlpha = this.record.outcome[i] === 2 ? 1 : 0.3 + 0.7 * (this.received(i) ?? 1);
        c.fillRect(x, top + (this.record.sender[i] - 1) * row, slim, tall);
        if (this.record.outcome[i] === 2 && slim > 6) { // a cross: not by colour alone
          const y = top + (this.record.sender[i] - 1) * row;
          c.strokeStyle = theme.color("card"); c.lineWidth = 0.9;
          c.beginPath(); c.moveTo(x + 1, y + 1); c.lineTo(x + slim - 1, y + tall - 1); c.moveTo(x + slim - 1, y + 1); c.lineTo(x + 1, y + tall - 1); c.stroke();
        }
        c.globalAlpha = 1;
        if (this.record.outcome[i] === 2) { c.fillStyle = theme.color("collision"); c.fillRect(x, 15, slim, 8); } // taller: not by colour alone
        else { c.fillStyle = theme.color("success"); c.fillRect(x, 19, slim, 4); }
        if (this.received(i) < 1 && this.received(i) !== null && this.record.outcome[i] !== 2 && axis) { c.fillStyle = theme.color("ink"); c.fillRect(x, top + (this.record.sender[i] - 1) * row + tall - Math.min(3, tall / 3), slim * (1 - this.received(i)), Math.min(3, tall / 3)); }
      }
    }
    c.fillStyle = theme.color("soft"); c.textAlign = "right"; c.textBaseline = "middle";
    const names = ticks(1, agents, Math.min(agents, agents * row / 15)).filter(value => value >= 1 && value === Math.round(value));
    for (const name of names) c.fillText(name, LEFT - 8, top + (name - 0.5) * row);
    const bottom = top + agents * row;
    c.textAlign = "center"; c.textBaseline = "top";
    const marks = ticks(first, first + count, this.width / 90).filter(value => value === Math.round(value) && value < first + count);
    for (const mark of marks) {
      const x = LEFT + (mark - first + (axis ? 0.5 : 0)) * wide;
      c.fillStyle = theme.color("line"); c.fillRect(x, bottom, 1, 4); c.fillStyle = theme.color("soft"); c.fillText(whole(mark), x, bottom + 6);
    }
    if (axis) { c.textAlign = "right"; c.fillText("slot", this.width - RIGHT, bottom + 21); }
  }
}
