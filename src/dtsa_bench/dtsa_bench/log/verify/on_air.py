"""All frames of a flight on one time line, with what became of each: for flights that are checked, not flown again."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.delays import Delays
from dtsa_agent.ros.common.names import agent_names
from dtsa_channel_sim import Air, Channel, ChannelConfig, FrameVerdict, OnAir, Reception

from dtsa_bench.log.arrays import FlightArrays, ReceivedFrames
from .result import Difference, Mismatch

Mask = NDArray[np.bool_]


@dataclass(slots=True)
class SentFrame:
    """One frame."""

    slot: int  # as its sender counts
    on_air: OnAir
    data: bytes
    asked_ns: int  # for when its sender handed it to its radio
    arrival_ns: int  # when the last of its receivers had it
    verdict: tuple[Mask, int, int]  # (N,) received, lost, collided

    @property
    def sender(self) -> int:
        """Its id."""
        return self.on_air.sender

    @property
    def received(self) -> Mask:
        """(N,) by whom."""
        return self.verdict[0]


class _RecordedMedium:
    """A medium in which frames are received by whom a log says.

    :param config: the channel's settings.
    :param frames: in the order in which they were handed to their radios.
    """

    def __init__(self, config: ChannelConfig, frames: Sequence[SentFrame]) -> None:
        self.config = config
        self._next: dict[int, deque[Mask]] = {}
        for frame in frames:
            self._next.setdefault(frame.sender, deque()).append(frame.received)

    def medium(self, slot: int) -> _RecordedMedium:
        return self

    def advance(self, slot: int) -> None:
        pass

    def resolve(self, slot: int, frame: OnAir, others: Any, positions: Any = None) -> Reception:
        return Reception(self._next[frame.sender].popleft(), 0, 0)


class FramesOnAir:
    """Frames as they were sent and judged.

    :param config: the channel's settings.
    :param own_clocks: whether frames start when their sender's clock says so; otherwise with their slot.
    :param positions: (S, 3, N) m, where all were at the start of each slot; None: the channel does not ask for it.
    """

    def __init__(self, config: ChannelConfig, own_clocks: bool, positions: NDArray[np.float64] | None = None) -> None:
        self.config, self.own_clocks, self._positions = config, own_clocks, positions
        self._sent: dict[tuple[int, int], SentFrame] = {}
        self.overlapping = 0  # pairs of frames

    @classmethod
    def of_log(cls, log: FlightArrays, config: ChannelConfig, own_clocks: bool) -> FramesOnAir:
        """The frames of a log."""
        found = cls(config, own_clocks, log.track[:, -1])
        frames = log.sent_frames
        numbers = (frames.row, frames.sender, frames.lost, frames.collided)
        columns = zip(*(values.tolist() for values in numbers), frames.data, strict=True)
        for k, (row, sender, lost, collided, data) in enumerate(columns):
            start_ns = row * log.slot_ns + (0 if log.sent_ns is None else int(log.sent_ns[row, sender - 1]))
            found.add(row, sender, start_ns, data, frames.received[k], lost, collided)
        if own_clocks and config.airtime.line.serial:
            found.wait_for_lines()
        return found

    def add(self, slot: int, sender: int, start_ns: int, data: bytes, *verdict: Any) -> None:
        """A frame that was handed to its radio; verdict: (N,) by whom it was received, how many lost it, collided."""
        airtime = self.config.airtime
        on_air = OnAir.of(airtime, sender, start_ns, len(data))
        arrival_ns = on_air.end_ns + airtime.from_radio_ns(len(data))
        received, lost, collided = verdict
        self._sent[slot, sender] = SentFrame(slot, on_air, data, start_ns, arrival_ns, (received, lost, collided))

    def wait_for_lines(self) -> None:
        """Find when frames began and arrived whose radios hand over one reception after the other."""
        in_order = sorted(self._sent.values(), key=lambda sent: sent.asked_ns)
        for verdict in self._verdicts(_RecordedMedium(self.config, in_order)):
            sent = self._sent[verdict.frame_id]
            sent.on_air = OnAir.of(self.config.airtime, sent.sender, verdict.start_ns, len(sent.data))
            sent.arrival_ns = verdict.arrival_ns

    def all(self) -> list[SentFrame]:
        """All frames."""
        return list(self._sent.values())

    def check_numbers(self) -> None:
        """Whether verdicts can be.

        :raises Mismatch: at the first that cannot.
        """
        most = self.config.agents - 1
        for sent in self._sent.values():
            received, lost, collided = sent.verdict
            if received[sent.sender - 1]:
                why = "no agent hears itself"
                raise Mismatch(Difference("received", "others only", f"cf{sent.sender}", why, sent.slot, sent.sender))
            if int(received.sum()) + lost + collided > most:
                why = "each counts once"
                expected = f"at most {most} receivers"
                raise Mismatch(Difference("received, lost, collided", expected, "more", why, sent.slot, sent.sender))

    def check_overlaps(self) -> int:
        """Whether no agent has heard two frames at one time, or while it sent; returns how many were compared.

        :raises Mismatch: at the first frame for which that is not so.
        """
        by_start = sorted(self._sent.values(), key=lambda sent: sent.on_air.start_ns)
        active: list[SentFrame] = []
        for sent in by_start:
            active = [other for other in active if other.on_air.end_ns > sent.on_air.start_ns]
            for other in active:
                self._check_pair(other, sent)
                self._check_pair(sent, other)
            active.append(sent)
        return len(by_start)

    def _check_pair(self, one: SentFrame, other: SentFrame) -> None:
        """Two frames that meet in time."""
        if one.on_air.overlaps(other.on_air):
            self.overlapping += one.on_air < other.on_air
            if (one.received & other.received).any():
                both = f"both at {_ids(one.received & other.received)}"
                why = f"it was on air together with a frame of cf{one.sender}"
                raise Mismatch(Difference("received", "one of two frames at most", both, why, other.slot, other.sender))
        if one.on_air.deafens(other.on_air) and other.received[one.sender - 1]:
            raise Mismatch(Difference("received", f"without cf{one.sender}", _ids(other.received),
                                      "a sender does not hear", other.slot, other.sender))  # fmt: skip

    def check_verdicts(self, changes: Sequence[tuple[int, dict[str, Any]]], until_ns: int | None = None) -> int:
        """Make all verdicts again from the frames, their times and the channel's seed; returns how many.

        :param changes: first slot and values of each change of the channel's settings.
        :param until_ns: only those on frames that have left the air by then; None: all.
        :raises Mismatch: at the first that is not equal.
        """
        channel = Channel(self.config)
        for slot, values in changes:
            channel.set(slot=slot, **values)
        again = self._by_times(channel) if self.own_clocks else self._by_slots(channel)
        keys = [key for key in again if until_ns is None or self._sent[key].on_air.end_ns <= until_ns]
        for key in sorted(keys):
            sent = self._sent[key]
            for name, one, other in zip(("received", "lost", "collided"), again[key], sent.verdict, strict=True):
                expected, recorded = (_ids(one), _ids(other)) if name == "received" else (str(one), str(other))
                if expected != recorded:
                    why = "overlap on the time line, and the channel's draw from its seed"
                    raise Mismatch(Difference(name, expected, recorded, why, sent.slot, sent.sender))
        return len(keys)

    def _by_times(self, channel: Channel) -> dict[tuple[int, int], tuple[Mask, int, int]]:
        settled = self._verdicts(channel)
        return {verdict.frame_id: (verdict.received, verdict.lost, verdict.collided) for verdict in settled}

    def _verdicts(self, media: Any) -> Iterator[FrameVerdict[tuple[int, int]]]:
        """The verdicts on all frames on one time line."""
        air: Air[tuple[int, int]] = Air(media)
        waiting = deque(sorted(self._sent.items(), key=lambda item: item[1].asked_ns))
        last = max((sent.on_air.end_ns for sent in self._sent.values()), default=0)
        for at in range(0, last + 2 * self.config.slot_ns, self.config.slot_ns):
            while waiting and waiting[0][1].asked_ns < at:
                key, sent = waiting.popleft()
                air.begin(key, sent.sender, sent.asked_ns, len(sent.data))
            yield from air.resolve(at)

    def _by_slots(self, channel: Channel) -> dict[tuple[int, int], tuple[Mask, int, int]]:
        slots: dict[int, list[SentFrame]] = {}
        for sent in self._sent.values():
            slots.setdefault(sent.slot, []).append(sent)
        result = {}
        for slot in sorted(slots):
            frames = sorted(slots[slot], key=lambda sent: sent.sender)
            senders = [sent.sender for sent in frames]
            lengths = [len(sent.data) for sent in frames]
            verdict = channel.arbitrate(slot, senders, lengths, None if self._positions is None else self._positions[slot])
            mask, nothing = verdict.mask(self.config.agents), (0,) * len(frames)
            for k, sender in enumerate(senders):
                result[(slot, sender)] = mask[k], (verdict.lost or nothing)[k], (verdict.collided or nothing)[k]
        return result

    def get(self, slot: int, sender: int) -> SentFrame | None:
        """A frame; None if it was not sent."""
        return self._sent.get((slot, sender))

    def check_received(self, heard: ReceivedFrames, slots: int) -> tuple[int, dict[str, Any]]:
        """Whether agents took in what was delivered to them, once, and not before it was.

        :param slots: how many the log has.
        :returns: how many receivers and frames there were, and how long after their arrival frames were taken in, ms.
        :raises Mismatch: at the first entry for which that is not so.
        """
        taken_in: dict[tuple[int, int], Mask] = {}
        delays, count = Delays(self.config.agents), 0
        for k, (slot, sender) in enumerate(zip(heard.slot.tolist(), heard.sender.tolist(), strict=True)):
            sent, by = self._sent.get((slot, sender)), heard.receivers[k]
            if sent is None:
                if slot >= slots:
                    continue
                raise Mismatch(Difference("heard_sender", "a frame that was sent", f"cf{sender}",
                                          "no agent hears a frame that was not sent", slot))  # fmt: skip
            before = taken_in.setdefault((slot, sender), np.zeros(self.config.agents, np.bool_))
            wrong = np.flatnonzero(by & (before | ~sent.received))
            if len(wrong):
                expected = "not yet taken in" if before[wrong[0]] else "not delivered"
                why = "an agent takes in what was delivered to it, once"
                raise Mismatch(Difference("heard_by", expected, f"taken in: cf{sender}", why, slot, int(wrong[0]) + 1))
            before |= by
            delay = int(heard.time_ns[k]) - sent.arrival_ns
            if delay < 0:
                raise Mismatch(Difference("heard_ns", f"at least {sent.arrival_ns} ns", f"{heard.time_ns[k]} ns",
                                          "no agent hears a frame before it has arrived", slot, sender))  # fmt: skip
            receivers = np.flatnonzero(by)
            delays.add_many(np.full(len(receivers), delay), receivers)
            count += len(receivers)
        delivered = sum(int(sent.received.sum()) for sent in self._sent.values())
        return count, {
            "delivery_p50_ms": delays.quantile_ms(0.5),
            "delivery_p99_ms": delays.quantile_ms(0.99),
            "delivery_max_ms": delays.largest_ms(),
            "deliveries_not_taken_in": delivered - count,
        }

    def safety(self) -> dict[str, Any]:
        """What is worth knowing about the frames."""
        return {
            "frames": len(self._sent),
            "overlapping_pairs": self.overlapping,
            "frames_collided": sum(1 for sent in self._sent.values() if sent.verdict[2]),
        }


def _ids(mask: Mask) -> str:
    return agent_names((np.flatnonzero(mask) + 1).tolist())
