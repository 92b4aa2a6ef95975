"""One quadcopter without I/O: events in, frames and commands out. The caller owns clock, radio and motors."""

from __future__ import annotations

from dataclasses import dataclass

from .config import SwarmConfig
from .frame import Vector
from .plugins import make_swarm
from .scenario import Scenario


@dataclass(frozen=True, slots=True)
class Decision:
    """What an agent decided for one slot, and why."""

    slot: int
    chosen: int  # id taken for the slot's sender, 0: nobody
    reason: str  # one of REASONS
    score: float  # priority value g of the chosen
    digest: int  # of the agent's table: equal digests, equal tables


class Agent:
    """One agent: scheduler, estimator and avoider.

    In every slot call :meth:`on_slot`, then :meth:`on_frame` for what was heard in it, then :meth:`on_silence` or
    nothing, then :meth:`command` as often as wanted. Time is the slot number.

    :param id: this agent's id, 1 .. N.
    :param config: the settings that all agents share.
    :param scenario: starts and goals; default: made from ``config``.
    """

    def __init__(self, id: int, config: SwarmConfig, scenario: Scenario | None = None) -> None:
        self.id = id
        self.swarm = make_swarm(config, scenario, local=[id])
        self._open: int | None = None

    def on_slot(self, slot: int) -> bytes | None:
        """Decides for a slot that begins now.

        :param slot: its number; the slot before is closed.
        :returns: the frame to send in it, or None.
        """
        if self._open is not None:
            self.swarm.end(self._open)
        self._open = slot
        self.swarm.scenario.advance(slot, self.swarm)
        return self.swarm.frame(0) if self.swarm.begin(slot) else None

    def on_frame(self, data: bytes, slot: int) -> bool:
        """Takes in the bytes of a frame.

        :param data: what was heard; malformed bytes are counted in ``swarm.malformed`` and ignored.
        :param slot: the slot it was heard in.
        :returns: whether it was a frame.
        """
        return bool(self.swarm.hear(slot, data))

    def on_silence(self, slot: int) -> None:
        """Nothing was heard in a slot (nobody sent, or frames collided). Agents learn that from the missing frame."""

    def decision(self) -> Decision:
        """The decision for the present slot."""
        s = self.swarm
        return Decision(self._open or 0, int(s.chosen[0]), s.reason_name(0), float(s.score[0]), int(s.digest[0]))

    def command(self, position: Vector, velocity: Vector, slot: int, step: int = 0) -> Vector:
        """Where to fly.

        :param position: own true position, m, frame map.
        :param velocity: own true velocity, m/s.
        :param slot: the present slot.
        :param step: control instant within the slot, 0 .. steps.
        :returns: commanded velocity, m/s, frame map.
        """
        self.swarm.position[:, 0] = position
        self.swarm.velocity[:, 0] = velocity
        self.swarm.steer(slot, step)
        x, y, z = self.swarm.command[:, 0]
        return (float(x), float(y), float(z))
