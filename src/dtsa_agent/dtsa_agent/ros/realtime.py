"""Agents on their own clocks: no agent waits for another, and a frame that is late is late.

1. **Time.** The channel calls all processes, then sends START with the time of slot 0 on CLOCK_MONOTONIC. Slot T lies
   T slot lengths after it. Each agent has a clock of its own, off by an offset and a drift.
2. **A slot.** Each agent is a station (`core/station`) that says when it is due, decides, and gives the frame to send.
   That is published with the time at which its transmission starts, mostly some time ahead; then the vehicles move.
   A frame that would leave half a slot late is not sent.
3. **The air.** The channel finds a frame's receivers and delivers it to all processes. The stations whose bits are set
   receive it; the time of its arrival moves their slots.
4. **Reports.** Some ten times a second a process reports what its agents decided, received and flew (`reporter`).
5. **Coming and going.** A late agent listens, takes the time from the first frame that it hears, and hovers until the
   others know it. One that gets a signal announces in its own turns that it leaves, and ends then.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np
from dtsa_msgs.msg import Frame, Report, Slot
from rclpy.duration import Duration
from rclpy.node import Node

from dtsa_agent.air.driver import AgentVehicle
from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core import station as core
from dtsa_agent.core.agent import REFUSED
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.core.settings.scenario import STREAM_CLOCKS, Scenario, generator
from dtsa_agent.core.station import ClockMap, Link, Station, StationSettings
from dtsa_agent.core.swarm import Presence
from dtsa_agent.priority import set_realtime
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import split_frames, unpack_received
from dtsa_agent.ros.common.checks import SIZES, SLOT, BadMessage, check_start
from dtsa_agent.ros.common.messages import FRAME, Fields
from dtsa_agent.stop import Stop

from .agents_node import AgentsNode
from .reporter import Reporter

_NEVER = 1 << 62
_LONGEST_LEAD_NS = 60_000_000_000  # from the start message to slot 0
_PATIENCE_NS = 50_000_000
_DELIVERY = Duration(seconds=0.2)  # longest wait for the channel to have the last report of an agent that leaves
_TRUST_NS = 1_000_000  # frames that are off by more do not move slots
_BURST = 64  # messages received at a time: whatever comes, the own slots go on


class RealtimeAgent:
    """A station, its clock, and a radio that sends when the slot begins what is ready by then.

    All times but the station's own are ns of CLOCK_MONOTONIC.

    :param index: place among the agents here.
    :param jitter_ns: standard deviation of the time of a single transmission.
    """

    def __init__(
        self, id: int, index: int, config: SwarmConfig, scenario: Scenario, clock: ClockMap, jitter_ns: float,
        reporter: Reporter,
    ) -> None:  # fmt: skip
        self.id, self.clock = id, clock
        self.swarm = make_swarm(config, scenario, local=[id])
        self.vehicle = AgentVehicle()
        self.slot = -1  # the present one
        self.start_ns = 0  # of its slot, or of the transmission in it
        self.frame = b""  # that it sends in this slot
        self.due_ns = _NEVER
        self.refusals: Counter[str] = Counter()  # frames, by reason; empty: because of their content
        self.index, self._reporter = index, reporter
        self._slot_ns, self._jitter_ns = config.slot_ns, jitter_ns
        self._random = generator(config.seed, STREAM_CLOCKS, id)
        self._opened = False

    def begin(self, settings: StationSettings, zero: int) -> None:
        """Take part from now on; ``zero``: CLOCK_MONOTONIC at the start of slot 0."""
        self.clock, self.due_ns = replace(self.clock, began_ns=zero), time.monotonic_ns()
        now, sense = self.clock.local_ns(self.due_ns), self.vehicle.before_slot(self.swarm)
        self.station = Station(self.swarm, settings, now, sense, self)

    def receive(self, frame: bytes, arrival_ns: int) -> None:
        """A frame has arrived."""
        self.station.receive(frame, self.clock.local_ns(arrival_ns))
        self.due_ns = min(self.due_ns, time.monotonic_ns())

    def step(self) -> bool:
        """Do what is due now; return True if a slot is open, in which it may send a :attr:`frame`."""
        self._opened, station, clock = False, self.station, self.clock
        due, _ = station.step(clock.local_ns(time.monotonic_ns()))
        if self._opened:
            self.slot = station.slot
            start = station.slot_start_ns(self.slot)
            self._send(start)
            shown = clock.local_ns(time.monotonic_ns())
            # Not yet the next slot: this one comes first.
            due = station.step(shown)[0] if shown < start else shown
        self.due_ns = clock.monotonic_ns(due)
        return self._opened

    def _send(self, slot_start: int) -> None:
        """Hand over the frame that is ready: its transmission begins with the slot, but for jitter, or now.

        :param slot_start: by the own clock.
        """
        self.start_ns, self.frame = self.clock.monotonic_ns(slot_start), b""
        if not self.swarm.frame_length[0]:
            return
        jitter = int(self._jitter_ns * self._random.standard_normal()) if self._jitter_ns else 0
        start = max(self.start_ns + jitter, time.monotonic_ns())
        late = max(0, start - self.start_ns)
        # So late that the next turn would be disturbed: the station keeps it back.
        sent = slot_start + (self._slot_ns if late > self._slot_ns // 2 else late)
        _, self.frame = self.station.step(sent)
        if self.frame:
            self.station.sent(sent, True)
            self.start_ns = start

    # Events of the station.

    def opened(self, slot: int, start_ns: int, is_first: bool) -> None:
        self._opened = True

    def restarted(self, slot: int) -> None:
        pass

    def heard(self, sender: int, slot: int, datagram: bytes, arrival_ns: int, accepted: bool) -> None:
        if accepted:
            self._reporter.add_received(self.index, sender, slot, self.station.slot)
        else:
            self.refusals[""] += 1

    def refused(self, fault: str, datagram: bytes, arrival_ns: int) -> None:
        if fault != core.REPEATED:  # it has it
            self.refusals[fault] += 1


class RealtimeNode(AgentsNode):
    """Agents that begin their slots by themselves.

    A process that comes after the channel's call is told where the time line lies, too, because the stamps of messages
    are on it.

    :param ids: of the agents that live here, ascending.
    :param clocks: one an agent, on the channel's time line; none: without offset and drift.
    :param jitter_ns: standard deviation of the time of a single transmission.
    :param align: whether agents move their slots towards what they hear.
    :param flight_time_ns: from the order to send a frame until the receivers' flight processors have it.
    :param priority: real-time priority of the process, where allowed, once all have found each other; 0: none.
    :param resume_at: m, x, y, z of each agent in turn: where its vehicle hovers when it comes into a flight under way;
        none: at its start in the scenario.
    """

    mode = "realtime"

    def __init__(
        self, node: Node, config: SwarmConfig, ids: Sequence[int], swarm_namespace: str = names.SWARM, *,
        authenticator: Authenticator | None = None, clocks: Sequence[ClockMap] = (), jitter_ns: float = 0.0,
        align: bool = True, flight_time_ns: int = 0, priority: int = 0, resume_at: Sequence[float] = (),
    ) -> None:  # fmt: skip
        self.slot_ns, self._flight_ns = config.slot_ns, flight_time_ns
        self._authenticator, self._align = authenticator, align
        qos = names.lockstep_qos(names.REALTIME_WAITING)
        self._air = node.create_publisher(Frame, f"{swarm_namespace}/{names.AIR_FRAME}", qos)
        self._telemetry = node.create_publisher(Report, f"{swarm_namespace}/{names.REPORT}", qos)
        self._reporter = Reporter(self._telemetry, config, ids)
        scenario = make_scenario(config)
        clocks = clocks or [ClockMap()] * len(ids)
        self.agents = [
            RealtimeAgent(agent, index, config, scenario, clock, jitter_ns, self._reporter)
            for index, (agent, clock) in enumerate(zip(ids, clocks, strict=True))
        ]
        self._columns = np.array(ids) - 1
        self._priority = priority  # still to be taken
        self._resume_at = np.array(resume_at, dtype=np.float64).reshape(-1, 3)
        self._called = False  # the channel called before it started
        self._zero = 0  # CLOCK_MONOTONIC at the start of slot 0, ns; 0: not known yet
        self._leaves_by: int | None = None  # slot: all have left then at the latest; None: no agent leaves
        self._signals = 0  # when that began
        super().__init__(node, config, ids, swarm_namespace, names.REALTIME_WAITING)

    def _check_next(self, message: Fields) -> None:
        now = time.monotonic_ns()
        if message.phase == Slot.START:
            if not 0 < message.time_ns <= now + _LONGEST_LEAD_NS:
                raise BadMessage(SLOT, f"a start at {message.time_ns / 1e9:.3f} s, which cannot be")
        elif message.phase == Slot.RUN and self._zero:
            if not len(message.sender):
                raise BadMessage(SIZES, "a delivery without a frame")
            here = max(self.slot, (now - self._zero) // self.slot_ns)
            check_start(message.heard_slot * self.slot_ns, here * self.slot_ns)
            check_start(message.time_ns - names.TIME_ZERO_NS - self._flight_ns, now - self._zero)

    def _dropped_frames(self) -> dict[str, int]:
        most: Counter[str] = Counter()  # a frame that several agents have refused counts once
        for agent in self.agents:
            most |= agent.refusals
        malformed, rejected = most[core.LENGTH] + most[core.NO_FRAME], most[core.REJECTED]
        return {
            "frame malformed": malformed + max(agent.swarm.malformed for agent in self.agents),
            "frame foreign": most.total() - most[""] - malformed - rejected
            + max(agent.swarm.foreign for agent in self.agents),
            "frame rejected": rejected,
            REFUSED: sum(agent.refusals.total() for agent in self.agents),
        }  # fmt: skip

    # From the call to the end.

    def _has_ended(self, stop: Stop) -> bool:
        """Whether to end now because of a signal: the second one, or when all agents here have left after the first."""
        if not stop:
            return False
        if self._leaves_by is None:
            if not self.config.policy_row.says_leaving or self.slot < 0:
                return True
            self._signals = stop.count
            self._leaves_by = self.slot + (self.config.main_every + 1) * self.config.agents
            for agent in self.agents:
                if agent.slot >= 0:
                    agent.station.leave()
        in_time = stop.count == self._signals and self.slot <= self._leaves_by
        if in_time and any(agent.swarm.present[0] == Presence.LEAVING for agent in self.agents):
            return not self.loop.subscription.get_publisher_count()
        self._reporter.publish(self.run_id, self.slot)
        for publisher in (self._air, self._telemetry):
            publisher.wait_for_all_acked(_DELIVERY)
        return True

    def _prepare(self, message: Fields) -> bool:
        """Answer the channel's call, or take the start time; return False when the run is over."""
        if message.phase == Slot.PREPARE and self._find_vehicles():
            self._called = True
            if message.slot > names.FIRST_CALL:
                self._go_first()
            for agent in self.agents:
                self._reporter.add_slot(agent.index, message.slot, agent.clock.monotonic_ns(0), 0, agent.swarm)
            self._reporter.publish(message.run, message.slot)
        elif message.phase == Slot.START and (self._called or self._may_join()) and self._find_vehicles():
            self._go_first()
            self._begin(message.run, message.time_ns)
        return message.phase != Slot.END

    def _find_vehicles(self) -> bool:
        """Write where the vehicles are into their agents; return whether that is known of all."""
        ready = [agent.vehicle.is_ready() for agent in self.agents]
        for agent in self.agents:
            agent.vehicle.sense(agent.swarm)
        return all(ready)

    def _go_first(self) -> None:
        """Take real-time priority, where allowed, but not before all processes have found each other.

        By turns of 0.1 s, as real-time priority has them, that would take minutes.
        """
        if self._priority:
            set_realtime(self._priority)
            self._priority = 0

    def _may_join(self) -> bool:
        """Whether the channel has found all that this process publishes: what is published before is lost."""
        core.check_joinable(self.config.policy)
        return all(p.get_subscription_count() for p in (self._processes, self._air, self._telemetry))

    def _begin(self, run: int, zero: int) -> None:
        """The run begins for these agents, with slot 0 at a time of CLOCK_MONOTONIC, ns."""
        session = self._begin_run(run)
        self._zero = zero
        if self._authenticator is not None and not self.config.auth_session:
            self._authenticator.begin(session)
        # The channel has said what time it is, or not.
        keeps = core.KeepsTime.NUMBERS if self._called else core.KeepsTime.NOTHING
        link = Link(b"", says_late=False, names=0, flight_ns=self._flight_ns, trust_ns=_TRUST_NS)
        for agent in self.agents:
            settings = StationSettings(
                self.config, link, self._authenticator, agent.id, origin_ns=zero, listens=not self._called,
                keeps_time=keeps if self._align else core.KeepsTime.STARTS,
            )  # fmt: skip
            agent.begin(settings, zero)
        for agent, place in zip(self.agents, self._resume_at if not self._called else (), strict=False):
            agent.swarm.position[:, 0] = agent.swarm.track[:, :, 0] = place

    # Slots.

    def _serve(self) -> bool:
        if not self._zero:
            message = self.loop.wait()
            return message is None or self._prepare(message)
        remaining = min(agent.due_ns for agent in self.agents) - time.monotonic_ns()
        if remaining > 0:
            message = self.loop.wait(min(remaining, _PATIENCE_NS))
            goes_on = message is None or self._receive(message)
            os.sched_yield()  # all agents of this machine hear a frame before any of them goes on
            return goes_on
        for message in islice(iter(self.loop.take, None), _BURST):
            if not self._receive(message):
                return False
        self._step()
        return True

    def _step(self) -> None:
        """Let agents do what is due; then report the slots that they have opened, and fly vehicles through them."""
        now = time.monotonic_ns()
        self._reporter.now_ns = now - self._zero
        opened = []
        for agent in self.agents:
            while agent.due_ns <= now:
                if agent.step():
                    opened.append(agent)
                    self._send(agent)
                    break
        if not opened:
            return
        for agent in opened:
            self.slot = max(self.slot, agent.slot)
            offset = agent.start_ns - self._zero - agent.slot * self.slot_ns
            self._reporter.add_slot(agent.index, agent.slot, offset, len(agent.frame), agent.swarm)
            self._publish_odometry(agent.index, agent.swarm, 0, agent.slot)
        for agent in opened:
            agent.vehicle.fly(agent.swarm, agent.slot)
        complete = min(agent.slot for agent in self.agents if agent.slot >= 0)
        if self._reporter.is_due(complete):
            self._reporter.publish(self.run_id, complete)

    def _receive(self, message: Fields) -> bool:
        """Hand frames to the agents that receive them; return False when the run is over."""
        if message.phase != Slot.RUN:
            return bool(message.phase != Slot.END)
        self._reporter.now_ns = time.monotonic_ns() - self._zero
        arrival_ns = self._zero + message.time_ns - names.TIME_ZERO_NS
        received = unpack_received(message.received, len(message.sender), self.config.agents)
        for frame, mask in zip(split_frames(message.data, message.length), received, strict=True):
            for index in np.flatnonzero(mask[self._columns]).tolist():
                self.agents[index].receive(frame, arrival_ns)
        return True

    def _send(self, agent: RealtimeAgent) -> None:
        """Hand the frame of an agent over to the channel, before anything else is done."""
        if agent.frame:
            time_ns = names.TIME_ZERO_NS + agent.start_ns - self._zero
            fields = {"run": self.run_id, "slot": agent.slot, "agent": agent.id, "data": agent.frame}
            self._air.publish(FRAME.pack_fields(time_ns, **fields))
