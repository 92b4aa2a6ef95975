"""What follows from a slot, as messages: decisions, receptions, and a picture of the swarm."""

from __future__ import annotations

from array import array
from functools import lru_cache

import numpy as np
from dtsa_msgs.msg import Decision, Reception, Transmission
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from visualization_msgs.msg import MarkerArray

from dtsa_agent.core import REASONS, Scenario
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.cdr import Message
from dtsa_agent.ros.common.wire.messages import header_of
from dtsa_agent.ros.common.wire.packing import pack_received
from dtsa_bench.recordings.bag.cdr import COLLIDED, QUIET, SENDING, WAITING, MarkerPacker
from dtsa_channel_sim.model.verdict import COLLISION, Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver, ChannelStatus

_KNOWN = 256  # combinations of reasons whose texts are kept
_RECEPTION = Message({
    "run": "I", "slot": "I", "outcome": "B", "sender": "*H", "received": "*B", "lost": "*H", "collided": "*H",
})  # fmt: skip


@lru_cache(256)
def _decision(count: int) -> Message:
    """Decision messages with this many names of reasons."""
    texts = dict.fromkeys((f"name {place}" for place in range(count)), "*B")
    return Message({
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
        self._markers = MarkerPacker([f"cf{agent}" for agent in range(1, self._agents + 1)])

    def _header(self, slot: int) -> Header:
        return header_of(names.slot_time_ns(slot, self._slot_ns))

    def transmission(self, slot: int, answers: Answers) -> bytes:
        """A dtsa_msgs/Transmission as CDR, of all agents that have reported for a slot in real time."""
        here = np.flatnonzero(answers.answered)
        frames = [answers.frames.get(int(index) + 1, b"") for index in here]
        planes = {name: getattr(answers, name)[..., here] for name in ("track", "velocity", "command", "goal")}
        message = Transmission(
            header=self._header(slot),
            run=self._run_id,
            slot=slot,
            agent=array("H", (here + 1).astype(np.uint16).tobytes()),
            length=array("B", [len(frame) for frame in frames]),
            data=array("B", b"".join(frames)),
            offset_ns=array("q", answers.offset_ns[here].tobytes()),
            chosen=array("H", answers.chosen[here].tobytes()),
            reason=array("B", answers.reason[here].tobytes()),
            digest=array("I", answers.digest[here].tobytes()),
            score=array("d", answers.score[here].tobytes()),
            steps=answers.steps,
            **{name: array("d", values.tobytes()) for name, values in planes.items()},
        )
        return bytes(serialize_message(message))

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
