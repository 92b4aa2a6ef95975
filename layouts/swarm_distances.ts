// The smallest distance in a recorded run, slot by slot. Input of layouts/make.py, which puts it into the layout.
import { Input } from "./types";

type Output = {
  slot: number; // that all agents have answered
  distance_min: number; // m, of the closest pair at its start
  distance_a: number; // their ids
  distance_b: number;
};

export const inputs = ["/swarm/slot_record"];
export const output = "/studio_script/swarm_distances";

const place: { [id: number]: number[] } = {};

// Every message gives an output: players warn of scripts that return nothing.
export default function script(event: Input<"/swarm/slot_record">): Output {
  const message = event.message as any;
  const count = message.agent.length;
  const last = (message.steps - 1) * 3 * count;
  for (let k = 0; k < count; k++) {
    place[message.agent[k]] = [0, 1, 2].map((axis) => message.track[last + axis * count + k]);
  }
  return closest(message.slot);
}

function closest(slot: number): Output {
  const found: Output = { slot, distance_min: NaN, distance_a: 0, distance_b: 0 };
  const ids = Object.keys(place).map(Number);
  for (let i = 0; i < ids.length; i++) {
    for (let j = i + 1; j < ids.length; j++) {
      const p = place[ids[i]!]!, q = place[ids[j]!]!;
      const distance = Math.hypot(p[0]! - q[0]!, p[1]! - q[1]!, p[2]! - q[2]!);
      if (!(distance >= found.distance_min)) {
        found.distance_min = distance;
        found.distance_a = ids[i]!;
        found.distance_b = ids[j]!;
      }
    }
  }
  return found;
}
