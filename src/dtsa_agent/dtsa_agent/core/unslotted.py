"""Policies that are not bound to slots, for agents that open slots one after the other by their own clocks."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .errors import ConfigError, PluginError
from .plugin_guard import Guarded
from .registry import POLICIES

if TYPE_CHECKING:
    from .plugins import Table

SILENT = -1  # in place of a time
_MOST_WAKES = 10_000  # of one policy in one slot


def check_slotted(policy: str) -> None:
    """Whether all frames of a policy begin with a slot.

    :raises ConfigError: if it sends at any instant.
    """
    if POLICIES.row(policy).unslotted:
        allowed = "a slotted one here; what sends at any instant is for simulated vehicles in real time"
        raise ConfigError("policy", policy, allowed)


class SlotRadio:
    """What a policy has of the radio while it acts; see :class:`~dtsa_agent.core.plugins.Radio`.

    One frame a slot, and it does not listen: what others send now is known after it has been received.
    """

    __slots__ = ("begin_ns", "now_ns", "policy")

    def __init__(self, policy: str) -> None:
        self.policy = policy
        self.now_ns = 0
        self.begin_ns = SILENT  # of the frame in this slot

    def busy(self) -> bool:
        """Not known here.

        :raises PluginError: always.
        """
        raise PluginError(f"{self.policy}, wake", "asked whether the air is in use, without 'busy' in its port")

    def send(self) -> bool:
        """Begins to send now; False: there is a frame in this slot already."""
        if self.begin_ns != SILENT:
            return False
        self.begin_ns = self.now_ns
        return True


class Wakes:
    """When the policies of some agents act.

    :param policies: one an agent.
    :param tables: what each agent knows.
    :param slot_ns: ns, length of a slot.
    """

    def __init__(self, policies: Sequence[Guarded], tables: Sequence[Table], slot_ns: int) -> None:
        self._policies, self._tables, self._slot_ns = policies, tables, slot_ns
        self._next_ns = [0] * len(policies)  # by each agent's own clock, from the start of slot 0

    def act(self, slot: int, present: NDArray[np.uint8]) -> list[int]:
        """Lets everybody act in a slot, all with the tables of its start.

        :param slot: its number.
        :param present: (L,) 0: switched off.
        :returns: (L,) when each begins to send, ns after the slot's start; SILENT: it does not.
        :raises PluginError: if a policy does not say when to be called again.
        """
        begin, end = slot * self._slot_ns, (slot + 1) * self._slot_ns
        offsets = []
        for index in range(len(present)):
            radio = SlotRadio(self._policies[index].name)
            if present[index]:
                self._next_ns[index] = self._wake(index, max(begin, self._next_ns[index]), end, radio)
            offsets.append(SILENT if radio.begin_ns == SILENT else radio.begin_ns - begin)
        return offsets

    def _wake(self, index: int, now_ns: int, end_ns: int, radio: SlotRadio) -> int:
        policy, table = self._policies[index], self._tables[index]
        for _ in range(_MOST_WAKES):
            if now_ns >= end_ns:
                return now_ns
            radio.now_ns = now_ns
            now_ns = next_wake(policy, policy.wake(table, now_ns, radio), now_ns)
        raise PluginError(f"{policy.name}, wake", f"wanted to be called more than {_MOST_WAKES} times in a slot")


def next_wake(policy: Guarded, answer: object, now_ns: int) -> int:
    """What ``wake`` has answered: when to call it again, ns.

    :param policy: whose answer it is.
    :param answer: its answer.
    :param now_ns: ns, now.
    :raises PluginError: if it is no later time.
    """
    try:
        again = operator.index(answer)  # type: ignore[arg-type]
    except TypeError:
        again = now_ns
    if again <= now_ns:
        fault = f"gave {answer!r} ns; allowed: whole numbers above {now_ns}, the present time"
        raise PluginError(f"{policy.name}, wake", fault)
    return again
