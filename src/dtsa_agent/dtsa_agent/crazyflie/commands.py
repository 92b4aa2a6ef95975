"""A streamed command on its way from its topic to its vehicle: read, converted, checked.

Everything is in the Crazyflies' world, with Crazyswarm2's units: `cmd_position` has its yaw in degrees,
`cmd_velocity_world` its yaw rate in degrees per second, a full state counts in radians. A header with the frame `map`
(the room's centre) is converted. The firmware wants the same, but for a full state: 16 bit numbers, so positions beyond
32.767 m would overflow.

rclpy's executor builds a wait set of everything that a node has for each message; with a hundred topics and services
that takes longer than all the rest of a command's way. So these topics have a thread with a wait set of their own.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from .safety import SafetySettings, outside_fence
from .state import Quaternion, Vector, to_world

VELOCITY_WORLD, POSITION, FULL_STATE = "velocity_world", "position", "full_state"
FULL_STATE_LIMIT = 32.767  # m, m/s, m/s^2, rad/s: 16 bit numbers in thousandths
_POLL_NS = 100_000_000  # the end is noticed after this time at the latest


@dataclass(frozen=True, slots=True)
class Setpoint:
    """One streamed command, ready for the radio: a method of cflib's commander and its arguments."""

    kind: str  # velocity_world, position or full_state
    arguments: tuple[Any, ...]
    stamp: float  # s, monotonic time at which it came in
    place: Vector | None = None  # m, world, where it leads
    speed: float = 0.0  # m/s


def velocity_world(velocity: Vector, yaw_rate: float, stamp: float) -> Setpoint:
    """Return a velocity, m/s along the world's axes, with a yaw rate in degrees/s."""
    return Setpoint(VELOCITY_WORLD, (*_finite(velocity), *_finite((yaw_rate,))), stamp, speed=math.hypot(*velocity))


def position(place: Vector, yaw: float, stamp: float) -> Setpoint:
    """Return a place, m (world), with a yaw in degrees."""
    return Setpoint(POSITION, (*_finite(place), *_finite((yaw,))), stamp, place)


def full_state(
    place: Vector, velocity: Vector, acceleration: Vector, orientation: Quaternion, rates: Vector, stamp: float
) -> Setpoint:
    """Position m, velocity m/s, acceleration m/s^2 (world), attitude (x, y, z, w), body rates rad/s (REP-103).

    Numbers beyond what the packet's 16 bits can say are kept at their limit: an overflow would send the Crazyflie the
    other way. An orientation of length zero (an unset message) means level, heading along x.
    """
    vectors = [tuple(_saturate(v) for v in _finite(vector)) for vector in (place, velocity, acceleration)]
    roll_rate, pitch_rate, yaw_rate = (_saturate(v) for v in _finite(rates))
    q = _finite(orientation)
    norm = math.sqrt(sum(c * c for c in q))
    q = tuple(c / norm for c in q) if norm > 1e-6 else (0.0, 0.0, 0.0, 1.0)
    arguments = (*vectors, q, roll_rate, pitch_rate, yaw_rate)
    return Setpoint(FULL_STATE, arguments, stamp, place, math.hypot(*velocity))


def _saturate(value: float) -> float:
    return min(FULL_STATE_LIMIT, max(-FULL_STATE_LIMIT, value))


def _finite(values: tuple[float, ...]) -> tuple[float, ...]:
    if not all(math.isfinite(v) for v in values):
        raise ValueError("a command with a number that is not finite")
    return values


def of_message(kind: str, m: Any, origin: Vector, stamp: float) -> Setpoint:
    """Return the set-point of a message.

    :param origin: m, where the world sees the origin of `map`.
    :raises ValueError: a number is not finite.
    """
    if kind == VELOCITY_WORLD:
        return velocity_world((m.vel.x, m.vel.y, m.vel.z), m.yaw_rate, stamp)
    shift = origin if m.header.frame_id == "map" else (0.0, 0.0, 0.0)
    if kind == POSITION:
        return position(to_world((m.x, m.y, m.z), shift), m.yaw, stamp)
    p, q, v, w, a = m.pose.position, m.pose.orientation, m.twist.linear, m.twist.angular, m.acc
    place = to_world((p.x, p.y, p.z), shift)
    return full_state(place, (v.x, v.y, v.z), (a.x, a.y, a.z), (q.x, q.y, q.z, q.w), (w.x, w.y, w.z), stamp)


def check_setpoint(setpoint: Setpoint, safety: SafetySettings, origin: Vector, fastest_mps: float) -> None:
    """Refuse a streamed command that leads out of the room, or is too fast; ValueError: why it is refused."""
    if setpoint.speed > fastest_mps:
        limit = f"(station.max_stream_mps is {fastest_mps:g})"
        raise ValueError(f"a command with {setpoint.speed:.2f} m/s is refused {limit}")
    if setpoint.place is not None and (problem := outside_fence(setpoint.place, safety, origin)):
        raise ValueError(f"a command to {problem} is refused")


class TopicThread:
    """Takes the newest messages of topics and calls back, in its own thread.

    :param node: subscribes; must not be in an executor.
    """

    def __init__(self, node: Any, name: str) -> None:
        self._node = node
        self._subscriptions: list[tuple[Any, type, Callable[[Any, float], None]]] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def subscribe(self, kind: type, topic: str, callback: Callable[[Any, float], None], qos: Any) -> None:
        """Before `start`: take the messages of a topic.

        :param callback: gets a message, and when it was published (s, Unix time).
        """
        subscription = self._node.create_subscription(kind, topic, lambda message: None, qos)
        self._subscriptions.append((subscription.handle, kind, callback))

    def start(self) -> None:
        """Begin, if there is something to take."""
        if self._subscriptions:
            self._thread.start()

    def close(self) -> None:
        """End of the thread and its node."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._node.destroy_node()

    def _run(self) -> None:
        from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy

        with ExitStack() as stack:
            context = self._node.context.handle
            for handle in (context, *(handle for handle, _, _ in self._subscriptions)):
                stack.enter_context(handle)
            wait_set = _rclpy.WaitSet(len(self._subscriptions), 0, 0, 0, 0, 0, context)
            while not self._closing.is_set() and self._node.context.ok():
                wait_set.clear_entities()
                for handle, _, _ in self._subscriptions:
                    wait_set.add_subscription(handle)
                wait_set.wait(_POLL_NS)
                ready = set(wait_set.get_ready_entities("subscription"))
                for handle, kind, callback in self._subscriptions:
                    taken = handle.take_message(kind, False) if handle.pointer in ready else None
                    if taken is not None:
                        callback(taken[0], taken[1]["source_timestamp"] * 1e-9)
