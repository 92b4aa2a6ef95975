"""All frames of a flight on one time line, with what became of each: for flights that are checked, not flown again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.ros.common.names import agent_names
from dtsa_bench.log.arrays import FlightArrays, ReceivedFrames
from dtsa_channel_sim import Air, Channel, ChannelConfig, FrameVerdict, OnAir, Reception

from .result import Mismatch

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


class _RecordedMedium:
    """A medium in which frames, in the order of their starts, are received by the agents that a log names."""

    def __init__(self, config: ChannelConfig, sender: Ints, received: Mask) -> None:
        self.config = config
        self._next = {agent: iter(received[sender == agent]) for agent in set(sender.tolist())}

    def medium(self, slot: int) -> _RecordedMedium:
        return self

    def advance(self, slot: int) -> None:
        pass

    def resolve(self, slot: int, frame: OnAir, others: Any, positions: Any = None) -> Reception:
        return Reception(next(self._next[frame.sender]), 0, 0)


@dataclass(slots=True)
class FramesOnAir:
    """The frames of a flight, in order of slot and sender (F), and what became of them."""

    config: ChannelConfig
    slot: Ints  # (F,) as the senders count
    sender: Ints  # (F,) ids
    length: Ints  # (F,) bytes
    received: Mask  # (F, N)
    lost: Ints  # (F,) receivers
    collided: Ints  # (F,) receivers
    asked_ns: Ints  # (F,) for when each sender handed its frame to its radio
    own_clocks: bool = True  # frames start when their sender's clock says so; otherwise with their slot
    positions: NDArray[np.float64] | None = None  # (S, 3, N) m, at the start of each slot
    start_ns: Ints = field(init=False)  # (F,) when the radio turned to sending
    end_ns: Ints = field(init=False)  # (F,)
    arrival_ns: Ints = field(init=False)  # (F,) when the last of the receivers had it

    def __post_init__(self) -> None:
        airtime, lengths = self.config.airtime, self.length.tolist()
        on_air_ns = np.array([airtime.total_ns(length) for length in lengths], np.int64)
        hand_over_ns = np.array([airtime.from_radio_ns(length) for length in lengths], np.int64)
        self.start_ns, self.end_ns = self.asked_ns, self.asked_ns + on_air_ns
        self.arrival_ns = self.end_ns + hand_over_ns
        if self.own_clocks and airtime.line.serial:  # radios hand over one reception after the other
            order = np.argsort(self.asked_ns, kind="stable")
            medium = _RecordedMedium(self.config, self.sender[order], self.received[order])
            self.start_ns = self.start_ns.copy()
            for verdict in self._resolve(medium):
                self.start_ns[verdict.frame_id], self.arrival_ns[verdict.frame_id] = (
                    verdict.start_ns,
                    verdict.arrival_ns,
                )
            self.end_ns = self.start_ns + on_air_ns

    @classmethod
    def of_log(cls, log: FlightArrays, config: ChannelConfig, own_clocks: bool) -> FramesOnAir:
        """The frames of a log."""
        row, sender, data, received, lost, collided = log.sent_frames
        asked_ns = row * log.slot_ns + (0 if log.sent_ns is None else log.sent_ns[row, sender - 1])
        length = np.array([len(frame) for frame in data], np.int64)
        return cls(config, row, sender, length, received, lost, collided, asked_ns, own_clocks, log.track[:, -1])

    def check_numbers(self) -> None:
        """Whether verdicts can be.

        :raises Mismatch: at the first that cannot.
        """
        most = self.config.agents - 1
        itself = self.received[np.arange(len(self.sender)), self.sender - 1]
        for wrong, what, expected, why in (
            (itself, "received", "others only", "no agent hears itself"),
            (self.received.sum(axis=1) + self.lost + self.collided > most, "received, lost, collided",
             f"at most {most} receivers", "each counts once"),
        ):  # fmt: skip
            for k in np.flatnonzero(wrong)[:1].tolist():
                raise self._mismatch(what, expected, "more", why, k)

    def _overlapping(self) -> tuple[Ints, Ints]:
        """Pairs of frames of which the second begins before the first has ended."""
        order = np.argsort(self.start_ns, kind="stable")
        pairs, apart = [(order[:0], order[:0])], 1
        while apart < len(order):
            meet = self.end_ns[order[:-apart]] > self.start_ns[order[apart:]]
            if not meet.any():  # then none that are farther apart do
                break
            pairs.append((order[:-apart][meet], order[apart:][meet]))
            apart += 1
        first, second = zip(*pairs, strict=True)
        return np.concatenate(first), np.concatenate(second)

    def check_overlaps(self) -> int:
        """Check that no agent has heard two frames at one time, or while it sent; return the overlapping pairs.

        :raises Mismatch: at the first frame for which that is not so.
        """
        first, second = self._overlapping()
        air_ns = self.start_ns + self.config.airtime.ramp_up_ns
        overlap = air_ns[second] < self.end_ns[first]
        both = self.received[first] & self.received[second] & overlap[:, None]
        for k in np.flatnonzero(both.any(axis=1))[:1].tolist():
            why = f"it was on air together with a frame of cf{self.sender[first[k]]}"
            raise self._mismatch("received", "one of two frames at most", f"both at {_ids(both[k])}", why, second[k])
        for deaf, other in ((first, second), (second, first)):
            hears = (air_ns[other] < self.end_ns[deaf]) & self.received[other, self.sender[deaf] - 1]
            for k in np.flatnonzero(hears)[:1].tolist():
                expected, recorded = f"without cf{self.sender[deaf[k]]}", _ids(self.received[other[k]])
                raise self._mismatch("received", expected, recorded, "a sender does not hear", other[k])
        return int(overlap.sum())

    def resolve_again(
        self, changes: Mapping[int, dict[str, Any]], until_ns: int | None = None
    ) -> tuple[Mask, Ints, Ints, int]:
        """Make all verdicts again from the frames, their times and the channel's seed: received, lost, collided.

        :param changes: of the channel's settings, by the first slot in which they hold.
        :param until_ns: leave those on frames that have not left the air by then as they are; None: none.
        :returns: the arrays, and how many verdicts were made again.
        """
        channel = Channel(self.config)
        for slot, values in changes.items():
            channel.set(slot=slot, **values)
        received, lost, collided = self.received.copy(), self.lost.copy(), self.collided.copy()
        if self.own_clocks:
            for verdict in self._resolve(channel):
                k = verdict.frame_id
                received[k], lost[k], collided[k] = verdict.received, verdict.lost, verdict.collided
        else:
            edges = np.flatnonzero(np.diff(self.slot, prepend=-1, append=-1)).tolist()
            for a, b in zip(edges, edges[1:], strict=False):
                slot = int(self.slot[a])
                positions = None if self.positions is None else self.positions[slot]
                verdict = channel.arbitrate(slot, self.sender[a:b].tolist(), self.length[a:b].tolist(), positions)
                received[a:b], lost[a:b], collided[a:b] = (
                    verdict.mask(self.config.agents),
                    verdict.lost or 0,
                    verdict.collided or 0,
                )
        late = np.zeros(len(lost), np.bool_) if until_ns is None else self.end_ns > until_ns
        received[late], lost[late], collided[late] = self.received[late], self.lost[late], self.collided[late]
        return received, lost, collided, int((~late).sum())

    def _resolve(self, media: Any) -> list[FrameVerdict[int]]:
        """The verdicts on all frames on one time line."""
        air, verdicts = Air[int](media), list[FrameVerdict[int]]()
        for k in np.argsort(self.asked_ns, kind="stable").tolist():
            air.begin(k, int(self.sender[k]), int(self.asked_ns[k]), int(self.length[k]))
        while air.pending:
            verdicts += air.resolve(air.due_ns)
        return verdicts

    def check_received(self, heard: ReceivedFrames, slots: int) -> tuple[int, dict[str, Any]]:
        """Whether agents took in what was delivered to them, once, and not before it was.

        :param slots: how many the log has.
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
            expected, why = (
                "not yet taken in" if repeated[k] else "not delivered",
                "an agent takes in what was delivered to it, once",
            )
            at = frames[k]
            raise Mismatch(
                "heard_by", expected, f"taken in: cf{self.sender[at]}", why, int(self.slot[at]), int(column[k]) + 1
            )
        delay_ns = heard.time_ns[within] - self.arrival_ns[frame[within]]
        for k in np.flatnonzero(delay_ns < 0)[:1].tolist():
            at, time_ns = frame[within][k], heard.time_ns[within][k]
            why = "no agent hears a frame before it has arrived"
            raise self._mismatch("heard_ns", f"at least {self.arrival_ns[at]} ns", f"{time_ns} ns", why, at)
        delays_ms = (heard.time_ns[entry] - self.arrival_ns[frames]) / 1e6
        shares = np.quantile(delays_ms, (0.5, 0.99, 1.0), method="inverted_cdf").tolist() if len(entry) else [None] * 3
        names = "delivery_p50_ms", "delivery_p99_ms", "delivery_max_ms"
        missing = int(self.received.sum()) - len(entry)
        return len(entry), dict(zip(names, shares, strict=True)) | {"deliveries_not_taken_in": missing}

    def _mismatch(self, what: str, expected: str, recorded: str, why: str, frame: Any) -> Mismatch:
        return Mismatch(what, expected, recorded, why, int(self.slot[frame]), int(self.sender[frame]))


def _ids(mask: Mask) -> str:
    return agent_names((np.flatnonzero(mask) + 1).tolist())
