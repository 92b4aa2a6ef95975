"""What the channel's node says on its logger and on /rosout while a run is under way."""

from __future__ import annotations

import time

from rclpy.node import Node

from dtsa_agent.ros.common.graph.names import named
from dtsa_agent.ros.common.process.waiting import Waiting
from dtsa_channel_sim.model.config import Change

from .answers import Answers
from .observer import ChannelObserver, ChannelStatus

_SLOW_S = 1.0  # wall time after which an answer that is missing in flight is worth a warning


class RunLog(ChannelObserver):
    """Says whom the channel waits for, when slot 0 starts, who is lost or back, and why the run ends.

    :param node: the channel's node.
    :param run_id: the run's id.
    :param lockstep: whether the channel waits for every answer.
    """

    def __init__(self, node: Node, run_id: int, lockstep: bool) -> None:
        self._logger = node.get_logger()
        self._lockstep = lockstep
        self._waiting = Waiting(self._logger)
        self._flying = False
        self._slot, self._since_s = -1, time.monotonic()
        self._told = False  # that the slot is slow
        self._logger.info(f"run {run_id:08x}: waiting for the agents")

    def all_answered(self, slot: int, answers: Answers) -> None:
        if not self._flying:
            self._flying = True
            self._logger.info("slot 0: all agents have answered, the run starts")

    def idle(self, status: ChannelStatus) -> None:
        if not self._flying:
            if status.awaited:
                self._waiting.tell(f"waiting for {named(status.awaited)} to answer")
        elif self._lockstep:
            self._watch(status)

    def _watch(self, status: ChannelStatus) -> None:
        """Warns once about a slot that somebody keeps waiting."""
        now = time.monotonic()
        if status.slot != self._slot or not status.awaited:
            self._slot, self._since_s, self._told = status.slot, now, False
        elif not self._told and now - self._since_s > _SLOW_S:
            self._told = True
            self._logger.warning(f"slot {status.slot}: still waiting for {named(status.awaited)}")

    def agent_silent(self, agent: int) -> None:
        self._logger.warning(f"{named([agent])} is lost: it has not been heard of for a while")

    def agents_back(self, agents: list[int]) -> None:
        self._logger.info(f"{named(agents)} {'is' if len(agents) == 1 else 'are'} back")

    def settings_changed(self, change: Change) -> None:
        values = ", ".join(f"{name} = {value}" for name, value in change.values)
        self._logger.info(f"from slot {change.slot} on: {values}")

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        text = f"the run ends after slot {slot}: {reason}" if self._flying else f"no slot was flown: {reason}"
        if failed:
            self._logger.error(text)
        else:
            self._logger.info(text)
