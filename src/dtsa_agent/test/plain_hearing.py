"""What an agent makes of a datagram, in plain Python: what :mod:`dtsa_agent.air.hearing` has to come to."""

from __future__ import annotations

from typing import NamedTuple

from dtsa_agent.air.clock import OwnClock
from dtsa_agent.air.contacts import Contacts, limits_of
from dtsa_agent.air.datagram import NO_FRAME, OTHER_TIME, OWN_ID, REPEATED, Said, Wrapping
from dtsa_agent.air.delay import Delay, Peer
from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import decode_frame
from dtsa_agent.core.reference.timebase import ALIGNED, FOREIGN, LISTENING, RESTARTED, ClockAligner, TimeBase
from dtsa_agent.core.settings.config import SwarmConfig

NEAR_SLOTS = 8  # frames that are off by more are of another time
_DOUBTS = 9  # frames in a row that do not fit the time that an agent has


class SlotTime(TimeBase):
    """A :class:`TimeBase` that takes the time of its own group anew when it fits nobody's.

    The frame that an agent has taken its time from may have left late, by less than half a slot but more than the
    alignment believes. Slot numbers stay as they are then, and so does what is known about turns.
    A frame may be off its slot by ``trust_ns`` and still say what time it is.
    """

    def __init__(self, config: SwarmConfig, agent: int, trust_ns: int = 1_000_000) -> None:
        #: How often the time of the own group was taken anew.
        self.corrected = 0
        super().__init__(
            agents=config.agents,
            anchor_every=config.anchor_every,
            slot_ns=config.slot_ns,
            agent=agent,
            seed=config.seed,
            aligner=ClockAligner(limit_ns=trust_ns),
        )

    def hear(self, slot: int, start_ns: int) -> str:
        """As of :class:`TimeBase`."""
        outcome = super().hear(slot, start_ns)
        if outcome == ALIGNED and self.aligner.ignored_in_a_row >= _DOUBTS:
            self.aligner.reset()
            self.state = LISTENING  # for this frame
            super().hear(slot, start_ns)
            self.corrected += 1
        return outcome

    @property
    def corrections(self) -> int:
        """How often the own slots have been moved a little."""
        return self.aligner.corrections


class Taken(NamedTuple):
    """What has come of a datagram."""

    fault: str  # why it is not taken in, or an empty text
    restarted: bool = False  # its time was taken over: whatever was known about turns is void
    said: Said | None = None


class PlainHearing:
    """Slots and delays of one agent, by what it hears; ``flight_ns``: from order to arrival of a frame, as supposed."""

    def __init__(
        self,
        config: SwarmConfig,
        agent: int,
        wrapping: Wrapping,
        flight_ns: int,
        clock: OwnClock | None = None,
        trust_ns: int = 1_000_000,
    ) -> None:
        self._config, self._agent, self._wrapping, self._flight_ns = config, agent, wrapping, flight_ns
        self._clock = OwnClock() if clock is None else clock
        self.time = SlotTime(config, agent, trust_ns)
        self.delay = Delay(agent, config.slot_ns // 4, wrapping.peers)
        self.contacts = Contacts(config.agents, agent, limits_of(config, wrapping.peers), wrapping.peers)
        #: Frames of about the same time, and of these those that were off by more than a quarter of a slot.
        self.timed = self.off = 0
        self._last: dict[int, int] = {}  # slot of the last frame, by sender

    def take(self, data: bytes, arrival_ns: int) -> Taken:
        """Takes in a datagram; ``arrival_ns`` is of CLOCK_MONOTONIC."""
        said = self._wrapping.read(data)
        if said.fault:
            return Taken(said.fault)
        if not self._is_frame(said.frame):
            return Taken(NO_FRAME)
        if said.sender == self._agent:  # somebody else in the own name, or what was said there again
            return Taken(OWN_ID)
        if self._last.get(said.sender, -1) == said.slot and self.time.state != LISTENING:
            return Taken(REPEATED)
        began = self._clock.local_ns(arrival_ns) - self._flight_ns - said.late_ns
        before = self.time.slot_start_ns(said.slot)
        off = abs(began - self.delay.error_ns - before)
        if self.time.state != LISTENING and off <= NEAR_SLOTS * self._config.slot_ns:
            self.timed += 1
            self.off += off > self._config.slot_ns // 4
        outcome = self.time.hear(said.slot, began - self.delay.error_ns)
        if outcome == FOREIGN:
            self.contacts.see(said.sender, said.slot, self.time.slot(began) or 0)
            return Taken(OTHER_TIME)
        self._last[said.sender] = said.slot
        if outcome == RESTARTED:
            self.delay.reset()
            self.contacts.reset(said.slot)
        else:
            self.delay.hear(said.sender, began - before, said.peers)
            self.delay.moved(self.time.slot_start_ns(said.slot) - before)
        self.contacts.hear(said.sender, said.slot, said.frame, [peer for peer, _ in said.peers])
        return Taken("", outcome == RESTARTED, said)

    def tell(self, slot: int) -> tuple[Peer, ...]:
        """What the next datagram, sent in this slot, says of the others."""
        return self.delay.tell(lambda agent: self.contacts.hears(agent, slot))

    def _is_frame(self, frame: bytes) -> bool:
        """Whether bytes are a frame: nothing else may say what time it is. What holders of the key seal is one."""
        if self._config.auth:
            return True
        try:
            decode_frame(self._config.protocol_part(frame), self._config.extent_m)
        except RemoteProtocolError:
            return False
        return True
