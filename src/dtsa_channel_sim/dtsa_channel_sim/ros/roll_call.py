"""Who is there before slot 0 in real time, and how long messages take on this machine."""

from __future__ import annotations

import time
from array import array
from contextlib import suppress

import numpy as np
from dtsa_msgs.msg import Slot
from rclpy.publisher import Publisher

from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.checks import Unusable
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.report_fields import read_report

from .accounts import Accounts
from .answers import Answers

_ROUNDS, _LONGEST_S = 20, 0.5
_PAUSE_S = 0.0001


class RollCall:
    """Calls all agents, by number, and takes their answers.

    :param publisher: of dtsa_msgs/Slot.
    :param reports: what they answer.
    :param run_id: the run's id.
    :param calling: what the channel's calls carry.
    :param accounts: those of the calls, a slot each; what agents answer is checked as all that they report.
    """

    def __init__(
        self, publisher: Publisher, reports: Feed, run_id: int, calling: array[int], accounts: Accounts
    ) -> None:
        self._publisher, self._reports, self._run_id, self._calling = publisher, reports, run_id, calling
        self._accounts = accounts

    def answers(self, number: int) -> Answers:
        """What has been answered to a call: where all are, above all.

        :param number: of the call.
        """
        return self._accounts[names.FIRST_CALL + number]

    def call(self, number: int) -> None:
        """Asks who is there.

        :param number: the answers name it.
        """
        number += names.FIRST_CALL
        self._publisher.publish(Slot(run=self._run_id, phase=Slot.PREPARE, slot=number, data=self._calling))

    def answered(self, number: int) -> set[int]:
        """Ids of agents that have answered a call, among the answers that have come in since this was asked last.

        :param number: of the call.
        """
        found: set[int] = set()
        while (data := self._reports.take()) is not None:
            try:
                message = read_report(data)
            except Exception:  # rclpy has no common base for what a message can do to it
                continue
            asked = names.FIRST_CALL + number
            if message.run == self._run_id and message.slot.tolist() == [asked]:
                with suppress(Unusable):
                    self._accounts.add(message, asked)
                    found.update(message.agent)
        return found

    def round_ms(self, agents: set[int]) -> float:
        """How long a round of messages takes, from a call to the last answer: ms, median over some rounds.

        :param agents: ids of those that answer.
        """
        end, rounds = time.monotonic() + _LONGEST_S, []
        for number in range(1, _ROUNDS + 1):
            begin, awaited = time.monotonic(), set(agents)
            self.call(number)
            while awaited and time.monotonic() < end:
                time.sleep(_PAUSE_S)
                awaited -= self.answered(number)
            rounds.append(time.monotonic() - begin)
            if time.monotonic() >= end:
                break
        return float(np.median(rounds)) * 1e3
