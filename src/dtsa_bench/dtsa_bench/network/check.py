"""`tools/dtsa agent --check`: whether all agents hear all, and in time, before they fly. Nothing moves."""

from __future__ import annotations

import statistics
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

from dtsa_agent.air.driver import AgentVehicle
from dtsa_agent.air.port import PortProperties, link_of
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.frame import condition_in
from dtsa_agent.core.station import BETWEEN, StationSettings
from dtsa_agent.core.swarm import Swarm
from dtsa_agent.keys import authenticator

ENOUGH = 0.8  # of the frames that are expected of an agent have to be heard in time
_LEAST_S = 5.0
_ROUNDS = 20  # in which frames are counted, after all have settled
_SILENT = 0.25  # of the check: an agent that began earlier and has ended may be silent for so long
_FEWEST = 5  # frames expected, of which a share says something


def lasts_s(config: SwarmConfig) -> float:
    """How long a check takes, s: until agents that begin cold have settled, and some rounds in which frames count."""
    begun = 3 * config.turn_every * config.agents  # at the latest, where nothing is lost
    return max(_LEAST_S, (begun + _probation_slots(config) + _ROUNDS * config.agents) * config.slot_s)


def _probation_slots(config: SwarmConfig) -> int:
    """Return the number of slots after which an agent knows the owner of each slot: its probation is over."""
    return (2 * config.main_every if config.policy_row.probation else 1) * config.agents


class HeldVehicle(AgentVehicle):
    """A vehicle that stays where it is, whatever its agent wants."""

    def fly(self, swarm: Swarm, slot: int) -> None:
        """Nothing."""


@dataclass(slots=True)
class _OtherAgent:
    """What was heard of another agent."""

    begun: bool = False  # somebody has heard it
    left: bool = False  # has announced that it leaves: its check is over
    new: bool = True  # on probation: it sends at its anchors only, or in turns of which others need not know yet
    expected: set[int] = field(default_factory=set)  # slots in which it was to send
    delays_ns: dict[int, int] = field(default_factory=dict)  # of its frames, by slot
    hears_count: Counter[int] = field(default_factory=Counter)  # by id: how often it announced that, less not

    def hears(self, agent: int) -> bool | None:
        """Whether it hears another one: what it announced more often, for others may end their check before it."""
        return self.hears_count[agent] > 0 if agent in self.hears_count else None


class Check:
    """A watcher of an agent whose vehicle is held."""

    def __init__(self, agent: int, config: SwarmConfig, port: PortProperties) -> None:
        self._agent, self._config = agent, config
        self._datagrams = StationSettings(config, link_of(config, port), authenticator(config))
        self._others: dict[int, _OtherAgent] = defaultdict(_OtherAgent)
        self._refused: Counter[str] = Counter()
        self._last = -1
        self._slots = 0  # since it began or restarted
        self._settled = _probation_slots(config)
        self._expects = False  # whether the policy expects senders at all

    def slot(self, record: SlotRecord) -> None:
        """A slot is over."""
        if record.is_first:  # another time: what was heard before counts its slots differently
            self._others.clear()
            self._slots = 0
        self._slots, self._last = self._slots + 1, record.slot
        if record.chosen not in (0, self._agent):
            self._expects = True
            other = self._others[record.chosen]
            if self._slots > self._settled and not other.new:
                other.expected.add(record.slot)
        for frame in (*record.before, *record.heard):
            other = self._others[frame.sender]
            start_ns = record.start_ns + (frame.slot - record.slot) * self._config.slot_ns
            other.delays_ns[frame.slot] = frame.arrival_ns - start_ns
            parsed = self._datagrams.read(frame.datagram)
            other.left, _, other.new = condition_in(parsed.frame)
            other.begun = True
            for agent in range(1, self._config.agents + 1):
                hears = self._datagrams.hears(parsed.names, agent) if self._datagrams.names else None
                about = self._others[agent]
                about.begun |= hears is True
                # An agent that leaves need hear nobody, nor be heard; one that has not begun cannot be.
                is_there = agent == self._agent or (about.begun and not about.left)
                if hears is not None and agent != parsed.sender and not other.left and (hears or is_there):
                    other.hears_count[agent] += 1 if hears else -1

    def refused(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """A datagram was not accepted."""
        self._refused[reason] += 1

    def result(self) -> dict[str, Any]:
        """What was found, as plain values; ``missing``: what keeps all from hearing all in time, a line each."""
        others = {agent: self._describe(agent) for agent in range(1, self._config.agents + 1) if agent != self._agent}
        heard_by = [k for k in others if any(other.hears(k) for other in self._others.values())]
        lost = {k for k, row in others.items() if not row["heard"] and k not in heard_by}
        missing = [f"cf{k} is heard by no agent" for k in sorted(lost)]
        for agent in sorted(others.keys() - lost):
            missing += self._missing(agent, others[agent], lost)
        return {
            "id": self._agent,
            "agents": self._config.agents,
            "slot_ms": self._config.slot_ms,
            "slots": self._slots,
            "others": {f"cf{agent}": row for agent, row in others.items()},
            "not_taken_in": dict(sorted(self._refused.items())),
            "missing": missing,
        }

    def _describe(self, agent: int) -> dict[str, Any]:
        other = self._others.get(agent, _OtherAgent())
        delays = other.delays_ns
        in_time = {slot for slot, delay in delays.items() if delay <= (1.0 - BETWEEN) * self._config.slot_ns}
        counted = {slot for slot in other.expected if slot <= max(delays, default=-1)}  # until it ended its check
        delays_ms = [delay / 1e6 for delay in delays.values()]
        return {
            "heard": len(delays),
            "expected": len(counted),
            "heard_share": len(counted & delays.keys()) / len(counted) if counted else None,
            "in_time_share": len(counted & in_time) / len(counted) if counted else None,
            "delay_ms": {"p50": statistics.median(delays_ms), "max": max(delays_ms)} if delays else None,
            "silent_slots": 0 if other.left or not delays else self._last - max(delays),
            "hears_this_agent": other.hears(self._agent),
            "does_not_hear": sorted(k for k in other.hears_count if not other.hears(k) and k != self._agent),
        }

    def _missing(self, agent: int, row: dict[str, Any], lost: set[int]) -> list[str]:
        """What is missing between an agent and others, but for those that no agent hears."""
        if not row["heard"]:
            return [f"cf{agent} is not heard"]
        found, share = [], row["in_time_share"]
        if row["silent_slots"] > max(_SILENT * self._slots, self._config.turn_every * self._config.agents):
            found.append(f"cf{agent} was not heard in the last {row['silent_slots']} slots")
        elif self._expects and row["expected"] < _FEWEST:
            found.append(f"of cf{agent} {row['expected']} frames were expected, too few to tell: check for longer")
        elif share is not None and share < ENOUGH:
            found.append(f"{share:.0%} of {row['expected']} frames of cf{agent} heard in time, {ENOUGH:.0%} needed")
        if row["hears_this_agent"] is False:
            found.append(f"cf{agent} does not hear cf{self._agent}")
        if row["hears_this_agent"] is None and self._datagrams.names:
            found.append(f"cf{agent} has not said yet that it hears cf{self._agent}")
        return found + [f"cf{agent} does not hear cf{k}" for k in row["does_not_hear"] if k not in lost]


def table(result: dict[str, Any]) -> str:
    """The result for people."""
    head = ("", "frames", "heard", "in time", "delay ms", "largest", f"hears cf{result['id']}", "does not hear")
    rows = [head]
    for name, row in result["others"].items():
        delay = row["delay_ms"]
        rows.append((
            name, str(row["heard"]), _percent(row["heard_share"]), _percent(row["in_time_share"]),
            f"{delay['p50']:.2f}" if delay else "-", f"{delay['max']:.2f}" if delay else "-",
            {True: "yes", False: "no", None: "-"}[row["hears_this_agent"]],
            ", ".join(f"cf{k}" for k in row["does_not_hear"]) or "-",
        ))  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    about = f"cf{result['id']}: {result['agents']} agents, slots of {result['slot_ms']:g} ms, {result['slots']} slots"
    refused = "; ".join(f"{count} {reason}" for reason, count in result["not_taken_in"].items())
    return "\n".join([about, *lines, *([f"not taken in: {refused}"] if refused else [])]) + "\n"


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{share:.0%}"
