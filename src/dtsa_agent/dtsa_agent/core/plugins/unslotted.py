"""Policies that are not bound to slots, for agents that begin slots one after the other by their own clocks."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError, PluginError, shown
from dtsa_agent.core.registry import POLICIES

from .guard import Guarded

if TYPE_CHECKING:
    from .table import Table

SILENT = -1  # in place of a time
ANSWER_NS = 50_000_000  # beyond two slots: a radio that has said nothing of a frame by then has not sent it
_MOST_WAKES = 10_000  # of one policy in one slot


def check_slotted(policy: str) -> None:
    """Whether all frames of a policy begin with a slot.

    :raises ConfigError: if it sends at any instant.
    """
    if POLICIES.row(policy).unslotted:
        allowed = "a slotted one here; what sends at any instant is for simulated vehicles in real time"
        raise ConfigError("policy", policy, allowed)


def check_carried(policy: str) -> None:
    """Whether nodes can carry a policy in real time.

    :raises ConfigError: if it acts on packets as they arrive.
    """
    if POLICIES.row(policy).reacts:
        allowed = "one that does not answer packets: messages between processes take longer than these"
        raise ConfigError("policy", policy, f"{allowed}; simulate and sweep can")


class SlotRadio:
    """What a policy has of the radio while it acts; see :class:`~dtsa_agent.core.plugins.kinds.Radio`.

    One frame a slot. Where the radio listens before it sends, it begins later, or not at all.
    """

    __slots__ = ("begin_ns", "now_ns")

    def __init__(self) -> None:
        self.now_ns = 0
        self.begin_ns = SILENT  # of the frame in this slot

    def send(self) -> bool:
        """Hands the frame over now; False: there is a frame in this slot already."""
        if self.begin_ns != SILENT:
            return False
        self.begin_ns = self.now_ns
        return True


class Wakes:
    """When the policies of some agents act.

    :param policies: one an agent.
    :param tables: what each agent knows.
    :param slot_ns: ns, length of a slot.
    :param listens: their radios listen before they send; whoever has handed a frame over waits for what they say of it.
    """

    def __init__(
        self, policies: Sequence[Guarded], tables: Sequence[Table], slot_ns: int, listens: bool = False
    ) -> None:
        self._policies, self._tables, self._slot_ns, self._listens = policies, tables, slot_ns, listens
        self._next_ns = [0] * len(policies)  # by each agent's own clock, from the start of slot 0
        self._handed_ns = [SILENT] * len(policies)  # when each handed over the frame that its radio holds
        self._begun_ns = [SILENT] * len(policies)  # when that frame began, as its radio has told
        self._not_sent: set[int] = set()  # whose frame has not been sent, as has been told

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
            radio = SlotRadio()
            if present[index] and self._take_answer(index, begin):
                self._next_ns[index] = self._wake(index, max(begin, self._next_ns[index]), end, radio)
            offsets.append(SILENT if radio.begin_ns == SILENT else radio.begin_ns - begin)
        return offsets

    def told(self, index: int, slot: int, delay_ns: int | None) -> None:
        """What a radio that listens has said of a frame; the policy hears of it when it acts next.

        :param index: position of its agent.
        :param slot: slot in which the frame was handed over.
        :param delay_ns: ns, how much later than handed over it began; None: it did not.
        """
        handed_ns = self._handed_ns[index]
        if handed_ns == SILENT or handed_ns // self._slot_ns != slot:
            return  # of a frame that nobody waits for any more
        if delay_ns is None:
            self._not_sent.add(index)
        else:
            self._begun_ns[index] = handed_ns + max(0, delay_ns)

    def _take_answer(self, index: int, now_ns: int) -> bool:
        """Tells a policy what became of its frame; False: its radio may still send it."""
        handed_ns, begun_ns = self._handed_ns[index], self._begun_ns[index]
        if handed_ns == SILENT:
            return True
        begun = begun_ns != SILENT
        over = begun or index in self._not_sent or now_ns >= handed_ns + 2 * self._slot_ns + ANSWER_NS
        if not over:
            return False
        self._handed_ns[index] = self._begun_ns[index] = SILENT
        self._not_sent.discard(index)
        policy, at_ns = self._policies[index], begun_ns if begun else now_ns
        self._next_ns[index] = next_wake(policy, policy.sent(self._tables[index], at_ns, begun), at_ns, "sent")
        return True

    def _wake(self, index: int, now_ns: int, end_ns: int, radio: SlotRadio) -> int:
        policy, table = self._policies[index], self._tables[index]
        for _ in range(_MOST_WAKES):
            if now_ns >= end_ns:
                return now_ns
            radio.now_ns = now_ns
            answer = policy.wake(table, now_ns, radio)
            if self._listens and radio.begin_ns != SILENT:
                self._handed_ns[index] = now_ns
                return now_ns
            now_ns = next_wake(policy, answer, now_ns)
        raise PluginError(f"{policy.name}, wake", f"wanted to be called more than {_MOST_WAKES} times in a slot")


def next_wake(policy: Guarded, answer: object, now_ns: int, method: str = "wake") -> int:
    """When a policy wants to be called next, ns.

    :param policy: whose answer it is.
    :param answer: its answer.
    :param now_ns: ns, now.
    :param method: what has answered.
    :raises PluginError: if it is no later time.
    """
    return whole_ns(policy, answer, method, now_ns + 1, f"whole numbers above {now_ns}, the present time")


def whole_ns(policy: Guarded, answer: object, method: str, least: int, allowed: str) -> int:
    """A number of ns that a policy has answered.

    :param policy: whose answer it is.
    :param answer: its answer.
    :param method: what has answered.
    :param least: ns, the smallest that is allowed.
    :param allowed: says so.
    :raises PluginError: if it is none, or smaller.
    """
    try:
        number = operator.index(answer)  # type: ignore[arg-type]
    except Exception:  # whatever its __index__ raises
        number = least - 1
    if number < least:
        raise PluginError(f"{policy.name}, {method}", f"gave {shown(answer)} ns; allowed: {allowed}")
    return number
