"""What the channel tells on ``/diagnostics``."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from std_msgs.msg import Header

from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.stamps import time_of
from dtsa_channel_sim.model.verdict import OUTCOMES, Verdict

from .answers import Answers
from .observer import ChannelObserver, ChannelStatus


class Diagnostics(ChannelObserver):
    """Publishes the channel's status once a second of wall time, stamped in the run's time, while somebody listens.

    :param node: the channel's node.
    :param slot_ns: ns, length of a slot.
    """

    def __init__(self, node: Node, slot_ns: int) -> None:
        self._slot_ns = slot_ns
        self._name = f"{node.get_namespace().strip('/')}: channel"
        self._counts = [0, 0, 0]  # slots by outcome
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._ticks = 0

    def judged(self, slot: int, answers: Answers, frames: dict[int, bytes], verdict: Verdict) -> None:
        self._counts[verdict.outcome] += 1

    def idle(self, status: ChannelStatus) -> None:
        self._ticks += 1
        if self._ticks % 10 or not self._publisher.get_subscription_count():
            return
        values = {
            "slot": status.slot,
            "not taken in": sum(status.dropped.values()),
            "agents awaited": status.awaited,
            **{f"not taken in: {reason}": count for reason, count in sorted(status.dropped.items())},
            **{f"slots: {name}": count for name, count in zip(OUTCOMES, self._counts, strict=True)},
        }
        told = DiagnosticStatus(
            level=DiagnosticStatus.WARN if status.dropped else DiagnosticStatus.OK,
            name=self._name,
            message=f"slot {status.slot}",
            hardware_id="simulated",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        stamp = time_of(names.slot_time_ns(max(0, status.slot), self._slot_ns))
        self._publisher.publish(DiagnosticArray(header=Header(stamp=stamp), status=[told]))
