"""What the channel's two modes have in common on the graph: topics, observers, and an end that is heard."""

from __future__ import annotations

import secrets
import time
from array import array
from typing import Any

from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Slot, Transmission
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.loop import Loop
from dtsa_agent.ros.common.wire import pack_received
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.schedule import Change

from .answers import Answers
from .observer import ChannelObserver, ChannelStatus, Observers, Referee, SlotLimit

_REPEAT_S = 0.1


class RosChannel:
    """A medium whose agents are nodes.

    It tells its observers what happens; a referee says when the run is over.

    :param node: the ROS node.
    :param channel: the medium.
    :param steps: control instants in a slot.
    :param waiting: messages that may wait to be read, for each agent.
    :param referee: ends the run; None: a signal does.
    :param swarm_namespace: namespace of the swarm's topics.
    :param startup_s: s of wall time that all agents have to answer for the first time.
    :param end_s: s of wall time that the nodes have to hear of the end.
    :param run_id: the run's id in all its messages, 32 bits; None: a random one.
    """

    def __init__(
        self,
        node: Node,
        channel: Channel,
        steps: int,
        waiting: int,
        referee: Referee | None = None,
        swarm_namespace: str = names.SWARM,
        startup_s: float = 60.0,
        end_s: float = 4.0,
        run_id: int | None = None,
    ) -> None:
        self.node, self.model = node, channel
        self.agents, self.slot_ns = channel.config.agents, channel.config.slot_ns
        self.run_id = new_run_id() if run_id is None else run_id
        self.slot = -1
        self.answers = Answers(self.agents, steps)
        self.unusable = 0  # messages that could not be read, or came from agents that do not exist
        self._observers = Observers()
        self._referee = referee or SlotLimit()
        self._reason, self._failed = "", False  # why the run has ended, and whether an error ended it
        self._startup_s, self._end_s = startup_s, end_s
        self._publisher = node.create_publisher(Slot, f"{swarm_namespace}/{names.SLOT}", names.lockstep_qos(waiting))
        self._clock = node.create_publisher(Clock, names.clock_topic(swarm_namespace), 10)
        self._clock_watched = False
        answers_qos = names.lockstep_qos(waiting * self.agents)
        self.loop = Loop(node, Transmission, f"{swarm_namespace}/{names.TRANSMISSION}", answers_qos, raw=True)

    def observe(self, *observers: ChannelObserver) -> None:
        """Adds observers; they are told in this order, after those that are there already."""
        for observer in observers:
            self._observers.add(observer)

    def run(self, stop: object) -> None:
        """Runs until the run is over or ``stop`` is true. The agents are told to end.

        :param stop: looked at again and again, true once a signal has come.
        :raises DtsaError: when an agent or an observer fails.
        """
        try:
            self._run(stop)
            self._reason = self._referee.reason or ("stopped by a signal" if stop else "")
        except DtsaError as error:
            self._reason, self._failed = str(error), True
            raise

    def _run(self, stop: object) -> None:
        raise NotImplementedError

    def change_settings(self, change: Change) -> None:
        """Tells the observers of a change of the medium's settings."""
        self._observers.settings_changed(change)

    # For the two modes.

    def _housekeeping(self) -> None:
        if self.loop.housekeeping():
            self._clock_watched = self._clock.get_subscription_count() > 0
            self._idle()

    def _idle(self) -> None:
        awaited = self.answers.silent if self.answers.missing else []
        self._observers.idle(ChannelStatus(self.slot, self.unusable, awaited))

    def _goes_on(self, slot: int, answers: Answers) -> bool:
        """All agents have answered a slot; whether the run goes on."""
        self._observers.all_answered(slot, answers)
        return not self._referee.over(slot, answers)

    def _tell_time(self, stamp: Time) -> None:
        if self._clock_watched:
            self._clock.publish(Clock(clock=stamp))

    def _publish_end(self) -> None:
        """Tells all nodes that the run is over."""
        if self.node.context.ok():
            self._publisher.publish(Slot(run=self.run_id, slot=max(0, self.slot + 1), phase=Slot.END))

    def close(self) -> None:
        """Closes the observers first, waits until all nodes know that the run is over or have left, frees the handles.

        :raises DtsaError: when an observer could not be closed.
        """
        try:
            self._observers.ended(self.slot, self._reason or "ended early", self._failed)
        finally:
            self._close()

    def _close(self) -> None:
        try:
            self._observers.close()
        finally:
            self._see_off()
            self.loop.close()

    def _see_off(self) -> None:
        """Waits until all nodes know that the run is over, or have left."""
        deadline = time.monotonic() + self._end_s
        while self.node.context.ok() and time.monotonic() < deadline:
            # The middleware asks for acknowledgements, and repeats what was lost, every 3 s only: so say it again.
            if self._publisher.wait_for_all_acked(Duration(seconds=_REPEAT_S)):
                break
            self._publish_end()


def new_run_id() -> int:
    """A random id for a run, 1 to 2^32 - 1; 64 bits would be more than some viewers can show."""
    return secrets.randbelow(2**32 - 1) + 1


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
