"""An agent flown again from its own bag: the same receptions give the same decisions, and frames."""

from __future__ import annotations

import dataclasses
from typing import Any

from dtsa_agent.air.datagram import frame_in
from dtsa_agent.air.record import Heard, SlotRecord
from dtsa_agent.core import AgentGroup, make_scenario
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_agent.core.plugins.entry_points import make_swarm

from .agent_bag import AgentBag

_KEPT = ("sent_position", "sent_velocity", "sent_intent", "sent_slot", "last_turn", "in_ap")


class Replay:
    """One agent that is where it said it was, and hears what it said it heard."""

    def __init__(self, bag: AgentBag) -> None:
        # Tags are left out: whether they are right was for the agent to judge, and the key is not in the bag.
        config = dataclasses.replace(bag.swarm, auth=False)
        self._of = bag.swarm
        self.agent = bag.agent
        self._unsent_kept = bag.unsent_kept
        self.swarm = make_swarm(config, make_scenario(config), local=[bag.agent])
        if bag.goals_told:
            self.swarm.final[:] = 0
        self._group = AgentGroup(self.swarm)
        self.equal = 0  # slots
        self.differences: list[dict[str, Any]] = []

    def fly(self, record: SlotRecord) -> None:
        """One slot."""
        swarm, slot = self.swarm, record.slot
        if record.anew:
            swarm.restart(0)
        self._hear(record.before)
        swarm.track[:, :, 0] = record.track
        swarm.position[:, 0] = record.track[-1]
        swarm.velocity[:, 0], swarm.command[:, 0] = record.velocity, record.command
        swarm.goal[:, 0] = record.goal  # one that flies where it is told to has others than the scenario's
        if record.present != 1:
            swarm.present[0] = record.present
        self._group.on_slot(slot)
        self._compare(record)
        if record.sent_ns < 0:
            swarm.drop(0)
        self._hear(record.heard)
        self._group.on_slot_end()

    def lay(self, tables: Any, row: int) -> None:
        """Copies what the agent knows into a row of tables."""
        for name in _KEPT:
            getattr(tables, name)[row] = getattr(self.swarm, name)[0]

    def _hear(self, frames: list[Heard]) -> None:
        for heard in frames:
            self.swarm.hear(heard.slot, self._frame_in(heard.datagram))

    def _frame_in(self, datagram: bytes) -> bytes:
        sealed = frame_in(datagram, self._of)
        return sealed[:-TAG_LENGTH] if self._of.auth else sealed

    def _compare(self, record: SlotRecord) -> None:
        swarm = self.swarm
        said = {
            "chosen": record.chosen, "reason": record.reason, "digest": record.digest,
            "frame": record.frame.hex(),
        }  # fmt: skip
        again = {
            "chosen": int(swarm.chosen[0]), "reason": int(swarm.reason[0]), "digest": int(swarm.digest[0]),
            "frame": swarm.frame(0).hex() if swarm.sends[0] else "",
        }  # fmt: skip
        if record.sent_ns < 0 and not self._unsent_kept:
            record.frame, said["frame"] = bytes.fromhex(str(again["frame"])), again["frame"]
        wrong = [name for name, value in said.items() if value != again[name]]
        if not wrong:
            self.equal += 1
        elif len(self.differences) < _MOST_DIFFERENCES:
            name = wrong[0]
            self.differences.append({
                "agent": self.agent, "slot": record.slot, "field": name, "recorded": said[name], "again": again[name],
            })  # fmt: skip


_MOST_DIFFERENCES = 5  # told of each agent
