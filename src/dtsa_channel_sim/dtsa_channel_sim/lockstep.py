"""The channel in lockstep: a slot starts as soon as all agents have answered the one before."""

from __future__ import annotations

import time
from array import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Slot, Transmission
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock

from dtsa_agent.core.errors import LocalProtocolError, RemoteProtocolError
from dtsa_agent.ros import names
from dtsa_agent.ros.loop import Loop
from dtsa_agent.ros.wire import pack_received

from .answers import Answers, named
from .channel import Channel
from .verdict import Verdict

_REPEAT_S = 0.1  # until all agents have answered slot 0, it is sent again and again
_GARBAGE_PATIENCE_S = 0.5


class LockstepChannel:
    """Slot clock and medium of a swarm whose agents wait for each other.

    What is built on it (a recorder, metrics) overrides :meth:`published`, :meth:`answered`, :meth:`judged` and
    :meth:`idle`.

    :param node: the ROS node.
    :param channel: the medium.
    :param steps: control instants in a slot.
    :param swarm_namespace: namespace of the swarm's topics.
    :param startup_s: s of wall time that all agents have to answer slot 0.
    :param answer_s: s of wall time that they have for any later slot.
    """

    def __init__(
        self,
        node: Node,
        channel: Channel,
        steps: int,
        swarm_namespace: str = names.SWARM,
        startup_s: float = 60.0,
        answer_s: float = 10.0,
    ) -> None:
        self.node, self.channel = node, channel
        self.agents, self.slot_ns = channel.config.agents, channel.config.slot_ns
        self.slot = -1
        self.answers = Answers(self.agents, steps)
        self.unusable = 0  # messages that could not be read, or came from agents that do not exist
        self._startup_s, self._answer_s = startup_s, answer_s
        self._complaint, self._complaint_time = "", 0.0
        self._bytes = b""
        qos = names.lockstep_qos()
        answers_qos = names.lockstep_qos(self.agents)
        self._publisher = node.create_publisher(Slot, f"{swarm_namespace}/{names.SLOT}", qos)
        self._clock = node.create_publisher(Clock, "/clock", 10)
        self._clock_watched = False
        self.loop = Loop(node, Transmission, f"{swarm_namespace}/{names.TRANSMISSION}", answers_qos, raw=True)

    # What a recorder overrides.

    def published(self, slot: int, data: bytes, time_ns: int) -> None:
        """A slot message has been sent.

        :param slot: the slot that it opens.
        :param data: the message as CDR.
        :param time_ns: ns, simulated time.
        """

    def received(self, slot: int, ids: bytes, data: bytes) -> None:
        """A usable transmission message has come in.

        :param slot: the slot that it answers.
        :param ids: the ids of its agents, as in the message.
        :param data: the message as CDR.
        """

    def answered(self, slot: int, answers: Answers) -> bool:
        """All agents have answered a slot. Whether the run goes on.

        :param slot: the slot; its answers carry the true motion during the slot before.
        :param answers: the answers.
        """
        return True

    def judged(self, slot: int, frames: dict[int, bytes], verdict: Verdict) -> None:
        """The air has carried a slot's frames.

        :param slot: the slot.
        :param frames: the frames by sender.
        :param verdict: who received what.
        """

    def recorded(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        """The next slot is on its way: time for what nobody waits for. Arguments as above."""

    def idle(self) -> None:
        """Called about ten times a second, and while waiting for an answer.

        :raises DtsaError: to end the run.
        """

    # The run.

    def run(self, stop: Any) -> None:
        """Runs slot after slot until the run is over or ``stop`` is true. The agents are told to end.

        :param stop: looked at in every slot, true once a signal has come.
        :raises LocalProtocolError: when an agent does not answer in time.
        :raises RemoteProtocolError: when an answer is unusable.
        """
        try:
            verdict: Verdict | None = None
            frames: dict[int, bytes] = {}
            slot = 0
            while not stop:
                self._open(slot, frames, verdict)
                if slot and verdict is not None:
                    self.recorded(slot - 1, self.answers, verdict)
                self.answers.open()
                if not self._collect(slot, stop) or not self.answered(slot, self.answers):
                    return
                frames = self.answers.frames
                verdict = self._judge(slot, frames)
                self.judged(slot, frames, verdict)
                slot += 1
        finally:
            self._publish_end()

    def _judge(self, slot: int, frames: dict[int, bytes]) -> Verdict:
        senders = sorted(frames)
        lengths = [len(frames[sender]) for sender in senders]
        return self.channel.arbitrate(slot, senders, lengths, self.answers.position)

    def _open(self, slot: int, frames: dict[int, bytes], verdict: Verdict | None) -> None:
        """Publishes the message that opens a slot."""
        message = self._message(slot, Slot.RUN)
        if verdict is not None and verdict.senders:
            self._fill(message, frames, verdict)
        self.slot, self._complaint = slot, ""
        self._bytes = serialize_message(message)
        self._publisher.publish(self._bytes)
        if self._clock_watched:
            self._clock.publish(Clock(clock=message.stamp))
        self.published(slot, self._bytes, names.slot_time_ns(slot, self.slot_ns))

    def _message(self, slot: int, phase: int) -> Slot:
        seconds, nanoseconds = divmod(names.slot_time_ns(slot, self.slot_ns), 1_000_000_000)
        return Slot(stamp=Time(sec=seconds, nanosec=nanoseconds), slot=slot, phase=phase, heard_slot=max(slot - 1, 0))

    def _fill(self, message: Slot, frames: dict[int, bytes], verdict: Verdict) -> None:
        """Puts the frames that somebody received into a slot message."""
        mask = verdict.mask(self.agents)
        heard = np.flatnonzero(mask.any(axis=1))
        senders = [verdict.senders[row] for row in heard]
        message.sender = array("H", senders)
        message.length = array("B", [len(frames[sender]) for sender in senders])
        message.data = array("B", b"".join([frames[sender] for sender in senders]))
        message.received = array("B", pack_received(mask[heard]))

    def _collect(self, slot: int, stop: Any) -> bool:
        """Takes in answers until all agents have given theirs; False when stopped."""
        loop, answers = self.loop, self.answers
        begin = repeat = time.monotonic()
        while answers.missing:
            data = loop.wait()
            if data is None:
                if stop:
                    return False
                repeat = self._wait(slot, begin, repeat)
            else:
                self._take(slot, data)
            if loop.housekeeping():
                self._clock_watched = self._clock.get_subscription_count() > 0
                self.idle()
        return not stop

    def _wait(self, slot: int, begin: float, repeat: float) -> float:
        """Nothing has come for a while: complain if that takes too long; says when slot 0 was last sent."""
        self.idle()
        now = time.monotonic()
        if self._complaint and now > self._complaint_time + _GARBAGE_PATIENCE_S:
            raise RemoteProtocolError(f"{named(self.answers.silent)} sent garbage in slot {slot}: {self._complaint}")
        limit = self._answer_s if slot else self._startup_s
        if now - begin > limit:
            raise LocalProtocolError(
                f"{named(self.answers.silent)} did not answer slot {slot} within {limit:g} s: dead or hung?"
            )
        if slot == 0 and now - repeat > _REPEAT_S:
            self._publisher.publish(self._bytes)
            return now
        return repeat

    def _take(self, slot: int, data: bytes) -> None:
        try:
            message = deserialize_message(data, Transmission)
        except Exception as error:  # rclpy has no common base for what a message can do to it
            self._complain(f"a message of {len(data)} bytes that is no Transmission ({str(error).splitlines()[0]})")
            return
        if message.slot != slot:
            if message.slot > slot:
                self._complain(f"{named(message.agent)} answered slot {message.slot}, which has not begun")
            return
        if not len(message.agent) or min(message.agent) < 1 or max(message.agent) > self.agents:
            self._complain(f"a message for agents {list(message.agent)[:8]}")
            return
        if self.answers.add(message):
            self.received(slot, message.agent.tobytes(), data)

    def _complain(self, text: str) -> None:
        """Unreadable messages name no sender: if an answer then is missing, this is why."""
        self.unusable += 1
        self._complaint, self._complaint_time = text, time.monotonic()

    def _publish_end(self) -> None:
        """Tells all nodes that the run is over."""
        if self.node.context.ok():
            self._publisher.publish(self._message(self.slot + 1, Slot.END))

    def close(self) -> None:
        """Waits for the last message to leave and gives the handles back."""
        from rclpy.duration import Duration

        if self.node.context.ok():
            self._publisher.wait_for_all_acked(Duration(seconds=1.0))
        self.loop.close()
