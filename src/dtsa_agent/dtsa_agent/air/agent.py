"""One agent with a clock of its own: its loop, which waits for its slots and for frames and does one thing at a time.

What carries its datagrams is a port (:class:`.port.DatagramPort`); the loop knows no network.
"""

from __future__ import annotations

import gc
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from dtsa_agent.core.agents.agent import AgentGroup
from dtsa_agent.core.agents.joining import check_joinable
from dtsa_agent.core.agents.pacing import BETWEEN, LEAD, MOST_EARLY, latest_send_ns, too_long_ns
from dtsa_agent.core.errors import ConfigError, LocalProtocolError
from dtsa_agent.core.frame import condition_in, decode_extended
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.swarm import PRESENT_LEAVING, Swarm
from dtsa_agent.keys import authenticator, check_session
from dtsa_agent.stop import Stop

from .contacts import Contact
from .datagram import EARLY, OTHER_TIME, OWN_ID, REPEATED, Wrapping, check_fits, flight_ns, late_in
from .hearing import OF_OWN_NAME, REASONS, STATES, make_hearing
from .outage import Outage
from .port import DatagramPort
from .precision import give_back_memory, going_first, wake_precisely
from .quorum import Hold, Quorum
from .record import Heard, SlotRecord, Watcher
from .settings import AgentSettings
from .short_slots import ShortSlots
from .strangers import Strangers
from .tally import TOO_LATE, Tally
from .vehicle import SimulatedVehicle, Vehicle

_SECOND = 1_000_000_000
_PATIENCE_S = 0.05  # a signal is noticed after this time at the latest
_LEAVING_NS = 900_000_000  # a signal is obeyed within a second
_OWN_ID = 3  # frames in the own name after which an agent that is new gives way
_JUDGED_S = 0.04  # from one look at the quorum to the next
_TIMED = 25  # such looks from one look at the length of slots to the next
_SAID = 64  # own frames that are remembered

_Frame = tuple[int, int, bytes, bytes, int]  # sender, slot, frame, datagram, arrival by the own clock


class AirAgent:
    """An agent that begins its slots by its own clock, and whose frames go over a port.

    It listens, takes the time of the first group that it hears, or begins one of its own; from then on it decides a
    little before each slot, as soon as it has heard whom it expects, and sends when its slot starts.

    :param own: this agent.
    :param config: the settings that all agents share.
    :param port: what carries its datagrams; the caller keeps it open while the agent flies.
    :param watcher: is told what happens; None: nobody is.
    :param vehicle: what it flies; None: a simulated one.
    :param say: is told in flight, a line at a time, what its user should know; None: nobody is.
    :raises ConfigError: for an id or a policy that cannot fly here, or a missing key or session.
    """

    def __init__(
        self,
        own: AgentSettings,
        config: SwarmConfig,
        port: DatagramPort,
        watcher: Watcher | None = None,
        vehicle: Vehicle | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        if own.id > config.agents:
            raise ConfigError("id", own.id, f"1 to {config.agents}, the number of agents")
        check_joinable(config.policy)
        check_session(config)
        self.own, self.config, self._port = own, config, port
        check_fits(config, port.properties)
        wrapping = Wrapping(config, authenticator(config), port=port.properties)
        self.swarm: Swarm = make_swarm(config, local=[own.id])
        self._group = AgentGroup(self.swarm)
        self._present, self._chosen = self.swarm.present.data, self.swarm.chosen.data
        self._active = self.swarm.active.data
        self.watcher = watcher
        self._vehicle = SimulatedVehicle() if vehicle is None else vehicle
        self.tally = Tally()
        self._strangers, self._outage = Strangers(say), Outage(say)
        port.say = say
        quorum = Quorum(own.quorum)
        if quorum.least >= config.agents:
            raise ConfigError("quorum", own.quorum, f"at most {config.agents - 1}, the number of the others")
        self._hold, self._short_slots = Hold(quorum, say), ShortSlots(config.slot_ms, say)
        self._judge_every = max(1, round(_JUDGED_S / config.slot_s))
        self._timed_every = _TIMED * self._judge_every
        self._contact: tuple[int, ...] = ()  # as it was judged last
        self._says_leaving = config.policy_row.says_leaving
        self._new_slots = 2 * config.main_every * config.agents  # as long as an agent with policy lease is on probation
        self._slot_ns = config.slot_ns
        self._lead_ns, self._latest_lead_ns = (round(lead * self._slot_ns) for lead in (LEAD, BETWEEN))
        self._flight_ns = flight = flight_ns(config, port.properties)
        self._layout = port.properties.header(config.auth) if port.properties.varies else None
        self._latest_send_ns = latest_send_ns(self._slot_ns, flight)
        self._too_long_ns = too_long_ns(config)
        self._ordinary = ""  # why it has no real-time priority
        self.slot = -1  # the present slot
        self._first = 0  # slot with which it began, or began anew
        self._awaits = False  # the slot's sender is another one, and has not been heard yet
        self._waiting = b""  # frame of this slot, ready to be sent
        self._early: list[_Frame] = []
        self._said: deque[bytes] = deque(maxlen=_SAID)  # own datagrams
        self._record: SlotRecord | None = None  # of the present slot
        self._before: list[Heard] = []  # heard after it began anew and before its first slot
        self._leaves_by: int | None = None  # CLOCK_MONOTONIC, ns
        self._signals = 0
        self._gone = False  # it has said on the air that it leaves
        self.hearing = make_hearing(config, own, wrapping, port)
        self._late_ns = self.hearing.late_ns

    def run(self, stop: Stop) -> None:
        """Flies until a signal comes or its time is over; with policy ``lease`` it first says that it leaves.

        :param stop: the signal flag.
        :raises ConfigError: if another agent of its id is on the air already.
        """
        wake_precisely()
        gc.collect()
        give_back_memory()
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
        hearing = self.hearing
        deadline = hearing.start()
        while not ((stop.signal or end is not None) and self._ended(stop, end)):
            if hearing.listening:
                hearing.await_frame(deadline)
                self._take_in(hearing.take())
                if hearing.wake():
                    self._begin_anew()
            elif self._waiting:
                if hearing.sleep_until(self.slot, 0):
                    self._send()
            else:
                # One wake-up a slot: frames wait in the port, which has noted when they arrived.
                found = hearing.listen(self.slot + 1, self._lead_ns)
                if found is not None:
                    self._go_on(self._take_in(found))
        self._tell(self._close_slot())
        self.tally.ended_ns = time.monotonic_ns()

    def _go_on(self, more: bool) -> None:
        """The next slot, if all is there that it waits for, or it is high time; else waits for that.

        :param more: there may be more to take in.
        """
        late = self._late_ns(self.slot + 1)
        lead = self._latest_lead_ns if more or self._awaits else self._lead_ns
        if late + lead >= 0:
            self._step(late)
        elif not more:
            self.hearing.await_frame(time.monotonic_ns() - late - lead)

    def _ended(self, stop: Stop, end: int | None) -> bool:
        """Whether to end now: after a second signal, when it has said that it leaves, or has no time left to."""
        if not stop and end is None:
            return False
        now = time.monotonic_ns()
        if not stop and (end is None or now < end):
            return False
        if self._leaves_by is None:
            if not self.config.policy_row.says_leaving or self.hearing.listening or self.slot < self._first:
                return True
            turns = (self.config.main_every + 1) * self.config.agents * self._slot_ns
            self._leaves_by, self._signals = now + min(_LEAVING_NS, turns), stop.count
            self.swarm.leave(0)
        return self._gone or now >= self._leaves_by or stop.count > self._signals

    # What is heard.

    def _take_in(self, found: tuple[list[_Frame] | None, list[tuple[int, int, bytes, int]] | None, bool, bool]) -> bool:
        """Takes in what has been heard; whether there may be more.

        :param found: see ``_hearing.pyi``.
        """
        heard, refused, restarted, more = found
        if self._strangers.due_ns:
            self._strangers.say(time.monotonic_ns())
        if refused is not None:
            for number, slot, data, arrival in refused:
                self._refuse(self._own_name(slot, data) if number == OF_OWN_NAME else REASONS[number], data, arrival)
        if heard is not None:
            for one in heard:
                if restarted and one is heard[-1]:
                    self._begin_anew()
                slot = one[1]
                if slot > self.slot:
                    if len(self._early) < MOST_EARLY:
                        self._early.append(one)
                    else:
                        self._refuse(EARLY, one[3], one[4])
                elif slot >= self._first - 1:
                    self._hear(one)
        return more

    def _refuse(self, reason: str, data: bytes, arrival_ns: int) -> None:
        self.tally.refused[reason] += 1
        self._strangers.note(reason, time.monotonic_ns())
        if self.watcher is not None:
            self.watcher.other(reason, data, arrival_ns)

    def _own_name(self, slot: int, data: bytes) -> str:
        """Somebody else speaks in the own name, or plays what was said there again.

        :raises ConfigError: while this agent is new: the other one was here before.
        """
        if data in self._said:
            return REPEATED
        if self.hearing.listening or slot < self.slot - 1:
            return OTHER_TIME
        new_ns = 2 * self.config.anchor_every * self.config.agents * self._slot_ns
        if self.tally.refused[OWN_ID] + 1 >= _OWN_ID and time.monotonic_ns() < self.tally.joined_ns + new_ns:
            raise ConfigError("id", self.own.id, "an id that no other agent on the air has")
        return OWN_ID

    def _hear(self, one: _Frame) -> None:
        sender, slot, frame, datagram, arrival = one
        accepted = self.swarm.hear(slot, frame)
        if self._awaits and slot >= self.slot:
            self._awaits = False
        if accepted:
            self.tally.hear(sender, slot, self._says_leaving and condition_in(frame)[0])
            if self._layout is not None:
                late_ns = late_in(datagram, self._layout)
                self.tally.off(arrival - self.hearing.slot_start_ns(slot) - self._flight_ns - late_ns)
        if self.watcher is not None:
            heard = Heard(sender, slot, arrival, datagram, bool(accepted))
            (self._before if self._record is None else self._record.heard).append(heard)

    # Its own slots.

    def _begin_anew(self) -> None:
        """From the next slot on it takes part, knowing nothing."""
        self._tell(self._close_slot())
        self._before.clear()
        if self.hearing.listening:
            raise LocalProtocolError("an agent that listens has no slots")
        following = self.hearing.slot_at(self.hearing.local_ns(time.monotonic_ns()) + self._lead_ns)
        self._first, self.slot = following + 1, following
        self._waiting, self._awaits = b"", False
        self._early.clear()
        self._group.restart(0, self._first)
        self.tally.begun(self._first, time.monotonic_ns())

    def _step(self, late_ns: int) -> None:
        """The next slot, or, after standing still for too long, a new beginning.

        :param late_ns: ns, how long ago it has started.
        """
        if late_ns > self._too_long_ns:
            self._begin_anew()
        else:
            self._open(self.slot + 1)

    def _open(self, slot: int) -> None:
        """Closes the last slot and opens the next: decide, fly, lay the frame ready."""
        swarm = self.swarm
        closed = self._close_slot()
        if self._leaves_by is not None and not self._gone:
            self._present[0] = PRESENT_LEAVING
        present = self._present[0]
        self._vehicle.sense(swarm)
        sends = self._group.on_slot(slot)
        self.slot = slot
        self._awaits = self._chosen[0] not in (0, self.own.id)
        frame = swarm.frame(0) if sends else b""
        if self.watcher is not None:
            self._record = self._recorded(slot, frame, present)
        self._waiting = frame
        if frame and self._late_ns(slot) > 0:
            self._send()
        self._fly(slot)
        if self._early:
            early, self._early = self._early, []
            for one in early:
                if one[1] > slot:
                    self._early.append(one)
                else:
                    self._hear(one)
        if closed is not None:
            self._tell(closed)

    def _fly(self, slot: int) -> None:
        """Flies through a slot; without a quorum it hovers, and all else goes on."""
        if slot % self._judge_every == 0:
            self._judge(slot)
        if not self._hold.held:
            self._vehicle.fly(self.swarm, slot)
            return
        if not self._group.newcomers.some:
            self._hold.hover()
        active, self._active[0] = self._active[0], 0
        self._vehicle.fly(self.swarm, slot)
        self._active[0] = active

    def _judge(self, slot: int) -> None:
        """Looks whether it has a quorum, and whether slots are long enough."""
        contact = self.hearing.contact(slot, slot < self._first + self._new_slots)
        new = self._group.newcomers.some
        if new or contact != self._contact or not self._hold.settled:
            self._contact = contact
            self._hold.judge(Contact(*contact), new, time.monotonic_ns())
        if not new:
            self.tally.look(contact[0], contact[1])
        if slot % self._timed_every == 0 and not self._short_slots.found:
            self._short_slots.judge(*self.hearing.timing())

    def _recorded(self, slot: int, frame: bytes, present: int) -> SlotRecord:
        swarm = self.swarm
        before, self._before = self._before, []
        return SlotRecord(
            slot,
            self.hearing.slot_start_ns(slot),
            self.hearing.local_ns(time.monotonic_ns()),
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
        late = max(0, self._late_ns(self.slot))
        frame, self._waiting = self._waiting, b""
        if late > self._latest_send_ns:  # it would disturb whoever has the next turn
            self._drop(TOO_LATE)
            return
        datagram = self.hearing.wrap(frame, self.slot, late)
        refusal = self._port.send(datagram)
        if refusal:
            self._outage.refused(refusal, time.monotonic_ns())
            self._drop(refusal)
            return
        if self._outage.since_ns:
            self._outage.left(time.monotonic_ns())
        self._said.append(datagram)
        self.tally.sent(late)
        if self._record is not None:
            self._record.sent_ns = self.hearing.slot_start_ns(self.slot) + late
            self._record.datagram = datagram
        if self._leaves_by is not None and self.config.policy_row.says_leaving:
            self._gone = decode_extended(self.config.protocol_part(frame), self.config.extent_m).leaving

    def _drop(self, reason: str) -> None:
        """The frame of this slot does not leave: the agent has been silent."""
        self.swarm.drop(0)
        self.tally.unsent[reason] += 1

    def _close_slot(self) -> SlotRecord | None:
        """The present slot is over; its record."""
        if self._group.slot >= 0:
            if self._waiting:  # it ends, or begins anew, before its turn has come
                self.swarm.drop(0)
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
        state, restarts, corrected, alignments, error_ns = self.hearing.status()
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
            **self.tally.summary(self.slot),
            "state": STATES[state],
            "times_taken_over": restarts,
            "times_corrected": corrected,
            "alignments": alignments,
            "flight_time_error_us": error_ns / 1e3,
            "quorum": self.own.quorum,
            "never_flew": self._hold.problem,
            "held_at_start_slots": self._hold.slots_at_start,
            "held_slots": self._hold.slots,
            "slots_too_short": self._short_slots.found,
            "heard_of": sorted(int(k) + 1 for k in np.flatnonzero(swarm.sent_slot[0] >= 0) if k + 1 != self.own.id),
            "not_taken_in": {name: count for name, count in sorted(refused.items()) if count},
            **self._port.counts(),
            "position_m": [round(float(x), 4) for x in swarm.position[:, 0]],
            "arrived": bool(np.sqrt((away * away).sum()) <= self.config.r_min and swarm.final[0]),
        }
