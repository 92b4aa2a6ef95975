"""What follows from a slot, as messages: decisions, receptions, and a picture of the swarm."""

from __future__ import annotations

from array import array
from functools import lru_cache

import numpy as np
from dtsa_msgs.msg import Decision, Reception, SlotRecord
from numpy.typing import NDArray
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from dtsa_agent.core import REASONS, Scenario
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import CdrMessage, pack_received
from dtsa_bench.log.bag.cdr import COLLIDED, QUIET, SENDING, WAITING, MarkerPacker
from dtsa_bench.log.record import frame_fields, pack_record
from dtsa_channel_sim.model.verdict import COLLISION, Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver, ChannelStatus

_ACCOUNT = ("chosen", "reason", "digest", "score", "track", "velocity", "command", "goal")
_KNOWN = 256  # combinations of reasons whose texts are kept
_RECEPTION = CdrMessage({
    "run": "I", "slot": "I", "outcome": "B", "sender": "*H", "received": "*B", "lost": "*H", "collided": "*H",
})  # fmt: skip


@lru_cache(256)
def _decision(count: int) -> CdrMessage:
    """Decision messages with this many names of reasons."""
    texts = dict.fromkeys((f"name {place}" for place in range(count)), "*B")
    return CdrMessage({
        "run": "I", "slot": "I", "agent": "*H", "chosen": "*H", "names": "I", **texts, "index": "*B", "reason": "*B",
        "digest": "*I", "score": "*d",
    })  # fmt: skip


class SlotMessages:
    """Packs what the agents of a swarm decided in a slot, who received what, and where everybody was.

    :param run_id: the run's id.
    """

    def __init__(self, scenario: Scenario, slot_ns: int, run_id: int) -> None:
        self._scenario, self._slot_ns, self._run_id = scenario, slot_ns, run_id
        self._agents = scenario.start.shape[1]
        self._ids = array("H", range(1, self._agents + 1)).tobytes()
        self._reasons: dict[bytes, tuple[list[bytes], bytes]] = {}
        self._markers = MarkerPacker(range(1, self._agents + 1))

    def decision(self, slot: int, answers: Answers) -> bytes:
        """A dtsa_msgs/Decision as CDR."""
        key = answers.reason.tobytes()
        known = self._reasons.get(key)
        if known is None:
            if len(self._reasons) >= _KNOWN:  # in a long flight agents that disagree decide in ever new combinations
                self._reasons.clear()
            known = self._reasons[key] = self._describe(answers.reason)
        texts, index = known
        return _decision(len(texts)).pack(names.slot_time_ns(slot, self._slot_ns), (
            self._run_id, slot, self._ids, answers.chosen.tobytes(), len(texts), *texts, index, key,
            answers.digest.tobytes(), answers.score.tobytes(),
        ))  # fmt: skip

    @staticmethod
    def _describe(reason: NDArray[np.uint8]) -> tuple[list[bytes], bytes]:
        """The names of the reasons that agents have, and which of them each has."""
        used = np.unique(reason)
        texts = [(REASONS[code] if code < len(REASONS) else str(code)).encode() + b"\0" for code in used]
        return texts, np.searchsorted(used, reason).astype(np.uint8).tobytes()

    def record(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A dtsa_msgs/SlotRecord as CDR, without what agents with clocks of their own took in."""
        frames = {sender: data for sender in sorted(verdict.senders) if (data := answers.frames.get(sender))}
        order = [verdict.senders.index(sender) for sender in frames]
        lost, collided = (
            [0] * len(order) if values is None else [values[row] for row in order]
            for values in (verdict.lost, verdict.collided)
        )
        here = slice(None) if answers.answered.all() else np.flatnonzero(answers.answered)
        account = {name: getattr(answers, name)[..., here] for name in _ACCOUNT}
        return pack_record(
            self._run_id, slot, names.slot_time_ns(slot, self._slot_ns), answers.steps, verdict.outcome,
            agent=np.arange(1, self._agents + 1)[here], **account,
            **frame_fields(frames, verdict.mask(self._agents)[order] if frames else None), lost=lost,
            collided=collided,
        )  # fmt: skip

    def reception(self, slot: int, verdict: Verdict) -> bytes:
        """A dtsa_msgs/Reception as CDR.

        :param verdict: the channel's verdict on it.
        """
        nothing = (0,) * len(verdict.senders)
        received = pack_received(verdict.mask(self._agents)) if verdict.senders else b""
        sent, lost, collided = (
            array("H", numbers).tobytes()
            for numbers in (verdict.senders, verdict.lost or nothing, verdict.collided or nothing)
        )
        time_ns = names.slot_time_ns(slot + 1, self._slot_ns)
        return _RECEPTION.pack(time_ns, (self._run_id, slot, verdict.outcome, sent, received, lost, collided))

    def markers(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A visualization_msgs/MarkerArray as CDR: the swarm at the start of a slot.

        :param verdict: the channel's verdict on it.
        """
        state = np.where(self._scenario.moving, WAITING, QUIET).astype(np.uint8)
        state[[sender - 1 for sender in verdict.senders]] = COLLIDED if verdict.outcome == COLLISION else SENDING
        time_ns = names.slot_time_ns(slot, self._slot_ns)
        return self._markers.pack(time_ns, answers.position, state, answers.goal)


_MARKER_PERIOD_NS = 50_000_000  # simulated


class LiveTopics(ChannelObserver):
    """Publishes each slot's decisions and receptions, and pictures of the swarm, while somebody subscribes.

    :param node: the channel's node.
    :param run_id: the run's id.
    :param space: namespace of the swarm's topics.
    """

    def __init__(self, node: Node, scenario: Scenario, slot_ns: int, run_id: int, space: str = names.SWARM) -> None:
        self._messages = SlotMessages(scenario, slot_ns, run_id)
        topics = {names.DECISION: Decision, names.RECEPTION: Reception, "slot_record": SlotRecord}
        topics[names.MARKERS] = MarkerArray
        self._publishers = [node.create_publisher(kind, f"{space}/{topic}", 10) for topic, kind in topics.items()]
        self._watched = [False] * len(topics)
        self._marker_slots = max(1, round(_MARKER_PERIOD_NS / slot_ns))

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        packed = self._messages
        makers = (
            lambda: packed.decision(slot, answers),
            lambda: packed.reception(slot, verdict),
            lambda: packed.record(slot, answers, verdict),
            lambda: packed.markers(slot, answers, verdict),
        )
        shown = [*self._watched[:3], self._watched[3] and slot % self._marker_slots == 0]
        for publisher, is_shown, pack in zip(self._publishers, shown, makers, strict=True):
            if is_shown:
                publisher.publish(pack())

    def idle(self, status: ChannelStatus) -> None:
        self._watched = [publisher.get_subscription_count() > 0 for publisher in self._publishers]
