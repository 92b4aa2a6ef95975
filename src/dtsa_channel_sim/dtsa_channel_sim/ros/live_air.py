"""The air of a channel in real time, and whether the channel keeps up with it.

Times are ns from the start of slot 0; positions are (3, N), m, frame map.
"""

from __future__ import annotations

from dtsa_agent.core.delays import Delays
from dtsa_channel_sim.model.air import NEVER, Air, Arrivals, FrameVerdict
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.medium import Positions

_NS = 1_000_000_000
_GRACE = 0.05  # of a slot: frames are handed over ahead of their start; one that is late by less still collides
_WINDOW = 0.5  # of a slot: a frame that reaches the channel later than this after its start is dropped
_STALL_SLOTS, _STALL_NS = 5, 50_000_000
_MOST_STALLS = 1000  # kept one by one; later ones are only counted
_BEHIND_NS, _TOO_LONG_NS = 1 * _NS, 8 * _NS  # a run that is that far behind for that long will not catch up

SentFrame = tuple[int, int]  # a frame: its slot as its sender counts, and the sender's id


class Pace:
    """Whether the channel keeps up with its time line, by the passes of its loop: how late it is, when it stalled."""

    def __init__(self, slot_ns: int) -> None:
        self._stall_ns = max(_STALL_SLOTS * slot_ns, _STALL_NS)
        self.lag = Delays()  # from when a frame could have been delivered to when it was
        self.stalls: list[tuple[int, int]] = []  # from, to
        self.stall_count = self._last_ns = 0
        self._behind_since_ns: int | None = None

    def passed(self, now_ns: int) -> tuple[int, int] | None:
        """The next pass begins; return from when to when the channel stood still before it, ns; None: it did not."""
        gap, self._last_ns = (self._last_ns, now_ns), now_ns
        if now_ns - gap[0] < self._stall_ns:
            return None
        self.stall_count += 1
        if len(self.stalls) < _MOST_STALLS:
            self.stalls.append(gap)
        return gap

    def falls_behind(self, now_ns: int, done_ns: int) -> bool:
        """Whether a run that should have come to ``done_ns`` by now is too far behind for too long to catch up."""
        if now_ns - done_ns < _BEHIND_NS:
            self._behind_since_ns = None
            return False
        if self._behind_since_ns is None:
            self._behind_since_ns = now_ns
        return now_ns - self._behind_since_ns > _TOO_LONG_NS

    @property
    def behind_since_s(self) -> float:
        """Since when the run has been behind, s from the start of slot 0."""
        return (self._behind_since_ns or 0) / _NS


class LiveAir(Air[SentFrame]):
    """One time line of frames: time is settled a little behind the clock, when all handed over in time is known."""

    def __init__(self, channel: Channel) -> None:
        super().__init__(channel)
        config = channel.config
        # A delivery may come no earlier than the frame arrives.
        self.hold_ns = max(round(_GRACE * config.slot_ns), config.airtime.from_radio_ns(0))
        self._window_ns = max(self.hold_ns, round(_WINDOW * config.slot_ns))
        self.frames: dict[SentFrame, bytes] = {}  # that are or were on the air, until their slot is closed
        self._arriving = Arrivals()  # verdicts on frames that are on lines

    @property
    def waits(self) -> bool:
        """Whether a frame waits for its delivery."""
        return self.pending > 0 or self._arriving.next_ns < NEVER

    def hand_over(self, key: SentFrame, start_ns: int, data: bytes) -> bool:
        """Put a frame on the air; return False if it is there already, or came too late: no agent hears it."""
        if key in self.frames or not self.begin(key, key[1], start_ns, len(data)):
            return False
        self.frames[key] = data
        return True

    def pop_arrived(self, now: int, positions: Positions) -> list[FrameVerdict[SentFrame]]:
        """Return the verdicts on all frames that have arrived."""
        while (due := self.due_ns) <= now - self.hold_ns:
            self._resolve_until(due, positions)
        self._resolve_until(now - self._window_ns, positions)
        return self._arriving.pop(now)

    def _resolve_until(self, until_ns: int, positions: Positions) -> None:
        for verdict in self.resolve(until_ns, positions):
            self._arriving.add(verdict.arrival_ns, verdict)

    def spare_ns(self, now: int, most_ns: int) -> int:
        """Return for how long there is nothing to do, ns, at most ``most_ns``."""
        return min(max(0, min(self.due_ns + self.hold_ns, self._arriving.next_ns) - now), most_ns)
