"""The node behind ``agent`` and ``swarm_host``: one or many agents behind one subscription and one publisher."""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Slot, Transmission
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.task import Future

from dtsa_agent.core import AgentGroup, Swarm
from dtsa_agent.core.agents.agent import REFUSED
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.core.settings.config import SwarmConfig, agreed_settings
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process.loop import HOUSEKEEPING_S, Loop, Stop
from dtsa_agent.ros.common.process.waiting import Waiting
from dtsa_agent.ros.common.wire.checks import SLOT, Unusable
from dtsa_agent.ros.common.wire.covariances import POSE_COVARIANCE, TWIST_COVARIANCE
from dtsa_agent.ros.common.wire.packing import split_frames, unpack_received
from dtsa_agent.ros.common.wire.slot_fields import SlotFields, read_slot
from dtsa_agent.ros.common.wire.stamps import time_of
from dtsa_agent.ros.common.wire.transmission_fields import TransmissionFields, pack_transmission

from .membership import Membership

_LOOK_S = 0.001  # an executor looks for messages so often
_STRANGERS = 32  # messages that may wait beside the channel's
_ODOMETRY_DEPTH = 10  # messages for a slow reader; reliable, because RViz asks for that


class AgentsNode(ABC):
    """What nodes of agents have in common: membership of a run, its loop, odometry.

    :param node: the ROS node.
    :param config: the settings that all agents share.
    :param ids: ids of the agents that live here, ascending.
    :param swarm_namespace: namespace of the swarm's topics.
    :param waiting: a quarter of the messages that may wait to be read.
    """

    mode: str

    def __init__(self, node: Node, config: SwarmConfig, ids: Sequence[int], swarm_namespace: str, waiting: int) -> None:
        self.node, self.config, self.ids = node, config, tuple(ids)
        self.slot = -1  # the last slot that has begun here
        self._odometry: list[tuple[int, Publisher]] = []
        self._frames: list[str] = []  # of the bodies in odometry
        self._watched: list[tuple[int, Publisher]] = []
        qos = names.lockstep_qos(waiting)
        self._namespace = swarm_namespace
        self._waiting = Waiting(node.get_logger())
        self._begun = False
        self._make_publishers(swarm_namespace, qos)
        settings = agreed_settings(config, self.mode)
        self.membership = Membership(node, ids, settings, swarm_namespace, self._dropped_frames, self._plausible)
        intake = self.membership.intake
        topic = f"{swarm_namespace}/{names.SLOT}"
        # Messages of strangers must not push the channel's out before they are read.
        reading = names.lockstep_qos(max(waiting, _STRANGERS // 4))
        self.loop = Loop(node, Slot, topic, reading, intake=intake, admits=self.membership.admits, read=read_slot)

    @abstractmethod
    def run(self, stop: Stop) -> None:
        """Fly until the run is over or a signal comes."""

    @abstractmethod
    def _make_publishers(self, swarm_namespace: str, qos: QoSProfile) -> None: ...

    @abstractmethod
    def _dropped_frames(self) -> dict[str, int]:
        """Frames that this process has kept out so far, by reason, and from how many agents in all."""

    @abstractmethod
    def _plausible(self, message: SlotFields) -> None:
        """Whether a slot message can be the next one.

        :raises Unusable: if it cannot.
        """

    @property
    def run_id(self) -> int:
        """The run that these agents take part in; 0: none yet."""
        return self.membership.run

    def offer_odometry(self, namespaces: Sequence[str] | None = None) -> None:
        """Offers each agent's true motion as ``odom``; published only while somebody subscribes.

        :param namespaces: one an agent; default: ``/cf1``, ``/cf2``, ... in the swarm's.
        """
        default = [names.agent_namespace(agent, self._namespace) for agent in self.ids]
        for index, space in enumerate(namespaces or default):
            topic = f"{space.rstrip('/')}/{names.ODOMETRY}"
            publisher = self.node.create_publisher(Odometry, topic, _ODOMETRY_DEPTH)
            self._odometry.append((index, publisher))
            self._frames.append(names.body_frame(space))

    def idle(self) -> None:
        """Looks around; called about ten times a second.

        :raises LocalProtocolError: when the channel has gone without ending the run.
        """
        self.membership.idle(self.loop.subscription.get_publisher_count(), self.slot)
        self._tell_progress()
        self._watched = [entry for entry in self._odometry if entry[1].get_subscription_count()]

    def _tell_progress(self) -> None:
        """Says on the node's logger whom it waits for, and that slot 0 has begun."""
        if self.slot >= 0:
            if not self._begun:
                self._begun = True
                self.node.get_logger().info(f"slot 0 has begun: run {self.run_id:08x}")
            return
        there = self.loop.subscription.get_publisher_count()
        topic = self.loop.subscription.topic_name
        self._waiting.tell("waiting for slot 0: the channel is there" if there else f"waiting for a channel on {topic}")

    def _publish_odometry(self, index: int, stamp: Time, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Publish where an agent is, if anybody listens.

        :param index: its place among those here.
        """
        message = Odometry()
        message.pose.covariance = POSE_COVARIANCE
        message.twist.covariance = TWIST_COVARIANCE
        message.header.frame_id = names.FRAME
        message.header.stamp = stamp
        # The attitude is not modelled, it is the identity: the body's axes are those of the map.
        message.child_frame_id = self._frames[index]
        place, speed = message.pose.pose.position, message.twist.twist.linear
        place.x, place.y, place.z = position
        speed.x, speed.y, speed.z = velocity
        self._odometry[index][1].publish(message)


class SwarmNode(AgentsNode):
    """Agents that answer every slot message of the channel with one transmission message.

    On the message that opens slot i: hear what the air carried in slot i-1, close that slot, decide for slot i, answer,
    and only then fly through slot i, while the channel is already at work.

    :param node: the ROS node.
    :param swarm: the agents that live here.
    :param swarm_namespace: namespace of the swarm's topics.
    """

    mode = "lockstep"

    def __init__(self, node: Node, swarm: Swarm, swarm_namespace: str = names.SWARM) -> None:
        self.agents = AgentGroup(swarm)
        self._goal = b""  # as last told
        self._nothing = np.zeros((0, swarm.config.agents), dtype=np.uint8)  # heard by whom, in a slot without frames
        super().__init__(node, swarm.config, swarm.ids, swarm_namespace, 1)

    def _make_publishers(self, swarm_namespace: str, qos: QoSProfile) -> None:
        self._agent_ids = array("H", self.ids)
        self._bytes = b""  # the last answer
        self._publisher = self.node.create_publisher(Transmission, f"{swarm_namespace}/{names.TRANSMISSION}", qos)

    @property
    def swarm(self) -> Swarm:
        """The agents that live here."""
        return self.agents.swarm

    def _dropped_frames(self) -> dict[str, int]:
        swarm = self.agents.swarm
        return {
            "frame malformed": swarm.malformed,
            "frame foreign": swarm.foreign,
            "frame rejected": swarm.rejected,
            REFUSED: self.agents.refused,
        }

    def _plausible(self, message: SlotFields) -> None:
        # The channel waits for this node's answer: it can be nowhere else.
        if message.phase == Slot.RUN and not 0 <= message.slot - self.slot <= 1:
            raise Unusable(SLOT, f"slot {message.slot} after slot {self.slot}")

    def run(self, stop: Stop) -> None:
        """Answers slot messages until the run is over or a signal comes."""
        self.loop.run(self.on_slot, self.idle, stop)

    def attach(self) -> Future:
        """Lets an ordinary executor serve these agents, instead of :meth:`run`: slower, with the same results.

        Add :attr:`node` to the executor.

        :returns: done when the run is over; holds the error if one ended it.
        """
        over = Future()
        loop = self.loop

        def guarded(act: Callable[[], bool]) -> Callable[[], None]:
            def call() -> None:
                try:
                    if not over.done() and not act():
                        over.set_result(None)
                except DtsaError as error:
                    over.set_exception(error)

            return call

        def serve() -> bool:
            message = loop.take()
            return message is None or self.on_slot(message)

        def look_around() -> bool:
            self.idle()
            return True

        # The loop takes messages itself: one that cannot be read would end an executor that takes it.
        self.node.create_timer(_LOOK_S, guarded(serve))
        self.node.create_timer(HOUSEKEEPING_S, guarded(look_around))
        return over

    def on_slot(self, message: SlotFields) -> bool:
        """Answers a slot message.

        :returns: False when the run is over.
        """
        if message.phase == Slot.END:
            return False
        if message.phase != Slot.RUN:
            return True
        slot = message.slot
        if slot == self.slot:  # asked again: the answer was given before the channel could hear it
            self._publisher.publish(self._bytes)
            return True
        if not slot:
            self.membership.begin(message.run)
            if self.config.auth and not self.config.auth_session:
                self.swarm.begin_session(self.membership.session)
        if slot:
            self._hear(message, slot - 1)
            self.agents.on_slot_end()
        # Its start is known: what a message says of it need not be believed.
        time_ns = names.slot_time_ns(slot, self.config.slot_ns)
        self._answer(slot, time_ns, self.agents.on_slot(slot))
        self.slot = slot
        for index, _ in self._watched:
            place, speed = self.swarm.position[:, index].tolist(), self.swarm.velocity[:, index].tolist()
            self._publish_odometry(index, time_of(time_ns), place, speed)
        self.swarm.fly(slot)
        return True

    def _hear(self, message: SlotFields, slot: int) -> NDArray[np.uint8] | None:
        """Takes in frames that the air carried.

        :param slot: the slot in which they are heard.
        :returns: (F, L) who of the local agents took them in; None if they share a table, or there are none.
        """
        count = len(message.sender)
        if not count:
            return self.agents.on_frames(slot, (), (), self._nothing)
        heard = unpack_received(message.received, count, self.config.agents)
        frames = split_frames(message.data, message.length)
        return self.agents.on_frames(slot, message.sender, frames, heard)

    def _answer(self, slot: int, time_ns: int, senders: Sequence[int]) -> None:
        swarm = self.swarm
        lengths = bytearray(len(swarm.ids))
        frames = [swarm.frame(index) for index in senders]
        for index, frame in zip(senders, frames, strict=True):
            lengths[index] = len(frame)
        goal = swarm.goal.tobytes()
        fields = TransmissionFields(
            time_ns=time_ns,
            run=self.membership.run,
            slot=slot,
            agent=self._agent_ids,
            length=bytes(lengths),
            data=b"".join(frames),
            chosen=swarm.chosen.tobytes(),
            reason=swarm.reason.tobytes(),
            digest=swarm.digest.tobytes(),
            score=swarm.score.tobytes(),
            track=swarm.track.tobytes(),
            velocity=swarm.velocity.tobytes(),
            command=swarm.command.tobytes(),
            goal=goal if goal != self._goal else b"",
        )
        self._goal = goal
        self._bytes = pack_transmission(fields, self.config.steps)
        self._publisher.publish(self._bytes)


def parse_ids(value: Any, agents: int) -> list[int]:
    """Ids from a parameter: a list of numbers, or an empty one for all.

    :param agents: number of agents.
    :raises ConfigError: if there are others.
    """
    ids = [int(item) for item in value] or list(range(1, agents + 1))
    if len(set(ids)) != len(ids) or min(ids) < 1 or max(ids) > agents:
        raise ConfigError("ids", list(value), f"different ids from 1 to {agents}; none: all")
    return sorted(ids)
