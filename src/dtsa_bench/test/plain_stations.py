"""Both statements of a station in one flight on virtual time."""

from __future__ import annotations

from typing import Any

from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.reference import datagram
from dtsa_agent.core.reference import station as reference
from dtsa_agent.core.reference.agent import Agent
from dtsa_agent.core.reference.arithmetic import Vector
from dtsa_agent.core.reference.frame import PROFILE_EXTENDED, PROFILE_PAPER
from dtsa_agent.core.reference.table import Rules, Table
from dtsa_bench.simulation.live import LiveFlight, S, _c_flight, fly

STARTED, RECEIVED, STEPPED = lib.LIVE_STARTED, lib.LIVE_RECEIVED, lib.LIVE_STEPPED  # kinds of a live_call
SENT, LEFT, NEW_GOAL = lib.LIVE_SENT, lib.LIVE_LEFT, lib.LIVE_NEW_GOAL


def compare_statements(flight: LiveFlight) -> int:
    """Fly with stations in C and in plain Python; how many calls they answered, byte by byte alike."""
    plain = PlainStations(flight)
    fly(flight, plain)
    assert not plain.fault, plain.fault
    return plain.calls


def rules_of(flight: LiveFlight) -> Rules:
    """What ``_c_flight`` sets, in plain Python."""
    return Rules(
        agents=flight.agents, slot_s=flight.slot_ns / S, policy=flight.policy, key=5, depth_rate=0.5,
        profile=PROFILE_EXTENDED if flight.policy == "lease" else PROFILE_PAPER, main_every=15,
        anchor_every=flight.anchor_every, open_every=11,
    )  # fmt: skip


class PlainStations:
    """Observes a flight: does the same with stations in plain Python, and compares what they answer."""

    def __init__(self, flight: LiveFlight) -> None:
        n = flight.agents
        self.fault = ""
        self.flight, self.calls, self.stations = flight, 0, dict[int, reference.Station]()
        self.coasts = dict[int, Vector | None]()  # velocity that the process of each host did not command
        self._c, self._kept = _c_flight(flight)
        places = self._c.config.start, self._c.config.target
        self._start, self._away = ([(at[k], at[n + k], at[2 * n + k]) for k in range(n)] for at in places)

    def __call__(self, call: Any) -> None:
        if not self.fault:
            try:
                self._compare(call)
            except Exception as error:  # C cannot raise it
                self.fault = repr(error)

    def _compare(self, call: Any) -> None:
        self.calls += 1
        if call.kind == STARTED:
            self.stations[call.host] = self._open(call)
            self.coasts.pop(call.host, None)
        station = self.stations[call.host]
        at = f"call {self.calls}, host {call.host}, slot {station.slot}"
        if call.kind == RECEIVED:
            verdict = station.receive(bytes(ffi.buffer(call.data, call.length)), call.now_ns)
            assert verdict == call.answer, at
        elif call.kind == STEPPED:
            agent = station.agent
            agent.position, agent.velocity = tuple(call.position), tuple(call.velocity)
            # A vehicle flies on until its new process commands it.
            if agent.velocity != self.coasts.setdefault(call.host, agent.velocity):
                agent.command, self.coasts[call.host] = agent.velocity, None
            due, data = station.step(call.now_ns)
            expected = bytes(ffi.buffer(call.out, call.out_length)) if call.out_length else b""
            assert (due, data.hex()) == (call.answer, expected.hex()), at
            status, counts = call.status, station.counts
            assert station.hovers == status.hovers, at
            assert (counts.hears, counts.heard_by, counts.both, counts.needed, counts.others) == (
                status.hears, status.heard_by, status.both, status.needed, status.others,
            ), at  # fmt: skip
        elif call.kind == SENT:
            station.sent(call.now_ns, bool(call.answer))
        elif call.kind == LEFT:
            station.leave()
        elif call.kind == NEW_GOAL:
            station.agent.goal, station.agent.final = tuple(call.position), False

    def _open(self, call: Any) -> reference.Station:
        c, flight, host = self._c.station, self.flight, call.host
        index = call.answer - 1
        agent = Agent(Table(index + 1, rules_of(flight), self._start, self._away))
        agent.position, agent.goal = self._start[index], self._away[index]
        link = datagram.Link(bytes(c.link.header), True, c.link.names, c.link.flight_ns, c.link.trust_ns)
        begins_ns = None
        if flight.first_slot and host < flight.agents and host not in self.stations:
            begins_ns = call.now_ns + (1 - flight.first_slot) * c.slot_ns
        key = bytes(ffi.buffer(c.key, c.key_length)) if c.key else b""
        settings = datagram.Settings(
            index + 1, c.slot_ns, c.seed, link, key=key, session=c.session, begins_ns=begins_ns
        )  # fmt: skip
        return reference.Station(settings, agent.rules, agent, call.now_ns, c.main_every)
