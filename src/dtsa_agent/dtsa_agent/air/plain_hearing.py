"""What an agent makes of a datagram, in plain Python: what :mod:`.hearing` has to come to, and what the tests ask."""

from __future__ import annotations

from typing import NamedTuple

from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import decode_frame
from dtsa_agent.core.reference.timebase import FOREIGN, LISTENING, RESTARTED
from dtsa_agent.core.settings.config import SwarmConfig

from .clock import OwnClock
from .datagram import NO_FRAME, OTHER_TIME, OWN_ID, REPEATED, Said, Wrapping
from .delay import Delay
from .slots import SlotTime


class Taken(NamedTuple):
    """What has come of a datagram."""

    fault: str  # why it is not taken in, or an empty text
    restarted: bool = False  # its time was taken over: whatever was known about turns is void
    said: Said | None = None


class PlainHearing:
    """Slots and delays of one agent, by what it hears.

    :param config: the settings that all agents share.
    :param agent: own id.
    :param wrapping: opens datagrams.
    :param flight_ns: ns, from the order to send a frame to its arrival, as supposed.
    :param clock: the own one.
    """

    def __init__(
        self, config: SwarmConfig, agent: int, wrapping: Wrapping, flight_ns: int, clock: OwnClock | None = None
    ) -> None:
        self._config, self._agent, self._wrapping, self._flight_ns = config, agent, wrapping, flight_ns
        self._clock = OwnClock() if clock is None else clock
        self.time = SlotTime(config, agent)
        self.delay = Delay(agent, config.slot_ns // 4, wrapping.peers)
        self._last: dict[int, int] = {}  # slot of the last frame, by sender

    def take(self, data: bytes, arrival_ns: int) -> Taken:
        """Takes in a datagram.

        :param data: the datagram.
        :param arrival_ns: ns, CLOCK_MONOTONIC.
        """
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
        outcome = self.time.hear(said.slot, began - self.delay.error_ns)
        if outcome == FOREIGN:
            return Taken(OTHER_TIME)
        self._last[said.sender] = said.slot
        if outcome == RESTARTED:
            self.delay.reset()
        else:
            self.delay.hear(said.sender, began - before, said.peers)
            self.delay.moved(self.time.slot_start_ns(said.slot) - before)
        return Taken("", outcome == RESTARTED, said)

    def _is_frame(self, frame: bytes) -> bool:
        """Whether bytes are a frame: nothing else may say what time it is. What holders of the key seal is one."""
        if self._config.auth:
            return True
        try:
            decode_frame(self._config.protocol_part(frame), self._config.extent_m)
        except RemoteProtocolError:
            return False
        return True
