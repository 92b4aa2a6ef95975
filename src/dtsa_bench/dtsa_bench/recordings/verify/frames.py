"""All frames of a run on one time line, with what became of each: for runs that are checked but not flown again."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.ros.common.graph.names import named
from dtsa_channel_sim import Air, Channel, ChannelConfig, FrameVerdict, OnAir, Reception

from .result import Difference, Mismatch

Mask = NDArray[np.bool_]


@dataclass(slots=True)
class Sent:
    """One frame."""

    slot: int  # as its sender counts
    on_air: OnAir
    data: bytes
    asked_ns: int  # for when its sender handed it to its radio
    arrival_ns: int  # when the last of its receivers had it
    received: Mask | None = None  # (N,) by whom, as delivered
    verdict: tuple[int, Mask, int, int] | None = None  # slot of its account, received, lost, collided
    alone: bool = True  # nobody else was sending meanwhile

    @property
    def sender(self) -> int:
        """Its id."""
        return self.on_air.sender

    @property
    def dropped(self) -> bool:
        """Whether nobody was in reach of it, as of a frame that the channel got too late to put it on the air."""
        return self.verdict is not None and not self.verdict[1].any() and self.verdict[2:] == (0, 0)


class _Recorded:
    """A medium in which frames are received by whom a recording says.

    :param config: the channel's settings.
    :param frames: sender and receivers, (N,), of each frame, in the order in which they were handed to their radios.
    """

    def __init__(self, config: ChannelConfig, frames: list[tuple[int, Mask]]) -> None:
        self.config = config
        self._next: dict[int, deque[Mask]] = {}
        for sender, received in frames:
            self._next.setdefault(sender, deque()).append(received)

    def medium(self, slot: int) -> _Recorded:
        return self

    def advance(self, slot: int) -> None:
        pass

    def judge(self, slot: int, frame: OnAir, others: Any, positions: Any = None) -> Reception:
        return Reception(self._next[frame.sender].popleft(), 0, 0)


class SentFrames:
    """Frames as they were sent, delivered and judged.

    :param config: the channel's settings.
    :param own_clocks: whether frames start when their sender's clock says so; otherwise with their slot.
    """

    def __init__(self, config: ChannelConfig, own_clocks: bool) -> None:
        self.config, self.own_clocks = config, own_clocks
        self._sent: dict[tuple[int, int], Sent] = {}
        self._unjudged: dict[int, deque[Sent]] = {}
        self._positions: dict[int, NDArray[np.float64]] = {}
        self.overlapping = 0  # pairs of frames

    def send(self, slot: int, sender: int, start_ns: int, data: bytes) -> None:
        """A frame goes out."""
        airtime = self.config.airtime
        on_air = OnAir.of(airtime, sender, start_ns, len(data))
        sent = Sent(slot, on_air, data, start_ns, on_air.end_ns + airtime.from_radio_ns(len(data)))
        self._sent[(slot, sender)] = sent
        self._unjudged.setdefault(sender, deque()).append(sent)

    def lay(self, received: dict[tuple[int, int], Mask]) -> None:
        """Finds when frames began and arrived whose radios hand over one reception after the other.

        :param received: by whom each frame was received as recorded, (N,), by its slot and sender.
        """
        nobody = np.zeros(self.config.agents, dtype=np.bool_)
        in_order = sorted(self._sent, key=lambda key: self._sent[key].asked_ns)
        recorded = _Recorded(self.config, [(key[1], received.get(key, nobody)) for key in in_order])
        for verdict in self._settled(recorded, set()):
            sent = self._sent[verdict.frame_id]
            sent.on_air = OnAir.of(self.config.airtime, sent.sender, verdict.start_ns, len(sent.data))
            sent.arrival_ns = verdict.arrival_ns

    def get(self, slot: int, sender: int) -> Sent | None:
        """A frame; None if it has not gone out."""
        return self._sent.get((slot, sender))

    def all(self) -> list[Sent]:
        """All frames that have gone out."""
        return list(self._sent.values())

    @property
    def delivered(self) -> int:
        """Receivers to which frames were delivered, over all frames."""
        return sum(int(sent.received.sum()) for sent in self._sent.values() if sent.received is not None)

    def place(self, slot: int, position: NDArray[np.float64]) -> None:
        """Where all are at a slot's start, (3, N) m; kept only where the channel asks for it.

        :param position: (3, N) m, frame map.
        """
        if self.config.range_m or self.config.capture_db:
            self._positions[slot] = position.copy()

    def deliver(self, slot: int, sender: int, data: bytes, received: Mask) -> Sent:
        """A frame reaches some.

        :raises Mismatch: nobody has sent it, it has been delivered already, or to its own sender.
        """
        sent = self._sent.get((slot, sender))
        if sent is None:
            why = "nobody hears what was not sent"
            raise Mismatch(Difference("slot.sender", "an agent that sent", f"cf{sender}", why, slot))
        for wrong, field_name, expected, recorded, why in (
            (sent.data != data, "data", sent.data.hex(), data.hex(), "frames arrive as they were sent"),
            (received[sender - 1], "received", "others only", f"cf{sender}", "nobody hears itself"),
            (sent.received is not None, "sender", "one delivery", "two", "a frame arrives once"),
        ):
            if wrong:
                raise Mismatch(Difference(f"slot.{field_name}", expected, recorded, why, slot, sender))
        sent.received = received
        return sent

    def judged(self, slot: int, sender: int, received: Mask, lost: int, collided: int) -> None:
        """The channel's verdict on a sender's next frame.

        :raises Mismatch: there is no such frame.
        """
        waiting = self._unjudged.get(sender)
        if not waiting:
            why = "only what is sent is judged"
            raise Mismatch(Difference("reception.sender", "agents that sent", f"cf{sender}", why, slot))
        waiting.popleft().verdict = slot, received, lost, collided

    def check_overlaps(self, late: int = 0) -> dict[str, int]:
        """Whether deliveries and verdicts agree, and nobody has heard two frames at one time, or while it sent.

        :raises Mismatch: at the first frame for which that is not so.
        """
        by_start = sorted(self._sent.values(), key=lambda sent: sent.on_air.start_ns)
        nobody = np.zeros(self.config.agents, dtype=np.bool_)
        active: list[Sent] = []
        for sent in by_start:
            if sent.verdict is not None:
                given = sent.received if sent.received is not None else nobody
                if (given != sent.verdict[1]).any():
                    raise Mismatch(Difference("reception.received", _ids(given), _ids(sent.verdict[1]),
                                              "as delivered to the agents", sent.slot, sent.sender))  # fmt: skip
            if late and sent.dropped:
                continue
            active = [other for other in active if other.on_air.end_ns > sent.on_air.start_ns]
            for other in active:
                self._pair(other, sent)
                self._pair(sent, other)
            active.append(sent)
        return {"frames that nobody heard together with another": len(by_start)} if by_start else {}

    def _pair(self, one: Sent, other: Sent) -> None:
        """Two frames that meet in time."""
        if one.on_air.deafens(other.on_air):
            one.alone = other.alone = False
        if one.on_air.overlaps(other.on_air):
            self.overlapping += one.on_air < other.on_air
            if one.received is not None and other.received is not None and (one.received & other.received).any():
                both = f"both at {_ids(one.received & other.received)}"
                why = f"it was on air together with a frame of cf{one.sender}"
                expected = "one of two frames at most"
                raise Mismatch(Difference("slot.received", expected, both, why, other.slot, other.sender))
        if one.on_air.deafens(other.on_air) and other.received is not None and other.received[one.sender - 1]:
            raise Mismatch(Difference("slot.received", f"without cf{one.sender}", _ids(other.received),
                                      "who sends does not hear", other.slot, other.sender))  # fmt: skip

    @property
    def dropped(self) -> int:
        """Frames whose verdict is that of a dropped one."""
        return sum(1 for sent in self._sent.values() if sent.dropped)

    def check_verdicts(self, changes: list[tuple[int, dict[str, Any]]], late: int = 0) -> int:
        """Makes all verdicts again from the frames, their times and the channel's seed; after :meth:`check_overlaps`.

        :param changes: first slot and values of each change of the channel's settings.
        :raises Mismatch: at the first that is not.
        """
        channel = Channel(self.config)
        for slot, values in changes:
            channel.set(slot=slot, **values)
        left_out = {key for key, sent in self._sent.items() if late and sent.dropped}
        only_alone = len(left_out) != late
        again = self._on_one_time_line(channel, left_out) if self.own_clocks else self._by_slots(channel)
        equal = 0
        for key, right in again.items():
            sent = self._sent[key]
            if sent.verdict is None or (only_alone and not sent.alone):
                continue  # the recording ended before it was judged
            expected, found = _shown(*right), _shown(*sent.verdict[1:])
            for name, one, other in zip(("received", "lost", "collided"), expected, found, strict=True):
                if one != other:
                    why = "overlap on the time line, and the channel's draw from its seed"
                    raise Mismatch(Difference(f"reception.{name}", one, other, why, sent.slot, sent.sender))
            equal += 1
        return equal

    def _on_one_time_line(
        self, channel: Channel, left_out: set[tuple[int, int]]
    ) -> dict[tuple[int, int], tuple[Mask, int, int]]:
        settled = self._settled(channel, left_out)
        return {verdict.frame_id: (verdict.received, verdict.lost, verdict.collided) for verdict in settled}

    def _settled(self, media: Any, left_out: set[tuple[int, int]]) -> Iterator[FrameVerdict[tuple[int, int]]]:
        """The verdicts on all frames on one time line."""
        air: Air[tuple[int, int]] = Air(media)
        frames = [item for item in self._sent.items() if item[0] not in left_out]
        waiting = deque(sorted(frames, key=lambda item: item[1].asked_ns))
        last = max((sent.on_air.end_ns for sent in self._sent.values()), default=0)
        for at in range(0, last + 2 * self.config.slot_ns, self.config.slot_ns):
            while waiting and waiting[0][1].asked_ns < at:
                key, sent = waiting.popleft()
                air.begin(key, sent.sender, sent.asked_ns, len(sent.data))
            yield from air.settle(at)

    def _by_slots(self, channel: Channel) -> dict[tuple[int, int], tuple[Mask, int, int]]:
        slots: dict[int, list[Sent]] = {}
        for sent in self._sent.values():
            slots.setdefault(sent.slot, []).append(sent)
        result = {}
        for slot in sorted(slots):
            frames = sorted(slots[slot], key=lambda sent: sent.sender)
            senders = [sent.sender for sent in frames]
            verdict = channel.arbitrate(slot, senders, [len(sent.data) for sent in frames], self._positions.get(slot))
            mask, nothing = verdict.mask(self.config.agents), (0,) * len(frames)
            for k, sender in enumerate(senders):
                result[(slot, sender)] = mask[k], (verdict.lost or nothing)[k], (verdict.collided or nothing)[k]
        return result

    def safety(self) -> dict[str, Any]:
        """What is worth knowing about the frames."""
        judged = [sent.verdict for sent in self._sent.values() if sent.verdict is not None]
        return {
            "frames": len(self._sent),
            "frames_not_judged": len(self._sent) - len(judged),
            "overlapping_pairs": self.overlapping,
            "frames_collided": sum(1 for verdict in judged if verdict[3]),
        }


def _shown(received: Mask, lost: int, collided: int) -> tuple[str, str, str]:
    return _ids(received), str(lost), str(collided)


def _ids(mask: Mask) -> str:
    return named((np.flatnonzero(mask) + 1).tolist())
