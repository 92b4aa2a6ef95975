"""What the channel tells on ``/diagnostics``."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from dtsa_channel_sim.model.verdict import OUTCOMES, Verdict

from .answers import Answers
from .observer import ChannelObserver, ChannelStatus


class Diagnostics(ChannelObserver):
    """Publishes the channel's status once a second, while somebody listens.

    :param node: the channel's node.
    """

    def __init__(self, node: Node) -> None:
        self._counts = [0, 0, 0]  # slots by outcome
        self._node = node
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
            "unusable messages": status.unusable,
            "agents awaited": status.awaited,
            **{f"slots: {name}": count for name, count in zip(OUTCOMES, self._counts, strict=True)},
        }
        told = DiagnosticStatus(
            level=DiagnosticStatus.WARN if status.unusable else DiagnosticStatus.OK,
            name="channel",
            message=f"slot {status.slot}",
            hardware_id="simulated",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[told])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
