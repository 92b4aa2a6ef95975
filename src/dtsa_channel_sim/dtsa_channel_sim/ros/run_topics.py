"""What the channel's node publishes about a run: settings and status, diagnostics, transforms, lines of its log."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from dtsa_msgs.msg import Configuration, RunStatus
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.messages import header_of
from dtsa_agent.ros.common.names import agent_names
from dtsa_agent.ros.common.runs import WaitingLog
from dtsa_channel_sim.model.schedule import Change
from dtsa_channel_sim.model.verdict import Verdict

from .answers import Answers
from .observer import ChannelObserver
from .ros_channel import RosChannel

_STATUS_S = 1.0  # wall time from one status to the next while nothing changes
_TRANSFORMS_S = 0.02  # wall time from one message of transforms to the next at the least
_TRANSFORMS_DEPTH = 100  # as tf2's own broadcasters
_SLOW_S = 1.0  # wall time after which an answer that is missing in flight is worth a warning


def configuration_message(settings: Mapping[str, Any], run_id: int) -> Configuration:
    """Return a dtsa_msgs/Configuration with the settings of a run by section, ``mode`` among them."""
    return Configuration(
        header=header_of(names.TIME_ZERO_NS),
        run=run_id,
        mode=str(settings.get("mode", "lockstep")),
        settings=json.dumps(settings, sort_keys=True),
    )


def status_message(channel: RosChannel, phase: int, slot: int, **more: Any) -> RunStatus:
    """Return a dtsa_msgs/RunStatus of a run that has come to a slot, -1: none yet."""
    return RunStatus(
        header=header_of(names.slot_time_ns(max(0, slot), channel.slot_ns)),
        run=channel.run_id, phase=phase, slot=max(0, slot),
        lost=sorted(channel.lost), returned=sorted(channel.returned), **more,
    )  # fmt: skip


class RunTopics(ChannelObserver):
    """Publishes ``configuration`` and ``status`` in the swarm's namespace, transient local, for late subscribers."""

    def __init__(self, node: Node, settings: Mapping[str, Any], channel: RosChannel, swarm_namespace: str) -> None:
        qos, self._channel = names.latched_qos(), channel
        self._settings = node.create_publisher(Configuration, f"{swarm_namespace}/{names.CONFIGURATION}", qos)
        self._settings.publish(configuration_message(settings, channel.run_id))
        self._status = node.create_publisher(RunStatus, f"{swarm_namespace}/{names.STATUS}", qos)
        self._phase, self._slot, self._awaited = RunStatus.WAITING, -1, list[int]()
        self._publish()

    def _publish(self, reason: str = "") -> None:
        self._next_s = time.monotonic() + _STATUS_S
        values = {"awaited": self._awaited, "lag_ms": self._channel.lag_ms, "reason": reason}
        self._status.publish(status_message(self._channel, self._phase, self._slot, **values))

    def all_answered(self, slot: int, answers: Answers) -> None:
        if not slot:
            self._phase, self._slot, self._awaited = RunStatus.FLYING, 0, []
            self._publish()

    def agent_silent(self, agent: int) -> None:
        self._publish()

    def agents_back(self, agents: list[int]) -> None:
        self._publish()

    def idle(self, slot: int, awaited: list[int]) -> None:
        before, self._slot = self._awaited, slot
        self._awaited = awaited if self._phase == RunStatus.WAITING else []
        if before != self._awaited or time.monotonic() >= self._next_s:
            self._publish()

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        self._phase, self._slot, self._awaited = RunStatus.ENDED, slot, []
        self._publish(reason)


class Diagnostics(ChannelObserver):
    """Publishes on ``/diagnostics`` once a second of wall time, while somebody subscribes, what was not received."""

    def __init__(self, node: Node, channel: RosChannel) -> None:
        self._name, self._channel = f"{node.get_namespace().strip('/')}: channel", channel
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._ticks = 0

    def idle(self, slot: int, awaited: list[int]) -> None:
        self._ticks += 1
        if self._ticks % 10 or not self._publisher.get_subscription_count():
            return
        dropped = self._channel.dropped()
        values = {"agents awaited": awaited, "not taken in": sum(dropped.values())}
        values |= {f"not taken in: {reason}": count for reason, count in sorted(dropped.items())}
        message = DiagnosticStatus(
            level=DiagnosticStatus.WARN if dropped else DiagnosticStatus.OK,
            name=self._name, message=f"slot {slot}", hardware_id="simulated",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )  # fmt: skip
        header = header_of(names.slot_time_ns(max(0, slot), self._channel.slot_ns))
        self._publisher.publish(DiagnosticArray(header=header, status=[message]))


class Transforms(ChannelObserver):
    """Publishes ``map`` -> ``cfN/base_link`` of all agents on ``/tf`` in one message, while somebody subscribes.

    Needs tf2_msgs, which an installation from apt has and the wheels lack. The attitude is not modelled: it is the
    identity.
    """

    def __init__(self, node: Node, agents: int, slot_ns: int, swarm_namespace: str) -> None:
        from tf2_msgs.msg import TFMessage

        self._slot_ns, self._kind = slot_ns, TFMessage
        spaces = [names.agent_namespace(agent, swarm_namespace) for agent in range(1, agents + 1)]
        self._transforms = [TransformStamped(child_frame_id=names.body_frame(space)) for space in spaces]
        self._next_s = 0.0  # time.monotonic()
        self._watched = False
        self._publisher = node.create_publisher(TFMessage, "/tf", _TRANSFORMS_DEPTH)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        if not self._watched or time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + _TRANSFORMS_S
        header = header_of(names.slot_time_ns(slot, self._slot_ns))
        for transform, place in zip(self._transforms, answers.position.T.tolist(), strict=True):
            transform.header, translation = header, transform.transform.translation
            translation.x, translation.y, translation.z = place
        self._publisher.publish(self._kind(transforms=self._transforms))

    def idle(self, slot: int, awaited: list[int]) -> None:
        self._watched = self._publisher.get_subscription_count() > 0


class RunLog(ChannelObserver):
    """Logs which agents are waited for, when slot 0 starts, which are lost or back, and why the run ends."""

    def __init__(self, node: Node, run_id: int, lockstep: bool) -> None:
        self._logger = node.get_logger()
        self._lockstep = lockstep
        self._waiting = WaitingLog(self._logger)
        self._flying = False
        self._slot, self._since_s = -1, time.monotonic()  # the slot that is watched; infinite: a warning was logged
        self._logger.info(f"run {run_id:08x}: waiting for the agents")

    def all_answered(self, slot: int, answers: Answers) -> None:
        if not self._flying:
            self._flying = True
            self._logger.info("slot 0: all agents have answered, the run starts")

    def idle(self, slot: int, awaited: list[int]) -> None:
        if not self._flying:
            if awaited:
                self._waiting.log(f"waiting for {agent_names(awaited)} to answer")
        elif slot != self._slot or not awaited:
            self._slot, self._since_s = slot, time.monotonic()
        elif self._lockstep and time.monotonic() - self._since_s > _SLOW_S:
            self._since_s = float("inf")
            self._logger.warning(f"slot {slot}: still waiting for {agent_names(awaited)}")

    def agent_silent(self, agent: int) -> None:
        self._logger.warning(f"{agent_names([agent])} is lost: it has not been heard of for a while")

    def agents_back(self, agents: list[int]) -> None:
        self._logger.info(f"{agent_names(agents)} {'is' if len(agents) == 1 else 'are'} back")

    def settings_changed(self, change: Change) -> None:
        values = ", ".join(f"{name} = {value}" for name, value in change.values)
        self._logger.info(f"from slot {change.slot} on: {values}")

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        text = f"the run ends after slot {slot}: {reason}" if self._flying else f"no slot was flown: {reason}"
        (self._logger.error if failed else self._logger.info)(text)
