"""The air: transmissions that begin at any instant, on one time line, resolved by overlap.

Pure code: the caller says how far time has come. Transmissions may be handed in out of order, as they come from
several processes, as long as each arrives before the time line is resolved past its start.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Any, Generic, TypeVar

import numpy as np

from dtsa_agent.core.errors import LocalProtocolError

from .airtime import Airtime
from .channel import Channel
from .medium import Mask, OnAir, Positions

Key = TypeVar("Key", bound=Hashable)

NEVER = 2**63  # ns
_GRACE = 0.05  # of a slot: frames are handed over ahead of their start; one that is late by less still collides
_WINDOW = 0.5  # of a slot: a frame that reaches a live channel later than this after its start is dropped


class Arrivals:
    """What is on its way to receivers: a heap by time of arrival, ns; what arrives together keeps its order."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Any]] = []
        self._count = 0

    @property
    def next_ns(self) -> int:
        """When the next one arrives."""
        return self._heap[0][0] if self._heap else NEVER

    def add(self, arrival_ns: int, item: Any) -> None:
        """Let something arrive at a time."""
        self._count += 1
        heappush(self._heap, (arrival_ns, self._count, item))

    def pop(self, until_ns: int) -> list[Any]:
        """Return what has arrived by a time, in order."""
        arrived = []
        while self.next_ns <= until_ns:
            arrived.append(heappop(self._heap)[2])
        return arrived


@dataclass(frozen=True, slots=True)
class FrameVerdict(Generic[Key]):
    """What became of one frame."""

    frame_id: Key  # what the caller calls the frame
    sender: int  # id
    slot: int  # of the channel's clock, in which the transmission started
    start_ns: int  # when the radio began to send, ns from the start of slot 0 by the channel's clock
    end_ns: int  # end of the last bit, same clock
    arrival_ns: int  # when the last of the receivers' flight processors has it, same clock
    received: Mask  # (N,) agent with id index + 1 received it
    lost: int  # receivers in reach that lost it to noise or jamming, or whose radios had no room for it
    collided: int  # receivers in reach where it collided, or that were sending themselves


class Lines:
    """The lines between flight processors and their radios: one of each kind for every agent, one frame at a time.

    A radio hands its receptions over in the order in which they ended, each when the one before it is through. One that
    comes when the radio holds as many as it can is lost. A radio that waits (:class:`~.airtime.Line`) sends a frame of
    its own when the reception that it hands over is through, before it turns to the next one. Calls come in the order
    of their times, ns; agents are ids.
    """

    __slots__ = ("_airtime", "_held", "_sending_ns")

    def __init__(self, airtime: Airtime, agents: int) -> None:
        self._airtime = airtime
        # By agent: when each reception that its radio holds is through, ns; the first is on the line.
        self._held: list[deque[int]] = [deque() for _ in range(agents)]
        self._sending_ns = [0] * agents  # when each radio has done with its own frames

    def start_ns(self, agent: int, at_ns: int, length: int) -> int:
        """Return when a radio begins to send a frame of its own that it has from ``at_ns`` on."""
        held = self._release(agent - 1, at_ns)
        start = held[0] if held and self._airtime.line.waits else at_ns
        start = max(start, self._sending_ns[agent - 1])
        self._sending_ns[agent - 1] = start + self._airtime.total_ns(length)
        return start

    def receive(self, end_ns: int, length: int, received: Mask) -> tuple[Mask, int]:
        """Receive a frame that ends now; return the agents with room for it, (N,), and when the last has it, ns."""
        takes_ns, queue = self._airtime.from_radio_ns(length), self._airtime.line.queue
        taken, last = received.copy(), end_ns + takes_ns
        for index in np.flatnonzero(received).tolist():
            held = self._release(index, end_ns)
            if queue and len(held) >= queue:
                taken[index] = False
                continue
            held.append((held[-1] if held else end_ns) + takes_ns)
            last = max(last, held[-1])
        return taken, last

    def handed_ns(self, agent: int) -> int:
        """Return when the reception that a radio has just received is through."""
        return self._held[agent - 1][-1]

    def reset(self, agent: int) -> None:
        """Forget what a radio holds: its power was off."""
        self._held[agent - 1].clear()
        self._sending_ns[agent - 1] = 0

    def _release(self, index: int, now_ns: int) -> deque[int]:
        """Return the receptions that a radio still holds."""
        held = self._held[index]
        while held and held[0] <= now_ns:
            held.popleft()
        return held


class Air(Generic[Key]):
    """One time line of transmissions.

    What is on air at one time is a handful of frames; only these are looked at, whatever waits beside them. With radios
    behind serial lines (:class:`Lines`) starts depend on what was received before, so all goes by the order of
    times: ends of transmissions before starts at the same instant.

    Times are ns from the start of slot 0 by the channel's clock; positions are (3, N), m, frame map, and needed with a
    limited range or capture.

    :param channel: the medium by slot.
    :param airtime: how long transmissions take; None: as the radio's frames.
    """

    __slots__ = (
        "_airtime", "_asked", "_by_end", "_by_start", "_channel", "_count", "_ids", "_lines", "_longest_ns",
        "_near", "_resolved", "_resolved_ns", "late",
    )  # fmt: skip

    def __init__(self, channel: Channel, airtime: Airtime | None = None) -> None:
        self._channel = channel
        self._airtime = airtime = airtime or channel.config.airtime
        self._longest_ns = airtime.total_ns(airtime.longest)
        self._lines = Lines(airtime, channel.config.agents) if airtime.line.serial else None
        self._asked: list[tuple[int, int, int, int, Key]] = []  # with lines, what no radio has begun to send: a heap
        self._resolved: list[FrameVerdict[Key]] = []  # verdicts that were not returned yet
        self._count = 0  # makes entries of the heaps differ: keys need no order
        self._by_end: list[tuple[int, int, int, int, OnAir, int, Key]] = []  # not resolved yet: a heap
        self._by_start: list[tuple[int, int, OnAir]] = []  # not near the time that is resolved yet: a heap
        self._near: list[OnAir] = []  # what may overlap the next frame that is resolved
        self._ids: set[Key] = set()
        self._resolved_ns = -(2**63)
        #: Frames handed in after the time line had been resolved past their start: they are dropped.
        self.late = 0

    @property
    def pending(self) -> int:
        """Number of frames that have no verdict yet."""
        return len(self._by_end) + len(self._asked) + len(self._resolved)

    @property
    def due_ns(self) -> int:
        """Until when to resolve next, ns: before that nothing begins or ends that has been handed in."""
        end_ns = self._by_end[0][0] if self._by_end else NEVER
        return min(end_ns, self._asked[0][0] + 1 if self._asked else NEVER)

    def begin(self, frame_id: Key, sender: int, start_ns: int, length: int) -> bool:
        """Hand in a transmission of some bytes; False when it is too late for it: it is dropped then, and counted.

        A radio that is at work when it has the frame begins later.

        :raises LocalProtocolError: for an id that is not the swarm's, a frame handed in twice, or an
            impossible length.
        """
        config, longest = self._channel.config, self._airtime.longest
        if not 1 <= sender <= config.agents:
            raise LocalProtocolError(f"sender {sender}: ids run from 1 to {config.agents}")
        if not 1 <= length <= longest:
            raise LocalProtocolError(f"length {length}: a frame has 1 to {longest} bytes")
        if frame_id in self._ids:
            raise LocalProtocolError(f"frame {frame_id!r} is pending already")
        if start_ns < self._resolved_ns:
            self.late += 1
            return False
        self._ids.add(frame_id)
        self._count += 1
        if self._lines is None:
            self._schedule(sender, start_ns, self._count, length, frame_id)
        else:
            heappush(self._asked, (start_ns, sender, self._count, length, frame_id))
        return True

    def busy(self, receiver: int, when_ns: int, positions: Positions | None = None) -> bool:
        """Return whether an agent's radio finds the air busy, or cannot listen because it sends itself.

        A transmission that is still turning to sending is not sensed yet: two that begin within that time collide.

        :raises LocalProtocolError: for a time that has been resolved already.
        """
        if when_ns < self._resolved_ns:
            raise LocalProtocolError(f"the air at {when_ns} ns: resolved until {self._resolved_ns} ns already")
        if self._lines is not None:
            self._run(when_ns, when_ns + 1, positions)
        self._approach(when_ns + 1)
        medium = self._channel.medium(self._slot(when_ns))
        return any(medium.senses(receiver, when_ns, frame, positions) for frame in self._near)

    def resolve(self, until_ns: int, positions: Positions | None = None) -> list[FrameVerdict[Key]]:
        """Return the verdicts on all frames that have left the air by a time, in the order of their ends.

        Every frame that starts before it has been handed in. The result does not depend on the order in which frames
        were handed in, nor on how often this is called.
        """
        self._resolved_ns = max(self._resolved_ns, until_ns)
        self._run(until_ns, until_ns, positions)
        verdicts, self._resolved = self._resolved, []
        if verdicts:
            self._channel.advance(until_ns // self._channel.config.slot_ns)
        return verdicts

    def _run(self, until_ns: int, before_ns: int, positions: Positions | None) -> None:
        """Let frames end up to and with a time, and radios begin what they have before another one."""
        asked, by_end = self._asked, self._by_end
        while True:
            end_ns = by_end[0][0] if by_end else NEVER
            if asked and asked[0][0] < end_ns:
                if asked[0][0] >= before_ns:
                    return
                at_ns, sender, count, length, frame_id = heappop(asked)
                assert self._lines is not None
                start_ns = self._lines.start_ns(sender, at_ns, length)
                self._schedule(sender, start_ns, count, length, frame_id)
            elif end_ns <= until_ns:
                *_, frame, length, frame_id = heappop(by_end)
                self._ids.discard(frame_id)
                self._approach(frame.end_ns)
                self._resolved.append(self._verdict(frame, length, frame_id, positions))
                # What is resolved later ends later, so it starts at most one longest frame before this end.
                self._forget(frame.end_ns - self._longest_ns)
            else:
                return

    def _schedule(self, sender: int, start_ns: int, count: int, length: int, frame_id: Key) -> None:
        """Put a transmission on the time line."""
        frame = OnAir.of(self._airtime, sender, start_ns, length)
        heappush(self._by_end, (frame.end_ns, start_ns, sender, count, frame, length, frame_id))
        heappush(self._by_start, (start_ns, count, frame))

    def _slot(self, time_ns: int) -> int:
        return max(0, time_ns // self._channel.config.slot_ns)

    def _approach(self, before_ns: int) -> None:
        """Move all transmissions that start before a time to those that may overlap."""
        while self._by_start and self._by_start[0][0] < before_ns:
            self._near.append(heappop(self._by_start)[2])

    def _forget(self, oldest_ns: int) -> None:
        if any(frame.end_ns <= oldest_ns for frame in self._near):
            self._near[:] = [frame for frame in self._near if frame.end_ns > oldest_ns]

    def _verdict(self, frame: OnAir, length: int, frame_id: Key, positions: Positions | None) -> FrameVerdict[Key]:
        """Return the verdict on a transmission that all are known to that may overlap it."""
        slot = self._slot(frame.start_ns)
        others = [o for o in self._near if o is not frame and o.start_ns < frame.end_ns and o.end_ns > frame.start_ns]
        received, lost, collided = self._channel.medium(slot).resolve(slot, frame, others, positions)
        arrival_ns = frame.end_ns + self._airtime.from_radio_ns(length)
        if self._lines is not None:
            reached = int(np.count_nonzero(received))
            received, arrival_ns = self._lines.receive(frame.end_ns, length, received)
            lost += reached - int(np.count_nonzero(received))
        return FrameVerdict(
            frame_id, frame.sender, slot, frame.start_ns, frame.end_ns, arrival_ns, received, lost, collided
        )


class LiveAir(Air[tuple[int, int]]):
    """The air of agents with clocks of their own: it is resolved a little behind the clock, when all frames are known.

    A frame is named by its slot, as its sender counts, and the sender's id.
    """

    def __init__(self, channel: Channel) -> None:
        super().__init__(channel)
        config = channel.config
        # A delivery may come no earlier than the frame arrives.
        self.hold_ns = max(round(_GRACE * config.slot_ns), config.airtime.from_radio_ns(0))
        self._window_ns = max(self.hold_ns, round(_WINDOW * config.slot_ns))
        self.frames: dict[tuple[int, int], bytes] = {}  # that are or were on the air, until their slot is closed
        self._arriving = Arrivals()  # verdicts on frames that are on lines

    @property
    def waits(self) -> bool:
        """Whether a frame waits for its delivery."""
        return self.pending > 0 or self._arriving.next_ns < NEVER

    def hand_over(self, key: tuple[int, int], start_ns: int, data: bytes) -> bool:
        """Put a frame on the air; return False if it is there already, or came too late: no agent hears it."""
        if key in self.frames or not self.begin(key, key[1], start_ns, len(data)):
            return False
        self.frames[key] = data
        return True

    def pop_arrived(self, now: int, positions: Positions) -> list[FrameVerdict[tuple[int, int]]]:
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
