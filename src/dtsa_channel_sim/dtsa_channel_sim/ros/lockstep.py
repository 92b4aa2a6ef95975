"""The channel in lockstep: a slot starts as soon as all agents have answered the one before."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from dtsa_msgs.msg import Transmission
from rclpy.node import Node

from dtsa_agent.core.errors import LocalProtocolError, RemoteProtocolError
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.checks import OTHER_RUN, OTHER_SENDER, SLOT, BadMessage
from dtsa_agent.ros.common.messages import TRANSMISSION
from dtsa_agent.ros.common.names import agent_names
from dtsa_agent.ros.common.runs import Patience
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.verdict import Verdict

from .ros_channel import REPEAT_S, RosChannel

_REPEAT_LATER_S = 0.5  # a slot is sent again so often until all agents have answered it; slot 0 more often
_GARBAGE_PATIENCE_S = 0.5


class LockstepChannel(RosChannel):
    """Slot clock and medium of a swarm whose agents wait for each other.

    :param answer_s: s of wall time that all agents have to answer any slot but the first.
    """

    def __init__(self, node: Node, channel: Channel, steps: int, answer_s: float = 10.0, **more: Any) -> None:
        super().__init__(node, channel, steps, waiting=1, input=(Transmission, names.TRANSMISSION), **more)
        self._answer_s = answer_s
        self._complaint, self._complaint_time = "", 0.0
        self._bytes = b""

    def _run(self, stop: object) -> None:
        """Run slot after slot.

        :raises LocalProtocolError: when an agent does not answer in time.
        :raises RemoteProtocolError: when an agent sends unusable messages only.
        :raises ConfigError: before slot 0, when nodes do not fit together.
        """
        if not self._call(stop):
            return
        verdict: Verdict | None = None
        slot = 0
        while not stop:
            self._open(slot, verdict)
            if slot and verdict is not None:
                self._observers.slot_over(slot - 1, self.answers, verdict)
            self.answers.open()
            if not self._collect(slot, stop) or not self._goes_on(slot, self.answers):
                return
            frames = self.answers.frames
            senders = sorted(frames)
            lengths = [len(frames[sender]) for sender in senders]
            verdict = self.model.arbitrate(slot, senders, lengths, self.answers.position)
            self._observers.arbitrated(slot, self.answers, verdict)
            slot += 1

    def _open(self, slot: int, verdict: Verdict | None) -> None:
        """Publish the message that opens a slot."""
        time_ns = names.slot_time_ns(slot, self.slot_ns)
        heard_slot = max(slot - 1, 0)
        if verdict is not None and verdict.senders:
            mask = verdict.mask(self.agents)
            heard = np.flatnonzero(mask.any(axis=1))
            senders = [verdict.senders[row] for row in heard]
            received = [self.answers.frames[sender] for sender in senders]
            self._bytes = self._pack_slot(time_ns, slot, heard_slot, senders, received, mask[heard])
        else:
            self._bytes = self._pack_slot(time_ns, slot, heard_slot)
        self.slot, self._complaint = slot, ""
        self._publisher.publish(self._bytes)
        self._publish_clock(time_ns)

    def _collect(self, slot: int, stop: object) -> bool:
        """Collect answers until all agents have given theirs; return False when stopped."""
        loop, answers = self.loop, self.answers
        patience, repeat = Patience(), time.monotonic()
        while answers.missing:
            data = loop.wait()
            if data is None or not self._accept(slot, data):
                if stop:
                    return False
                repeat = self._wait(slot, patience.spent_s(), repeat)
            self._housekeeping()
        return not stop

    def _wait(self, slot: int, waited_s: float, repeat: float) -> float:
        """No answer has come: complain if that takes too long; return when the slot was last sent."""
        now = time.monotonic()
        if self._complaint and now > self._complaint_time + _GARBAGE_PATIENCE_S:
            raise RemoteProtocolError(
                f"{agent_names(self.answers.silent)} sent garbage in slot {slot}: {self._complaint}"
            )
        limit = self._answer_s if slot else self._startup_s
        if waited_s > limit:
            silent = agent_names(self.answers.silent)
            raise LocalProtocolError(f"{silent} did not answer slot {slot} within {limit:g} s: dead or hung?")
        if now - repeat > (_REPEAT_LATER_S if slot else REPEAT_S):
            self._publisher.publish(self._bytes)
            return now
        return repeat

    def _accept(self, slot: int, data: bytes) -> bool:
        """Check one message; return whether it is an answer that was missing."""
        try:
            message = self._decoded(data, Transmission, TRANSMISSION.read_fields)
            at = self.roster.check_sender(message.agent, self.loop.sender)
            if message.slot < slot:
                return False  # an answer that was asked for twice
            if message.slot > slot:
                raise BadMessage(
                    SLOT, f"{agent_names(message.agent)} answered slot {message.slot}, which has not begun"
                )
            return self.answers.add(at, message)
        except BadMessage as error:
            self.intake.drop(error.reason, str(error))
            # A stranger's garbage is no reason to give an agent up.
            if error.reason not in (OTHER_RUN, OTHER_SENDER) and self.roster.is_member(self.loop.sender):
                self._complaint, self._complaint_time = str(error), time.monotonic()
            return False
