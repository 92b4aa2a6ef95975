"""Quadcopters without I/O: slots and frames in, frames and commands out. The caller owns clock, radio and motors.

:class:`AgentGroup` is what the nodes run, with all agents of a process; :class:`Agent` is the same for a single one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import Vector
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.scenario import Scenario
from dtsa_agent.core.station import check_slotted
from dtsa_agent.core.swarm import Bytes, SlotOutcome, Swarm

REFUSED = "reception refused"  # a frame that reached an agent and was not taken in; what processes call it


class AgentGroup:
    """The agents of one process. In every slot call ``on_slot``, ``on_frames``, ``on_slot_end``, in this order.

    :param swarm: the agents; a shared table is given up with the first frame that not all of them have heard.
    :raises ConfigError: for a policy without slots.
    """

    def __init__(self, swarm: Swarm) -> None:
        check_slotted(swarm.config.policy)
        self.swarm = swarm
        self.refused = 0  # frames that reached an agent and were not taken in, over all agents
        self.slot = -1  # the present slot, -1: none

    def on_slot(self, slot: int) -> tuple[int, ...]:
        """Decide for a slot that begins now; the slot before is closed.

        :returns: positions in ``swarm.ids`` of those that send; their frames are ``swarm.frame(position)``.
        """
        swarm = self.swarm
        self.slot = slot
        swarm.scenario.advance(slot, swarm)
        return swarm.begin(slot)

    def on_frames(self, slot: int, senders: Sequence[int], frames: Sequence[bytes], heard: Bytes) -> Bytes | None:
        """Receive all that the air carried in a slot.

        :param slot: the slot in which it is heard.
        :param senders: ids of those that sent, as the air knows them.
        :param frames: their frames; malformed and foreign ones are counted and change nothing.
        :param heard: (F, N) 1: who of all agents received each frame.
        :returns: (F, L) who of the local agents took each in; None if they share a table, or there are no frames.
        """
        swarm = self.swarm
        if swarm.shared:
            own = [swarm.ids[index] for index in np.flatnonzero(swarm.sends)]
            received = heard.copy()
            received[np.arange(len(senders)), np.array(senders, dtype=np.intp) - 1] = 1  # knows what it said
            # A frame that nobody heard is known to its sender alone.
            if all(agent in senders for agent in own) and received[:, swarm.local].all():
                for frame in frames:
                    self.refused += 0 if swarm.hear(slot, frame) else len(swarm.ids) - 1
                return None
            swarm = self.swarm = swarm.with_own_tables(slot)
        if not len(frames):
            return None
        local = np.ascontiguousarray(heard[:, swarm.local])
        for frame, mask in zip(frames, local, strict=True):
            if not swarm.hear(slot, frame, mask):
                self.refused += int(mask.sum())
                mask[:] = 0
        return local

    def on_slot_end(self, collided: Bytes | None = None) -> None:
        """The present slot is over.

        :param collided: (V,) which receivers noticed a collision; None: they cannot tell it from silence.
        """
        self.swarm.end(self.slot, collided)
        self.slot = -1


@dataclass(frozen=True, slots=True)
class Decision:
    """What an agent decided for one slot, and why."""

    slot: int
    chosen: int  # id taken for the slot's sender, 0: nobody
    reason: str  # one of REASONS
    score: float  # priority value g of the chosen
    digest: int  # of the agent's table: equal digests, equal tables


class Agent:
    """One agent: scheduler, estimator and avoider. Time is the slot number.

    In every slot call :meth:`on_slot`, then :meth:`on_frame` for what was heard in it, :meth:`command` as often as
    wanted, and :meth:`on_slot_end`.

    :param id: this agent's id, 1 .. N.
    :param config: the settings that all agents share.
    :param scenario: starts and goals; default: made from ``config``.
    :param authenticator: holds the key, if the settings say that frames are authenticated.
    :raises ConfigError: for an id that does not exist, or a key where none belongs, or none where one does.
    """

    def __init__(
        self, id: int, config: SwarmConfig, scenario: Scenario | None = None, authenticator: Authenticator | None = None
    ) -> None:
        if (authenticator is not None) != config.auth:
            raise ConfigError("authenticator", authenticator, "one if auth is on, else None")
        self.id = id
        self.swarm = make_swarm(config, scenario, local=[id])  # the agent's state and table, as arrays
        self.swarm.authenticator = authenticator
        self.group = AgentGroup(self.swarm)

    def on_slot(self, slot: int) -> bytes | None:
        """Decide for a slot that begins now.

        :param slot: its number; if the slot before is still open it is closed.
        :returns: the frame to send in it, or None.
        """
        if self.group.slot >= 0:
            self.on_slot_end()
        return self.swarm.frame(0) if self.group.on_slot(slot) else None

    def on_frame(self, data: bytes, slot: int) -> bool:
        """Receive the bytes of a frame.

        :param data: what was heard; malformed bytes are counted in ``swarm.malformed`` and ignored.
        :param slot: the slot it was heard in.
        :returns: whether it was a frame of this swarm and this time.
        """
        return self.swarm.hear(slot, data)

    def on_slot_end(self, outcome: SlotOutcome | None = None) -> None:
        """The slot is over.

        :param outcome: what the receiver could tell; None: a frame if one was heard, else silence.
        """
        collided = None if outcome is None else np.array([outcome == SlotOutcome.COLLISION], dtype=np.uint8)
        self.group.on_slot_end(collided)

    def decision(self) -> Decision:
        """The decision for the present slot."""
        s = self.swarm
        return Decision(
            max(0, self.group.slot), int(s.chosen[0]), s.reason_name(0), float(s.score[0]), int(s.digest[0])
        )

    def command(self, position: Vector, velocity: Vector, slot: int, step: int = 0) -> Vector:
        """Where to fly.

        :param position: own true position, m, frame map.
        :param velocity: own true velocity, m/s.
        :param slot: the present slot.
        :param step: control instant within the slot, 0 .. steps.
        :returns: commanded velocity, m/s, frame map.
        """
        self.swarm.position[:, 0], self.swarm.velocity[:, 0] = position, velocity
        self.swarm.steer(slot, step)
        x, y, z = self.swarm.command[:, 0].tolist()
        return (x, y, z)
