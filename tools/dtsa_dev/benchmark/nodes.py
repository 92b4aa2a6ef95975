"""Real nodes in lockstep, recorded, beside rounds of messages without any protocol.

In a bare round one process publishes a number, every other process answers it, and the round is over when all answers
are there: what a flight in lockstep does in every slot, with the same loop, quality of service and number of processes.
As a module, this is the process that answers.
"""

from __future__ import annotations

import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import UInt32

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.loop import Loop
from dtsa_agent.ros.common.node_process import init_ros, node_options, run_node
from dtsa_agent.stop import Stop
from dtsa_bench.experiments.sweep import run_config
from dtsa_bench.flights.children import Children
from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.flights.flight import fly, run_environment
from dtsa_bench.flights.options import FlightOptions

from . import Measurement

TARGETS = ((4, 4, None), (12, 12, 200.0), (18, 1, 500.0), (70, 2, 200.0))  # agents, processes, slots/s
SLOTS, REPEATS = 1000, 3
RATIO = 2.5  # bare rounds over slots at most
_ASK, _ANSWER, _OVER = "/bare_round/ask", "/bare_round/answer", 2**32 - 1
_START_S = 60.0


def nodes() -> Iterator[Measurement]:
    """Slots a second; where each agent has a process, bare rounds in turn: the machine changes within minutes."""
    for agents, processes, limit in TARGETS:
        run = run_config({"agents": agents, "timeout_s": SLOTS / 100, "stop_on_crash": False})
        rates, bare = [], []
        for _ in range(REPEATS):
            with tempfile.TemporaryDirectory() as place:
                options = FlightOptions(processes=processes, pictures=False)
                summary = fly(run, Path(place) / "flight", options, label="benchmark").summary
            rates.append(summary["slots"]["total"] / summary["wall_time_s"])
            if processes == agents:
                bare.append(rounds_per_s(processes, SLOTS, 2)[-1])  # the first ones are slower
        row = Measurement(f"nodes in lockstep, agents {agents}, processes {processes}", f"{max(rates):.0f} slots/s")
        if bare:
            ratio = statistics.median(rounds / slots for rounds, slots in zip(bare, rates, strict=True))
            row = row._replace(other=f"bare rounds {statistics.median(bare):.0f}/s", ratio=ratio)
        if limit:
            slow = row.ratio is not None and row.ratio > RATIO
            target = f"{f'<= {RATIO:g}, ' * bool(bare)}>= {limit:g} slots/s"
            row = row._replace(target=target, met=max(rates) >= limit and not slow)
        yield row


def rounds_per_s(processes: int, rounds: int, repeats: int) -> list[float]:
    """Bare rounds a second with so many processes that answer, one value a repetition."""
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
        """Ask until all have answered one question."""
        deadline = time.monotonic() + _START_S
        while (heard := self._round(patience_s=0.2)) < self._processes:
            if time.monotonic() > deadline:
                raise DtsaError(f"only {heard} of {self._processes} processes answer after {_START_S:g} s")

    def _round(self, patience_s: float = math.inf) -> int:
        """Ask once; how many have answered that within a time."""
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

    try:
        while not stop:
            message = loop.wait()
            if message is not None:
                if message.data == _OVER:
                    return
                publisher.publish(message)
            loop.housekeeping()
    finally:
        loop.close()


if __name__ == "__main__":
    sys.exit(run_node("bare_round", _body))
