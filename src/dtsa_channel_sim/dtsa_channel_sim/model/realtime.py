"""Frames that start whenever their sender's clock says so: laid on one time line and settled by overlap.

Pure code: the caller says how far time has come. Frames may be handed in out of order, as they do from
several processes, as long as each arrives before the time line is settled past its start.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import LocalProtocolError

from .airtime import LONGEST_FRAME
from .channel import Channel
from .medium import OnAir


class FrameVerdict(NamedTuple):
    """What became of one frame."""

    frame_id: Hashable
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
    received: NDArray[np.bool_]
    """(N,): agent with id index + 1 received it."""
    lost: int
    """Receivers in reach that lost it to noise or jamming."""
    collided: int
    """Receivers in reach where it collided, or that were sending themselves."""
    late: bool
    """True when it was handed in after the time line had been settled past its start."""


class RealtimeArbiter:
    """Arbitrates a channel by overlap in time.

    :param channel: the channel: its settings, losses and changes.
    """

    __slots__ = ("_channel", "_ids", "_longest_ns", "_past", "_pending", "_settled_ns", "late")

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._longest_ns = channel.config.airtime.total_ns(LONGEST_FRAME)
        self._pending: list[tuple[OnAir, Hashable, bool]] = []
        self._ids: set[Hashable] = set()
        self._past: list[OnAir] = []
        self._settled_ns = -(2**63)
        #: Frames handed in too late: those settled before them could not be destroyed by them any more.
        self.late = 0

    @property
    def pending(self) -> int:
        """Number of frames that have no verdict yet."""
        return len(self._pending)

    def push(self, frame_id: Hashable, sender: int, start_ns: int, length: int) -> None:
        """Hand in one frame.

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
        airtime = config.airtime
        frame = OnAir(sender, start_ns, start_ns + airtime.ramp_up_ns, start_ns + airtime.total_ns(length))
        late = start_ns < self._settled_ns
        self.late += late
        self._ids.add(frame_id)
        self._pending.append((frame, frame_id, late))

    def settle(self, until_ns: int, positions: NDArray[np.float64] | None = None) -> list[FrameVerdict]:
        """Return the verdicts on all frames that have left the air by a time, in the order of their ends.

        The result does not depend on the order in which frames were handed in, nor on how often this is
        called, as long as no frame is late.

        :param until_ns: every frame that starts before this has been handed in; ns from the start of slot 0.
        :param positions: (3, N), m, frame map; needed with a limited range or capture.
        """
        self._settled_ns = max(self._settled_ns, until_ns)
        ripe = sorted((item for item in self._pending if item[0].end_ns <= until_ns), key=_order)
        if not ripe:
            return []
        others = [*self._past, *(item[0] for item in self._pending)]
        self._pending = [item for item in self._pending if item[0].end_ns > until_ns]
        result = []
        for frame, frame_id, late in ripe:
            self._ids.discard(frame_id)
            near = [o for o in others if o is not frame and o.start_ns < frame.end_ns and o.end_ns > frame.start_ns]
            result.append(self._verdict(frame, frame_id, late, near, positions))
        # Whatever is pending or still to come started, or will start, within one longest frame before this
        # time.
        oldest = min([until_ns - self._longest_ns, *(item[0].start_ns for item in self._pending)])
        self._past = [o for o in (*self._past, *(item[0] for item in ripe)) if o.end_ns > oldest]
        self._channel.advance(until_ns // self._channel.config.slot_ns)
        return result

    def _verdict(
        self,
        frame: OnAir,
        frame_id: Hashable,
        late: bool,
        near: list[OnAir],
        positions: NDArray[np.float64] | None,
    ) -> FrameVerdict:
        config = self._channel.config
        slot = max(0, frame.start_ns // config.slot_ns)
        received, lost, collided = self._channel.judge(slot, frame, near, positions)
        return FrameVerdict(
            frame_id, frame.sender, slot, frame.start_ns, frame.end_ns, frame.end_ns + config.link_delay_ns,
            received, lost, collided, late,
        )  # fmt: skip


def _order(item: tuple[OnAir, Hashable, bool]) -> tuple[int, int, int]:
    frame = item[0]
    return (frame.end_ns, frame.start_ns, frame.sender)
