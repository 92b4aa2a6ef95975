"""A thread that serves nodes beside what else their process does."""

from __future__ import annotations

import threading
from contextlib import suppress

from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

_LONGEST_S = 0.5  # it looks whether it is closed that often at least
_END_S = 2.0


class Serving:
    """Calls the callbacks of nodes in one thread, until it is closed.

    ``Executor.spin`` in a thread raises when the executor is shut down under it; this ends between two callbacks.

    :param context: context of the nodes.
    :param name: of the thread.
    :param nodes: the nodes.
    """

    def __init__(self, context: Context, name: str, *nodes: Node) -> None:
        self.executor = SingleThreadedExecutor(context=context)
        for node in nodes:
            self.executor.add_node(node)
        self._context, self._closed = context, threading.Event()
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)

    def start(self) -> None:
        """Begins."""
        self._thread.start()

    def close(self) -> None:
        """Ends it: a callback under way is waited for, 2 s at most."""
        self._closed.set()
        if self._thread.is_alive():
            self.executor.wake()
            self._thread.join(_END_S)
        self.executor.shutdown(timeout_sec=0)

    def _serve(self) -> None:
        with suppress(ExternalShutdownException):
            while self._context.ok() and not self._closed.is_set():
                self.executor.spin_once(timeout_sec=_LONGEST_S)
