"""A round of messages without any protocol: what the middleware alone costs a slot.

One process publishes a number, every other process answers it, and the round is over when all answers are there: what a
flight in lockstep does in every slot, with the same loop, quality of service and number of processes. As a module, this
is the process that answers.
"""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from pathlib import Path

from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import UInt32

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process.loop import Loop, Stop
from dtsa_agent.ros.common.process.node_process import init_ros, node_options, run_node
from dtsa_bench.flights.children import Children
from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.flights.flight import run_environment

_ASK, _ANSWER, _OVER = "/bare_round/ask", "/bare_round/answer", 2**32 - 1
_START_S = 60.0


def rounds_per_s(processes: int, rounds: int, repeats: int) -> list[float]:
    """Rounds per second, one value a repetition.

    :param processes: number of processes that answer.
    :param rounds: rounds in one repetition.
    :param repeats: number of repetitions.
    :raises DtsaError: if a process ends, or they do not find each other.
    """
    with ros_domain() as domain, tempfile.TemporaryDirectory() as place:
        context = Context()
        children = Children(Path(place), run_environment(domain, Path(place)))
        try:
            for number in range(1, processes + 1):
                children.start(f"process {number}", [], __name__, [])
            init_ros([], context, domain)
            return _Asker(context, children, processes).measure(rounds, repeats)
        finally:
            context.try_shutdown()
            children.stop()


class _Asker:
    def __init__(self, context: Context, children: Children, processes: int) -> None:
        node = Node("bare_round", context=context, **node_options(True))
        self._children, self._processes = children, processes
        self._publisher = node.create_publisher(UInt32, _ASK, names.lockstep_qos())
        self._loop = Loop(node, UInt32, _ANSWER, names.lockstep_qos(processes))
        self._number = 0

    def measure(self, rounds: int, repeats: int) -> list[float]:
        try:
            self._meet()
            found = []
            for _ in range(repeats):
                begin = time.perf_counter()
                for _ in range(rounds):
                    self._round()
                found.append(rounds / (time.perf_counter() - begin))
            return found
        finally:
            self._publisher.publish(UInt32(data=_OVER))
            time.sleep(0.2)
            self._loop.close()

    def _meet(self) -> None:
        """Asks until all have answered one question."""
        deadline = time.monotonic() + _START_S
        while (heard := self._round(patience_s=0.2)) < self._processes:
            if time.monotonic() > deadline:
                raise DtsaError(f"only {heard} of {self._processes} processes answer after {_START_S:g} s")

    def _round(self, patience_s: float = math.inf) -> int:
        """Asks once; how many have answered that within a time."""
        self._number += 1
        self._publisher.publish(UInt32(data=self._number))
        end, heard = time.monotonic() + patience_s, 0
        while heard < self._processes and time.monotonic() < end:
            message = self._loop.wait()
            if message is None:
                self._children.check()
            else:
                heard += message.data == self._number
        return heard


def _body(stop: Stop, supervised: bool) -> None:
    node = Node(f"bare_round_{os.getpid()}", **node_options(supervised))
    publisher = node.create_publisher(UInt32, _ANSWER, names.lockstep_qos())
    loop = Loop(node, UInt32, _ASK, names.lockstep_qos())

    def answer(message: UInt32) -> bool:
        if message.data == _OVER:
            return False
        publisher.publish(message)
        return True

    try:
        loop.run(answer, lambda: None, stop)
    finally:
        loop.close()


if __name__ == "__main__":
    sys.exit(run_node("bare_round", _body))
