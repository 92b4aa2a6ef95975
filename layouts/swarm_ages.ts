// Ages of news from a recorded run, slot by slot. Input of layouts/make.py, which puts it into the layout.
import { Input } from "./types";

type Output = {
  slot: number;
  age_mean: number; // slots since each agent's last frame that somebody received, mean of all agents
  age_max: number;
  ages: number[]; // by id - 1; NaN while unknown because the script did not see the flight's start
};

export const inputs = ["/swarm/slot_record"];
export const output = "/studio_script/swarm_ages";

let ids: number[] = [];
let heard: { [id: number]: number } = {};
let first = -1; // slot that the script saw first
let latest = -1;
let result: Output = { slot: 0, age_mean: NaN, age_max: NaN, ages: [] };

// Every message gives an output: players warn of scripts that return nothing.
export default function script(event: Input<"/swarm/slot_record">): Output {
  const message = event.message as any;
  ids = Array.from(message.agent as number[]);
  if (message.slot < latest) {
    // The player went back: what was heard later is not known yet.
    heard = {};
    first = -1;
  }
  latest = message.slot;
  if (first < 0) {
    first = message.slot;
  }
  const width = message.sender.length > 0 ? message.received.length / message.sender.length : 0;
  for (let k = 0; k < message.sender.length; k++) {
    for (let byte = k * width; byte < (k + 1) * width; byte++) {
      if (message.received[byte] !== 0) {
        heard[message.sender[k]] = message.slot;
      }
    }
  }
  result = { slot: message.slot, age_mean: NaN, age_max: NaN, ages: [] };
  let sum = 0, most = 0;
  for (const id of ids) {
    const age = message.slot - (heard[id] ?? (first === 0 ? -1 : NaN));
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
