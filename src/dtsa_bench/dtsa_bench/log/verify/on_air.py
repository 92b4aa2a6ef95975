"""All frames of a flight on one time line, with what became of each: for flights that are checked, not flown again."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_bench.log.arrays import ReceivedFrames, SentFrames
from dtsa_channel_sim import Air, Channel, ChannelConfig, FrameVerdict, OnAir, Reception

from .result import Mismatch

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


class _RecordedMedium:
    """A medium in which frames are received by whom a log says."""

    def __init__(self, frames: FramesOnAir) -> None:
        self.config = frames.config
        self._next: list[deque[Mask]] = [deque() for _ in range(self.config.agents + 1)]  # by sender
        for k in np.argsort(frames.asked_ns, kind="stable").tolist():
            self._next[frames.sender[k]].append(frames.received[k])

    def medium(self, slot: int) -> _RecordedMedium:
        return self

    def advance(self, slot: int) -> None:
        pass

    def resolve(self, slot: int, frame: OnAir, others: Sequence[OnAir], positions: Any = None) -> Reception:
        return Reception(self._next[frame.sender].popleft(), 0, 0)


class FramesOnAir:
    """The frames of a flight whose agents have clocks of their own (F), and what became of them.

    :param frames: in order of slot and sender; slots are those that the senders count.
    :param asked_ns: (F,) for when each sender handed its frame to its radio.
    """

    def __init__(self, config: ChannelConfig, frames: SentFrames, asked_ns: Ints) -> None:
        self.config, self.asked_ns = config, asked_ns
        self.slot, self.sender, data, self.received, self.lost, self.collided = frames
        lengths, airtime = [len(frame) for frame in data], config.airtime
        self._length = np.array(lengths, np.int64)
        for k in np.flatnonzero(self._length > airtime.longest)[:1].tolist():
            values = f"{airtime.longest} bytes at most", f"{lengths[k]} bytes"
            raise Mismatch("length", *values, "the radio takes no longer ones", int(self.slot[k]), int(self.sender[k]))
        # Without other frames; `resolve_again` and `find_times` add those that a radio has to hand over before.
        #: (F,) of the transmission.
        self.end_ns = asked_ns + np.array([airtime.total_ns(length) for length in lengths], np.int64)
        #: (F,) when the last of the receivers had it.
        self.arrival_ns = self.end_ns + np.array([airtime.from_radio_ns(length) for length in lengths], np.int64)

    def resolve_again(
        self, changes: Mapping[int, dict[str, Any]], until_ns: int = 1 << 62
    ) -> tuple[Mask, Ints, Ints, int]:
        """Make all verdicts again from the frames, their times and the channel's seed: received, lost, collided.

        :param changes: of the channel's settings, by the first slot in which they hold.
        :param until_ns: verdicts on frames that have not left the air by then stay as they are.
        :returns: the arrays, and how many verdicts were made again.
        """
        channel, count = Channel(self.config), 0
        for slot, values in changes.items():
            channel.set(slot=slot, **values)
        received, lost, collided = self.received.copy(), self.lost.copy(), self.collided.copy()
        for v in self._on_one_line(channel):
            if v.end_ns <= until_ns:
                k = v.frame_id
                received[k], lost[k], collided[k], count = v.received, v.lost, v.collided, count + 1
        return received, lost, collided, count

    def _on_one_line(self, media: Any) -> Iterator[FrameVerdict[int]]:
        """The verdicts on all frames on one time line; they say when each frame has left and arrived."""
        air = Air[int](media)
        for k in np.argsort(self.asked_ns, kind="stable").tolist():
            air.begin(k, int(self.sender[k]), int(self.asked_ns[k]), int(self._length[k]))
        while air.pending:
            for verdict in air.resolve(air.due_ns):
                k = verdict.frame_id
                self.end_ns[k], self.arrival_ns[k] = verdict.end_ns, verdict.arrival_ns
                yield verdict

    def find_times(self) -> None:
        """Find when frames left and arrived, by who received which, where verdicts cannot be made again."""
        for _ in self._on_one_line(_RecordedMedium(self)):
            pass

    def check_numbers(self) -> None:
        """Whether each receiver of a frame counts once, and its sender not at all, where verdicts cannot be made again.

        :raises Mismatch: at the first frame for which that is not so.
        """
        most = self.config.agents - 1
        for k in np.flatnonzero(self.received[np.arange(len(self.sender)), self.sender - 1])[:1].tolist():
            sender = int(self.sender[k])
            values = "others only", f"cf{sender}"
            raise Mismatch("received", *values, "no agent hears itself", int(self.slot[k]), sender)
        count = self.received.sum(axis=1) + self.lost + self.collided
        for k in np.flatnonzero(count > most)[:1].tolist():
            values = f"{most} receivers at most", f"{count[k]}"
            at = int(self.slot[k]), int(self.sender[k])
            raise Mismatch("received, lost, collided", *values, "each counts once", *at)

    def check_overlaps(self) -> None:
        """Whether agents received no two frames at one time, and none while they sent, by the times that were found.

        :raises Mismatch: at the first frame for which that is not so.
        """
        on_air_ns = np.array([self.config.airtime.on_air_ns(length) for length in self._length.tolist()], np.int64)
        for agent in range(1, self.config.agents + 1):
            own = self.sender == agent
            # It is deaf from the order to send on.
            begin_ns = self.end_ns - on_air_ns - self.config.airtime.ramp_up_ns * own
            frames = np.flatnonzero(own | self.received[:, agent - 1])
            frames = frames[np.argsort(begin_ns[frames], kind="stable")]
            before, after = frames[:-1], frames[1:]
            overlap = (begin_ns[after] < self.end_ns[before]) & ~(own[before] & own[after])
            for one, other in zip(before[overlap][:1].tolist(), after[overlap][:1].tolist(), strict=True):
                heard = one if own[other] else other
                why = f"it was on the air together with a frame of cf{self.sender[one + other - heard]}"
                at = int(self.slot[heard]), int(self.sender[heard])
                raise Mismatch("received", f"without cf{agent}", f"cf{agent}", why, *at)

    def check_received(
        self, heard: ReceivedFrames, slots: int, reached: NDArray[np.bool_]
    ) -> tuple[int, dict[str, Any]]:
        """Whether agents took in what was delivered to them, once, and not before it was.

        :param slots: how many the log has.
        :param reached: (F, N) receivers that were there.
        :returns: how many receivers and frames there were, and how long after their arrival frames were taken in, ms.
        :raises Mismatch: at the first entry for which that is not so.
        """
        agents, place = self.config.agents, np.full((slots, self.config.agents + 1), -1)
        place[self.slot, self.sender] = np.arange(len(self.slot))
        within = heard.slot < slots  # a frame of a slot that is in no record is not known
        sender = np.where(heard.sender <= agents, heard.sender, 0)
        frame = place[np.where(within, heard.slot, 0), sender] if slots else np.full(len(sender), -1)
        for k in np.flatnonzero(within & (frame < 0))[:1].tolist():
            why = "no agent hears a frame that was not sent"
            raise Mismatch("heard_sender", "a frame that was sent", f"cf{heard.sender[k]}", why, int(heard.slot[k]))
        entry, column = np.nonzero(heard.receivers & within[:, None])
        frames = frame[entry]
        repeated = np.ones(len(entry), np.bool_)
        repeated[np.unique(frames * agents + column, return_index=True)[1]] = False
        for k in np.flatnonzero(repeated | ~self.received[frames, column])[:1].tolist():
            expected, slot = "not yet taken in" if repeated[k] else "not delivered", int(self.slot[frames[k]])
            why = "an agent takes in what was delivered to it, once"
            raise Mismatch("heard_by", expected, f"taken in: cf{self.sender[frames[k]]}", why, slot, int(column[k]) + 1)
        frame, time_ns = frame[within], heard.time_ns[within]
        for k in np.flatnonzero(time_ns < self.arrival_ns[frame])[:1].tolist():
            values = f"at least {self.arrival_ns[frame[k]]} ns", f"{time_ns[k]} ns"
            at = int(self.slot[frame[k]]), int(self.sender[frame[k]])
            raise Mismatch("heard_ns", *values, "no agent hears a frame before it has arrived", *at)
        delays_ms = (heard.time_ns[entry] - self.arrival_ns[frames]) / 1e6
        shares = np.quantile(delays_ms, (0.5, 0.99, 1.0), method="inverted_cdf").tolist() if len(entry) else [None] * 3
        names = "delivery_p50_ms", "delivery_p99_ms", "delivery_max_ms"
        missing = int(reached.sum()) - int(reached[frames, column].sum())
        return len(entry), dict(zip(names, shares, strict=True)) | {"deliveries_not_taken_in": missing}
