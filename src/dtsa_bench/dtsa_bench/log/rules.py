"""Whether frames on the air are what the protocol allows: two senders in a slot, out of turn, turns given twice.

The rules are judged from frames alone, by an outside observer that shares no code with the agents that run: it knows
what was sent, not what was heard.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import decode_extended

OPEN = 255
_MAX_RULES_LISTED = 10
# Of slots with two senders: given to all who wake; given away by another than the owner; an anchor that its owner gave
# away before it restarted; a turn that a lessee handed on before it restarted. Any other is PLAIN.
COLLISIONS = {
    "open": "two_senders_in_open_turns", "adopted": "two_senders_in_adopted_turns",
    "anchor": "two_senders_in_anchors_given_away", "handed": "two_senders_in_turns_handed_on",
}  # fmt: skip
PLAIN = "plain"


@dataclass(slots=True)
class GrantedTurn:
    """A turn that was given away, and the agents that it was given to."""

    given: list[tuple[int, int]] = field(default_factory=list)  # issuer, lessee
    holders: set[int] = field(default_factory=set)  # named last, one for each that gave it away
    named: set[int] = field(default_factory=set)  # ever
    handed_on: dict[int, int] = field(default_factory=dict)  # slot in which an agent first handed it on

    def name(self, lessee: int) -> None:
        """Note that a frame names an agent for the turn."""
        self.holders.add(lessee)
        self.named.add(lessee)


@dataclass(slots=True)
class GrantLedger:
    """Who gave which turn to whom, and whether all kept to it.

    :param main_every: K M; 0: M.
    """

    agents: int
    anchor_every: int
    main_every: int = 0
    turns: dict[int, GrantedTurn] = field(default_factory=dict)
    quiet: dict[int, int] = field(default_factory=dict)  # last slot in which each was in probation
    collisions: Counter[str] = field(default_factory=Counter)  # slots with two senders, by a key of COLLISIONS or PLAIN
    leased_slots: int = 0
    broken: list[str] = field(default_factory=list)  # rules that were broken, in words

    _NEVER: ClassVar[int] = 2**62  # slot

    def _is_anchor(self, slot: int, every: int = 0) -> bool:
        """Whether nobody but its owner may give a slot away: (R + T mod N) mod M = 0."""
        return (slot // self.agents + slot % self.agents) % (every or self.anchor_every) == 0

    def _is_main(self, slot: int) -> bool:
        """Whether a slot is its owner's whatever happens."""
        return self._is_anchor(slot, self.main_every)

    def _turns_of_leases(self, slot: int, c_s: int, room: int) -> list[int]:
        """The turns that the lease bytes of a frame speak of, in order.

        T + j N - i for j = 1 .. K M, and within each j for i = c_s .. 0; anchors of others (i > 0) are left out, and of
        the sender's own turns (i = 0) those from its next main anchor on.
        """
        turns, own = [], True
        for j in range(1, (self.main_every or self.anchor_every) + 1):
            for i in range(c_s, -1, -1):
                turn = slot + j * self.agents - i
                own = own and not (i == 0 and self._is_main(turn))
                if not self._is_anchor(turn) if i > 0 else own:
                    turns.append(turn)
        return turns[:room]

    def check_slot(self, slot: int, frames: dict[int, bytes]) -> None:
        """Takes in one slot."""
        turn, owner = self.turns.pop(slot, GrantedTurn()), slot % self.agents + 1
        is_open = any(lessee == OPEN for _, lessee in turn.given)
        adopted = any(issuer != owner for issuer, _ in turn.given)
        self.leased_slots += bool(turn.given) and not is_open and not adopted
        if len(frames) > 1:
            cause = (
                "open" if is_open else "adopted" if adopted
                else "anchor" if self._is_reclaimed(slot, frames.get(owner))
                else "handed" if any(self._has_forgotten(turn, sender) for sender in frames) else PLAIN
            )  # fmt: skip
            self.collisions[cause] += 1
            if cause == PLAIN:
                to = f"given {turn.given}, by now to {turn.holders}"
                self.broken.append(f"slot {slot}: senders {sorted(frames)}, {to}")
        for sender, data in frames.items():
            self._check_sender(slot, sender, data, turn)
            self.note_frame(slot, sender, data)

    def _is_reclaimed(self, slot: int, data: bytes | None) -> bool:
        """Whether the owner sends in an anchor, no main one, in probation: it may have given it away before."""
        if data is None or not self._is_anchor(slot) or self._is_main(slot):
            return False
        try:
            return decode_extended(data).probation
        except RemoteProtocolError:  # as `note_frame` says
            return False

    def _has_forgotten(self, turn: GrantedTurn, sender: int) -> bool:
        """Whether a sender handed the turn on before it restarted: what others relay may be all that it knows."""
        return self.quiet.get(sender, -1) > turn.handed_on.get(sender, self._NEVER)

    def _check_sender(self, slot: int, sender: int, data: bytes, turn: GrantedTurn) -> None:
        last, owner = turn.holders, slot % self.agents + 1
        if sender in last or OPEN in last or self._has_forgotten(turn, sender):
            return
        if sender != owner:
            self.broken.append(f"slot {slot}: agent {sender} sends in a turn of {owner} given to {sorted(last)}")
        elif any(issuer == owner for issuer, _ in turn.given) and not self._is_reclaimed(slot, data):
            self.broken.append(f"slot {slot}: owner {owner} sends in a turn that it gave to {sorted(last)}")

    def note_frame(self, slot: int, sender: int, data: bytes) -> None:
        """Takes note of what a frame gives away, whether or not it got on the air."""
        try:
            frame = decode_extended(data)
        except RemoteProtocolError as error:
            self.broken.append(f"slot {slot}: agent {sender} sent a frame that is none: {error}")
            return
        if frame.probation:
            self.quiet[sender] = slot
        if frame.c_s and (frame.probation or frame.leaving):
            self.broken.append(f"slot {slot}: agent {sender} claims others dead in probation, or as it leaves")
        leases = frame.leases
        if leases and slot % self.agents != sender - 1:
            self.broken.append(f"slot {slot}: agent {sender} gives turns away in another agent's turn")
        for number, lessee in zip(self._turns_of_leases(slot, frame.c_s, len(leases)), leases, strict=False):
            if not lessee:
                continue
            if self._is_main(number) or number <= slot:
                self.broken.append(f"slot {slot}: agent {sender} gives away turn {number}")
            turn = self.turns.setdefault(number, GrantedTurn())
            is_again = any(issuer == sender for issuer, _ in turn.given)
            if is_again and lessee in turn.named:
                continue
            if is_again and sender == number % self.agents + 1:
                self.broken.append(f"slot {slot}: agent {sender} gives turn {number} away a second time")
            turn.given.append((sender, lessee))
            turn.name(lessee)
        for ahead, lessee in (*frame.relay, *((far, frame.far_lessee) for far in frame.far)):
            self._hand_on(slot, sender, slot + ahead, lessee)

    def _hand_on(self, slot: int, sender: int, turn: int, lessee: int) -> None:
        """Whose turn it is names another agent for it; everybody else only relays.

        An agent that does not know yet that it was named relays an earlier holder. That one takes the turn again, so it
        counts as handing on.
        """
        given = self.turns.get(turn)
        if given is None or sender not in given.holders or lessee in given.holders:
            return
        if lessee in (OPEN, turn % self.agents + 1) or self._is_main(turn):
            if lessee not in given.named:  # else a relay of another one that gave it away
                self.broken.append(f"slot {slot}: agent {sender} hands turn {turn} on to {lessee}")
            return
        given.holders.remove(sender)
        given.name(lessee)
        given.handed_on.setdefault(sender, slot)


class RuleChecker:
    """Reads the frames of a swarm slot by slot.

    What was given away before it began it cannot know: unless it begins with slot 0, it only listens for as long as
    leases reach.
    """

    def __init__(self, config: SwarmConfig) -> None:
        self._config = config
        rounds = config.anchor_every, config.main_every
        self._ledger = GrantLedger(config.agents, *rounds) if config.policy == "lease" else None
        self._window = (config.main_every + 2) * config.agents if self._ledger else 0
        self._from: int | None = None  # slot
        self.broken: list[str] = []
        self._known_from = 0  # slot from which on no turn depends on a frame that nobody has recorded
        self.slots = self.frames = 0
        self.unchecked = 0  # slots that may depend on such a frame
        self.double_slots = 0  # slots with two senders or more

    def restart(self) -> None:
        """Forget what was given away: the swarm was started again, and counts its slots anew."""
        self._from, self._known_from = None, 0
        if self._ledger is not None:
            self._ledger.turns.clear()
            self._ledger.quiet.clear()

    def check_slot(
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
            self._ledger.check_slot(slot, said)
            for agent, data in (unsent or {}).items():
                self._ledger.note_frame(slot, agent, self._config.protocol_part(data))
            found, self._ledger.broken = self._ledger.broken, []
        else:  # in fixed turns
            owner, fixed = slot % self._config.agents + 1, self._config.policy == "tdma"
            others = [agent for agent in frames if fixed and agent != owner]
            found = [f"slot {slot}: agent {agent} sends in a turn of {owner}" for agent in others]
        if unrecorded:
            self._known_from = slot + self._window
        if slot < self._from:
            return
        if found and slot < self._known_from:
            self.unchecked += 1
            return
        self.slots += 1
        self.frames += len(frames)
        self.double_slots += len(frames) > 1
        self.broken += found

    @property
    def has_rules(self) -> bool:
        """Whether the policy has rules that frames alone can break."""
        return self._ledger is not None or self._config.policy == "tdma"

    def summary(self) -> dict[str, Any]:
        """What was found."""
        counts = self._ledger.collisions if self._ledger is not None else None
        return {
            "slots_judged": self.slots,
            "slots_not_judged": self.unchecked,
            "frames_judged": self.frames,
            "slots_with_two_senders": self.double_slots,
            **({name: counts[cause] for cause, name in COLLISIONS.items()} if counts is not None else {}),
            "rules_broken": len(self.broken),
            "which": self.broken[:_MAX_RULES_LISTED],
        }
