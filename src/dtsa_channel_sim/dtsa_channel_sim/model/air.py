"""The air: transmissions that begin at any instant, on one time line, settled by overlap.

Pure code: the caller says how far time has come. Transmissions may be handed in out of order, as they come from
several processes, as long as each arrives before the time line is settled past its start.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Generic, Protocol, TypeVar

from dtsa_agent.core.errors import LocalProtocolError

from .airtime import LONGEST_FRAME
from .config import ChannelConfig
from .medium import Mask, Medium, OnAir, Positions, Reception

Key = TypeVar("Key", bound=Hashable)


class Media(Protocol):
    """The medium by slot: settings may change in flight. A :class:`~dtsa_channel_sim.model.channel.Channel` is one."""

    config: ChannelConfig

    def medium(self, slot: int) -> Medium:
        """Return the medium of a slot."""

    def advance(self, slot: int) -> None:
        """Note that a slot has been dealt with: later changes of settings begin after it."""


@dataclass(frozen=True, slots=True)
class FrameVerdict(Generic[Key]):
    """What became of one frame."""

    frame_id: Key
    """What the caller calls the frame."""
    sender: int
    """Id of the sender."""
    slot: int
    """Slot of the channel's clock in which the transmission started."""
    start_ns: int
    """Start of the transmission, ns from the start of slot 0 by the channel's clock."""
    end_ns: int
    """End of the last bit, same clock."""
    arrival_ns: int
    """When the receivers' flight processors have it, same clock."""
    received: Mask
    """(N,): agent with id index + 1 received it."""
    lost: int
    """Receivers in reach that lost it to noise or jamming."""
    collided: int
    """Receivers in reach where it collided, or that were sending themselves."""


class Air(Generic[Key]):
    """One time line of transmissions.

    What is on air at one time is a handful of frames; only these are looked at, whatever waits beside them.

    :param channel: the medium by slot.
    """

    __slots__ = ("_by_end", "_by_start", "_channel", "_count", "_ids", "_longest_ns", "_near", "_settled_ns", "late")

    def __init__(self, channel: Media) -> None:
        self._channel = channel
        self._longest_ns = channel.config.airtime.total_ns(LONGEST_FRAME)
        self._count = 0  # makes entries of the heaps differ: keys need no order
        self._by_end: list[tuple[int, int, int, int, OnAir, Key]] = []  # not settled yet: a heap
        self._by_start: list[tuple[int, int, OnAir]] = []  # not near the time that is settled yet: a heap
        self._near: list[OnAir] = []  # settled or not, what may overlap the next frame that is settled
        self._ids: set[Key] = set()
        self._settled_ns = -(2**63)
        #: Frames handed in after the time line had been settled past their start: they are dropped.
        self.late = 0

    @property
    def pending(self) -> int:
        """Number of frames that have no verdict yet."""
        return len(self._by_end)

    @property
    def near(self) -> list[OnAir]:
        """Transmissions that may still overlap others; always the same list."""
        return self._near

    def begin(self, frame_id: Key, sender: int, start_ns: int, length: int) -> bool:
        """Hand in one transmission; False when it is too late for it: it is dropped then, and counted.

        :param frame_id: anything that tells frames apart until they are settled.
        :param sender: id of the sender, 1 to N.
        :param start_ns: start of the transmission, ns from the start of slot 0 by the channel's clock.
        :param length: bytes, 1 to 255.
        :raises LocalProtocolError: for an id that is not the swarm's, a frame handed in twice, or an
            impossible length.
        """
        config = self._channel.config
        if not 1 <= sender <= config.agents:
            raise LocalProtocolError(f"sender {sender}: ids run from 1 to {config.agents}")
        if not 1 <= length <= LONGEST_FRAME:
            raise LocalProtocolError(f"length {length}: a frame has 1 to {LONGEST_FRAME} bytes")
        if frame_id in self._ids:
            raise LocalProtocolError(f"frame {frame_id!r} is pending already")
        if start_ns < self._settled_ns:
            self.late += 1
            return False
        frame = OnAir.of(config.airtime, sender, start_ns, length)
        self._ids.add(frame_id)
        self._count += 1
        heappush(self._by_end, (frame.end_ns, start_ns, sender, self._count, frame, frame_id))
        heappush(self._by_start, (start_ns, self._count, frame))
        return True

    def busy(self, receiver: int, when_ns: int, positions: Positions | None = None) -> bool:
        """Return whether an agent's radio finds the air busy, or cannot listen because it sends itself.

        A transmission that is still turning to sending is not sensed yet: two that begin within that time collide.

        :param receiver: id of the agent.
        :param when_ns: ns, same clock; not before what has been settled. What begins before it has been handed in.
        :param positions: (3, N), m, frame map; needed with a limited range or capture.
        :raises LocalProtocolError: for a time that has been settled already.
        """
        if when_ns < self._settled_ns:
            raise LocalProtocolError(f"the air at {when_ns} ns: settled until {self._settled_ns} ns already")
        self._approach(when_ns + 1)
        medium = self._channel.medium(self._slot(when_ns))
        return any(medium.senses(receiver, when_ns, frame, positions) for frame in self._near)

    def settle(self, until_ns: int, positions: Positions | None = None) -> list[FrameVerdict[Key]]:
        """Return the verdicts on all frames that have left the air by a time, in the order of their ends.

        The result does not depend on the order in which frames were handed in, nor on how often this is called.

        :param until_ns: every frame that starts before this has been handed in; ns from the start of slot 0.
        :param positions: (3, N), m, frame map; needed with a limited range or capture.
        """
        self._settled_ns = max(self._settled_ns, until_ns)
        verdicts = []
        while self._by_end and self._by_end[0][0] <= until_ns:
            *_, frame, frame_id = heappop(self._by_end)
            self._ids.discard(frame_id)
            self._approach(frame.end_ns)
            verdicts.append(self._verdict(frame, frame_id, positions))
            # What is settled later ends later, so it starts at most one longest frame before this end.
            self._forget(frame.end_ns - self._longest_ns)
        if verdicts:
            self._channel.advance(until_ns // self._channel.config.slot_ns)
        return verdicts

    def judge_slot(
        self, slot: int, frames: Sequence[OnAir], positions: Positions | None = None, keep: bool = False
    ) -> list[Reception]:
        """Judge a slot's transmissions as soon as they are known: what outlasts the slot disturbs the next ones only.

        :param slot: slot whose settings and random numbers count.
        :param frames: all its transmissions.
        :param positions: (3, N), m, frame map; needed with a limited range or capture.
        :param keep: True when transmissions of the next slot may begin before it.
        """
        medium = self._channel.medium(slot)
        end_ns = (slot + 1) * self._channel.config.slot_ns
        on_air = [*self._near, *frames]
        first = len(self._near)
        self._near[:] = [frame for k, frame in enumerate(on_air) if frame.end_ns > end_ns or (keep and k >= first)]
        return [
            medium.judge(slot, frame, on_air[:k] + on_air[k + 1 :], positions) for k, frame in enumerate(frames, first)
        ]

    def _slot(self, time_ns: int) -> int:
        return max(0, time_ns // self._channel.config.slot_ns)

    def _approach(self, before_ns: int) -> None:
        """Take a look at all transmissions that start before a time."""
        while self._by_start and self._by_start[0][0] < before_ns:
            self._near.append(heappop(self._by_start)[2])

    def _forget(self, oldest_ns: int) -> None:
        if any(frame.end_ns <= oldest_ns for frame in self._near):
            self._near[:] = [frame for frame in self._near if frame.end_ns > oldest_ns]

    def _verdict(self, frame: OnAir, frame_id: Key, positions: Positions | None) -> FrameVerdict[Key]:
        """Return the verdict on a transmission that all are known to that may overlap it."""
        slot = self._slot(frame.start_ns)
        others = [o for o in self._near if o is not frame and o.start_ns < frame.end_ns and o.end_ns > frame.start_ns]
        received, lost, collided = self._channel.medium(slot).judge(slot, frame, others, positions)
        arrival_ns = frame.end_ns + self._channel.config.link_delay_ns
        return FrameVerdict(
            frame_id, frame.sender, slot, frame.start_ns, frame.end_ns, arrival_ns, received, lost, collided
        )
