"""The way of a streamed command from its topic to its vehicle: a thread with a wait set for these topics alone.

rclpy's executor builds a wait set of everything that a node has for each message; with a hundred topics and services
that takes longer than all the rest of a command's way.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile

_POLL_NS = 100_000_000  # the end is noticed after this time at the latest
_BURST = 4  # messages taken from one topic in one round; only the latest one counts anyway


class CommandThread:
    """Takes messages and calls back, in its own thread.

    :param node: subscribes; must not be in an executor.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscriptions: list[tuple[Any, type, Callable[[Any, Any], None]]] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="commands", daemon=True)

    def subscribe(self, kind: type, topic: str, callback: Callable[[Any, Any], None], qos: QoSProfile) -> None:
        """Before `start`: take the messages of a topic.

        :param callback: gets a message and its information (`source_timestamp` in ns).
        """
        subscription = self._node.create_subscription(kind, topic, lambda message: None, qos)
        self._subscriptions.append((subscription.handle, kind, callback))

    def start(self) -> None:
        """Begin, if there is something to take."""
        if self._subscriptions:
            self._thread.start()

    def close(self) -> None:
        """End of the thread."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def _run(self) -> None:
        with ExitStack() as stack:
            context = self._node.context.handle
            for handle in (context, *(handle for handle, _, _ in self._subscriptions)):
                stack.enter_context(handle)
            wait_set = _rclpy.WaitSet(len(self._subscriptions), 0, 0, 0, 0, 0, context)
            while not self._over.is_set() and self._node.context.ok():
                wait_set.clear_entities()
                for handle, _, _ in self._subscriptions:
                    wait_set.add_subscription(handle)
                wait_set.wait(_POLL_NS)
                ready = set(wait_set.get_ready_entities("subscription"))
                for handle, kind, callback in self._subscriptions:
                    if handle.pointer in ready:
                        self._drain(handle, kind, callback)

    @staticmethod
    def _drain(handle: Any, kind: type, callback: Callable[[Any, Any], None]) -> None:
        latest = None
        for _ in range(_BURST):
            taken = handle.take_message(kind, False)
            if taken is None:
                break
            latest = taken
        if latest is not None:
            callback(*latest)
