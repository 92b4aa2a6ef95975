"""What follows from a slot, as messages: decisions, receptions, and a picture of the swarm."""

from __future__ import annotations

from array import array
from functools import lru_cache

import numpy as np
from dtsa_msgs.msg import Decision, Reception, SlotRecord
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from dtsa_agent.core import REASONS, Scenario
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import pack_received
from dtsa_agent.ros.common.messages import CdrMessage
from dtsa_bench.log.bag.cdr import COLLIDED, QUIET, SENDING, WAITING, MarkerPacker
from dtsa_bench.log.record import frame_fields, pack_record
from dtsa_channel_sim.model.verdict import COLLISION, Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver, ChannelStatus

_ACCOUNT = ("chosen", "reason", "digest", "score", "track", "velocity", "command", "goal")
_VIEW_NS = 50_000_000  # simulated time from one picture of the swarm to the next
_RECEPTION = CdrMessage({
    "run": "I", "slot": "I", "outcome": "B", "sender": "*H", "received": "*B", "lost": "*H", "collided": "*H",
})  # fmt: skip


@lru_cache(256)
def _decision(count: int) -> CdrMessage:
    """Decision messages with this many names of reasons."""
    texts = dict.fromkeys((f"name_{place}" for place in range(count)), "*B")
    return CdrMessage({
        "run": "I", "slot": "I", "agent": "*H", "chosen": "*H", "names": "I", **texts, "index": "*B", "reason": "*B",
        "digest": "*I", "score": "*d",
    })  # fmt: skip


class SlotMessages:
    """Packs what the agents of a swarm decided in a slot, who received what, and where all were, as CDR."""

    def __init__(self, scenario: Scenario, slot_ns: int, run_id: int) -> None:
        self._scenario, self._slot_ns, self._run_id = scenario, slot_ns, run_id
        self._agents = scenario.start.shape[1]
        self._ids = array("H", range(1, self._agents + 1)).tobytes()
        self.view_slots = max(1, round(_VIEW_NS / slot_ns))
        self._markers = MarkerPacker(range(1, self._agents + 1))

    def decision(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A dtsa_msgs/Decision; it names the reasons that agents have."""
        used = np.unique(answers.reason)
        texts = [(REASONS[code] if code < len(REASONS) else str(code)).encode() + b"\0" for code in used]
        index = np.searchsorted(used, answers.reason).astype(np.uint8)
        return _decision(len(texts)).pack(names.slot_time_ns(slot, self._slot_ns), (
            self._run_id, slot, self._ids, answers.chosen.tobytes(), len(texts), *texts, index.tobytes(),
            answers.reason.tobytes(), answers.digest.tobytes(), answers.score.tobytes(),
        ))  # fmt: skip

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

    def reception(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A dtsa_msgs/Reception."""
        nothing = (0,) * len(verdict.senders)
        received = pack_received(verdict.mask(self._agents)) if verdict.senders else b""
        sent, lost, collided = (
            array("H", numbers).tobytes()
            for numbers in (verdict.senders, verdict.lost or nothing, verdict.collided or nothing)
        )
        time_ns = names.slot_time_ns(slot + 1, self._slot_ns)
        return _RECEPTION.pack(time_ns, (self._run_id, slot, verdict.outcome, sent, received, lost, collided))

    def markers(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A visualization_msgs/MarkerArray: the swarm at the start of a slot."""
        state = np.where(self._scenario.moving, WAITING, QUIET).astype(np.uint8)
        state[[sender - 1 for sender in verdict.senders]] = COLLIDED if verdict.outcome == COLLISION else SENDING
        time_ns = names.slot_time_ns(slot, self._slot_ns)
        return self._markers.pack(time_ns, answers.position, state, answers.goal)


class LiveTopics(ChannelObserver):
    """Publishes each slot's decisions and receptions, and pictures of the swarm, while a node subscribes.

    :param node: the channel's node.
    :param space: namespace of the swarm's topics.
    """

    def __init__(self, node: Node, scenario: Scenario, slot_ns: int, run_id: int, space: str = names.SWARM) -> None:
        packed = SlotMessages(scenario, slot_ns, run_id)
        self._topics = [
            (node.create_publisher(kind, f"{space}/{topic}", 10), pack, slots)
            for topic, kind, pack, slots in (
                (names.DECISION, Decision, packed.decision, 1),
                (names.RECEPTION, Reception, packed.reception, 1),
                ("slot_record", SlotRecord, packed.record, 1),
                (names.MARKERS, MarkerArray, packed.markers, packed.view_slots),
            )
        ]
        self._watched = [False] * len(self._topics)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        for (publisher, pack, slots), watched in zip(self._topics, self._watched, strict=True):
            if watched and slot % slots == 0:
                publisher.publish(pack(slot, answers, verdict))

    def idle(self, status: ChannelStatus) -> None:
        self._watched = [publisher.get_subscription_count() > 0 for publisher, _, _ in self._topics]
