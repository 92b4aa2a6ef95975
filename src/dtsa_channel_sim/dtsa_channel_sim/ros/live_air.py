"""The air of a run in real time: frames are handed over ahead, and settled when they have left the air."""

from __future__ import annotations

from collections.abc import Sequence
from heapq import heappop, heappush

import numpy as np

from dtsa_channel_sim.model.air import NEVER, Air, FrameVerdict
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.medium import Positions
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS, Verdict

Sent = tuple[int, int]  # a frame: its slot as its sender counts, and the sender's id

_GRACE = 0.05  # of a slot: frames are handed over ahead of their start; who is late by less than this still collides
_WINDOW = 0.5  # of a slot: a frame that reaches the channel later than this after its start is dropped
_BEFORE = -(2**63)  # ns


class LiveAir:
    """One time line of frames: time is settled a little behind the clock, when all handed over in time is known.

    Times are ns from the start of slot 0, positions (3, N), m, frame map.
    """

    def __init__(self, channel: Channel) -> None:
        config = channel.config
        self.air: Air[Sent] = Air(channel)
        # A delivery may come no earlier than the frame arrives.
        self.hold_ns = max(round(_GRACE * config.slot_ns), config.airtime.from_radio_ns(0))
        self.late = 0  # frames that came when the air had been settled past their start, and were dropped
        self._window_ns = round(_WINDOW * config.slot_ns)
        self._frames: dict[Sent, bytes] = {}
        self._arriving: list[tuple[int, int, FrameVerdict[Sent]]] = []  # what lines still carry: a heap by arrival
        self._count = 0
        self._settled_ns = _BEFORE

    @property
    def waits(self) -> bool:
        """Whether a frame waits for its delivery."""
        return bool(self.air.pending or self._arriving)

    def holds(self, key: Sent) -> bool:
        """Whether a frame has been handed over, and has no verdict that was asked for yet."""
        return key in self._frames

    def hand_over(self, key: Sent, start_ns: int, data: bytes) -> bool:
        """Put a frame on the air at ``start_ns``; False: it came too late."""
        if not self.air.begin(key, key[1], start_ns, len(data)):
            self.late += 1
            return False
        self._frames[key] = data
        return True

    def settle(self, now: int, positions: Positions) -> list[FrameVerdict[Sent]]:
        """The verdicts on all frames that have arrived."""
        ripe, late = now - self.hold_ns, now - max(self.hold_ns, self._window_ns)
        while (due := self.air.due_ns) <= ripe:
            self._settle(due, positions)
        self._settle(late, positions)
        arrived = []
        while self._arriving and self._arriving[0][0] <= now:
            arrived.append(heappop(self._arriving)[2])
        return arrived

    def _settle(self, until_ns: int, positions: Positions) -> None:
        if until_ns <= self._settled_ns:
            return
        self._settled_ns = until_ns
        for verdict in self.air.settle(until_ns, positions):
            self._count += 1
            heappush(self._arriving, (verdict.arrival_ns, self._count, verdict))

    def frame(self, key: Sent) -> bytes:
        """The bytes of a frame that is or was on the air."""
        return self._frames[key]

    def forget(self, key: Sent) -> bytes:
        """The same, for the last time."""
        return self._frames.pop(key)

    def spare_ns(self, now: int, most_ns: int) -> int:
        """For how long there is nothing to do, ns, at most ``most_ns``."""
        arrival = self._arriving[0][0] if self._arriving else NEVER
        return min(max(0, min(self.air.due_ns + self.hold_ns, arrival) - now), most_ns)


def slot_verdict(settled: Sequence[FrameVerdict[Sent]]) -> Verdict:
    """What the air did in a slot, frame by frame."""
    if not settled:
        return Verdict(IDLE, (), None, None, None)
    return Verdict(
        COLLISION if any(verdict.collided for verdict in settled) else SUCCESS,
        tuple(verdict.sender for verdict in settled),
        np.array([verdict.received for verdict in settled]),
        tuple(verdict.lost for verdict in settled),
        tuple(verdict.collided for verdict in settled),
    )
