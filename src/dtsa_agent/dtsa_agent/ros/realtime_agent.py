"""One agent in real time over ROS: a station whose datagrams travel as messages."""

from __future__ import annotations

import time
from collections.abc import Callable

from dtsa_agent.air.port import ClockMap
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.scenario import STREAM_CLOCKS, Scenario, generator
from dtsa_agent.core.station import Station, StationSettings
from dtsa_agent.core.swarm import PRESENT_LEAVING

_NEVER = 1 << 62


class RealtimeAgent:
    """A station, its clock, and a radio that sends when the slot begins what lies ready by then.

    All times but the station's own are ns on the channel's time line, from the start of slot 0.

    :param id: its id.
    :param config: the settings that all agents share.
    :param scenario: starts and goals.
    :param clock: its clock; CLOCK_MONOTONIC stands for the channel's time line.
    :param jitter_ns: standard deviation of the time of a single transmission.
    :param accepted: is told of each frame that the agent takes in: sender, its slot, the slot here.
    :param refused: is told why it does not take a frame in; empty: because of what is in it.
    """

    def __init__(
        self,
        id: int,
        config: SwarmConfig,
        scenario: Scenario,
        clock: ClockMap,
        jitter_ns: float,
        accepted: Callable[[int, int, int], None],
        refused: Callable[[str], None],
    ) -> None:
        self.id, self.clock = id, clock
        self.swarm = make_swarm(config, scenario, local=[id])
        self.slot = -1  # the present one
        self.start_ns = 0  # of its slot, or of the transmission in it
        self.frame = b""  # that it sends in this slot
        self.due_ns = _NEVER
        self._slot_ns, self._jitter_ns = config.slot_ns, jitter_ns
        self._random = generator(config.seed, STREAM_CLOCKS, id)
        self._accepted, self._refused = accepted, refused
        self._zero = self._start_ns = 0
        self._opened = False

    def begin(self, settings: StationSettings, zero: int) -> None:
        """From now on it takes part.

        :param zero: CLOCK_MONOTONIC at the start of slot 0, ns.
        """
        self._zero = zero
        self.due_ns = self._now()
        self.station = Station(self.swarm, settings, self.clock.local_ns(self.due_ns), None, self)

    def _now(self) -> int:
        return time.monotonic_ns() - self._zero

    @property
    def leaves(self) -> bool:
        """Whether it still has to say that it leaves."""
        return bool(self.swarm.present[0] == PRESENT_LEAVING)

    def receive(self, frame: bytes, arrival_ns: int) -> None:
        """A frame has arrived."""
        self.station.receive(frame, self.clock.local_ns(arrival_ns))
        self.due_ns = min(self.due_ns, self._now())

    def step(self) -> bool:
        """Does what is due now; True if it has opened a slot, and maybe sends a :attr:`frame` in it."""
        self._opened, shown = False, self.clock.local_ns(self._now())
        due, _ = self.station.step(shown)
        if self._opened:
            self._send()
            shown = self.clock.local_ns(self._now())
            # Not yet the next slot: this one comes first.
            due = self.station.step(shown)[0] if shown < self._start_ns else shown
        self.due_ns = self.clock.monotonic_ns(due)
        return self._opened

    def _send(self) -> None:
        """Hands over the frame that lies ready: its transmission begins with the slot, but for jitter, or now."""
        station, self.frame = self.station, b""
        self.slot = station.slot
        self._start_ns = station.slot_start_ns(self.slot)
        self.start_ns = self.clock.monotonic_ns(self._start_ns)
        if not self.swarm.frame_length[0]:
            return
        jitter = int(self._jitter_ns * self._random.standard_normal()) if self._jitter_ns else 0
        start = max(self.start_ns + jitter, self._now())
        late = max(0, start - self.start_ns)
        # So late that the next turn would be disturbed: the station keeps it back.
        sent_ns = self._start_ns + (self._slot_ns if late > self._slot_ns // 2 else late)
        _, self.frame = station.step(sent_ns)
        if self.frame:
            station.sent(sent_ns, True)
            self.start_ns = start

    # Events of the station.

    def opened(self, slot: int, start_ns: int, now_ns: int, is_first: bool) -> None:
        """A slot is open."""
        self._opened = True

    def restarted(self, slot: int) -> None:
        """It restarts: nothing to do here."""

    def heard(self, sender: int, slot: int, datagram: bytes, arrival_ns: int, accepted: bool) -> None:
        """A frame was heard in its slot."""
        if accepted:
            self._accepted(sender, slot, self.station.slot)
        else:
            self._refused("")

    def refused(self, fault: str, datagram: bytes, arrival_ns: int) -> None:
        """A frame was not accepted."""
        self._refused(fault)
