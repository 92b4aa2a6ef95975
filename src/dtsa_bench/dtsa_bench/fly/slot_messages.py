"""What follows from a slot, as messages: decisions, receptions, and a picture of the swarm."""

from __future__ import annotations

from array import array

import numpy as np
from dtsa_msgs.msg import Decision, Reception, Transmission
from rclpy.serialization import serialize_message
from std_msgs.msg import Header

from dtsa_agent.core import REASONS, Scenario
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.stamps import header_of
from dtsa_agent.ros.common.wire import pack_received
from dtsa_bench.bag.cdr import COLLIDED, QUIET, SENDING, WAITING, MarkerPacker
from dtsa_channel_sim.model.verdict import COLLISION, Verdict
from dtsa_channel_sim.ros.answers import Answers


class SlotMessages:
    """Packs what the agents of a swarm decided in a slot, who received what, and where everybody was.

    :param scenario: the scenario.
    :param slot_ns: ns, length of a slot.
    :param run_id: the run's id.
    """

    def __init__(self, scenario: Scenario, slot_ns: int, run_id: int) -> None:
        self._scenario, self._slot_ns, self._run_id = scenario, slot_ns, run_id
        self._agents = scenario.start.shape[1]
        self._reasons: dict[bytes, tuple[list[str], array[int]]] = {}
        self._markers = MarkerPacker([f"cf{agent}" for agent in range(1, self._agents + 1)])

    def _header(self, slot: int) -> Header:
        return header_of(names.slot_time_ns(slot, self._slot_ns))

    def transmission(self, slot: int, answers: Answers) -> bytes:
        """A dtsa_msgs/Transmission as CDR, of all agents that have reported for a slot in real time.

        :param slot: the slot.
        :param answers: what they reported, and their frames.
        """
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
        """A dtsa_msgs/Decision as CDR.

        :param slot: the slot.
        :param answers: what the agents answered to it.
        """
        key = answers.reason.tobytes()
        known = self._reasons.get(key)
        if known is None:
            used = np.unique(answers.reason)
            labels = [REASONS[code] if code < len(REASONS) else str(code) for code in used]
            known = labels, array("B", np.searchsorted(used, answers.reason).astype(np.uint8).tobytes())
            self._reasons[key] = known
        message = Decision(
            header=self._header(slot),
            run=self._run_id,
            slot=slot,
            agent=array("H", range(1, self._agents + 1)),
            chosen=array("H", answers.chosen.tobytes()),
            reason_name=known[0],
            reason_index=known[1],
            reason=array("B", key),
            digest=array("I", answers.digest.tobytes()),
            score=array("d", answers.score.tobytes()),
        )
        return bytes(serialize_message(message))

    def reception(self, slot: int, verdict: Verdict) -> bytes:
        """A dtsa_msgs/Reception as CDR.

        :param slot: the slot.
        :param verdict: the channel's verdict on it.
        """
        nothing = (0,) * len(verdict.senders)
        received = pack_received(verdict.mask(self._agents)) if verdict.senders else b""
        message = Reception(
            header=self._header(slot + 1),
            run=self._run_id,
            slot=slot,
            outcome=verdict.outcome,
            sender=array("H", verdict.senders),
            received=array("B", received),
            lost=array("H", verdict.lost or nothing),
            collided=array("H", verdict.collided or nothing),
        )
        return bytes(serialize_message(message))

    def markers(self, slot: int, answers: Answers, verdict: Verdict) -> bytes:
        """A visualization_msgs/MarkerArray as CDR: the swarm at the start of a slot.

        :param slot: the slot.
        :param answers: what the agents answered to it.
        :param verdict: the channel's verdict on it.
        """
        state = np.where(self._scenario.moving, WAITING, QUIET).astype(np.uint8)
        state[[sender - 1 for sender in verdict.senders]] = COLLIDED if verdict.outcome == COLLISION else SENDING
        time_ns = names.slot_time_ns(slot, self._slot_ns)
        return self._markers.pack(time_ns, answers.position, state, answers.goal)
