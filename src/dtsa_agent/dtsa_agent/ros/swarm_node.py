"""The node behind ``agent`` and ``swarm_host``: one or many agents behind one subscription and one publisher."""

from __future__ import annotations

from abc import ABC, abstractmethod
from array import array
from collections.abc import Sequence

from dtsa_msgs.msg import Slot, Transmission
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.publisher import Publisher

from dtsa_agent.core import AgentGroup, Swarm
from dtsa_agent.core.agent import REFUSED
from dtsa_agent.core.settings.config import SwarmConfig, agreed_settings
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import POSE_COVARIANCE, TWIST_COVARIANCE, split_frames, unpack_received
from dtsa_agent.ros.common.checks import SLOT as SLOT_REASON
from dtsa_agent.ros.common.checks import BadMessage
from dtsa_agent.ros.common.loop import Loop
from dtsa_agent.ros.common.messages import SLOT, TRANSMISSION, Fields, header_of
from dtsa_agent.ros.common.runs import WaitingLog
from dtsa_agent.stop import Stop

from .membership import Membership

_OTHER_MESSAGES = 32  # that may wait beside the channel's: they must not push those out before they are read
_ODOMETRY_DEPTH = 10  # messages for a slow reader; reliable, because RViz asks for that


class AgentsNode(ABC):
    """What nodes of agents have in common: membership of a run, its loop, odometry.

    Subclasses make their publishers first: a channel that knows this process has then found them, too.

    :param ids: of the agents that live here, ascending.
    :param waiting: a quarter of the messages that may wait to be read.
    """

    mode: str

    def __init__(self, node: Node, config: SwarmConfig, ids: Sequence[int], swarm_namespace: str, waiting: int) -> None:
        self.node, self.config, self.ids = node, config, tuple(ids)
        self.slot = -1  # the last slot that has begun here
        self._odometry: list[tuple[int, Publisher, str]] = []  # place among those here, frame of the body
        self._watched: list[tuple[int, Publisher, str]] = []  # those of them with subscribers
        self._waiting = WaitingLog(node.get_logger())
        self._has_begun = False
        settings = agreed_settings(config, self.mode)
        self.membership = Membership(node, ids, settings, swarm_namespace, self._dropped_frames, self._check_next)
        qos, topic = names.lockstep_qos(max(waiting, _OTHER_MESSAGES // 4)), f"{swarm_namespace}/{names.SLOT}"
        intake, admits = self.membership.intake, self.membership.admits
        self.loop = Loop(node, Slot, topic, qos, intake=intake, admits=admits, read=SLOT.read_fields)

    @abstractmethod
    def run(self, stop: Stop) -> None:
        """Fly until the run is over or a signal comes."""

    @abstractmethod
    def _dropped_frames(self) -> dict[str, int]:
        """Return the number of frames that this process has kept out so far, by reason and over all agents."""

    @abstractmethod
    def _check_next(self, message: Fields) -> None:
        """Raise BadMessage for a slot message that cannot be the next one."""

    def offer_odometry(self, namespaces: Sequence[str]) -> None:
        """Offer each agent's true motion as ``odom`` in its namespace; published only while a node subscribes."""
        for index, space in enumerate(namespaces):
            topic = f"{space.rstrip('/')}/{names.ODOMETRY}"
            publisher = self.node.create_publisher(Odometry, topic, _ODOMETRY_DEPTH)
            self._odometry.append((index, publisher, names.body_frame(space)))

    def idle(self) -> None:
        """Look around, about ten times a second; log what is waited for, and that slot 0 has begun.

        :raises LocalProtocolError: when the channel has gone without ending the run.
        """
        subscription = self.loop.subscription
        publishers = subscription.get_publisher_count()
        self.membership.idle(publishers, self.slot)
        if self.slot < 0:
            channel = "slot 0: the channel is there" if publishers else f"a channel on {subscription.topic_name}"
            self._waiting.log(f"waiting for {channel}")
        elif not self._has_begun:
            self._has_begun = True
            self.node.get_logger().info(f"slot 0 has begun: run {self.membership.run:08x}")
        self._watched = [entry for entry in self._odometry if entry[1].get_subscription_count()]

    def _publish_odometry(self, entry: tuple[int, Publisher, str], swarm: Swarm, column: int, slot: int) -> None:
        """Publish the position of an agent, in a column of a swarm, at the start of a slot."""
        # The attitude is not modelled, it is the identity: the body's axes are those of the map.
        header = header_of(names.slot_time_ns(slot, self.config.slot_ns))
        message = Odometry(header=header, child_frame_id=entry[2])
        message.pose.covariance, message.twist.covariance = POSE_COVARIANCE, TWIST_COVARIANCE
        place, speed = message.pose.pose.position, message.twist.twist.linear
        place.x, place.y, place.z = swarm.position[:, column].tolist()
        speed.x, speed.y, speed.z = swarm.velocity[:, column].tolist()
        entry[1].publish(message)


class SwarmNode(AgentsNode):
    """Agents that answer every slot message of the channel with one transmission message.

    On the message that opens slot i: hear what the air carried in slot i-1, close that slot, decide for slot i, answer,
    and only then fly through slot i, while the channel is already at work.
    """

    mode = "lockstep"

    def __init__(self, node: Node, swarm: Swarm, swarm_namespace: str = names.SWARM) -> None:
        self.agents = AgentGroup(swarm)
        self._goal = b""  # as last sent
        self._agent_ids = array("H", swarm.ids).tobytes()
        self._bytes = b""  # the last answer
        topic = f"{swarm_namespace}/{names.TRANSMISSION}"
        self._publisher = node.create_publisher(Transmission, topic, names.lockstep_qos())
        super().__init__(node, swarm.config, swarm.ids, swarm_namespace, 1)

    @property
    def swarm(self) -> Swarm:
        """The agents that live here."""
        return self.agents.swarm

    def _dropped_frames(self) -> dict[str, int]:
        counts = {f"frame {name}": getattr(self.swarm, name) for name in ("malformed", "foreign", "rejected")}
        return {**counts, REFUSED: self.agents.refused}

    def _check_next(self, message: Fields) -> None:
        # The channel waits for this node's answer: it can be nowhere else.
        if message.phase == Slot.RUN and not 0 <= message.slot - self.slot <= 1:
            raise BadMessage(SLOT_REASON, f"slot {message.slot} after slot {self.slot}")

    def run(self, stop: Stop) -> None:
        self.loop.run(self.on_slot, self.idle, stop)

    def on_slot(self, message: Fields) -> bool:
        """Answer a slot message; return False when the run is over."""
        if message.phase != Slot.RUN:
            return bool(message.phase != Slot.END)
        slot = message.slot
        if slot == self.slot:  # asked again: the answer was given before the channel could hear it
            self._publisher.publish(self._bytes)
            return True
        if not slot:
            self.membership.begin(message.run)
            if self.config.auth and not self.config.auth_session:
                self.swarm.begin_session(self.membership.session)
        else:
            received = unpack_received(message.received, len(message.sender), self.config.agents)
            frames = split_frames(message.data, message.length)
            self.agents.on_frames(slot - 1, message.sender, frames, received)
            self.agents.on_slot_end()
        self._answer(slot, self.agents.on_slot(slot))
        self.slot = slot
        for entry in self._watched:
            self._publish_odometry(entry, self.swarm, entry[0], slot)
        self.swarm.fly(slot)
        return True

    def _answer(self, slot: int, senders: Sequence[int]) -> None:
        swarm, lengths = self.swarm, bytearray(len(self.ids))
        frames = [swarm.frame(index) for index in senders]
        for index, frame in zip(senders, frames, strict=True):
            lengths[index] = len(frame)
        goal = swarm.goal.tobytes()
        self._bytes = TRANSMISSION.pack_fields(
            names.slot_time_ns(slot, self.config.slot_ns), run=self.membership.run, slot=slot, agent=self._agent_ids,
            length=bytes(lengths), data=b"".join(frames), offset_ns=b"", chosen=swarm.chosen.tobytes(),
            reason=swarm.reason.tobytes(), digest=swarm.digest.tobytes(), score=swarm.score.tobytes(),
            steps=self.config.steps, track=swarm.track.tobytes(), velocity=swarm.velocity.tobytes(),
            command=swarm.command.tobytes(), goal=goal if goal != self._goal else b"",  # sent when it changes
        )  # fmt: skip
        self._goal = goal
        self._publisher.publish(self._bytes)
