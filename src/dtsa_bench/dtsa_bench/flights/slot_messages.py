"""What follows from a slot, as messages: its record, and a picture of the swarm."""

from __future__ import annotations

import numpy as np
from dtsa_msgs.msg import SlotRecord
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from dtsa_agent.core import Scenario
from dtsa_agent.ros.common import names
from dtsa_bench.log.bag.cdr import COLLIDED, QUIET, SENDING, WAITING, MarkerPacker
from dtsa_bench.log.record import frame_fields, pack_record
from dtsa_channel_sim.model.verdict import COLLISION, Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver

_ACCOUNT = ("chosen", "reason", "digest", "score", "track", "velocity", "command", "goal")
_VIEW_NS = 50_000_000  # simulated time from one picture of the swarm to the next


class SlotMessages:
    """Packs a slot as CDR: what agents decided, where they were, who received what."""

    def __init__(self, scenario: Scenario, slot_ns: int, run_id: int) -> None:
        self._scenario, self._slot_ns, self._run_id = scenario, slot_ns, run_id
        self._agents = scenario.start.shape[1]
        self.view_slots = max(1, round(_VIEW_NS / slot_ns))
        self._markers = MarkerPacker(range(1, self._agents + 1))

    def record(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A dtsa_msgs/SlotRecord, without what agents with clocks of their own took in."""
        frames = {sender: data for sender in sorted(verdict.senders) if (data := answers.frames.get(sender))}
        order, nothing = [verdict.senders.index(sender) for sender in frames], (0,) * len(verdict.senders)
        lost, collided = ([(values or nothing)[row] for row in order] for values in (verdict.lost, verdict.collided))
        here = slice(None) if answers.answered.all() else np.flatnonzero(answers.answered)
        account = {name: getattr(answers, name)[..., here] for name in _ACCOUNT}
        return pack_record(
            self._run_id, slot, names.slot_time_ns(slot, self._slot_ns), answers.steps, verdict.outcome,
            agent=np.arange(1, self._agents + 1)[here], **account,
            **frame_fields(frames, verdict.mask(self._agents)[order] if frames else None), lost=lost,
            collided=collided,
        )  # fmt: skip

    def markers(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A visualization_msgs/MarkerArray: the swarm at the start of a slot."""
        state = np.where(self._scenario.moving, WAITING, QUIET).astype(np.uint8)
        state[[sender - 1 for sender in verdict.senders]] = COLLIDED if verdict.outcome == COLLISION else SENDING
        time_ns = names.slot_time_ns(slot, self._slot_ns)
        return self._markers.pack(time_ns, answers.position, state, answers.goal)


class LiveTopics(ChannelObserver):
    """Publishes a record of each slot, and pictures of the swarm, while a node subscribes.

    :param node: the channel's node.
    :param space: namespace of the swarm's topics.
    """

    def __init__(self, node: Node, scenario: Scenario, slot_ns: int, run_id: int, space: str = names.SWARM) -> None:
        packed = SlotMessages(scenario, slot_ns, run_id)
        self._topics = [
            (node.create_publisher(kind, f"{space}/{topic}", 10), pack, slots)
            for topic, kind, pack, slots in (
                (names.SLOT_RECORD, SlotRecord, packed.record, 1),
                (names.MARKERS, MarkerArray, packed.markers, packed.view_slots),
            )
        ]
        self._watched = [False] * len(self._topics)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        for (publisher, pack, slots), watched in zip(self._topics, self._watched, strict=True):
            if watched and slot % slots == 0:
                publisher.publish(pack(slot, answers, verdict))

    def idle(self, slot: int, awaited: list[int]) -> None:
        self._watched = [publisher.get_subscription_count() > 0 for publisher, _, _ in self._topics]
