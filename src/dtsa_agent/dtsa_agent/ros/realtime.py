"""Agents on their own clocks: nobody waits for anybody, and who is late is late."""

from __future__ import annotations

import time
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Slot
from numpy.typing import NDArray

from dtsa_agent.core.alignment import ClockAligner
from dtsa_agent.core.scenario import STREAM_CLOCKS, generator

from . import names
from .loop import Stop
from .swarm_node import SwarmNode

_PPB = 1_000_000_000
_PATIENCE_NS = 50_000_000
_LEAD = 0.25  # of a slot: an agent decides this long before its slot starts, so that its frame leaves on time


def slot_starts(local_ns: int, offset_ns: NDArray[np.int64], drift_ppb: NDArray[np.int64]) -> NDArray[np.int64]:
    """How much later than the channel's clock some clocks show a time, ns: the first ns at which they show it.

    :param local_ns: the time, ns.
    :param offset_ns: (L,) ns, what each clock shows at the channel's time 0.
    :param drift_ppb: (L,) parts per billion by which each runs fast.
    """
    # The first c with c (1 + drift) + offset >= local, written so that no product leaves 64 bits within months.
    ahead = local_ns - offset_ns
    return np.asarray(ahead - ahead * drift_ppb // (_PPB + drift_ppb) - local_ns)


class RealtimeNode(SwarmNode):
    """A :class:`SwarmNode` whose agents open their slots by themselves.

    The time line is the channel's: ns from the start of slot 0. An agent's slot starts when its own clock says so; that
    is off by an offset and a drift, and by what the agent has learned from others' frames. As on a vehicle, where a
    timer sends what lies ready, decisions are made a little before. All agents of one process are served when the first
    of them is due; a frame carries the time at which its agent starts to send it: its slot's start, or later if it was
    not ready by then.

    :param args: as for :class:`SwarmNode`.
    :param offset_ns: (L,) ns, offset of each agent's clock: positive clocks are early.
    :param drift_ppb: (L,) parts per billion by which each runs fast.
    :param jitter_ns: ns, standard deviation of the time of a single transmission.
    :param align: whether agents move their slots towards what they hear.
    :param flight_time_ns: ns from the order to send a frame until the receivers' flight processors have it: for any
        frame, and for each of its bytes.
    """

    def __init__(
        self,
        *args: Any,
        offset_ns: Sequence[int],
        drift_ppb: Sequence[int],
        jitter_ns: float = 0.0,
        align: bool = True,
        flight_time_ns: tuple[int, int] = (0, 0),
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, waiting=names.REALTIME_WAITING, **kwargs)
        count = len(self.swarm.ids)
        self.slot_ns = self.config.slot_ns
        self._lead_ns = round(_LEAD * self.slot_ns)
        self.unsent = 0  # frames that would have left half a slot late or more
        self._offset: NDArray[np.int64] = np.array(offset_ns, dtype=np.int64)
        self._drift: NDArray[np.int64] = np.array(drift_ppb, dtype=np.int64)
        self._shift: NDArray[np.int64] = np.zeros(count, dtype=np.int64)  # ns, what each has learned to wait
        self._aligners = [ClockAligner() for _ in range(count)] if align else []
        self._jitter_ns = jitter_ns
        self._random = [generator(self.config.seed, STREAM_CLOCKS, agent) for agent in self.swarm.ids]
        self._fixed_ns, self._per_byte_ns = flight_time_ns
        self._zero = 0  # CLOCK_MONOTONIC at the start of slot 0, ns; 0: not known yet
        self._early: list[Slot] = []  # frames of a slot that is still to come here

    def starts(self, slot: int) -> NDArray[np.int64]:
        """When each agent's slot starts, ns after the channel's start of that slot.

        :param slot: its number.
        """
        return slot_starts(slot * self.slot_ns, self._offset, self._drift) + self._shift

    def run(self, stop: Stop) -> None:
        """Flies until the run is over or a signal comes."""
        while not stop:
            if not self._zero:
                message = self.loop.wait()
                if message is not None and not self._prepare(message):
                    return
            elif not self._step():
                return
            if self.loop.housekeeping():
                self.idle()

    def _prepare(self, message: Slot) -> bool:
        """Answers the channel's call, or takes the start time; False when the run is over."""
        if message.phase == Slot.PREPARE:
            self._answer(0, message.stamp, ())
        elif message.phase == Slot.START:
            self._zero = message.stamp.sec * _PPB + message.stamp.nanosec
        return message.phase != Slot.END

    def _step(self) -> bool:
        """Waits for the next slot or message; False when the run is over."""
        due = self._zero + (self.slot + 1) * self.slot_ns + int(self.starts(self.slot + 1).min()) - self._lead_ns
        remaining = due - time.monotonic_ns()
        if remaining > 0:
            message = self.loop.wait(min(remaining, _PATIENCE_NS))
            return message is None or self._take(message)
        while (message := self.loop.take()) is not None:
            if not self._take(message):
                return False
        self._open(self.slot + 1)
        return True

    def _take(self, message: Slot) -> bool:
        if message.phase == Slot.END:
            return False
        if message.phase == Slot.RUN:
            if message.heard_slot > self.slot:
                self._early.append(message)
            else:
                self._take_frames(message)
        return True

    def _take_frames(self, message: Slot) -> None:
        # In the slot in which it was sent, even if this process, or the channel's, has been kept waiting since.
        masks = self._hear(message, message.heard_slot)
        if not self._aligners or masks is None:
            return
        arrival = message.stamp.sec * _PPB + message.stamp.nanosec - names.TIME_ZERO_NS
        expected = message.heard_slot * self.slot_ns + self._fixed_ns + self._per_byte_ns * message.length[0]
        late = arrival - expected - self.starts(message.heard_slot)
        for index in np.flatnonzero(masks[0]):
            self._shift[index] += self._aligners[index].hear(int(late[index]))

    def _open(self, slot: int) -> None:
        """Closes the last slot and opens the next: decide, send, fly."""
        swarm = self.swarm
        if slot:
            swarm.end(slot - 1)
        swarm.scenario.advance(slot, swarm)
        senders = swarm.begin(slot)
        starts = self.starts(slot)
        now = time.monotonic_ns() - self._zero - slot * self.slot_ns
        offsets = starts.copy()
        for index in senders:
            jitter = self._jitter_ns * self._random[index].standard_normal() if self._jitter_ns else 0.0
            offsets[index] = max(int(starts[index] + jitter), now)
            if offsets[index] - starts[index] > self.slot_ns // 2:
                # The turn is as good as over: speaking now would disturb whoever has the next one.
                swarm.frame_length[index] = 0
                offsets[index] = starts[index]
                self.unsent += 1
        self._message.offset_ns = array("q", offsets.tobytes())
        seconds, nanoseconds = divmod(names.slot_time_ns(slot, self.slot_ns), _PPB)
        self.slot = slot
        stamp = Time(sec=seconds, nanosec=nanoseconds)
        self._answer(slot, stamp, [index for index in senders if swarm.frame_length[index]])
        if self._watched:
            self._publish_odometry(stamp)
        swarm.fly(slot)
        early, self._early = self._early, []
        for message in early:
            self._take(message)
