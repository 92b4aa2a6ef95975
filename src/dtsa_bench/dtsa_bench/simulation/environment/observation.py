"""What an agent has heard, as numbers: an observation. What is in it and in which units: docs/how-to/learning.md.

It is made of an agent's table and of its own state alone, so a policy that flies as a plug-in can have the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.plugins.table import Table

Floats = NDArray[np.float64]

#: Numbers about the agent itself, by name: first position and count.
OWN = {"slot": (0, 1), "turn_in": (1, 1), "frame": (2, 1), "far": (3, 1), "goal": (4, 3), "velocity": (7, 3)}
OWN_SIZE = 10
#: Planes of N numbers, one an agent, by name: first plane and count.
PLANES = {"age": (0, 1), "silence": (1, 1), "moves": (2, 1), "position": (3, 3), "relative_velocity": (6, 3)}
PLANE_COUNT = 9


def size(agents: int) -> int:
    """How many numbers an observation has.

    :param agents: number of agents N.
    """
    return OWN_SIZE + PLANE_COUNT * agents


def fields(observations: NDArray[np.float32], agents: int) -> dict[str, NDArray[np.float32]]:
    """Windows on the parts of observations, by name.

    :param observations: (..., F), any number of them.
    :param agents: number of agents N.
    :returns: ``slot``, ``turn_in``, ``frame``, ``far`` (...), ``goal``, ``velocity`` (..., 3), ``age``, ``silence``,
        ``moves`` (..., N), ``position``, ``relative_velocity`` (..., 3, N).
    """
    planes = observations[..., OWN_SIZE:].reshape(*observations.shape[:-1], PLANE_COUNT, agents)
    own = {name: observations[..., at] if n == 1 else observations[..., at : at + n] for name, (at, n) in OWN.items()}
    return own | {
        name: planes[..., at, :] if n == 1 else planes[..., at : at + n, :] for name, (at, n) in PLANES.items()
    }


def bounds(agents: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and greatest values, (F,) each; infinite where there is no limit.

    :param agents: number of agents N.
    """
    low, high = (np.full(size(agents), limit, dtype=np.float32) for limit in (-np.inf, np.inf))
    for name, least, most in (
        ("slot", 0, np.inf), ("turn_in", 0, agents - 1), ("frame", 0, 1), ("far", 0, 1), ("age", -1, np.inf),
        ("silence", 0, np.inf), ("moves", 0, 1),
    ):  # fmt: skip
        fields(low, agents)[name][...], fields(high, agents)[name][...] = least, most
    return low, high


class Tables(Protocol):
    """Tables and own states of V observers in B flights."""

    sent_slot: NDArray[np.int64]  # (B, V, N)
    last_turn: NDArray[np.int64]  # (B, V, N)
    in_ap: NDArray[np.uint8]  # (B, V, N)
    sent_position: Floats  # (B, V, 3, N) m
    sent_velocity: Floats  # (B, V, 3, N) m/s
    position: Floats  # (B, 3, V) m, own
    velocity: Floats  # (B, 3, V) m/s, own
    goal: Floats  # (B, 3, V) m, own


class Encoder:
    """Makes observations of tables, in an array that is made once.

    :param config: the swarm's settings.
    :param ids: (V,) ids of the observers.
    :param flights: number of flights B.
    """

    def __init__(self, config: SwarmConfig, ids: Sequence[int], flights: int) -> None:
        agents, observers = config.agents, len(ids)
        self.observations = np.zeros((flights, observers, size(agents)), dtype=np.float32)
        self._fields = fields(self.observations, agents)
        self._agents, self._slot_s, self._r_min = agents, config.slot_s, config.r_min
        self._own = np.array(ids)[None, :] - 1  # (1, V)
        # Each observer has itself first, then those with the next ids.
        order = (self._own.T + np.arange(agents)) % agents
        table = np.arange(observers)[:, None]
        self._columns = table * agents + order  # (V, N) into (V N)
        axes = np.arange(3)[None, :, None] * agents
        self._planes = (table * 3 * agents + order)[:, None, :] + axes  # (V, 3, N) into (V 3 N)
        # Arrays that NumPy would otherwise ask the system for in each slot.
        shape = (flights, observers, agents)
        self._sent, self._turn = (np.zeros(shape, dtype=np.int64) for _ in range(2))
        self._in_ap = np.zeros(shape, dtype=np.uint8)
        self._ago_s = np.zeros(shape)
        self._place, self._velocity, self._moved = (np.zeros((flights, observers, 3, agents)) for _ in range(3))

    def fill(self, slots: NDArray[np.int64], tables: Tables) -> NDArray[np.float32]:
        """Fills the observations.

        :param slots: (B,) the slot that begins in each flight.
        :param tables: what is known at its start.
        :returns: (B, V, F), the same array each time.
        """
        out, now = self._fields, slots[:, None, None]
        sent, turn = self._sent, self._turn
        _take(tables.sent_slot, self._columns, sent)
        _take(tables.last_turn, self._columns, turn)
        _take(tables.in_ap, self._columns, self._in_ap)
        _take(tables.sent_position, self._planes, self._place)
        _take(tables.sent_velocity, self._planes, self._velocity)
        never = sent < 0
        out["frame"][...] = (sent == now - 1).any(axis=2) & (slots > 0)[:, None]
        np.subtract(now, sent, out=sent)
        sent[never] = 0  # nobody that was never heard has moved
        np.subtract(sent, 1, out=out["age"], casting="unsafe")
        np.subtract(now - 1, turn, out=out["silence"], casting="unsafe")
        out["moves"][...] = self._in_ap
        np.multiply(sent, self._slot_s, out=self._ago_s)
        np.multiply(self._velocity, self._ago_s[:, :, None, :], out=self._moved)
        np.add(self._place, self._moved, out=self._place)
        np.subtract(self._place, tables.position.swapaxes(1, 2)[..., None], out=out["position"], casting="same_kind")
        own = tables.velocity.swapaxes(1, 2)
        np.subtract(self._velocity, own[..., None], out=out["relative_velocity"], casting="same_kind")
        way = tables.goal - tables.position
        out["slot"][...] = slots[:, None]
        out["turn_in"][...] = (self._own - slots[:, None]) % self._agents
        out["far"][...] = np.sqrt((way * way).sum(axis=1)) > self._r_min
        out["goal"][...] = way.swapaxes(1, 2)
        out["velocity"][...] = own
        return self.observations


def _take(values: NDArray[Any], where: NDArray[np.intp], out: NDArray[Any]) -> None:
    """Fills an array with values by id, as each observer has them."""
    values.reshape(len(values), -1).take(where, axis=1, out=out, mode="clip")


class _One:
    """The table of a plug-in as one of one."""

    def __init__(self, table: Table) -> None:
        assert table.own_position is not None
        assert table.own_velocity is not None
        assert table.goal is not None
        self.sent_slot, self.last_turn = table.sent_slot[None, None], table.last_turn[None, None]
        self.in_ap = table.in_ap[None, None]
        self.sent_position, self.sent_velocity = table.sent_position[None, None], table.sent_velocity[None, None]
        self.position, self.velocity = table.own_position[None, :, None], table.own_velocity[None, :, None]
        self.goal = table.goal[None, :, None]


class Observer:
    """Observations of one agent that flies as a plug-in: what the environment gives to that agent, bit for bit.

    :param config: what the plug-in's factory was given.
    :param agent: id, as its factory was given it.
    """

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self._encoder = Encoder(config, [agent], 1)
        self._slot = np.zeros(1, dtype=np.int64)

    def __call__(self, table: Table, slot: int) -> NDArray[np.float32]:
        """(F,) what the agent has heard before a slot; the same array each time.

        :param table: what ``choose`` was given.
        :param slot: the slot that begins.
        """
        self._slot[0] = slot
        return self._encoder.fill(self._slot, _One(table))[0, 0]
