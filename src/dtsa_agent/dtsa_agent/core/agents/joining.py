"""What a policy must have for live flights, and how agents come into one: they listen, then hover until known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.swarm import Swarm


def check_slotted(policy: str) -> None:
    """Refuse a policy whose frames may begin at any instant: only `simulate` and `sweep` carry those.

    :raises ConfigError: if it is one.
    """
    if POLICIES.row(policy).unslotted:
        raise ConfigError("policy", policy, "a policy with slots; those without fly in simulate and sweep only")


def check_joinable(policy: str) -> None:
    """Whether agents can come into a flight that is under way.

    :raises ConfigError: if they never could agree with the others.
    """
    row = POLICIES.row(policy)
    if not row.may_join or row.unslotted:  # who comes late takes its time from a frame that begins with a slot
        joinable = [row.name for row in POLICIES.rows.values() if row.may_join]
        raise ConfigError("policy", policy, f"{', '.join(joinable)}, to come into a flight that is under way")


class Listeners:
    """Agents that do not know yet where the slots of the swarm lie.

    :param config: the settings that all agents share.
    :param ids: ids of the agents.
    :param now_ns: (L,) what their clocks show.
    :raises ConfigError: for a policy with which nobody can come late.
    """

    def __init__(self, config: SwarmConfig, ids: Sequence[int], now_ns: Sequence[int]) -> None:
        check_joinable(config.policy)
        self._bases = [ffi.new("dtsa_timebase *") for _ in ids]
        for base, agent, now in zip(self._bases, ids, now_ns, strict=True):
            lib.dtsa_timebase_init(base, config.agents, config.anchor_every, config.slot_ns, agent, config.seed)
            lib.dtsa_timebase_start(base, int(now))

    def hear(self, index: Any, slot: int, start_ns: int) -> bool:
        """An agent hears a frame of a slot; whether that is where it has its time from.

        :param start_ns: ns, own clock, when its transmission started.
        """
        base = self._bases[index]
        if base.state != lib.DTSA_LISTENING:
            return False
        lib.dtsa_timebase_hear(base, slot, start_ns)
        return True

    def ready(self, now_ns: Sequence[int]) -> bool:
        """Whether each has heard a frame, or has waited in vain for as long as the protocol says.

        :param now_ns: (L,) what their clocks show.
        """
        for base, now in zip(self._bases, now_ns, strict=True):
            lib.dtsa_timebase_wake(base, int(now))
        return all(base.state != lib.DTSA_LISTENING for base in self._bases)


class Newcomers:
    """Local agents that hover because they are new: nobody knows where they are, and they do not know the others.

    An agent flies from when it has spoken in a turn of its own and, where the policy has probation, is through with it:
    then it has been heard; and after a whole round, in which it has heard everybody else where nothing is lost.

    :param count: number of local agents L.
    """

    def __init__(self, count: int) -> None:
        self._since: NDArray[np.int64] = np.full(count, -1, dtype=np.int64)  # first slot, -1: not new
        self.some = False  # whether any is new; most processes never have any

    def add(self, swarm: Swarm, index: Any, slot: int) -> None:
        """An agent begins anew between two slots, knowing nothing; slot: its first one."""
        swarm.restart(index)
        self._since[index] = slot
        self.some = True

    def hold(self, swarm: Swarm, slot: int) -> None:
        """Keeps those that are still new where they are, after ``scenario.advance`` for the slot that begins."""
        if not self.some:
            return
        for index in np.flatnonzero(self._since >= 0):
            swarm.active[index] = 0
            if self._known(swarm, index, slot):
                self._since[index] = -1
                course = swarm.course
                flies = swarm.scenario.moving[swarm.local] if course is None else course.active
                swarm.active[index] = flies[index]
        self.some = bool((self._since >= 0).any())

    def _known(self, swarm: Swarm, index: Any, slot: int) -> bool:
        config = swarm.config
        since = self._since[index]
        if slot < since + config.agents or swarm.sent_slot[index, swarm.local[index]] < since:
            return False
        return not config.policy_row.probation or not swarm.lease_status(index)["probation"]
