"""What the channel tells late subscribers: the run's settings, and how it is doing."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

from dtsa_msgs.msg import Configuration, RunStatus
from rclpy.node import Node

from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.stamps import header_of

from .answers import Answers
from .observer import ChannelObserver, ChannelStatus

_PERIOD_S = 1.0  # wall time from one status to the next while nothing changes


def configuration_message(settings: Mapping[str, Any], run_id: int) -> Configuration:
    """A dtsa_msgs/Configuration.

    :param settings: the settings of the run by section, with ``mode`` among them.
    :param run_id: the run's id.
    """
    return Configuration(
        header=header_of(names.TIME_ZERO_NS),
        run=run_id,
        mode=str(settings.get("mode", "lockstep")),
        settings=json.dumps(settings, sort_keys=True),
    )


class RunState:
    """What a status message says, kept up to date by who observes a channel.

    :param run_id: the run's id.
    :param slot_ns: ns, length of a slot.
    """

    def __init__(self, run_id: int, slot_ns: int) -> None:
        self.phase: int = RunStatus.WAITING
        self.slot = 0
        self.awaited: list[int] = []
        self.lag_ms = 0.0
        self.reason = ""
        self._run_id, self._slot_ns = run_id, slot_ns
        self._lost: set[int] = set()
        self._returned: set[int] = set()

    def lose(self, agent: int) -> None:
        """Takes note that an agent has fallen silent."""
        self._lost.add(agent)
        self._returned.discard(agent)

    def regain(self, agents: list[int]) -> None:
        """Takes note that agents report again."""
        self._lost.difference_update(agents)
        self._returned.update(agents)

    def message(self) -> RunStatus:
        """A dtsa_msgs/RunStatus."""
        return RunStatus(
            header=header_of(names.slot_time_ns(self.slot, self._slot_ns)),
            run=self._run_id,
            phase=self.phase,
            slot=self.slot,
            awaited=self.awaited if self.phase == RunStatus.WAITING else [],
            lost=sorted(self._lost),
            returned=sorted(self._returned),
            lag_ms=self.lag_ms,
            reason=self.reason,
        )


class RunTopics(ChannelObserver):
    """Publishes ``configuration`` and ``status`` in the swarm's namespace, transient local.

    :param node: the channel's node.
    :param settings: the settings of the run by section.
    :param run_id: the run's id.
    :param slot_ns: ns, length of a slot.
    :param swarm_namespace: namespace of the swarm's topics.
    """

    def __init__(
        self, node: Node, settings: Mapping[str, Any], run_id: int, slot_ns: int, swarm_namespace: str = names.SWARM
    ) -> None:
        qos = names.latched_qos()
        self._settings = node.create_publisher(Configuration, f"{swarm_namespace}/{names.CONFIGURATION}", qos)
        self._settings.publish(configuration_message(settings, run_id))
        self._status = node.create_publisher(RunStatus, f"{swarm_namespace}/{names.STATUS}", qos)
        self._state = RunState(run_id, slot_ns)
        self._next_s = 0.0  # time.monotonic()
        self._tell()

    def _tell(self) -> None:
        self._next_s = time.monotonic() + _PERIOD_S
        self._status.publish(self._state.message())

    def all_answered(self, slot: int, answers: Answers) -> None:
        if not slot:
            self._state.phase = RunStatus.FLYING
            self._tell()

    def agent_silent(self, agent: int) -> None:
        self._state.lose(agent)
        self._tell()

    def agents_back(self, agents: list[int]) -> None:
        self._state.regain(agents)
        self._tell()

    def idle(self, status: ChannelStatus) -> None:
        state = self._state
        awaited = status.awaited != state.awaited and state.phase == RunStatus.WAITING
        state.slot, state.awaited, state.lag_ms = max(0, status.slot), status.awaited, status.lag_ms
        if awaited or time.monotonic() >= self._next_s:
            self._tell()

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        self._state.phase, self._state.slot, self._state.reason = RunStatus.ENDED, max(0, slot), reason
        self._tell()
