"""One agent on a network: its loop, which waits for its slots and for frames and does one thing at a time."""

from __future__ import annotations

import gc
import select
import time
from collections import Counter, deque
from typing import Any

import numpy as np

from dtsa_agent.core.abstract_swarm import PRESENT_LEAVING, AbstractSwarm
from dtsa_agent.core.agent import AgentGroup
from dtsa_agent.core.config import SwarmConfig
from dtsa_agent.core.errors import ConfigError, LocalProtocolError, RemoteProtocolError
from dtsa_agent.core.frame import decode_frame
from dtsa_agent.core.frame_extended import decode_extended
from dtsa_agent.core.joining import check_joinable
from dtsa_agent.core.pacing import BETWEEN, LEAD, MOST_EARLY, latest_send_ns, too_long_ns
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.core.reference.timebase import FOREIGN, LISTENING, RESTARTED
from dtsa_agent.keys import authenticator
from dtsa_agent.stop import Stop

from .clock import OwnClock
from .datagram import NO_FRAME, Wrapping, flight_ns
from .delay import Delay
from .precision import going_first, wake_precisely
from .record import Heard, SlotRecord, Watcher
from .settings import AgentSettings, UdpSettings
from .slots import SlotTime
from .sockets import Datagram, MulticastSocket
from .tally import Tally
from .vehicle import SimulatedVehicle, Vehicle

_SECOND = 1_000_000_000
_PATIENCE_S = 0.05  # a signal is noticed after this time at the latest
_BURST = 16  # datagrams taken in at a time: whatever comes, the own slots go on
_LEAVING_NS = 900_000_000  # a signal is obeyed within a second
_OWN_ID = 3  # frames in the own name after which an agent that is new gives way
_SAID = 64  # own frames that are remembered
OTHER_TIME, REPEATED, OWN_ID, EARLY = "other time", "repeated", "own id", "too early"


class UdpAgent:
    """An agent whose frames go over a network.

    It listens, takes the time of the first group that it hears, or begins one of its own; from then on it decides a
    little before each slot, as soon as it has heard whom it expects, and sends when its slot starts.

    :param own: this agent.
    :param config: the settings that all agents share.
    :param udp: the network.
    :param watcher: is told what happens; None: nobody is.
    :param vehicle: what it flies; None: a simulated one.
    :raises ConfigError: for an id or a policy that cannot fly here, a missing key, or a network that cannot be used.
    """

    def __init__(
        self,
        own: AgentSettings,
        config: SwarmConfig,
        udp: UdpSettings,
        watcher: Watcher | None = None,
        vehicle: Vehicle | None = None,
    ) -> None:
        if own.id > config.agents:
            raise ConfigError("id", own.id, f"1 to {config.agents}, the number of agents")
        check_joinable(config.policy)
        self.own, self.config, self.udp = own, config, udp
        self._wrapping = Wrapping(config, authenticator(config))
        self.swarm: AbstractSwarm = make_swarm(config, local=[own.id])
        self._group = AgentGroup(self.swarm)
        self._clock = OwnClock(own.clock_offset_ns, own.clock_drift_ppb)
        self.time = SlotTime(config, own.id)
        self.delay = Delay(own.id, config.slot_ns // 4)
        self.watcher = watcher
        self._vehicle = SimulatedVehicle() if vehicle is None else vehicle
        self.tally = Tally()
        self._slot_ns = config.slot_ns
        self._lead_ns, self._latest_lead_ns = (round(lead * self._slot_ns) for lead in (LEAD, BETWEEN))
        self._flight_ns = flight_ns(config, udp.flight_time_ns, udp.byte_time_ns)
        self._latest_send_ns = latest_send_ns(self._slot_ns, self._flight_ns)
        self._too_long_ns = too_long_ns(config)
        self._ordinary = ""  # why it has no real-time priority
        self.slot = -1  # the slot that is open
        self._first = 0  # slot with which it began, or began anew
        self._awaits = False  # the slot's sender is another one, and has not been heard yet
        self._waiting = b""  # frame of this slot, ready to be sent
        self._early: list[tuple[int, int, bytes, Datagram]] = []
        self._last: dict[int, int] = {}  # slot of the last frame, by sender
        self._said: deque[bytes] = deque(maxlen=_SAID)  # own datagrams
        self._record: SlotRecord | None = None  # of the open slot
        self._before: list[Heard] = []  # heard after it began anew and before its first slot
        self._leaves_by: int | None = None  # CLOCK_MONOTONIC, ns
        self._signals = 0
        self._gone = False  # it has said on the air that it leaves
        self._socket = MulticastSocket(udp)

    def __enter__(self) -> UdpAgent:
        return self

    def __exit__(self, *unused: object) -> None:
        self._socket.close()

    def run(self, stop: Stop) -> None:
        """Flies until a signal comes or its time is over; with policy ``lease`` it first says that it leaves.

        :param stop: the signal flag.
        :raises ConfigError: if another agent of its id is on the air already.
        """
        wake_precisely()
        gc.freeze()  # nothing made so far is garbage: do not look at it again and again
        with going_first(self.own.priority) as self._ordinary:
            self._run(stop)

    def _run(self, stop: Stop) -> None:
        began = time.monotonic_ns()
        end = began + round(self.own.duration_s * _SECOND) if self.own.duration_s else None
        self.tally.began_ns = began
        while not self._vehicle.ready():
            if self._ended(stop, end):
                self.tally.ended_ns = time.monotonic_ns()
                return
            time.sleep(_PATIENCE_S)
        self._vehicle.sense(self.swarm)
        began = time.monotonic_ns()
        deadline = self._clock.monotonic_ns(self.time.start(self._clock.local_ns(began)))
        while not self._ended(stop, end):
            if self.time.state == LISTENING:
                self._await_frame(deadline)
                self._take_in()
                if self.time.wake(self._clock.local_ns(time.monotonic_ns())):
                    self._begin_anew()
            elif self._waiting:
                if _slept_until(self._due_ns()):
                    self._send()
            elif _slept_until(self._due_ns(self._lead_ns)):
                # One wake-up a slot: frames wait in the socket, and the kernel has noted when they arrived.
                more = self._take_in()
                due = self._due_ns(self._latest_lead_ns if more or self._awaits else self._lead_ns)
                if time.monotonic_ns() >= due:
                    self._step()
                elif not more:
                    self._await_frame(due)
        self._tell(self._close_slot())
        self.tally.ended_ns = time.monotonic_ns()

    def _await_frame(self, until_ns: int) -> None:
        """Waits for a frame, or until a time; ns, CLOCK_MONOTONIC."""
        remaining = until_ns - time.monotonic_ns()
        if remaining > 0:
            select.select([self._socket], [], [], min(remaining / _SECOND, _PATIENCE_S))

    def _due_ns(self, lead_ns: int = 0) -> int:
        """When to send the frame that lies ready, or to decide the next slot, this long ahead; ns, CLOCK_MONOTONIC."""
        slot = self.slot if self._waiting else self.slot + 1
        return self._clock.monotonic_ns(self.time.slot_start_ns(slot) - lead_ns)

    def _ended(self, stop: Stop, end: int | None) -> bool:
        """Whether to end now: after a second signal, when it has said that it leaves, or has no time left to."""
        if not stop and end is None:
            return False
        now = time.monotonic_ns()
        if not stop and (end is None or now < end):
            return False
        if self._leaves_by is None:
            if not self.config.policy_row.says_leaving or self.time.state == LISTENING or self.slot < self._first:
                return True
            turns = (self.config.main_every + 1) * self.config.agents * self._slot_ns
            self._leaves_by, self._signals = now + min(_LEAVING_NS, turns), stop.count
            self.swarm.leave(0)
        return self._gone or now >= self._leaves_by or stop.count > self._signals

    # What is heard.

    def _take_in(self) -> bool:
        """Takes in what has arrived; whether there may be more."""
        arrived = self._socket.receive(_BURST)
        for datagram in arrived:
            if not datagram.own:
                reason = self._take(datagram)
                if reason:
                    self.tally.refused[reason] += 1
                    if self.watcher is not None:
                        self.watcher.other(reason, datagram.data, self._clock.local_ns(datagram.arrival_ns))
        return len(arrived) == _BURST

    def _take(self, datagram: Datagram) -> str:
        """Takes in a datagram; why not, or an empty text."""
        fault, sender, slot, late_ns, peers, frame = self._wrapping.read(datagram.data)
        if fault:
            return fault
        if not self._is_frame(frame):
            return NO_FRAME
        if sender == self.own.id:
            return self._own_name(slot, datagram.data)
        if self._last.get(sender, -1) == slot and self.time.state != LISTENING:
            return REPEATED
        began = self._clock.local_ns(datagram.arrival_ns) - self._flight_ns - late_ns
        before = self.time.slot_start_ns(slot)
        outcome = self.time.hear(slot, began - self.delay.error_ns)
        if outcome == FOREIGN:
            return OTHER_TIME
        self._last[sender] = slot
        if outcome == RESTARTED:
            self.delay.reset()
            self._begin_anew()
        else:
            self.delay.hear(sender, began - before, peers)
            self.delay.moved(self.time.slot_start_ns(slot) - before)
        if slot > self.slot:
            if len(self._early) >= MOST_EARLY:
                return EARLY
            self._early.append((sender, slot, frame, datagram))
        elif slot >= self._first - 1:
            self._hear(sender, slot, frame, datagram)
        return ""

    def _is_frame(self, frame: bytes) -> bool:
        """Whether bytes are a frame: nothing else may say what time it is. What holders of the key seal is one."""
        if self.config.auth:
            return True
        try:
            decode_frame(frame[: len(frame) - self.config.own_bytes], self.config.extent_m)
        except RemoteProtocolError:
            return False
        return True

    def _own_name(self, slot: int, data: bytes) -> str:
        """Somebody else speaks in the own name, or plays what was said there again.

        :raises ConfigError: while this agent is new: the other one was here before.
        """
        if data in self._said:
            return REPEATED
        if self.time.state == LISTENING or slot < self.slot - 1:
            return OTHER_TIME
        new_ns = 2 * self.config.anchor_every * self.config.agents * self._slot_ns
        if self.tally.refused[OWN_ID] + 1 >= _OWN_ID and time.monotonic_ns() < self.tally.joined_ns + new_ns:
            raise ConfigError("id", self.own.id, "an id that no other agent on the air has")
        return OWN_ID

    def _hear(self, sender: int, slot: int, frame: bytes, datagram: Datagram) -> None:
        accepted = self.swarm.hear(slot, frame)
        if self._awaits and slot >= self.slot:
            self._awaits = False
        self.tally.heard += accepted
        if self.watcher is None:
            return
        arrival = self._clock.local_ns(datagram.arrival_ns)
        heard = Heard(sender, slot, arrival, datagram.data, bool(accepted))
        (self._before if self._record is None else self._record.heard).append(heard)

    # Its own slots.

    def _begin_anew(self) -> None:
        """From the next slot on it takes part, knowing nothing."""
        self._tell(self._close_slot())
        self._before.clear()
        now = self._clock.local_ns(time.monotonic_ns())
        following = self.time.slot(now + self._lead_ns)
        if following is None:
            raise LocalProtocolError("an agent that listens has no slots")
        self._first, self.slot = following + 1, following
        self._waiting, self._awaits = b"", False
        self._early.clear()
        self._group.restart(0, self._first)
        self.tally.begun(self._first, time.monotonic_ns())

    def _step(self) -> None:
        """The next slot, or, after standing still for too long, a new beginning."""
        late = time.monotonic_ns() - self._clock.monotonic_ns(self.time.slot_start_ns(self.slot + 1))
        if late > self._too_long_ns:
            self._begin_anew()
        else:
            self._open(self.slot + 1)

    def _open(self, slot: int) -> None:
        """Closes the last slot and opens the next: decide, fly, lay the frame ready."""
        swarm = self.swarm
        closed = self._close_slot()
        if self._leaves_by is not None and not self._gone:
            swarm.present[0] = PRESENT_LEAVING
        present = int(swarm.present[0])
        self._vehicle.sense(swarm)
        sends = bool(self._group.on_slot(slot))
        self.slot = slot
        self._awaits = int(swarm.chosen[0]) not in (0, self.own.id)
        frame = swarm.frame(0) if sends else b""
        self._record = None if self.watcher is None else self._recorded(slot, frame, present)
        self._waiting = frame
        if self._waiting and self._due_ns() - time.monotonic_ns() < 0:
            self._send()
        self._vehicle.fly(swarm, slot)
        early, self._early = self._early, []
        for sender, sent_in, data, datagram in early:
            if sent_in > slot:
                self._early.append((sender, sent_in, data, datagram))
            else:
                self._hear(sender, sent_in, data, datagram)
        self._tell(closed)

    def _recorded(self, slot: int, frame: bytes, present: int) -> SlotRecord:
        swarm = self.swarm
        before, self._before = self._before, []
        return SlotRecord(
            slot,
            self.time.slot_start_ns(slot),
            self._clock.local_ns(time.monotonic_ns()),
            slot == self._first,
            present,
            int(swarm.chosen[0]),
            int(swarm.reason[0]),
            int(swarm.digest[0]),
            float(swarm.score[0]),
            swarm.track[:, :, 0].copy(),
            swarm.velocity[:, 0].copy(),
            swarm.command[:, 0].copy(),
            swarm.goal[:, 0].copy(),
            frame,
            before=before,
        )

    def _send(self) -> None:
        """Sends the frame that lies ready, unless its slot is as good as over."""
        due, now = self._due_ns(), time.monotonic_ns()
        frame, self._waiting = self._waiting, b""
        if now - due > self._latest_send_ns:  # it would disturb whoever has the next turn
            self.swarm.frame_length[0] = 0
            self.tally.unsent += 1
            return
        datagram = self._wrapping.wrap(frame, self.slot, now - due, self.delay.tell())
        self._socket.send(datagram)
        self._said.append(datagram)
        self.tally.sent(now - due)
        if self._record is not None:
            self._record.sent_ns = self._clock.local_ns(now)
            self._record.datagram = datagram
        if self._leaves_by is not None and self.config.policy_row.says_leaving:
            self._gone = decode_extended(frame[: len(frame) - self.config.own_bytes], self.config.extent_m).leaving

    def _close_slot(self) -> SlotRecord | None:
        """The open slot is over; its record."""
        if self._group.slot >= 0:
            if self._waiting:  # it ends, or begins anew, before its turn has come
                self.swarm.frame_length[0] = 0
                self._waiting = b""
            self._group.on_slot_end()
            self.tally.slots += 1
        record, self._record = self._record, None
        return record

    def _tell(self, record: SlotRecord | None) -> None:
        if record is not None and self.watcher is not None:
            self.watcher.slot(record)

    def summary(self) -> dict[str, Any]:
        """What came of it, as plain values."""
        swarm, away = self.swarm, self.swarm.goal[:, 0] - self.swarm.position[:, 0]
        refused: Counter[str] = Counter(self.tally.refused)
        refused.update({"malformed": self.swarm.malformed, "foreign": self.swarm.foreign})
        return {
            "id": self.own.id,
            "agents": self.config.agents,
            "policy": self.config.policy,
            "slot_ms": self.config.slot_ms,
            "sealed": self.config.auth,
            "no_priority": self._ordinary,
            **self.tally.summary(),
            "state": self.time.state,
            "times_taken_over": self.time.restarts,
            "times_corrected": self.time.corrected,
            "alignments": self.time.corrections,
            "flight_time_error_us": self.delay.error_ns / 1e3,
            "heard_of": sorted(int(k) + 1 for k in np.flatnonzero(swarm.sent_slot[0] >= 0) if k + 1 != self.own.id),
            "not_taken_in": {name: count for name, count in sorted(refused.items()) if count},
            "unsendable": self._socket.unsendable,
            "unreadable": self._socket.unreadable,
            "clock_steps": self._socket.clock_steps,
            "position_m": [round(float(x), 4) for x in swarm.position[:, 0]],
            "arrived": bool(np.sqrt((away * away).sum()) <= self.config.r_min and swarm.final[0]),
        }


def _slept_until(until_ns: int) -> bool:
    """Sleeps until a time, or a while, so that signals are noticed; whether it is that time.

    :param until_ns: ns, CLOCK_MONOTONIC.
    """
    remaining = until_ns - time.monotonic_ns()
    if remaining <= 0:
        return True
    time.sleep(min(remaining / _SECOND, _PATIENCE_S))
    return time.monotonic_ns() >= until_ns
