"""Agents on their own clocks: nobody waits for anybody, and a frame that is late is late.

How a flight in real time works, and where each part stands ("channel": `dtsa_channel_sim/ros`):

1. **The time line.** The channel calls all processes (`roll_call`), then sends START with the time of slot 0 on
   CLOCK_MONOTONIC. Slot T lies at T slot lengths after it. Each agent has a clock of its own, off by an offset and a
   drift; `slot_clocks` says when its slots begin on the time line.
2. **A slot here.** :meth:`RealtimeNode._step` takes in messages until a lead before the slot's start
   (`core/agents/pacing.py`). :meth:`~RealtimeNode._open` ends the slot before, decides, sends, and moves the vehicles.
   A frame is published with the time at which its transmission starts; one that would leave half a slot late is not
   sent.
3. **On the air.** The channel (`realtime_channel`) puts each frame on the time line (`live_air`, `model/air`). Once no
   frame that overlaps it can come any more, it is settled: who heard it, by reach, overlap and losses. A RUN message
   delivers it to all processes with the receivers' bits.
4. **Heard.** :meth:`~RealtimeNode._take_frames` hands it to those agents whose bit is set, in the slot in which it was
   sent. The lateness of its start moves their own slots (`core/reference/timebase.py`).
5. **Told.** Some ten times a second a process reports what its agents decided, took in and flew (`reporter`). The
   channel fills an account for each slot (`accounts`); it closes when all have reported or have been given up. The
   recorder, the metrics and the live view get closed accounts only: what agents had, not what they should have had.
6. **Late.** Nobody is waited for. A process that is behind by too much begins anew with the present slot, in probation.
   `pace` says how far the channel itself is behind; a flight that cannot keep up is ended with the reason.
7. **Coming and going.** A late process listens, takes the time from the first frame it hears, and begins in probation
   (`core/agents/joining.py`). One that gets a signal says in its own turns that it leaves, and ends then
   (:meth:`~RealtimeNode._ended`).
"""

from __future__ import annotations

import os
import time
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from dtsa_msgs.msg import Frame, Report, Slot
from numpy.typing import NDArray
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rclpy.task import Future

from dtsa_agent.core.agents.joining import Listeners, check_joinable
from dtsa_agent.core.agents.pacing import LATEST_LEAD, LEAD, MOST_EARLY, too_long_ns
from dtsa_agent.core.errors import LocalProtocolError
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.process.loop import Stop
from dtsa_agent.ros.common.process.priority import take_priority
from dtsa_agent.ros.common.wire.checks import SIZES, SLOT, Unusable, check_start
from dtsa_agent.ros.common.wire.packing import split_frames, unpack_received
from dtsa_agent.ros.common.wire.slot_fields import SlotFields
from dtsa_agent.ros.common.wire.stamps import header_of, time_of

from .leaving import Leaving
from .reporter import Reporter
from .send_times import SendTimes
from .slot_clocks import SlotClocks
from .swarm_node import SwarmNode

_PPB = 1_000_000_000
_LONGEST_LEAD_NS = 60_000_000_000  # from the start message to slot 0
_PATIENCE_NS = 50_000_000
_DELIVERY = Duration(seconds=0.2)  # longest wait for the channel to have the last report of an agent that leaves
_DOUBTS = 9  # frames in a row that do not fit the time which an agent took from a single one
# With a policy that needs all tables equal it waits beyond the start: a late frame costs less than tables that differ.
_LATEST, _LATEST_NS = 0.3, 3_000_000
_BURST = 64  # messages taken in at a time: whatever comes, the own slots go on


class RealtimeNode(SwarmNode):
    """A :class:`SwarmNode` whose agents begin their slots by themselves.

    The time line is the channel's: ns from the start of slot 0. An agent's slot starts when its own clock says so; that
    is off by an offset and a drift, and by what the agent has learned from others' frames. As on a vehicle, where a
    timer sends what lies ready, decisions are made a little before. All agents of one process are served when the first
    of them is due; a frame carries the time at which its agent starts to send it: its slot's start, or later if it was
    not ready by then.

    A process that was there at the channel's call begins with slot 0. One that comes later is told where the time line
    lies, too, because the stamps of messages are on it; but its agents take the time of their slots from the first
    frame that each hears, and know nothing: :mod:`dtsa_agent.core.agents.joining`.

    :param args: as for :class:`SwarmNode`.
    :param offset_ns: (L,) ns, offset of each agent's clock: positive clocks are early.
    :param drift_ppb: (L,) parts per billion by which each runs fast.
    :param jitter_ns: ns, standard deviation of the time of a single transmission.
    :param align: whether agents move their slots towards what they hear.
    :param flight_time_ns: ns from the order to send a frame until the receivers' flight processors have it: for any
        frame, and for each of its bytes.
    :param priority: real-time priority of the process, where allowed, once all have found each other; 0: none.
    :param resume_at: m, x, y, z of each agent in turn: where its vehicle hovers when it comes into a flight under way;
        none: at its start in the scenario.
    """

    mode = "realtime"

    def __init__(
        self,
        *args: Any,
        offset_ns: Sequence[int],
        drift_ppb: Sequence[int],
        jitter_ns: float = 0.0,
        align: bool = True,
        flight_time_ns: tuple[int, int] = (0, 0),
        priority: int = 0,
        resume_at: Sequence[float] = (),
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, waiting=names.REALTIME_WAITING, **kwargs)
        count = len(self.swarm.ids)
        self.slot_ns = self.config.slot_ns
        self._lead_ns, self._latest_lead_ns = round(LEAD * self.slot_ns), round(LATEST_LEAD * self.slot_ns)
        if not self.config.policy_row.may_join:
            self._latest_lead_ns = -min(_LATEST_NS, round(_LATEST * self.slot_ns))
        self._own_or_nobody = {0, *self.swarm.ids}
        self._awaits = False  # somebody here takes another one for the slot's sender, and has not heard it yet
        self.unsent = 0  # frames that would have left half a slot late or more
        self._clocks = SlotClocks(self.slot_ns, offset_ns, drift_ppb, align)
        self._lengths: NDArray[np.uint8] = np.zeros(count, dtype=np.uint8)  # bytes sent in the present slot
        self._send_times = SendTimes(self.swarm, jitter_ns, flight_time_ns)
        self._priority = priority  # still to be taken
        self._resume_at = np.array(resume_at, dtype=np.float64).reshape(-1, 3).T
        self._called = False  # was there when the channel asked who is
        self._listeners: Listeners | None = None
        # Came late, and takes its time from the next frame.
        self._timeless: NDArray[np.bool_] = np.zeros(count, dtype=np.bool_)
        self._first = 0  # slot with which this process began, or began anew
        self._too_long_ns = too_long_ns(self.config)
        self._leaving = Leaving(self.swarm)
        self._zero = 0  # CLOCK_MONOTONIC at the start of slot 0, ns; 0: not known yet
        self._complete = False  # the step before took in all that was waited for: no need to look for more
        self._early: list[SlotFields] = []  # frames of a slot that is still to come here

    def _make_publishers(self, swarm_namespace: str, qos: QoSProfile) -> None:
        create = self.node.create_publisher
        self._air = create(Frame, f"{swarm_namespace}/{names.AIR_FRAME}", qos)
        self._telemetry = create(Report, f"{swarm_namespace}/{names.REPORT}", qos)
        self._reporter = Reporter(self._telemetry, self.swarm)

    def _plausible(self, message: SlotFields) -> None:
        now = time.monotonic_ns()
        if message.phase == Slot.START:
            if not 0 < message.time_ns <= now + _LONGEST_LEAD_NS:
                raise Unusable(SLOT, f"a start at {message.time_ns / _PPB:.3f} s, which cannot be")
        elif message.phase == Slot.RUN and self._zero:
            if not len(message.sender):
                raise Unusable(SIZES, "a delivery without a frame")
            here = max(self.slot, (now - self._zero) // self.slot_ns)
            check_start(message.heard_slot * self.slot_ns, here * self.slot_ns)
            check_start(self._began_ns(message), now - self._zero)

    def attach(self) -> Future:
        """Agents with clocks of their own need the loop's timing.

        :raises LocalProtocolError: always.
        """
        raise LocalProtocolError("agents in real time run in a loop of their own, not in an executor")

    def run(self, stop: Stop) -> None:
        """Flies until the run is over or a signal comes; with policy ``lease`` agents first say that they leave.

        :raises ConfigError: in a flight under way that agents of this policy cannot come into.
        """
        while not self._ended(stop):
            if not self._zero:
                message = self.loop.wait()
                if message is not None and not self._prepare(message):
                    return
            elif not (self._listen() if self._listeners else self._step()):
                return
            if self.loop.housekeeping():
                self.idle()

    def _ended(self, stop: Stop) -> bool:
        """Whether to end now because of a signal: the second one, or when all agents here have left after the first."""
        if not stop:
            return False
        leaving = self._leaving
        if not leaving.begun and (self.slot < self._first or not leaving.begin(stop.count, self.slot)):
            return True
        if leaving.goes_on(stop.count, self.slot):
            return not self.loop.subscription.get_publisher_count()
        self._reporter.publish(self.run_id)
        for publisher in (self._air, self._telemetry):
            publisher.wait_for_all_acked(_DELIVERY)
        return True

    def _prepare(self, message: SlotFields) -> bool:
        """Answers the channel's call, or takes the start time; False when the run is over."""
        if message.phase == Slot.PREPARE:
            self._called = True
            if message.slot > names.FIRST_CALL:
                self._go_first()
            self._reporter.add_slot(message.slot, self._clocks.starts(0), self._lengths)
            self._reporter.publish(message.run)
        elif message.phase == Slot.START and (self._called or self._may_join()):
            self._go_first()
            self._begin(message.run)
            self._zero = message.time_ns
            if not self._called:
                now = self._clocks.local_ns(time.monotonic_ns() - self._zero)
                self._listeners = Listeners(self.config, self.swarm.ids, now.tolist())
                self._timeless[:] = True
                if self._resume_at.size:
                    self.swarm.position[:] = self._resume_at
                    self.swarm.track[:] = self._resume_at
        return message.phase != Slot.END

    def _go_first(self) -> None:
        """Real-time priority, where it may be had.

        Not earlier: many processes that look for each other keep all processors busy for seconds, and by turns of
        0.1 s, as real-time priority has them, for minutes.
        """
        if self._priority:
            take_priority(self._priority)
            self._priority = 0

    def _may_join(self) -> bool:
        """Whether the channel has found all that this process sends; who comes late waits for that.

        What is published before is lost, above all what it says about itself. The start is told again and again.

        :raises ConfigError: with a policy whose tables all have to be equal.
        """
        check_joinable(self.config.policy)
        return self.membership.is_heard() and bool(
            self._air.get_subscription_count() and self._telemetry.get_subscription_count()
        )

    def _listen(self) -> bool:
        """Waits for frames that say what time it is; False when the run is over."""
        assert self._listeners is not None
        message = self.loop.wait(_PATIENCE_NS)
        if message is not None and message.phase == Slot.END:
            return False
        if message is not None and message.phase == Slot.RUN:
            self._overhear(message)
        now = time.monotonic_ns() - self._zero
        if self._listeners.ready(self._clocks.local_ns(now).tolist()):
            self._listeners = None
            self._begin_anew(now)
        return True

    def _begin_anew(self, now: int) -> None:
        """From the next slot on all agents here take part, knowing nothing.

        :param now: ns on the channel's time line.
        """
        ahead = now + self._lead_ns
        following = (ahead - int(self._clocks.starts(ahead // self.slot_ns).min())) // self.slot_ns + 1
        self._first, self.slot = following, following - 1
        for index in range(len(self.swarm.ids)):
            self.agents.restart(index, following)
        self._clocks.forget()

    def _step(self) -> bool:
        """Waits for the next slot or message; False when the run is over."""
        lead_ns = self._latest_lead_ns if self._awaits else self._lead_ns
        due = self._zero + (self.slot + 1) * self.slot_ns + int(self._clocks.starts(self.slot + 1).min()) - lead_ns
        remaining = due - time.monotonic_ns()
        if remaining > 0:
            message = self.loop.wait(min(remaining, _PATIENCE_NS))
            goes_on = message is None or self._take(message)
            self._complete = message is not None and not self._awaits
            if self._complete:
                os.sched_yield()  # all agents of this machine hear a frame before any of them goes on
            return goes_on
        complete, self._complete = self._complete, False
        for _ in range(0 if complete else _BURST):
            message = self.loop.take()
            if message is None:
                break
            if not self._take(message):
                return False
        if -remaining > self._too_long_ns and self.config.policy_row.probation:
            self._begin_anew(time.monotonic_ns() - self._zero)
        else:
            self._open(self.slot + 1)
        return True

    def _take(self, message: SlotFields) -> bool:
        if message.phase == Slot.END:
            return False
        if message.phase == Slot.RUN:
            if message.heard_slot > self.slot:
                if len(self._early) < MOST_EARLY:
                    self._early.append(message)
            else:
                self._take_frames(message)
        return True

    def _take_frames(self, message: SlotFields) -> None:
        if message.heard_slot < self._first - 1:
            return  # from before it began
        # In the slot in which it was sent, even if this process, or the channel's, has been kept waiting since.
        masks = self._hear(message, message.heard_slot)
        self._awaits &= message.heard_slot < self.slot
        if masks is not None:
            now = time.monotonic_ns() - self._zero
            for sender, mask in zip(message.sender, masks, strict=True):
                if mask.any():
                    self._reporter.add_heard(sender, message.heard_slot, self.slot, now, mask)
        if masks is None or not (self._clocks.align or self._timeless.any()):
            return
        late = self._lateness(message)
        for index in np.flatnonzero(masks[0]):
            if self._timeless[index]:
                self._take_time(index, late)
                if abs(late[index]) >= self.slot_ns // 2:
                    self.agents.restart(index, self.slot + 1)
            elif self._clocks.align:
                misfits = self._clocks.hear(index, int(late[index]))
                # The frame that a newcomer took its time from may have left late.
                self._timeless[index] = not self._called and misfits >= _DOUBTS

    def _overhear(self, message: SlotFields) -> None:
        """Takes in a frame of which only the time counts."""
        assert self._listeners is not None
        heard = unpack_received(message.received, len(message.sender), self.config.agents)
        (frame,) = split_frames(message.data, message.length)
        if self.swarm.unseal(frame, message.heard_slot) is None:
            return
        late, began = self._lateness(message), self._clocks.local_ns(self._began_ns(message))
        for index in np.flatnonzero(heard[0, self.swarm.local]):
            if self._listeners.hear(index, message.heard_slot, int(began[index])):
                self._take_time(index, late)

    def _take_time(self, index: np.intp, late: NDArray[np.int64]) -> None:
        self._clocks.take(index, int(late[index]))
        self._timeless[index] = False

    def _began_ns(self, message: SlotFields) -> int:
        """When the transmission of a frame began, by its arrival and length: ns on the channel's time line."""
        arrival = message.time_ns - names.TIME_ZERO_NS
        return arrival - self._send_times.under_way_ns(int(message.length[0]))

    def _lateness(self, message: SlotFields) -> NDArray[np.int64]:
        """How much later than each agent expects a frame has begun, ns."""
        slot = int(message.heard_slot)
        return np.asarray(self._began_ns(message) - slot * self.slot_ns - self._clocks.starts(slot))

    def _open(self, slot: int) -> None:
        """Closes the last slot and opens the next: decide, send, fly."""
        swarm = self.swarm
        if slot > self._first:
            self.agents.on_slot_end()
        self._leaving.mark()
        senders = self.agents.on_slot(slot)
        starts = self._clocks.starts(slot)
        offsets = self._send(slot, senders, starts)
        self.slot = slot
        self._awaits = not self._own_or_nobody.issuperset(swarm.chosen.tolist())
        self._reporter.add_slot(slot, offsets, self._lengths)
        if self._watched:
            self._publish_odometry(time_of(names.slot_time_ns(slot, self.slot_ns)))
        self._fly(slot)
        early, self._early = self._early, []
        for message in early:
            self._take(message)
        if self._reporter.due():
            self._reporter.publish(self.run_id)

    def _fly(self, slot: int) -> None:
        """Flies the vehicles through a slot."""
        self.swarm.fly(slot)

    def _send(self, slot: int, senders: Sequence[int], starts: NDArray[np.int64]) -> NDArray[np.int64]:
        """Hands the frames of a slot over to the channel, before anything else is done.

        :param senders: positions of the agents that send.
        :param starts: (L,) ns, start of each agent's slot, from the channel's start of the slot.
        :returns: (L,) ns, the same, but of the transmission where there is one.
        """
        swarm, began = self.swarm, self._zero + slot * self.slot_ns
        offsets = starts.copy()
        self._lengths[:] = 0
        for index in senders:
            data = swarm.frame(index)
            start = self._send_times.start_ns(index, began + int(starts[index]))
            if start is None:
                swarm.drop(index)
                self.unsent += 1
                continue
            offset = start - began
            offsets[index], self._lengths[index] = offset, len(data)
            header = header_of(names.slot_time_ns(slot, self.slot_ns) + offset)
            self._air.publish(
                Frame(header=header, run=self.run_id, slot=slot, agent=swarm.ids[index], data=array("B", data))
            )
            self._leaving.sent(index, data)
        return offsets
