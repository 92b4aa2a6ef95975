"""Radios that listen before they send, as those that sense the carrier do: each holds one frame until it may begin.

The rule is that of the agents' policy (``dtsa_agent.core.plugins.kinds.Listens.sensed``); whether the air is in use
where a radio is says the medium: range, hidden senders, turning from listening to sending. The simulator and the
channel in real time carry frames by the same radios.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from heapq import heappop, heappush
from typing import Generic, NamedTuple, TypeVar

from dtsa_agent.core.errors import PluginError
from dtsa_agent.core.plugins.guard import Guarded
from dtsa_agent.core.plugins.unslotted import whole_ns
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.scenario import STREAM_RADIOS, generator

from .air import NEVER, Air
from .medium import Positions

Key = TypeVar("Key", bound=Hashable)

_MOST_LISTENS = 10_000  # for one frame


class Released(NamedTuple):
    """What a radio has done with its frame."""

    agent: int
    """Id of the agent."""
    now_ns: int
    """When, ns from the start of slot 0 by the channel's clock."""
    begun: bool
    """Whether it begins to send; else it has given the frame up."""


@dataclass(slots=True)
class _Held:
    """A frame that a radio holds."""

    entry: int  # its place in the order of events
    until_ns: int  # it is given up then
    listens: int = 0  # how often the radio has listened


def radio_rules(config: SwarmConfig) -> list[Guarded]:
    """An instance of the policy for each agent's radio, (N,), with random numbers of its own.

    :param config: the swarm's settings, with a policy whose radios listen.
    :raises ConfigError: if it cannot be used here.
    :raises PluginError: if it cannot be made.
    """
    own = replace(config, seed=int(generator(config.seed, STREAM_RADIOS).integers(2**31)))
    factory = POLICIES.factory(config.policy)
    return [Guarded("policy", config.policy, factory, own, agent) for agent in range(1, config.agents + 1)]


class Radios(Generic[Key]):
    """The radios of all agents on one air.

    :param air: the air; the caller puts on it what begins.
    :param rules: the policy of each radio, (N,).
    """

    def __init__(self, air: Air[Key], rules: Sequence[Guarded]) -> None:
        self._air, self._rules = air, rules
        self._held: dict[int, _Held] = {}  # by id
        self._events: list[tuple[int, int, int]] = []  # heap: ns, id, entry
        self._count = 0
        self._sent_ns = [0] * len(rules)  # when each began its last frame

    def holds(self, agent: int) -> bool:
        """Whether a radio holds a frame that has not begun.

        :param agent: id.
        """
        return agent in self._held

    def hand_over(self, agent: int, at_ns: int, until_ns: int = NEVER) -> None:
        """Gives a radio a frame, in place of one that it holds.

        :param agent: id.
        :param at_ns: ns, when it listens first; not before what the radios have listened to.
        :param until_ns: ns, when it gives the frame up.
        """
        self._held[agent] = _Held(0, until_ns)
        self._listen_at(agent, at_ns)

    def drop(self, agent: int) -> None:
        """A radio loses the frame that it holds.

        :param agent: id.
        """
        self._held.pop(agent, None)

    @property
    def next(self) -> tuple[int, int]:
        """When which radio listens next: ns, id."""
        events = self._events
        while events and ((held := self._held.get(events[0][1])) is None or held.entry != events[0][2]):
            heappop(events)
        return events[0][:2] if events else (NEVER, 0)

    def listen(self, positions: Positions | None = None) -> Released | None:
        """Lets the radio listen whose turn is next; all that begins before has been put on the air.

        :param positions: (3, N), m, frame map; needed with a limited range.
        :returns: what it has done with its frame; None: it waits.
        :raises PluginError: if the policy gives no answer that can be, or lets the radio listen without end.
        """
        now_ns, agent = self.next
        held, rule = self._held[agent], self._rules[agent - 1]
        if now_ns > held.until_ns:
            del self._held[agent]
            return Released(agent, now_ns, False)
        busy = self._air.busy(agent, now_ns, positions)
        answer = rule.sensed(busy, now_ns, self._sent_ns[agent - 1])
        allowed = "whole numbers from 1, as the air is in use" if busy else "whole numbers from 0"
        wait_ns = whole_ns(rule, answer, "sensed", int(busy), allowed)
        if not wait_ns:
            del self._held[agent]
            self._sent_ns[agent - 1] = now_ns
            return Released(agent, now_ns, True)
        held.listens += 1
        if held.listens >= _MOST_LISTENS:
            raise PluginError(f"{rule.name}, sensed", f"listened {_MOST_LISTENS} times for one frame")
        self._listen_at(agent, now_ns + wait_ns)
        return None

    def _listen_at(self, agent: int, at_ns: int) -> None:
        self._count += 1
        self._held[agent].entry = self._count
        heappush(self._events, (at_ns, agent, self._count))
