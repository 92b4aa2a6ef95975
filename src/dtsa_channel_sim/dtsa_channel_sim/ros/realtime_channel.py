"""The channel in real time: every agent sends when its own clock says so, and the air decides by overlap."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from dtsa_msgs.msg import Slot, Transmission
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message

from dtsa_agent.core.errors import LocalProtocolError
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.checks import OTHER_RUN, SIZES, UNREADABLE, Unusable, check_start
from dtsa_agent.ros.common.runs import run_text
from dtsa_agent.ros.common.stamps import header_of, time_of
from dtsa_channel_sim.model.air import Air, FrameVerdict
from dtsa_channel_sim.model.airtime import LONGEST_FRAME
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.medium import OnAir
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS, Verdict

from .answers import Answers, named
from .ros_channel import RosChannel, put_frames

_NS = 1_000_000_000
_TICK_NS = 500_000
_REPEAT_S = 0.1
_TELL_S = 1.0  # the start is told again so often, for processes that come later
_LEAD_NS = 300_000_000  # from the start message to slot 0
_GRACE = 0.35  # of a slot: a frame reaches the channel at most this late, or it is late
_STRIDE = 0.25  # of a slot: time moves on by this much at most before messages are looked for again
_PATIENCE = 10  # slots that a slot is kept open for agents that have not reported yet
LOST_AFTER_S = 2.0  # an agent that others outlast by this is lost
_AHEAD = 100  # slots: a report from farther in the future is none
_AFTERLIFE = 10  # slots: a report for a later one was made after its agent had been given up

_Sent = tuple[int, int]  # a frame: its slot as its sender counts, and the sender's id


class RealtimeChannel(RosChannel):
    """Medium of a swarm whose agents have clocks of their own.

    Slots are the channel's own. An agent that falls silent is missed, but nobody waits for it.

    :param node: the ROS node.
    :param channel: the medium.
    :param steps: control instants in a slot.
    :param answer_s: not used: nobody waits.
    :param more: as for :class:`RosChannel`.
    """

    mode = "realtime"

    def __init__(self, node: Node, channel: Channel, steps: int, answer_s: float = 0.0, **more: Any) -> None:
        super().__init__(node, channel, steps, waiting=names.REALTIME_WAITING, **more)
        self.missed = 0  # reports of agents that came too late to count
        self.returned: set[int] = set()  # ids of those that were, and report again
        self.air: Air[_Sent] = Air(channel)
        self._steps = steps
        self._zero = 0
        self._told = 0.0  # time.monotonic() of the last start message
        self._given_up: dict[int, int] = {}  # slot in which an agent was taken for lost, by id
        self._book: dict[int, Answers] = {}
        self._frames: dict[_Sent, bytes] = {}
        self._settled: dict[int, list[FrameVerdict[_Sent]]] = {}
        self._heard_ns = np.zeros(self.agents, dtype=np.int64)
        self._offset_ns = np.zeros(self.agents, dtype=np.int64)  # of each agent's slots, as last reported
        self._lag_ns = 0  # the swarm's common time runs with the mean of its clocks: its slots start so much later
        self._stride_ns = round(_STRIDE * self.slot_ns)
        self._grace_ns = round(_GRACE * self.slot_ns)
        self._close_ns = self._grace_ns + channel.config.airtime.total_ns(LONGEST_FRAME) + _TICK_NS

    def _run(self, stop: object) -> None:
        """Runs until the run is over or ``stop`` is true.

        :raises LocalProtocolError: when an agent does not report at the start.
        :raises DtsaError: when an observer fails.
        """
        try:
            if self._prepare(stop):
                self._fly(stop)
        finally:
            self._publish_end()

    def expect_later(self, agent: int, place: NDArray[np.float64]) -> None:
        """An agent will not be there at the start.

        :param agent: its id.
        :param place: (3,) m, where its vehicle waits.
        """
        self.lose(agent)
        self._given_up[agent] = -_AFTERLIFE
        self.answers.track[:, :, agent - 1] = place

    def lose(self, agent: int) -> None:
        """Takes note that an agent is gone."""
        if agent not in self.lost:
            self.lost.add(agent)
            self.returned.discard(agent)
            self._given_up[agent] = (time.monotonic_ns() - self._zero) // self.slot_ns
            self._observers.agent_silent(agent)

    def last_place(self, agent: int) -> NDArray[np.float64]:
        """Where an agent has reported to be last, (3,) m."""
        reported = [slot for slot, book in self._book.items() if book.answered[agent - 1]]
        book = self._book[max(reported)] if reported else self.answers
        return book.position[:, agent - 1]

    def _welcome(self, slot: int, book: Answers) -> None:
        """Takes agents back that were lost and have reported for a slot."""
        again = [a for a in sorted(self.lost) if book.answered[a - 1] and slot > self._given_up[a] + _AFTERLIFE]
        if again:
            self.lost.difference_update(again)
            self.returned.update(again)
            self._observers.agents_back(again)

    def _prepare(self, stop: object) -> bool:
        """Waits until all agents have reported, and tells them when slot 0 starts."""
        if not self._call(stop, self.lost):
            return False
        begin = time.monotonic()
        repeat = 0.0
        self.answers.open()
        while set(self.answers.silent) - self.lost:
            if stop:
                return False
            now = time.monotonic()
            if now - repeat > _REPEAT_S:
                repeat = now
                self._publisher.publish(Slot(run=self.run_id, phase=Slot.PREPARE, data=self._calling))
            data = self.loop.wait()
            if data is not None:
                message = self._decoded(data)
                if message is not None:
                    with self.intake.guard():
                        self.answers.add(message)
            self._housekeeping()
            if now - begin > self._startup_s:
                missing = named(set(self.answers.silent) - self.lost)
                raise LocalProtocolError(f"{missing} did not report within {self._startup_s:g} s: dead or hung?")
        self._zero = time.monotonic_ns() + _LEAD_NS
        self._tell_start()
        self._heard_ns[:] = 0
        return True

    def _tell_start(self) -> None:
        self._told = time.monotonic()
        header = header_of(self._zero)
        self._publisher.publish(Slot(header=header, run=self.run_id, phase=Slot.START, data=self._calling))

    def _fly(self, stop: object) -> None:
        tick = now = 0
        while not stop:
            data = self.loop.wait(_TICK_NS)
            while data is not None:
                self._take(data)
                data = self.loop.take()
            # After a pause of this process, or of the whole machine, time catches up in small steps: what the others
            # did meanwhile is still on its way.
            now = min(time.monotonic_ns() - self._zero, now + self._stride_ns)
            if now >= tick:
                tick = now + _TICK_NS
                for verdict in self.air.settle(now - self._grace_ns, self.answers.position):
                    self._deliver(verdict)
            while self._due(now):
                if not self._close_slot():
                    return
            if time.monotonic() - self._told > _TELL_S:
                self._tell_start()
            self._housekeeping()

    def _decoded(self, data: bytes) -> Any:
        with self.intake.guard():
            try:
                message = deserialize_message(data, Transmission)
            except Exception:  # rclpy has no common base for what a message can do to it
                raise Unusable(UNREADABLE, f"a message of {len(data)} bytes that is no Transmission") from None
            if message.run != self.run_id:
                raise Unusable(OTHER_RUN, f"an answer of run {run_text(message.run)}")
            self.roster.check_sender(message.agent, self.loop.number, time.monotonic())
            return message
        return None

    def _take(self, data: bytes) -> None:
        """Takes in one process's report for one slot."""
        message = self._decoded(data)
        if message is None:
            return
        slot, now = message.slot, time.monotonic_ns() - self._zero
        with self.intake.guard():
            for offset in message.offset_ns:
                check_start(slot * self.slot_ns + offset, now)
            self._take_report(slot, now, message, data)

    def _take_report(self, slot: int, now: int, message: Any, data: bytes) -> None:
        if slot > now // self.slot_ns + _AHEAD:
            self.missed += len(message.agent)
            return
        if slot > self.slot:
            book = self._entry(slot)
        else:  # too late for the slot's account; what it sends may still be on the air
            self.missed += len(message.agent)
            book = Answers(self.agents, self._steps)
        if not slot and not len(message.offset_ns):
            return  # an answer to the call
        if len(message.offset_ns) != len(message.agent):
            raise Unusable(SIZES, f"{len(message.offset_ns)} offsets of {len(message.agent)} agents")
        if not book.add(message):
            return
        self._observers.answer_received(slot, message.agent.tobytes(), data)
        self._observers.report(message)
        for agent, offset, length in zip(message.agent, message.offset_ns, message.length, strict=True):
            self._heard_ns[agent - 1] = now
            self._offset_ns[agent - 1] = offset
            key = (slot, agent)
            if length and key not in self._frames:
                self._frames[key] = book.frames[agent]
                start_ns = slot * self.slot_ns + offset
                if not self.air.begin(key, agent, start_ns, length):
                    self._drop(key, start_ns, length)

    def _entry(self, slot: int) -> Answers:
        book = self._book.get(slot)
        if book is None:
            book = self._book[slot] = Answers(self.agents, self._steps)
        return book

    def _drop(self, key: _Sent, start_ns: int, length: int) -> None:
        """Takes a frame into its slot's account that came too late to be on the air: nobody hears it."""
        frame = OnAir.of(self.model.config.airtime, key[1], start_ns, length)
        nobody = np.zeros(self.agents, dtype=np.bool_)
        slot = max(0, start_ns // self.slot_ns)
        verdict = FrameVerdict(key, key[1], slot, start_ns, frame.end_ns, frame.end_ns, nobody, 0, 0)
        self._settled.setdefault(max(key[0], self.slot + 1), []).append(verdict)

    def _deliver(self, verdict: FrameVerdict[_Sent]) -> None:
        """Sends a frame that has left the air to those that received it."""
        slot, sender = verdict.frame_id
        self._settled.setdefault(max(slot, self.slot + 1), []).append(verdict)
        if not verdict.received.any():
            return
        frame = self._frames[(slot, sender)]
        time_ns = names.TIME_ZERO_NS + max(0, verdict.arrival_ns)
        message = Slot(header=header_of(time_ns), run=self.run_id, slot=slot, phase=Slot.RUN, heard_slot=slot)
        put_frames(message, [sender], [frame], verdict.received[None])
        data = bytes(serialize_message(message))
        self._publisher.publish(data)
        self._observers.slot_published(max(slot, self.slot + 1), data, time_ns)

    def _due(self, now: int) -> bool:
        """Whether the next slot can be closed: its frames are settled, all agents have reported for the one after."""
        end = (self.slot + 2) * self.slot_ns + self._lag_ns
        if now < end + self._close_ns:
            return False
        if now >= end + round(_PATIENCE * self.slot_ns):
            return True
        following = self._book.get(self.slot + 2)
        return following is not None and not set(following.silent) - self.lost

    def _close_slot(self) -> bool:
        """Tells the observers of a slot that has passed; False when the run is over."""
        slot = self.slot + 1
        book = self._completed(slot)
        if not slot and not self._goes_on(0, book):
            return False
        self.answers = book
        frames, verdict = self._verdict(slot)
        self._observers.judged(slot, book, frames, verdict)
        self._tell_time(time_of(names.slot_time_ns(slot, self.slot_ns)))
        self._observers.slot_over(slot, book, verdict)
        self.slot = slot
        self._lag_ns = int(np.median(self._offset_ns[[k for k in range(self.agents) if k + 1 not in self.lost] or [0]]))
        following = self._completed(slot + 1)
        self._book.pop(slot, None)
        return self._goes_on(slot + 1, following)

    def _completed(self, slot: int) -> Answers:
        """A slot's reports, those that are missing taken from the slot before."""
        book = self._entry(slot)
        if self.lost:
            self._welcome(slot, book)
        book.carry(self.answers)
        # Compared with the others: if nobody is heard, it may be this process that got no time.
        newest = int(self._heard_ns.max())
        for agent in book.silent:
            if newest - self._heard_ns[agent - 1] > LOST_AFTER_S * _NS:
                self.lose(agent)
        return book

    def _verdict(self, slot: int) -> tuple[dict[int, bytes], Verdict]:
        """What the air did in one slot, frame by frame."""
        settled = self._settled.pop(slot, [])
        frames = {}
        for verdict in settled:
            frames[verdict.sender] = self._frames.pop(verdict.frame_id)
        if not settled:
            return frames, Verdict(IDLE, (), None, None, None)
        outcome = COLLISION if any(verdict.collided for verdict in settled) else SUCCESS
        return frames, Verdict(
            outcome,
            tuple(verdict.sender for verdict in settled),
            np.array([verdict.received for verdict in settled]),
            tuple(verdict.lost for verdict in settled),
            tuple(verdict.collided for verdict in settled),
        )
