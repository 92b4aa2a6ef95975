"""The node behind ``agent`` and ``swarm_host`` in lockstep: one or many agents that answer the channel."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

from dtsa_msgs.msg import Slot, Transmission
from rclpy.node import Node

from dtsa_agent.core import AgentGroup, Swarm
from dtsa_agent.core.agent import REFUSED
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import split_frames, unpack_received
from dtsa_agent.ros.common.checks import SLOT, BadMessage
from dtsa_agent.ros.common.messages import TRANSMISSION, Fields

from .agents_node import AgentsNode


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
            raise BadMessage(SLOT, f"slot {message.slot} after slot {self.slot}")

    def _serve(self) -> bool:
        """Answer the next slot message."""
        message = self.loop.wait()
        if message is None:
            return True
        if message.phase != Slot.RUN:
            return bool(message.phase != Slot.END)
        slot = message.slot
        if slot == self.slot:  # asked again: the answer was given before the channel could hear it
            self._publisher.publish(self._bytes)
            return True
        if not slot:
            session = self._begin_run(message.run)
            if self.config.auth and not self.config.auth_session:
                self.swarm.begin_session(session)
        else:
            received = unpack_received(message.received, len(message.length), self.config.agents)
            frames = split_frames(message.data, message.length)
            self.agents.on_frames(slot - 1, message.sender, frames, received)
            self.agents.on_slot_end()
        self._answer(slot, self.agents.on_slot(slot))
        self.slot = slot
        for index in self._watched:
            self._publish_odometry(index, self.swarm, index, slot)
        self.swarm.fly(slot)
        return True

    def _answer(self, slot: int, senders: Sequence[int]) -> None:
        swarm, lengths = self.swarm, bytearray(len(self.ids))
        frames = [swarm.frame(index) for index in senders]
        for index, frame in zip(senders, frames, strict=True):
            lengths[index] = len(frame)
        goal = swarm.goal.tobytes()
        self._bytes = TRANSMISSION.pack_fields(
            names.slot_time_ns(slot, self.config.slot_ns), run=self.run_id, slot=slot, agent=self._agent_ids,
            length=bytes(lengths), data=b"".join(frames), offset_ns=b"", chosen=swarm.chosen.tobytes(),
            reason=swarm.reason.tobytes(), digest=swarm.digest.tobytes(), score=swarm.score.tobytes(),
            steps=self.config.steps, track=swarm.track.tobytes(), velocity=swarm.velocity.tobytes(),
            command=swarm.command.tobytes(), goal=goal if goal != self._goal else b"",  # sent when it changes
        )  # fmt: skip
        self._goal = goal
        self._publisher.publish(self._bytes)
