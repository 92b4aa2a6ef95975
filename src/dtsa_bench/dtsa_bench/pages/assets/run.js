"use strict";
/* A run as it comes in: the same fields as a recorded one, in arrays of limited length. */
const MOMENTS = 12000, PLACES = 24000, FRAMES = 240000, POINTS = 500, UNKNOWN = 65535;

/* Columns that grow together; of too many rows the oldest quarter goes. widths: values a row. */
class Table {
  constructor(most, columns) {
    this.most = most; this.columns = columns; this.room = 256; this.length = 0; this.dropped = 0;
    for (const [name, [kind, width]] of Object.entries(columns)) this[name] = new kind(this.room * width);
  }

  /* Makes room for some rows; the index of the first of them. */
  more(count) {
    if (this.length + count > this.most) this.drop(Math.max(Math.floor(this.most / 4), this.length + count - this.most));
    if (this.length + count > this.room) {
      while (this.room < this.length + count) this.room *= 2;
      for (const [name, [kind, width]] of Object.entries(this.columns)) {
        const longer = new kind(this.room * width);
        longer.set(this[name]); this[name] = longer;
      }
    }
    this.length += count;
    return this.length - count;
  }

  drop(count) {
    const gone = Math.min(count, this.length);
    for (const [name, [, width]] of Object.entries(this.columns)) this[name].copyWithin(0, gone * width, this.length * width);
    this.length -= gone; this.dropped += gone;
  }
}

/* Values over time for a chart: when there are too many points, every second one goes. */
export class Series {
  constructor(names) { this.time = []; this.names = names; this.values = names.map(() => []); this.step = 0; this.next = -1; }

  add(time, values) {
    if (time < this.next) return;
    this.next = time + this.step;
    this.time.push(time); values.forEach((value, k) => this.values[k].push(value));
    if (this.time.length < 2 * POINTS) return;
    for (const list of [this.time, ...this.values]) { for (let i = 0; 2 * i < list.length; i++) list[i] = list[2 * i]; list.length = Math.ceil(list.length / 2); }
    this.step = (this.time[this.time.length - 1] - this.time[0]) / POINTS;
  }

  get most() { return Math.max(0, ...this.values.flat().filter(value => value !== null)) || 1; }
}

/* The two agents that are closest: [distance, id, id]. */
export function closestOf(places, base, n, ids) {
  let least = Infinity, one = -1, other = -1;
  for (let a = 0; a < n; a++) {
    const x = places[base + a], y = places[base + n + a], z = places[base + 2 * n + a];
    for (let b = a + 1; b < n; b++) {
      const dx = places[base + b] - x, dy = places[base + n + b] - y, dz = places[base + 2 * n + b] - z, gap = dx * dx + dy * dy + dz * dz;
      if (gap < least) { least = gap; one = a; other = b; }
    }
  }
  return one < 0 ? null : [Math.sqrt(least), ids[one], ids[other]];
}

class LiveRecord {
  constructor(n, box) {
    this.scale = 1; this.box = box; this.first = 0; this.count = 0;
    this.place = new Table(PLACES, {times: [Float64Array, 1], places: [Float32Array, 3 * n]});
    this.sending = new Table(FRAMES, {slot: [Uint32Array, 1], sender: [Uint16Array, 1], outcome: [Uint8Array, 1], reason: [Uint8Array, 1], received: [Uint8Array, 1]});
  }
  get times() { return this.place.times; }
  get places() { return this.place.places; }
  get frames() { return this.place.length; }
  get slot() { return this.sending.slot; }
  get sender() { return this.sending.sender; }
  get outcome() { return this.sending.outcome; }
  get reason() { return this.sending.reason; }
  get received() { return this.sending.received; }
  get sent() { return this.sending.length; }
}

export class LiveRun {
  constructor(info) {
    Object.assign(this, info, {crashes: [], events: [], lost: new Set(), state: "", watched: 0, dirty: true, time: 0, begin: 0});
    const n = this.agents, ids = Array.from({length: n}, (_, k) => k + 1);
    this.scene = {ids, target: this.target};
    this.slots = {};
    this.decisions = {names: this.reasons};
    this.record = new LiveRecord(n, [this.box[0].slice(), this.box[1].slice()]);
    this.moments = new Table(MOMENTS, {at: [Float64Array, 1], compared: [Uint16Array, 1], same: [Uint16Array, 1], tables: [Uint16Array, 1], lag: [Float32Array, 1],
      age: [Uint16Array, n], chosen: [Uint16Array, n], closest: [Float32Array, 1], one: [Uint16Array, 1], other: [Uint16Array, 1],
      heard: [Uint16Array, n], believed: [Int16Array, 3 * n], told: [Uint16Array, 1], refused: [Uint32Array, 1]});
    this.number = 0; // of the first moment that has come
    this.distance = new Series(["closest of all"]); this.ages = new Series(["mean of agents", "worst agent"]);
    this.shares = new Series(["success", "collision", "idle", "agents agree"]);
  }

  /* Takes in moments; number: of the first. */
  take(first, moments) {
    const held = this.moments;
    if (!held.length && !held.dropped) {
      this.number = first;
      if (moments.length) this.beginAt(moments[0]);
    }
    else if (first !== this.number + held.dropped + held.length) { // some were gone before they could be sent
      held.drop(held.length); held.dropped = 0; this.number = first;
    }
    for (const moment of moments) this.takeOne(moment);
    this.dirty = true;
  }

  /* Who comes late knows nothing of the slots before. */
  beginAt(moment) {
    const slot = new Uint32Array(bytes(moment.frames.slot)), at = new Uint32Array(bytes(moment.at));
    this.record.first = Math.min(moment.slot, ...slot, ...at);
    this.begin = this.record.first * this.slot_s;
  }

  /* The oldest time that is kept (s). */
  get oldest() { return this.moments.dropped && this.moments.length ? this.moments.at[0] : this.begin; }

  takeOne(moment) {
    const n = this.agents, record = this.record, time = moment.slot * this.slot_s;
    const at = new Uint32Array(bytes(moment.at)), place = new Float32Array(bytes(moment.place));
    const from = record.place.more(at.length);
    record.places.set(place, 3 * n * from);
    for (let k = 0; k < at.length; k++) record.times[from + k] = at[k] * this.slot_s;
    this.takeFrames(moment.frames);
    record.count = moment.slot - record.first;
    const held = this.moments, row = held.more(1), near = record.frames ? closestOf(record.places, 3 * n * (record.frames - 1), n, this.scene.ids) : null;
    held.at[row] = time; held.compared[row] = moment.agree[0]; held.same[row] = moment.agree[1]; held.tables[row] = moment.tables;
    held.lag[row] = moment.lag_ms ?? 0; held.refused[row] = moment.refused ?? 0; held.told[row] = 0;
    held.age.set(new Uint16Array(bytes(moment.age)), n * row); held.chosen.set(new Uint16Array(bytes(moment.chosen)), n * row);
    [held.closest[row], held.one[row], held.other[row]] = near ?? [NaN, 0, 0];
    this.time = Math.max(this.time, time);
    this.lost = new Set(moment.absent);
    for (const [slot, kind, text] of moment.events) this.events.push({time: slot * this.slot_s, kind, text});
    if (this.events.length > 300) this.events.splice(0, this.events.length - 300);
    for (const [slot, one, other, gap] of moment.crashes) this.takeCrash(slot, one, other, gap);
    this.chart(row, time, near);
  }

  takeFrames(frames) {
    const table = this.record.sending, slot = new Uint32Array(bytes(frames.slot)), from = table.more(slot.length);
    table.slot.set(slot, from); table.sender.set(new Uint16Array(bytes(frames.sender)), from);
    for (const name of ["outcome", "reason", "received"]) table[name].set(new Uint8Array(bytes(frames[name])), from);
    for (let i = from; i < table.length; i++) {
      const name = this.reasons[table.reason[i]];
      if (name && name !== "nobody" && !REASONS.includes(name)) REASONS.push(name);
    }
    if (table.dropped) this.record.first = table.slot[0];
  }

  takeCrash(slot, one, other, gap) {
    if (this.crashes.length >= 50 || !this.record.frames) return;
    const time = slot * this.slot_s, out = new Float64Array(3 * this.agents), n = this.agents;
    Scene.prototype.at.call({record: this.record, count: n}, time, out);
    const place = [0, 1, 2].map(axis => (out[one - 1 + axis * n] + out[other - 1 + axis * n]) / 2);
    this.crashes.push({ids: [one, other], time_s: time, place, distance_m: gap});
    this.events.push({time, kind: "bad", text: `cf${one} and cf${other} have crashed, ${num(gap, 3, "m")}`});
  }

  chart(row, time, near) {
    const held = this.moments, n = this.agents;
    if (near) this.distance.add(time, [near[0]]);
    let sum = 0, count = 0, most = 0;
    for (let k = 0; k < n; k++) { const age = held.age[n * row + k]; if (age !== UNKNOWN) { sum += age; count++; if (age > most) most = age; } }
    if (count) this.ages.add(time, [sum / count / 10, most / 10]);
    const load = this.load(time, 1), compared = held.compared[row];
    if (load) this.shares.add(time, [load.success, load.collision, load.idle, compared ? held.same[row] / compared : null]);
  }

  /* Shares of the slots of the last seconds: success, collision, idle. */
  load(time, span) {
    const record = this.record, last = Math.min(Math.floor(time / this.slot_s + 1e-6), record.first + record.count), first = Math.max(record.first, last - Math.round(span / this.slot_s)), slots = last - first;
    if (slots <= 0) return null;
    let success = 0, collision = 0, before = -1;
    for (let i = after(record.slot, first - 1, record.sent); i < record.sent && record.slot[i] < last; i++) {
      if (record.slot[i] === before) continue;
      before = record.slot[i];
      if (record.outcome[i] === 2) collision++; else success++;
    }
    return {success: success / slots, collision: collision / slots, idle: 1 - (success + collision) / slots};
  }

  /* Row of the last moment at a time; -1: none. */
  momentAt(time) { return after(this.moments.at, time + 1e-9, this.moments.length) - 1; }

  /* What has come of the chosen agent's beliefs; message: at, heard, place. */
  takeGhosts(message) {
    if (message.agent !== this.watched) return;
    const n = this.agents, heard = new Uint16Array(bytes(message.heard)), place = new Int16Array(bytes(message.place)), held = this.moments;
    message.at.forEach((number, k) => {
      const row = number - this.number - held.dropped;
      if (row < 0 || row >= held.length) return;
      held.heard.set(heard.subarray(n * k, n * k + n), n * row);
      held.believed.set(place.subarray(3 * n * k, 3 * n * k + 3 * n), 3 * n * row);
      held.told[row] = message.agent;
    });
  }

  /* What the chosen agent believes at a time: {place (3n), age (n), known(k)}; null: nobody is chosen, or it is not told. */
  ghosts(time) {
    const row = this.watched ? this.momentAt(time) : -1, held = this.moments, n = this.agents;
    if (row < 0 || held.told[row] !== this.watched) return null;
    const next = row + 1 < held.length && held.told[row + 1] === this.watched && held.at[row + 1] - held.at[row] < 0.2 ? row + 1 : row;
    const part = next > row ? Math.min(1, (time - held.at[row]) / (held.at[next] - held.at[row])) : 0;
    this.believed ??= new Float64Array(3 * n);
    for (let i = 0; i < 3 * n; i++) this.believed[i] = (held.believed[3 * n * row + i] * (1 - part) + held.believed[3 * n * next + i] * part) / 1000;
    const age = held.heard.subarray(n * row, n * row + n), mine = this.watched - 1;
    return {place: this.believed, age, known: k => k !== mine && age[k] !== UNKNOWN};
  }
}
export const NOT_KNOWN = UNKNOWN;
