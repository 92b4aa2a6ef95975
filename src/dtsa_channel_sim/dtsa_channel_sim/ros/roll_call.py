"""Who is there before slot 0 in real time, and how long messages take on this machine."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
from dtsa_msgs.msg import Slot
from rclpy.publisher import Publisher

from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process.loop import Feed
from dtsa_agent.ros.common.wire.checks import Unusable
from dtsa_agent.ros.common.wire.report_fields import ReportFields, read_report

from .accounts import Accounts
from .answers import Answers

_ROUNDS, _LONGEST_S = 20, 0.5  # of one measurement
_SHORTER = 0.8  # rounds that take so much of what those before took become shorter
_SETTLED_S = 10.0  # after that a measurement counts however long rounds take
_PAUSE_S = 0.0001
_BURST = 256  # messages; whatever comes, the clock is looked at


class RollCall:
    """Calls all agents, by number, and takes their answers."""

    def __init__(
        self, publisher: Publisher, reports: Feed, run_id: int, calling: array[int], accounts: Accounts
    ) -> None:
        self._publisher, self._reports, self._run_id, self._calling = publisher, reports, run_id, calling
        self._accounts = accounts
        self._number = names.FIRST_CALL

    def call(self) -> None:
        """Asks who is there, with the same number until a round is measured."""
        data = self._calling
        self._publisher.publish(Slot(run=self._run_id, phase=Slot.PREPARE, slot=self._number, data=data))

    def present(self) -> set[int]:
        """Ids of agents that have answered the first call, among the answers that have come since this was asked."""
        found: set[int] = set()
        for message in self._answers():
            with suppress(Unusable):
                self._accounts.add(message, self._number)
                found.update(message.agent)
        return found

    @property
    def told(self) -> Answers:
        """What all have answered to the first call: where they are, above all."""
        return self._accounts[names.FIRST_CALL]

    def _answers(self) -> Iterator[ReportFields]:
        """Answers to the last call that have come in, some at a time."""
        for _ in range(_BURST):
            data = self._reports.take()
            if data is None:
                return
            try:
                message = read_report(data)
            except Exception:  # rclpy has no common base for what a message can do to it
                continue
            if message.run == self._run_id and message.slot.tolist() == [self._number]:
                yield message

    def round_ms(self, agents: set[int], enough_ms: float, give_up: Callable[[], object]) -> float:
        """How long a round of messages takes, from a call to the last answer: ms, median over some rounds.

        Many processes may have found the channel and still look for each other. So a measurement is repeated for some
        seconds while only some answer in time, or rounds that take too long become shorter.
        """
        end, before = time.monotonic() + _SETTLED_S, math.inf
        while True:
            took, silent = self._series(agents)
            settled = silent == agents or (not silent and (took <= enough_ms or took > _SHORTER * before))
            if settled or time.monotonic() > end or give_up():
                return took
            before = math.inf if silent else took

    def _series(self, agents: set[int]) -> tuple[float, set[int]]:
        """Median of some rounds, ms, and who did not answer in time in the last of them."""
        end, rounds = time.monotonic() + _LONGEST_S, []
        for _ in range(_ROUNDS):
            begin, awaited = time.monotonic(), set(agents)
            self._number += 1
            self.call()
            while awaited and time.monotonic() < end:
                time.sleep(_PAUSE_S)
                for message in self._answers():
                    awaited.difference_update(message.agent)
            rounds.append(time.monotonic() - begin)
            if time.monotonic() >= end:
                break
        return float(np.median(rounds)) * 1e3, awaited
