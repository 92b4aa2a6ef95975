"""Decisions of agents on their own clocks, made again from what they say to have taken in, and when."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from dtsa_agent.core import AgentGroup, make_scenario
from dtsa_agent.core.frame import decode_extended
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.keys import with_key
from dtsa_bench.runs.config import RunConfig

from .frames import SentFrames
from .result import Difference, Mismatch

_DECIDED = ("chosen", "reason", "digest")


class _Heard(NamedTuple):
    slot: int
    sender: int
    mask: Any  # (N,)


class Decisions:
    """All agents of a run, who fly where they reported to be, and hear what they reported to have taken in."""

    def __init__(self, run: RunConfig, frames: SentFrames) -> None:
        self._frames, self._config, self._agents = frames, run.swarm, run.swarm.agents
        self._steps = run.swarm.steps
        self._group = AgentGroup(with_key(make_swarm(run.swarm, make_scenario(run.swarm))))
        self._rows: dict[int, list[tuple[Any, dict[str, Any]]]] = {}
        self._heard: dict[int, list[_Heard]] = {}

    def report(self, said: Any) -> None:
        """Takes in one report."""
        count, index = len(said.agent), np.asarray(said.agent, dtype=np.intp) - 1
        slots = said.slot.tolist()
        for row, slot in enumerate(slots):
            part = slice(row * count, (row + 1) * count)
            fields = {name: getattr(said, name)[part] for name in (*_DECIDED, "length")}
            for name, planes in (("track", 3 * self._steps), ("velocity", 3), ("command", 3)):
                at = slice(row * planes * count, (row + 1) * planes * count)
                fields[name] = getattr(said, name)[at].reshape(-1, 3, count)
            self._rows.setdefault(slot, []).append((index, fields))
        rows = np.asarray(said.heard_by, dtype=np.uint8).reshape(-1, -(-count // 8))
        masks = np.unpackbits(rows, axis=1, count=count, bitorder="little") if len(rows) else ()
        entries = zip(said.heard_in.tolist(), said.heard_slot.tolist(), said.heard_sender.tolist(), masks, strict=True)
        for here, slot, sender, mask in entries:
            everybody = np.zeros(self._agents, dtype=np.uint8)
            everybody[index] = mask
            self._heard.setdefault(here, []).append(_Heard(slot, sender, everybody))

    def check(self, slots: int) -> int:
        """Makes all decisions again.

        :raises Mismatch: at the first that is not.
        """
        swarm = self._group.swarm
        equal = 0
        for slot in range(slots):
            rows = self._rows.pop(slot, [])
            if sum(len(index) for index, _ in rows) != self._agents:
                return equal  # an agent is silent from here on
            for index, fields in rows:
                swarm.track[:, :, index] = fields["track"]
                swarm.position[:, index] = fields["track"][-1]
                swarm.velocity[:, index] = fields["velocity"][0]
                swarm.command[:, index] = fields["command"][0]
                for agent in index[fields["length"] > 0]:
                    if self._leaves(slot, int(agent) + 1):
                        swarm.leave(int(agent))
            self._group.on_slot(slot)
            for index, fields in rows:
                for name in _DECIDED:
                    self._compare(slot, name, index, getattr(swarm, name)[index], fields[name])
                equal += len(index)
                for late in index[fields["length"] == 0]:
                    swarm.drop(int(late))  # it was too late to send
            for heard in self._heard.pop(slot, []):
                sent = self._frames.get(heard.slot, heard.sender)
                if sent is not None:
                    swarm.hear(heard.slot, sent.data, heard.mask)
            self._group.on_slot_end()
        return equal

    def _leaves(self, slot: int, agent: int) -> bool:
        """Whether an agent says in a frame that it leaves: what made it leave came from outside."""
        sent = self._frames.get(slot, agent)
        if sent is None or not self._config.policy_row.says_leaving:
            return False
        return decode_extended(self._config.protocol_part(sent.data, sealed=True)).leaving

    @staticmethod
    def _compare(slot: int, name: str, index: Any, expected: Any, recorded: Any) -> None:
        wrong = np.flatnonzero(expected != recorded)
        if len(wrong):
            at = wrong[0]
            why = "follows from what the agent says to have taken in"
            raise Mismatch(
                Difference(f"report.{name}", str(expected[at]), str(recorded[at]), why, slot, int(index[at]) + 1)
            )
