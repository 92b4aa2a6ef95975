// Distances and ages from a recorded run, slot by slot. Input of layouts/make.py, which puts it into the layout.
import { Input } from "./types";

type Output = {
  slot: number;
  distance_min: number; // m, of the closest pair
  distance_a: number; // their ids
  distance_b: number;
  age_mean: number; // slots since each agent's last frame that somebody received, mean of all agents
  age_max: number;
  ages: number[]; // by id - 1
};
type InputEvent = Input<"/swarm/transmission"> | Input<"/swarm/reception">;

export const inputs = ["/swarm/transmission", "/swarm/reception"];
export const output = "/studio_script/swarm_news";

const place: { [id: number]: number[] } = {};
const heard: { [id: number]: number } = {};
let latest = -1;

export default function script(event: InputEvent): Output | undefined {
  if (event.topic === "/swarm/transmission") {
    const message = event.message as any;
    const count = message.agent.length;
    const last = (message.steps - 1) * 3 * count;
    for (let k = 0; k < count; k++) {
      const id = message.agent[k];
      place[id] = [message.track[last + k], message.track[last + count + k], message.track[last + 2 * count + k]];
    }
    return undefined;
  }
  const message = event.message as any;
  if (message.slot < latest) {
    // The player went back: what was heard later is not known yet.
    for (const id of Object.keys(heard)) {
      if (heard[Number(id)]! >= message.slot) {
        heard[Number(id)] = message.slot - 1;
      }
    }
  }
  latest = message.slot;
  const width = message.sender.length > 0 ? message.received.length / message.sender.length : 0;
  for (let k = 0; k < message.sender.length; k++) {
    for (let byte = k * width; byte < (k + 1) * width; byte++) {
      if (message.received[byte] !== 0) {
        heard[message.sender[k]] = message.slot;
      }
    }
  }
  const ids = Object.keys(place).map(Number);
  const result: Output = {
    slot: message.slot, distance_min: NaN, distance_a: 0, distance_b: 0, age_mean: NaN, age_max: NaN, ages: [],
  };
  for (let i = 0; i < ids.length; i++) {
    for (let j = i + 1; j < ids.length; j++) {
      const p = place[ids[i]!]!, q = place[ids[j]!]!;
      const distance = Math.hypot(p[0]! - q[0]!, p[1]! - q[1]!, p[2]! - q[2]!);
      if (!(distance >= result.distance_min)) {
        result.distance_min = distance;
        result.distance_a = ids[i]!;
        result.distance_b = ids[j]!;
      }
    }
  }
  let sum = 0, most = 0;
  for (const id of ids) {
    const age = message.slot - (heard[id] ?? -1);
    result.ages[id - 1] = age;
    sum += age;
    most = Math.max(most, age);
  }
  if (ids.length > 0) {
    result.age_mean = sum / ids.length;
    result.age_max = most;
  }
  return result;
}
