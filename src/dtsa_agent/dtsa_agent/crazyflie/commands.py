"""A streamed command on its way from its topic to its vehicle: read and converted.

Everything is in the Crazyflies' world, with Crazyswarm2's units: `cmd_position` has its yaw in degrees,
`cmd_velocity_world` its yaw rate in degrees per second, a full state counts in radians. A header with the frame `map`
(the room's centre) is converted.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, NamedTuple

from .state import Vector, to_world

VELOCITY_WORLD, POSITION, FULL_STATE = "velocity_world", "position", "full_state"
FULL_STATE_LIMIT = 32.767  # m, m/s, m/s^2, rad/s: 16 bit numbers in thousandths
_POLL_NS = 100_000_000  # the end is noticed after this time at the latest


class Setpoint(NamedTuple):
    """One streamed command, ready for the radio: a method of cflib's commander and its arguments."""

    kind: str  # velocity_world, position or full_state
    arguments: tuple[Any, ...]
    stamp: float  # s, monotonic time at which it came in
    place: Vector | None = None  # m, world, where it leads
    speed: float = 0.0  # m/s


def velocity_world(velocity: Vector, yaw_rate: float, stamp: float) -> Setpoint:
    """Return a velocity, m/s along the world's axes, with a yaw rate in degrees/s."""
    return Setpoint(VELOCITY_WORLD, (*velocity, yaw_rate), stamp, speed=math.hypot(*velocity))


def of_message(kind: str, m: Any, origin: Vector, stamp: float) -> Setpoint:
    """Return the set-point of a message of a kind.

    Numbers of a full state beyond what the packet's 16 bits can say are kept at their limit: an overflow would send the
    Crazyflie the other way. An orientation of length zero (an unset message) means level, heading along x.

    :param origin: m, where the world sees the origin of `map`.
    :raises ValueError: a number is not finite.
    """
    if kind == VELOCITY_WORLD:
        numbers = [m.vel.x, m.vel.y, m.vel.z, m.yaw_rate]
    elif kind == POSITION:
        numbers = [m.x, m.y, m.z, m.yaw]
    else:
        vectors = m.pose.position, m.twist.linear, m.acc, m.twist.angular
        q = m.pose.orientation
        numbers = [*(c for v in vectors for c in (v.x, v.y, v.z)), q.x, q.y, q.z, q.w]
    if not all(map(math.isfinite, numbers)):
        raise ValueError("a command with a number that is not finite")
    if kind == VELOCITY_WORLD:
        return velocity_world((numbers[0], numbers[1], numbers[2]), numbers[3], stamp)
    place = numbers[0], numbers[1], numbers[2]
    if m.header.frame_id == "map":
        place = to_world(place, origin)
    if kind == POSITION:
        return Setpoint(kind, (*place, numbers[3]), stamp, place)
    fixed = [min(FULL_STATE_LIMIT, max(-FULL_STATE_LIMIT, number)) for number in (*place, *numbers[3:12])]
    norm = math.hypot(*numbers[12:])
    orientation = tuple(c / norm for c in numbers[12:]) if norm > 1e-6 else (0.0, 0.0, 0.0, 1.0)
    position, velocity, acceleration = (tuple(fixed[k : k + 3]) for k in (0, 3, 6))
    arguments = (position, velocity, acceleration, orientation, *fixed[9:])
    return Setpoint(kind, arguments, stamp, place, math.hypot(*numbers[3:6]))


class TopicThread:
    """Takes the newest messages of topics and calls back, in its own thread, with a node and a wait set of its own.

    rclpy's executor builds a wait set of everything that a node has for each message; with a hundred topics and
    services that takes longer than all the rest of a command's way.
    """

    def __init__(self, parent: Any, name: str) -> None:
        from rclpy.node import Node

        plain = {"enable_rosout": False, "start_parameter_services": False, "use_global_arguments": False}
        space = parent.get_namespace()
        self._node = Node(f"{parent.get_name()}_{name}", namespace=space, context=parent.context, **plain)
        self._subscriptions: list[tuple[Any, type, Callable[[Any, float], None]]] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def subscribe(self, kind: type, topic: str, callback: Callable[[Any, float], None], qos: Any) -> None:
        """Before `start`: give a callback the messages of a topic, with when they were published (s, Unix time)."""
        subscription = self._node.create_subscription(kind, topic, lambda message: None, qos)
        self._subscriptions.append((subscription.handle, kind, callback))

    def start(self) -> None:
        if self._subscriptions:
            self._thread.start()

    def close(self) -> None:
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
