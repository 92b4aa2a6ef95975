"""An outside observer that reads every frame of policy ``lease`` and holds the agents to the protocol's rules.

It knows what was sent, not what was heard, and shares no code with the agents that run: what an anchor is, and which
turns a frame's lease bytes speak of, it asks the specification.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame_extended import decode_extended
from dtsa_agent.core.reference.lease.memory import Memory
from dtsa_agent.core.reference.rules import Rules

OPEN = 255


@dataclass(slots=True)
class Ledger:
    """Who gave which turn to whom, and whether all kept to it.

    :param agents: number of agents N.
    :param anchor_every: M.
    :param main_every: K M; 0: M.
    """

    agents: int
    anchor_every: int
    main_every: int = 0
    issued: dict[int, list[tuple[int, int]]] = field(default_factory=dict)  # turn -> (issuer, lessee)
    open_collisions: int = 0  # slots with two senders that had been given to all who wake
    adopted_collisions: int = 0  # slots with two senders, given away by somebody other than their owner
    anchor_collisions: int = 0  # ... in an anchor that its owner gave away before it restarted
    plain_collisions: int = 0  # any other slot with two senders
    open_slots: int = 0
    adopted_slots: int = 0
    leased_slots: int = 0
    broken: list[str] = field(default_factory=list)  # rules that were broken, in words
    _rules: Memory = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        main = self.main_every or self.anchor_every
        self._rules = Memory(Rules(agents=self.agents, slot_s=1.0, anchor_every=self.anchor_every, main_every=main))

    def slot(self, slot: int, frames: dict[int, bytes]) -> None:
        """Takes in one slot.

        :param slot: its number; slots come in order.
        :param frames: the frames of all senders, by id.
        """
        given = self.issued.pop(slot, [])
        owner = slot % self.agents + 1
        is_open = any(lessee == OPEN for _, lessee in given)
        adopted = any(issuer != owner for issuer, _ in given)
        self.open_slots += is_open
        self.adopted_slots += adopted and not is_open
        self.leased_slots += bool(given) and not is_open and not adopted
        if len(frames) > 1:
            self.open_collisions += is_open
            self.adopted_collisions += adopted and not is_open
            taken_back = not is_open and not adopted and self._taken_back(slot, frames.get(owner))
            self.anchor_collisions += taken_back
            self.plain_collisions += not is_open and not adopted and not taken_back
            if not is_open and not adopted and not taken_back:
                self.broken.append(f"slot {slot}: senders {sorted(frames)}, given {given}")
        for sender, data in frames.items():
            self._check_sender(slot, sender, owner, given, data)
            self.read(slot, sender, data)

    def _taken_back(self, slot: int, data: bytes | None) -> bool:
        """Whether the owner sends in an anchor, no main one, in probation: it may have given it away before."""
        if data is None or not self._rules.is_anchor(slot) or self._rules.is_main(slot):
            return False
        return decode_extended(data).probation

    def _check_sender(self, slot: int, sender: int, owner: int, given: list[tuple[int, int]], data: bytes) -> None:
        lessees = {lessee for _, lessee in given}
        if sender in lessees or OPEN in lessees:
            return
        if sender != owner:
            self.broken.append(f"slot {slot}: agent {sender} sends in a turn of {owner} given to {sorted(lessees)}")
        elif any(issuer == owner for issuer, _ in given) and not self._taken_back(slot, data):
            self.broken.append(f"slot {slot}: owner {owner} sends in a turn that it gave to {sorted(lessees)}")

    def read(self, slot: int, sender: int, data: bytes) -> None:
        """Takes note of what a frame gives away, whether or not it got on the air.

        :param slot: in which it was made.
        :param sender: id.
        :param data: the frame.
        """
        try:
            frame = decode_extended(data)
        except RemoteProtocolError as error:
            self.broken.append(f"slot {slot}: agent {sender} sent a frame that is none: {error}")
            return
        leases = frame.leases
        if leases and slot % self.agents != sender - 1:
            self.broken.append(f"slot {slot}: agent {sender} gives turns away in somebody else's turn")
        for turn, lessee in zip(self._rules.turns_of_leases(slot, frame.c_s, len(leases)), leases, strict=False):
            if not lessee:
                continue
            owner = turn % self.agents + 1
            if self._rules.is_main(turn) or turn <= slot:
                self.broken.append(f"slot {slot}: agent {sender} gives away turn {turn}")
            entries = self.issued.setdefault(turn, [])
            if sender == owner and any(i == owner and other != lessee for i, other in entries):
                self.broken.append(f"slot {slot}: agent {sender} gives turn {turn} away a second time")
            if (sender, lessee) not in entries:
                entries.append((sender, lessee))
