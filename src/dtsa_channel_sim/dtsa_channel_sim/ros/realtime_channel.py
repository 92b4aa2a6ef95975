"""The channel in real time: every agent sends when its own clock says so, and the air decides by overlap.

Times are ns from the start of slot 0, unless said otherwise; positions are (3, N), m, frame map.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from dtsa_msgs.msg import Frame, Report, Slot
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from dtsa_agent.core.delays import Delays
from dtsa_agent.core.frame import named_in
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import ns_of
from dtsa_agent.ros.common.checks import RANGE, SIZES, BadMessage, check_start
from dtsa_agent.ros.common.loop import Feed
from dtsa_agent.ros.common.messages import Fields, header_of, read_report
from dtsa_channel_sim.model.air import NEVER, FrameVerdict, LiveAir
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.verdict import Verdict

from .answers import Accounts, Answers, check_report
from .ros_channel import RosChannel

_NS = 1_000_000_000
_TICK_NS = 2_000_000  # longest wait for a frame
LOST_AFTER_S = 2.0  # an agent that others outlast by this is lost
_RETURN_SLOTS = 10  # a report for a slot that much after its agent was given up says that the agent is back
_LONGEST_S = 0.5  # of one round of messages before slot 0
_SETTLED_S = 10.0  # after that the run starts, however long rounds take
_PAUSE_S = 0.0001
_BURST = 256  # messages; whatever comes, the clock is looked at
_START_S = 1.0  # the start is published again so often, for processes that come later
_LEAD_NS = 300_000_000  # from the start message to slot 0
_PATIENCE_SLOTS, _PATIENCE_NS = 10, 500_000_000  # an account waits for reports at least so long
# After a stall the middleware repeats some messages only when its writers ask for acknowledgements, every 3 s.
_RECOVERY_NS = 4 * _NS
_AHEAD = 100  # slots: a report from farther in the future is none
_KEEP_NS = 10 * _NS  # an agent may report so late that it received a frame
# What one pass of the loop does at most: frames, reports. Then it checks the clock and signals again.
_FRAMES, _REPORTS = 64, 2
_TIGHT = 0.6  # of a slot: a round of messages that takes longer leaves too little for the rest

_STALL_SLOTS, _STALL_NS = 5, 50_000_000
_MOST_STALLS = 1000  # kept one by one; later ones are only counted
_BEHIND_NS, _TOO_LONG_NS = 1 * _NS, 8 * _NS  # a run that is that far behind for that long will not catch up

SentFrame = tuple[int, int]  # a frame: its slot as its sender counts, and the sender's id
_read_frame = partial(deserialize_message, message_type=Frame)


class Pace:
    """Whether the channel keeps up with its time line, by the passes of its loop: how late it is, when it stalled."""

    def __init__(self, slot_ns: int) -> None:
        self._stall_ns = max(_STALL_SLOTS * slot_ns, _STALL_NS)
        self.lag = Delays()  # from when a frame could have been delivered to when it was
        self.stalls: list[tuple[int, int]] = []  # from, to
        self.stall_count = self._last_ns = 0
        self._behind_since_ns: int | None = None

    def passed(self, now_ns: int) -> tuple[int, int] | None:
        """The next pass begins; return from when to when the channel stood still before it, ns; None: it did not."""
        gap, self._last_ns = (self._last_ns, now_ns), now_ns
        if now_ns - gap[0] < self._stall_ns:
            return None
        self.stall_count += 1
        if len(self.stalls) < _MOST_STALLS:
            self.stalls.append(gap)
        return gap

    def falls_behind(self, now_ns: int, done_ns: int) -> bool:
        """Whether a run that should have come to ``done_ns`` by now is too far behind for too long to catch up."""
        if now_ns - done_ns < _BEHIND_NS:
            self._behind_since_ns = None
            return False
        if self._behind_since_ns is None:
            self._behind_since_ns = now_ns
        return now_ns - self._behind_since_ns > _TOO_LONG_NS

    @property
    def behind_since_s(self) -> float:
        """Since when the run has been behind, s from the start of slot 0."""
        return (self._behind_since_ns or 0) / _NS


class RealtimeChannel(RosChannel):
    """Medium of a swarm whose agents have clocks of their own.

    Slots are the channel's own. An agent that falls silent is missed, but not waited for. Frames come apart from all
    else and are dealt with first; what the agents report fills an account of each slot, in which frames are long
    delivered.
    """

    mode = "realtime"

    def __init__(
        self, node: Node, channel: Channel, steps: int, answer_s: float = 0.0, swarm_namespace: str = names.SWARM,
        **more: Any,
    ) -> None:  # fmt: skip
        air = (Frame, names.AIR_FRAME)
        super().__init__(node, channel, steps, names.REALTIME_WAITING, air, swarm_namespace=swarm_namespace, **more)
        qos = names.lockstep_qos(names.REALTIME_WAITING * self.agents)
        self._reports = Feed(node, Report, f"{swarm_namespace}/{names.REPORT}", qos, read=bytes)
        self.accounts = Accounts(self.agents, steps, max(100, _KEEP_NS // self.slot_ns))
        self.air = LiveAir(channel)
        self.pace = Pace(self.slot_ns)
        self.round_ms: float | None = None  # of the last round of messages before slot 0
        self._given_up: dict[int, int] = {}  # slot in which an agent was taken for lost, by id
        self._heard_ns = np.zeros(self.agents, dtype=np.int64)  # when each was heard last
        self._steps = steps
        self._zero = 0  # CLOCK_MONOTONIC at the start of slot 0
        self._start_published_s = 0.0  # time.monotonic() of the last start message
        self._leisure_ns = -NEVER  # when there was time for all that is not the air
        self._resolved: dict[int, list[FrameVerdict[SentFrame]]] = {}  # by slot that is not closed
        self._recovered_ns = 0  # when all that was sent during the last stall should have come
        self._newest = -1  # slot: last one reported by any agent
        self._lag_ns = 0  # the swarm's common time runs with the mean of its clocks: its slots start so much later
        self._longest = channel.config.airtime.longest
        self._close_ns = self.air.hold_ns + channel.config.airtime.latest_ns(self._longest) + _TICK_NS
        self._patience_ns = max(_PATIENCE_SLOTS * self.slot_ns, _PATIENCE_NS)

    def _run(self, stop: object) -> None:
        if self._prepare(stop):
            self._fly(stop)

    def close(self) -> None:
        try:
            super().close()
        finally:
            self._reports.close()

    # Which agents take part.

    def expect_later(self, agent: int, place: NDArray[np.float64]) -> None:
        """Note that an agent comes after the start; its vehicle waits at a place, (3,) m."""
        self.answers.track[:, :, agent - 1] = place
        self.lose(agent)
        self._given_up[agent] = -_RETURN_SLOTS

    def lose(self, agent: int) -> None:
        """Note that an agent is gone."""
        if agent not in self.lost:
            self.lost.add(agent)
            self.returned.discard(agent)
            self._given_up[agent] = self._now() // self.slot_ns
            self._observers.agent_silent(agent)

    def _hear(self, agents: Sequence[int], now: int) -> None:
        index = np.array(agents, dtype=np.intp) - 1
        silence_ns = now - self._heard_ns.max()
        if silence_ns > self._patience_ns:  # of all: it counts for no agent
            self._heard_ns += silence_ns
            self._recovered_ns = max(self._recovered_ns, now + self._patience_ns)
        self._heard_ns[index] = np.maximum(self._heard_ns[index], now)

    def last_place(self, agent: int) -> NDArray[np.float64]:
        """Return the last position that an agent has reported, (3,) m."""
        place = self.accounts.last_place(agent)
        return self.answers.position[:, agent - 1] if place is None else place

    # Before slot 0.

    def _prepare(self, stop: object) -> bool:
        """Wait until all agents have reported, and publish when slot 0 starts; return False when stopped."""
        if not self._call(stop, self.lost):
            return False

        def still_awaited() -> set[int]:
            self._answered_call(names.FIRST_CALL)
            return set(self.answers.silent) - self.lost

        if not self._await_all(stop, still_awaited, _TICK_NS):
            return False
        self._await_short_round(stop)
        if stop:
            return False
        self._zero = time.monotonic_ns() + _LEAD_NS
        self._publish_start()
        self._observers.start_known(self._zero / _NS)
        self._heard_ns[:] = 0
        return True

    def _answered_call(self, number: int) -> set[int]:
        """Return the agents whose answers to a call of this number have come since this was asked.

        The first answer of each says where it is: one that is late with its first report has been nowhere else.
        """
        present: set[int] = set()
        for data in islice(iter(self._reports.take, None), _BURST):
            with suppress(Exception):  # rclpy has no common base for what a message can do to it
                message = read_report(data)
                if message.run == self.run_id and message.slot.tolist() == [number]:
                    at = self.roster.check_sender(message.agent, self._reports.sender)
                    check_report(message, self._steps)
                    if not self.answers.answered[at].any():
                        self.answers.add_report(at, message, 0)
                    present.update(message.agent)
        return present

    def _await_short_round(self, stop: object) -> None:
        """Call until a round of messages, from a call to the last answer, is short enough, or for some seconds.

        Many processes may have found the channel and still look for each other.
        """
        end_s, absent, number = time.monotonic() + _SETTLED_S, set(self.lost), names.FIRST_CALL
        while not stop and self.lost == absent and time.monotonic() < end_s:
            begin_s, awaited = time.monotonic(), set(range(1, self.agents + 1)) - absent
            number += 1
            self._publish_call(number)
            while awaited and time.monotonic() < begin_s + _LONGEST_S:
                time.sleep(_PAUSE_S)
                awaited -= self._answered_call(number)
            self.round_ms = (time.monotonic() - begin_s) * 1e3
            if not self.tight:
                return
            self._housekeeping()

    @property
    def tight(self) -> bool:
        """Whether a round of messages before slot 0 took so much of a slot that the machine may not keep up."""
        return self.round_ms is not None and self.round_ms * 1e6 > _TIGHT * self.slot_ns

    def _publish_start(self) -> None:
        self._start_published_s = time.monotonic()
        header = header_of(self._zero)
        self._publisher.publish(Slot(header=header, run=self.run_id, phase=Slot.START, data=self._calling))

    # The time line.

    def _now(self) -> int:
        return time.monotonic_ns() - self._zero

    def _fly(self, stop: object) -> None:
        self.pace = Pace(self.slot_ns)
        self.pace.passed(self._now())
        more = False
        while not stop:
            data = self.loop.wait(0 if more else self.air.spare_ns(self._now(), _TICK_NS))
            if gap := self.pace.passed(self._now()):
                self._resume(*gap)
            for _ in range(_FRAMES):
                if data is None:
                    break
                with self.intake.guard():
                    self._accept_frame(data)
                data = self.loop.take()
            now = self._now()
            self._deliver_arrived(now)
            more = False
            if self._at_leisure(now):
                more = self._read_reports()
                if self._can_close(now):
                    if not self._close_slot():
                        return
                    more = more or self._can_close(now)
                if time.monotonic() - self._start_published_s > _START_S:
                    self._publish_start()
                self._housekeeping()
            if self._falls_behind(now):
                return

    def _at_leisure(self, now: int) -> bool:
        """Whether there is time for the rest: no frame waits for its delivery, or the rest has waited for a slot."""
        if self.air.waits and now - self._leisure_ns < self.slot_ns:
            return False
        self._leisure_ns = now
        return True

    def _resume(self, before: int, now: int) -> None:
        """After a stall: what was handed over meanwhile is too late for the air, and silence counts for no agent."""
        self._deliver_arrived(now)
        self._recovered_ns = now + (_RECOVERY_NS if now - before > self._patience_ns else self._patience_ns)
        self._heard_ns[:] = np.maximum(self._heard_ns + (now - before), self._recovered_ns)

    def _falls_behind(self, now: int) -> bool:
        """Whether the run cannot keep up, by its accounts or by the agents' reports."""
        accounted = (self.slot + 2) * self.slot_ns + self._patience_ns
        reported = (self._newest + 2) * self.slot_ns + self._patience_ns
        all_lost = len(self.lost) == self.agents
        if not self.pace.falls_behind(now, accounted if all_lost else min(accounted, reported)):
            return False
        is_heard = now - self._heard_ns.max() < _BEHIND_NS
        behind = "the channel is" if accounted <= reported and is_heard else "the agents are"
        self.fell_behind = (
            f"the machine does not keep up: {behind} {(now - min(accounted, reported)) / _NS:.1f} s behind, "
            f"since {self.pace.behind_since_s:.1f} s; longer slots or fewer processes would help"
        )
        return True

    def _accept_frame(self, data: bytes) -> None:
        """Put a frame on the time line.

        :raises BadMessage: if it cannot be one.
        """
        message = self._decoded(data, Frame, _read_frame)
        slot, agent, frame = message.slot, message.agent, bytes(message.data)
        if agent in self.lost:
            self._meet_processes()  # a new process tells about itself before it sends anything else
        self.roster.check_frame(agent, self.loop.sender)
        start_ns, now = ns_of(message.header.stamp) - names.TIME_ZERO_NS, self._now()
        if not 1 <= len(frame) <= self._longest:
            raise BadMessage(SIZES, f"a frame of {len(frame)} bytes")
        if named_in(frame) != (agent, slot & 0xFFFFFFFF):
            raise BadMessage(RANGE, f"a frame for cf{agent} and slot {slot} that does not name them")
        check_start(start_ns, now, early_ns=_AHEAD * self.slot_ns)
        check_start(slot * self.slot_ns, now, early_ns=_AHEAD * self.slot_ns)
        if not self.air.hand_over((slot, agent), start_ns, frame):
            return
        self._observers.frame_sent(slot, agent, frame, start_ns)
        self._hear((agent,), now)

    def _deliver_arrived(self, now: int) -> None:
        """Send all frames whose time has come to those that received them."""
        for verdict in self.air.pop_arrived(now, self.answers.position):
            slot, sender = verdict.frame_id
            self._resolved.setdefault(max(slot, self.slot + 1), []).append(verdict)
            lag_ns = self._now() - max(verdict.end_ns + self.air.hold_ns, verdict.arrival_ns)
            self.pace.lag.add(lag_ns)
            self.lag_ms = lag_ns / 1e6
            if not verdict.received.any():
                continue
            frame = self.air.frames[verdict.frame_id]
            time_ns = names.TIME_ZERO_NS + max(0, verdict.arrival_ns)
            self._publisher.publish(self._pack_slot(time_ns, slot, slot, (sender,), (frame,), verdict.received[None]))
            self.accounts.deliver(slot, sender, frame, verdict.arrival_ns, verdict.received)

    # The accounts.

    def _read_reports(self) -> bool:
        """Read some reports; return whether there may be more."""
        for _ in range(_REPORTS):
            data = self._reports.take()
            if data is None:
                return False
            with self.intake.guard():
                self._accept_report(self._decoded(data, Report, read_report))
        return True

    def _accept_report(self, message: Fields) -> None:
        """Add one process's report to the accounts.

        :raises BadMessage: if it cannot be one.
        """
        if self.lost and not self.lost.isdisjoint(message.agent[: self.agents]):
            self._meet_processes()
        at = self.roster.check_sender(message.agent, self._reports.sender)
        now = self._now()
        if len(message.slot) and message.slot[0] >= names.FIRST_CALL:
            return  # an answer to a call, which has come late
        self._newest = max(self._newest, self.accounts.add(at, message, now // self.slot_ns + _AHEAD))
        self._hear(message.agent, now)
        self._observers.report(message)

    def _can_close(self, now: int) -> bool:
        """Whether the next slot can be closed: its frames are resolved, all agents have reported for the one after."""
        end = (self.slot + 2) * self.slot_ns + self._lag_ns
        if now < end + self._close_ns:
            return False
        # Agents that are silent all together are stopped: what they report comes later.
        is_anybody_heard = self._heard_ns.max() >= end or len(self.lost) == self.agents
        if is_anybody_heard and now >= max(end + self._patience_ns, self._recovered_ns):
            return True
        book = self.accounts[self.slot + 2]
        return bool(book.answered.any()) and not set(book.silent) - self.lost

    def _close_slot(self) -> bool:
        """Tell the observers of a slot that has passed; return False when the run is over."""
        slot = self.slot + 1
        book = self._completed(slot)
        if not slot and not self._goes_on(0, book):
            return False
        self.answers = book
        found = {verdict.sender: verdict for verdict in reversed(self._resolved.get(slot, []))}
        # A frame that came late, of a sender that has another one here, counts in the next slot.
        later = [verdict for verdict in self._resolved.pop(slot, []) if found[verdict.sender] is not verdict]
        self._resolved[slot + 1] = later + self._resolved.get(slot + 1, [])
        resolved = [found[sender] for sender in sorted(found)]
        book.frames = {verdict.sender: self.air.frames.pop(verdict.frame_id) for verdict in resolved}
        verdict = Verdict.of([verdict.sender for verdict in resolved], resolved)
        self._observers.arbitrated(slot, book, verdict)
        self._publish_clock(names.slot_time_ns(slot, self.slot_ns))
        self._observers.slot_over(slot, book, verdict)
        self.slot = slot
        here = book.answered.copy()
        here[[agent - 1 for agent in self.lost]] = False
        if here.any():
            self._lag_ns = int(np.median(book.offset_ns[here]))
        following = self._completed(slot + 1)
        self.accounts.close(slot)
        return self._goes_on(slot + 1, following)

    def _completed(self, slot: int) -> Answers:
        """Return a slot's reports, those that are missing copied from the slot before."""
        book = self.accounts[slot]
        back = [a for a in sorted(self.lost) if book.answered[a - 1] and slot > self._given_up[a] + _RETURN_SLOTS]
        if back:
            self.lost.difference_update(back)
            self.returned.update(back)
            self._observers.agents_back(back)
        book.carry(self.answers)
        # Agents are compared with the others: if none is heard, it may be the channel that got no time.
        silent_ns = self._heard_ns.max() - self._heard_ns
        for agent in book.silent:
            if silent_ns[agent - 1] > LOST_AFTER_S * _NS:
                self.lose(agent)
        return book
