// Velocities as arrows, from the odometry. Input of layouts/make.py, which puts in all agents' topics.
import { Input, Message } from "./types";

export const inputs = ["/cf1/odom"];
export const output = "/studio_script/swarm_odometry";

const AHEAD = 0.5; // s, an arrow ends where its agent would be then
const COLOURS = [[0.25, 0.6, 0.45]]; // by agent; make.py puts the palette in
const STILL = 0.02; // m/s, below that an agent has no arrow

export default function script(event: Input<"/cf1/odom">): Message<"foxglove.SceneUpdate"> {
  const message = event.message as any;
  const { x, y, z } = message.twist.twist.linear; // in map: the orientation is always the identity
  const speed = Math.hypot(x, y, z);
  const id = message.child_frame_id;
  const timestamp = event.receiveTime;
  const scene: any = { deletions: [], entities: [] };
  if (speed < STILL) {
    scene.deletions.push({ timestamp, type: 0, id });
    return scene;
  }
  // The rotation that takes the arrow's own direction, x, to the velocity's.
  const size = Math.hypot(z, y, speed + x);
  const orientation =
    size > 1e-6 * speed ? { x: 0, y: -z / size, z: y / size, w: (speed + x) / size } : { x: 0, y: 0, z: 1, w: 0 };
  const length = AHEAD * speed;
  const [r, g, b] = COLOURS[(parseInt(id.slice(2)) - 1) % COLOURS.length]!;
  const head = Math.min(0.1, length / 2);
  scene.entities.push({
    timestamp,
    frame_id: message.header.frame_id,
    id,
    lifetime: { sec: 0, nsec: 0 },
    frame_locked: false,
    metadata: [],
    arrows: [
      {
        pose: { position: message.pose.pose.position, orientation },
        shaft_length: length - head,
        shaft_diameter: 0.03,
        head_length: head,
        head_diameter: 0.08,
        color: { r: r!, g: g!, b: b!, a: 1 },
      },
    ],
    cubes: [],
    spheres: [],
    cylinders: [],
    lines: [],
    triangles: [],
    texts: [],
    models: [],
  });
  return scene;
}
