"""Whether frames on the air are what the protocol allows: two senders in a slot, out of turn, turns given twice."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from dtsa_agent.core import SwarmConfig

from .ledger import Ledger

_TOLD = 10  # broken rules


class Judge:
    """Reads the frames of a swarm slot by slot.

    What was given away before it began it cannot know: unless it begins with slot 0, it only listens for as long as
    leases reach.
    """

    def __init__(self, config: SwarmConfig) -> None:
        self._config = config
        rounds = config.anchor_every, config.main_every
        self._ledger = Ledger(config.agents, *rounds) if config.policy == "lease" else None
        self._window = (config.main_every + 2) * config.agents if self._ledger else 0
        self._from: int | None = None  # slot
        self.broken: list[str] = []
        self._known_from = 0  # slot from which on no turn depends on a frame that nobody has recorded
        self.slots = self.frames = 0
        self.unjudged = 0  # slots that may depend on such a frame
        self.double = 0  # slots with two senders or more

    def slot(
        self,
        slot: int,
        frames: Mapping[int, bytes],
        unsent: Mapping[int, bytes] | None = None,
        unrecorded: Collection[int] = (),
    ) -> None:
        """A slot in which frames were sent.

        :param frames: the frames as they were on the air, by the sender's id.
        """
        if self._from is None:
            self._from = slot + self._window if slot else 0
        if self._ledger is not None:
            said = {agent: self._config.protocol_part(data, sealed=True) for agent, data in frames.items()}
            self._ledger.slot(slot, said)
            for agent, data in (unsent or {}).items():
                self._ledger.read(slot, agent, self._config.protocol_part(data))
            found, self._ledger.broken = self._ledger.broken, []
        else:
            found = self._turns(slot, frames)
        if unrecorded:
            self._known_from = slot + self._window
        if slot < self._from:
            return
        if found and slot < self._known_from:
            self.unjudged += 1
            return
        self.slots += 1
        self.frames += len(frames)
        self.double += len(frames) > 1
        self.broken += found

    def _turns(self, slot: int, frames: Mapping[int, bytes]) -> list[str]:
        """With a policy of fixed turns, who has sent out of turn; with others nobody can."""
        owner = slot % self._config.agents + 1
        if self._config.policy != "tdma":
            return []
        return [f"slot {slot}: agent {agent} sends in a turn of {owner}" for agent in frames if agent != owner]

    @property
    def knows_rules(self) -> bool:
        """Whether the policy has rules that frames alone can break."""
        return self._ledger is not None or self._config.policy == "tdma"

    def summary(self) -> dict[str, Any]:
        """What was found."""
        ledger = self._ledger
        shared = {} if ledger is None else {
            "two_senders_in_open_turns": ledger.open_collisions,
            "two_senders_in_adopted_turns": ledger.adopted_collisions,
            "two_senders_in_anchors_given_away": ledger.anchor_collisions,
            "two_senders_in_turns_handed_on": ledger.handed_collisions,
        }  # fmt: skip
        return {
            "slots_judged": self.slots,
            "slots_not_judged": self.unjudged,
            "frames_judged": self.frames,
            "slots_with_two_senders": self.double,
            **shared,
            "rules_broken": len(self.broken),
            "which": self.broken[:_TOLD],
        }
