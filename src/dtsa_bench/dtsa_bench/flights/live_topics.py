"""What a recorded flight publishes for whoever watches: decisions, receptions, markers."""

from __future__ import annotations

from dtsa_msgs.msg import Decision, Reception
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from dtsa_agent.core import Scenario
from dtsa_agent.ros.common.graph import names
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver, ChannelStatus

from .slot_messages import SlotMessages

_MARKER_PERIOD_NS = 50_000_000  # simulated


class LiveTopics(ChannelObserver):
    """Publishes each slot's decisions and receptions, and pictures of the swarm, while somebody subscribes.

    :param node: the channel's node.
    :param run_id: the run's id.
    :param space: namespace of the swarm's topics.
    """

    def __init__(self, node: Node, scenario: Scenario, slot_ns: int, run_id: int, space: str = names.SWARM) -> None:
        self._messages = SlotMessages(scenario, slot_ns, run_id)
        self._decision, self._reception, self._markers = self._publishers = tuple(
            node.create_publisher(kind, f"{space}/{topic}", 10)
            for kind, topic in ((Decision, names.DECISION), (Reception, names.RECEPTION), (MarkerArray, names.MARKERS))
        )
        self._watched = [False, False, False]
        self._marker_slots = max(1, round(_MARKER_PERIOD_NS / slot_ns))

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        decision, reception, markers = self._watched
        if decision:
            self._decision.publish(self._messages.decision(slot, answers))
        if reception:
            self._reception.publish(self._messages.reception(slot, verdict))
        if markers and slot % self._marker_slots == 0:
            self._markers.publish(self._messages.markers(slot, answers, verdict))

    def idle(self, status: ChannelStatus) -> None:
        self._watched = [publisher.get_subscription_count() > 0 for publisher in self._publishers]
