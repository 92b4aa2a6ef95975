"""Agents without I/O: slots and frames in, frames and commands out. The caller owns clock, radio and motors.

:class:`AgentGroup` holds all agents of a process, as nodes run them; :class:`Agent` is a single one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import Vector
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.core.registry import REASONS
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.scenario import Scenario
from dtsa_agent.core.station import check_slotted
from dtsa_agent.core.swarm import Bytes, SlotOutcome, Swarm

REFUSED = "reception refused"  # name of the count of frames that reached an agent and were not accepted


class AgentGroup:
    """The agents of one process. In every slot call ``on_slot``, ``on_frames``, ``on_slot_end``, in this order.

    :param swarm: the agents; they stop sharing a table at the first frame that not all of them receive.
    :raises ConfigError: for a policy without slots.
    """

    def __init__(self, swarm: Swarm) -> None:
        check_slotted(swarm.config.policy)
        self.swarm = swarm
        self.refused = 0  # frames that reached an agent and were not accepted, summed over agents
        self.slot = -1  # the present slot, -1: none

    def on_slot(self, slot: int) -> tuple[int, ...]:
        """Begin a slot, after the one before is closed; returns the positions in ``swarm.ids`` of those that send."""
        self.slot = slot
        self.swarm.scenario.advance(slot, self.swarm)
        return self.swarm.begin(slot)

    def on_frames(self, slot: int, senders: Sequence[int], frames: Sequence[bytes], heard: Bytes) -> Bytes | None:
        """Receive the frames of a slot.

        :param senders: ids of the agents that sent, as the channel knows them.
        :param frames: their F frames; malformed and foreign ones are counted and change nothing.
        :param heard: (F, N) 1 where an agent (of all N) received a frame.
        :returns: (F, L) 1 where one of the L local agents accepted a frame; None if they share a table, or if F = 0.
        """
        swarm = self.swarm
        if swarm.shared:
            received = heard.copy()
            received[np.arange(len(senders)), np.array(senders, dtype=np.intp) - 1] = 1  # a sender knows its own frame
            # A frame without receivers is known to its sender alone: the tables are no longer equal.
            sent = {swarm.ids[index] for index in np.flatnonzero(swarm.sends)}
            if sent <= set(senders) and received[:, swarm.local].all():
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
        """Close the present slot.

        :param collided: (V,) 1 where an observer detected a collision; None: receivers cannot tell it from silence.
        """
        self.swarm.end(self.slot, collided)
        self.slot = -1


@dataclass(frozen=True, slots=True)
class Decision:
    """Decision of an agent for one slot."""

    slot: int
    chosen: int  # id of the agent that it expects to send, 0: none
    reason: str  # one of REASONS
    score: float  # priority value g of that agent
    digest: int  # of the deciding agent's table: equal digests, equal tables


class Agent:
    """One agent: scheduler, estimator and avoider. Time is the slot number.

    In every slot call :meth:`on_slot`, then :meth:`on_frame` for each frame received in it, :meth:`command` at each
    control instant, and :meth:`on_slot_end`.

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
        """Begin a slot, after closing an open one.

        :param slot: its number, larger than that of the slot before.
        :returns: the frame to send in it; None: the agent is silent.
        """
        if self.group.slot >= 0:
            self.on_slot_end()
        return self.swarm.frame(0) if self.group.on_slot(slot) else None

    def on_frame(self, data: bytes, slot: int) -> bool:
        """Receive a frame; malformed ones are counted in ``swarm.malformed`` and ignored.

        :param data: the frame, whatever it is.
        :param slot: number of the slot in which it arrived.
        :returns: whether it was accepted: a frame of this swarm and this slot time.
        """
        return self.swarm.hear(slot, data)

    def on_slot_end(self, outcome: SlotOutcome | None = None) -> None:
        """Close the slot.

        :param outcome: as the receiver detected it; None: a frame if one arrived, else silence.
        """
        collided = None if outcome is None else np.array([outcome == SlotOutcome.COLLISION], dtype=np.uint8)
        self.group.on_slot_end(collided)

    def decision(self) -> Decision:
        """Return the decision for the present slot."""
        swarm, slot = self.swarm, max(0, self.group.slot)
        reason = REASONS[int(swarm.reason[0])]
        return Decision(slot, int(swarm.chosen[0]), reason, float(swarm.score[0]), int(swarm.digest[0]))

    def command(self, position: Vector, velocity: Vector, slot: int, step: int = 0) -> Vector:
        """Return the commanded velocity for a control instant, 0 .. steps, of the present slot; m/s, frame map.

        :param position: own true position, m, frame map.
        :param velocity: own true velocity, m/s.
        """
        self.swarm.position[:, 0], self.swarm.velocity[:, 0] = position, velocity
        self.swarm.steer(slot, step)
        x, y, z = self.swarm.command[:, 0].tolist()
        return (x, y, z)
