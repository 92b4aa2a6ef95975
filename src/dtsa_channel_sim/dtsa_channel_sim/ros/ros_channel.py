"""What the channel's two modes have in common on the graph: topics, hooks for a recorder, and an end that is heard."""

from __future__ import annotations

import time
from array import array
from typing import Any

from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Slot, Transmission
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.loop import Loop
from dtsa_agent.ros.common.wire import pack_received
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.verdict import Verdict

from .answers import Answers

_REPEAT_S = 0.1


class RosChannel:
    """A medium whose agents are nodes.

    What is built on it (a recorder, metrics) overrides :meth:`published`, :meth:`received`, :meth:`answered`,
    :meth:`judged`, :meth:`recorded` and :meth:`idle`.

    :param node: the ROS node.
    :param channel: the medium.
    :param steps: control instants in a slot.
    :param waiting: messages that may wait to be read, for each agent.
    :param swarm_namespace: namespace of the swarm's topics.
    :param startup_s: s of wall time that all agents have to answer for the first time.
    """

    farewell_s = 4.0  # wall time that the nodes have to hear of the end

    def __init__(
        self,
        node: Node,
        channel: Channel,
        steps: int,
        waiting: int,
        swarm_namespace: str = names.SWARM,
        startup_s: float = 60.0,
    ) -> None:
        self.node, self.channel = node, channel
        self.agents, self.slot_ns = channel.config.agents, channel.config.slot_ns
        self.slot = -1
        self.answers = Answers(self.agents, steps)
        self.unusable = 0  # messages that could not be read, or came from agents that do not exist
        self._startup_s = startup_s
        self._publisher = node.create_publisher(Slot, f"{swarm_namespace}/{names.SLOT}", names.lockstep_qos(waiting))
        self._clock = node.create_publisher(Clock, "/clock", 10)
        self._clock_watched = False
        answers_qos = names.lockstep_qos(waiting * self.agents)
        self.loop = Loop(node, Transmission, f"{swarm_namespace}/{names.TRANSMISSION}", answers_qos, raw=True)

    # What a recorder overrides.

    def published(self, slot: int, data: bytes, time_ns: int) -> None:
        """A slot message has been sent.

        :param slot: the slot that it opens, or whose frame it delivers.
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
        """All agents (that still live) have answered a slot. Whether the run goes on.

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
        """The slot is over: time for what nobody waits for. Arguments as above."""

    def idle(self) -> None:
        """Called about ten times a second, and while waiting for an answer.

        :raises DtsaError: to end the run.
        """

    # For the two modes.

    def _housekeeping(self) -> None:
        if self.loop.housekeeping():
            self._clock_watched = self._clock.get_subscription_count() > 0
            self.idle()

    def _tell_time(self, stamp: Time) -> None:
        if self._clock_watched:
            self._clock.publish(Clock(clock=stamp))

    def _publish_end(self) -> None:
        """Tells all nodes that the run is over."""
        if self.node.context.ok():
            self._publisher.publish(Slot(slot=max(0, self.slot + 1), phase=Slot.END))

    def close(self) -> None:
        """Waits until all nodes know that the run is over, or have left, and gives the handles back."""
        deadline = time.monotonic() + self.farewell_s
        while self.node.context.ok() and time.monotonic() < deadline:
            # The middleware asks for acknowledgements, and repeats what was lost, every 3 s only: so say it again.
            if self._publisher.wait_for_all_acked(Duration(seconds=_REPEAT_S)):
                break
            self._publish_end()
        self.loop.close()


def slot_stamp(time_ns: int) -> Time:
    """A message's time.

    :param time_ns: ns.
    """
    seconds, nanoseconds = divmod(time_ns, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def put_frames(message: Slot, senders: list[int], frames: list[bytes], received: Any) -> None:
    """Puts frames that somebody received into a slot message.

    :param message: the message.
    :param senders: their senders.
    :param frames: the frames.
    :param received: (F, N) bool, who received which.
    """
    message.sender = array("H", senders)
    message.length = array("B", [len(frame) for frame in frames])
    message.data = array("B", b"".join(frames))
    message.received = array("B", pack_received(received))
