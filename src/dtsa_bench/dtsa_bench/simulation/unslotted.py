"""Flights in which agents send at any instant: what is on the air in a slot, and who hears it.

Slots are the ticks of the flight: frames carry the state at the start of the slot in which they begin, and are heard in
the slot in which they arrive.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_agent.core.errors import PluginError, shown
from dtsa_agent.core.plugins import Guarded, PluginSwarm
from dtsa_channel_sim import Channel
from dtsa_channel_sim.model.air import NEVER, Air
from dtsa_channel_sim.model.medium import Positions
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

_MOST_LISTENS = 10_000  # for one frame


@dataclass(slots=True)
class SlotTraffic:
    """What the air carried in one slot."""

    senders: tuple[int, ...] = ()  # ids that began to send a frame in it, each once
    lengths: list[int] = field(default_factory=list)  # bytes of the packets that began in it
    # Frames that arrived, or that policies have put together from packets: slot, frame, and (N,) which agents heard it.
    # The slot is the present one, or that of the state in a frame put together.
    heard: list[tuple[int, bytes, NDArray[np.bool_]]] = field(default_factory=list)
    combined: list[tuple[int, bytes, NDArray[np.bool_]]] = field(default_factory=list)
    outcome: int = IDLE  # SUCCESS: packets ended in it and none was disturbed; COLLISION: one was


class _Packet(NamedTuple):
    """What a radio sends: a frame, bytes of the policy's own before it, or both."""

    sender: int
    frame: bytes
    note: bytes = b""
    to: int = 0  # id of the one agent that receives the frame; 0: all


class ListeningRadios:
    """Radios that listen before they send: each holds one frame until its policy's ``sensed`` says that it may begin.

    The air says whether it is in use where a radio is; the caller puts on it what begins. ``rules``: (N,) policies.
    """

    def __init__(self, air: Air[Any], rules: Sequence[Guarded]) -> None:
        self._air, self._rules = air, rules
        self._held: dict[int, list[int]] = {}  # by id: number of the radio's next event, and how often it has listened
        self._events: list[tuple[int, int, int]] = []  # heap: ns, id, number
        self._count = 0
        self._sent_ns = [0] * len(rules)  # when each began its last frame

    def holds(self, agent: int) -> bool:
        """Return whether a radio holds a frame that has not begun."""
        return agent in self._held

    def hand_over(self, agent: int, at_ns: int) -> None:
        """Give a radio a frame in place of one that it holds; it listens first at ``at_ns``."""
        self._held[agent] = [0, 0]
        self._listen_at(agent, at_ns)

    def drop(self, agent: int) -> None:
        """Take the frame from a radio, if it holds one."""
        self._held.pop(agent, None)

    @property
    def next(self) -> tuple[int, int]:
        """When which radio listens next: ns, id."""
        events = self._events
        while events and ((held := self._held.get(events[0][1])) is None or held[0] != events[0][2]):
            heappop(events)
        return events[0][:2] if events else (NEVER, 0)

    def listen(self, positions: Positions | None = None) -> tuple[int, int] | None:
        """Let the next radio listen; return (ns, id) if it begins to send, None if it waits."""
        now_ns, agent = self.next
        held, rule = self._held[agent], self._rules[agent - 1]
        busy = self._air.busy(agent, now_ns, positions)
        answer = rule.sensed(busy, now_ns, self._sent_ns[agent - 1])
        allowed = "whole numbers from 1, as the air is in use" if busy else "whole numbers from 0"
        wait_ns = _whole_ns(rule, answer, "sensed", int(busy), allowed)
        if not wait_ns:
            del self._held[agent]
            self._sent_ns[agent - 1] = now_ns
            return now_ns, agent
        held[1] += 1
        if held[1] >= _MOST_LISTENS:
            raise PluginError(f"{rule.name}, sensed", f"listened {_MOST_LISTENS} times for one frame")
        self._listen_at(agent, now_ns + wait_ns)
        return None

    def _listen_at(self, agent: int, at_ns: int) -> None:
        self._count += 1
        self._held[agent][0] = self._count
        heappush(self._events, (at_ns, agent, self._count))


class UnslottedTraffic:
    """Lets the policies of all agents act, on one medium; each agent has a table of its own.

    At one instant arrivals come first, then what agents and radios do, in the order of their ids.
    """

    def __init__(self, swarm: Swarm, channel: Channel) -> None:
        assert isinstance(swarm, PluginSwarm)
        self._swarm = swarm
        self._slot_ns = swarm.config.slot_ns
        self._airtime = channel.config.airtime
        self._air: Air[int] = Air(channel)
        row = swarm.config.policy_row
        self._radios = ListeningRadios(self._air, swarm.policies) if row.listens else None
        self._reacts = row.reacts
        self._wakes = [(0, index) for index in range(len(swarm.ids))]
        heapify(self._wakes)
        self._due_ns = [0] * len(swarm.ids)  # the entry of each agent in that heap that counts
        self._free_ns = [0] * len(swarm.ids)  # when each radio has done with its last packet
        self._slot = self._count = 0
        self._on_air: dict[int, _Packet] = {}
        self._arriving: list[tuple[int, int, _Packet, NDArray[np.bool_]]] = []  # heap by arrival
        self._frames: list[bytes] = []
        self._carried = SlotTraffic()
        self._began: set[int] = set()

    def slot(self, slot: int) -> SlotTraffic:
        """What happens on the air in the slot after the last one; tables are as they were at its start."""
        swarm, end_ns, self._slot = self._swarm, (slot + 1) * self._slot_ns, slot
        self._carried, self._began = SlotTraffic(), set()
        swarm.sends[:] = swarm.present > 0
        swarm.emit(slot)
        self._frames = [swarm.frame(index) for index in range(len(swarm.ids))]
        self._act(end_ns)
        self._resolve(end_ns)
        self._deliver(end_ns)
        self._carried.senders = tuple(swarm.ids[index] for index in sorted(self._began))
        swarm.sends[:] = 0
        swarm.sends[sorted(self._began)] = 1
        swarm.emit(slot)
        return self._carried

    def _act(self, end_ns: int) -> None:
        """Lets policies and radios act until the end of a slot."""
        while True:
            wake = self._wakes[0] if self._wakes else (NEVER, 0)
            heard = self._radios.next if self._radios is not None else (NEVER, 0)
            next_ns = min(wake, heard)[0]
            if self._reacts and self._air.due_ns <= min(next_ns, end_ns):
                self._resolve(self._air.due_ns)
            elif self._reacts and self._arriving and self._arriving[0][0] <= min(next_ns, end_ns - 1):
                self._deliver(self._arriving[0][0])
            elif next_ns >= end_ns:
                return
            elif heard[0] < NEVER and (heard[0], heard[1] - 1) < wake:
                self._listen(*heard, end_ns)
            else:
                heappop(self._wakes)
                if self._due_ns[wake[1]] == wake[0]:
                    self._wake(wake[1], wake[0], end_ns)

    def _call_at(self, index: int, at_ns: int) -> None:
        self._due_ns[index] = at_ns
        heappush(self._wakes, (at_ns, index))

    def _wake(self, index: int, now_ns: int, end_ns: int) -> None:
        """Lets a policy act, unless its agent is switched off."""
        if self._swarm.present[index]:
            policy, table = self._swarm.policies[index], self._swarm.tables[index]
            answer = policy.wake(table, now_ns, Radio(self, index, now_ns))
            if self._radios is not None and self._radios.holds(self._swarm.ids[index]):
                return
            end_ns = _next_wake(policy, answer, now_ns)
        self._call_at(index, end_ns)

    def _listen(self, now_ns: int, agent: int, end_ns: int) -> None:
        """Lets a radio listen, and its policy know if it has begun to send the agent's frame of this slot."""
        assert self._radios is not None
        index = agent - 1
        if not self._swarm.present[index]:
            self._radios.drop(agent)
            self._call_at(index, end_ns)
        elif self._radios.listen(self._swarm.position) is not None:
            self._begin(_Packet(agent, self._frames[index]), now_ns, now_ns)
            policy, table = self._swarm.policies[index], self._swarm.tables[index]
            answer = policy.sent(table, now_ns)
            self._call_at(index, _next_wake(policy, answer, now_ns, "sent"))

    def send(self, index: int, now_ns: int, note: bytes, to: int) -> bool:
        """An agent begins to send its frame of this slot, or its radio listens first; see :class:`Radio`."""
        frame = self._frames[index]
        if frame and self._radios is not None:
            self._radios.hand_over(index + 1, now_ns + self._to_radio_ns(len(frame)))
        return bool(frame) and (self._radios is not None or self.transmit(_Packet(index + 1, frame, note, to), now_ns))

    def transmit(self, packet: _Packet, now_ns: int) -> bool:
        """A radio begins to send a packet; False: it still sends another."""
        if not isinstance(packet.note, bytes) or packet.to not in range(len(self._frames) + 1):
            policy, given = self._swarm.policies[packet.sender - 1].name, (packet.note, packet.to)
            raise PluginError(f"{policy}, wake", f"sent {given!r}; allowed: bytes, to 0 (all) to {len(self._frames)}")
        if now_ns < self._free_ns[packet.sender - 1]:
            return False
        self._begin(packet, now_ns + self._to_radio_ns(len(packet.note) + len(packet.frame)), now_ns)
        return True

    def frame(self, index: int) -> bytes:
        """An agent's frame of this slot, which its policy sends in packets of its own."""
        if self._frames[index]:
            self._began.add(index)
        return self._frames[index]

    def receive_frame(self, index: int, frame: bytes, slot: int) -> None:
        """An agent hears a frame that its policy has put together from packets."""
        if not isinstance(frame, bytes) or not frame:
            policy = self._swarm.policies[index].name
            raise PluginError(f"{policy}, wake", f"received {frame!r}; allowed: bytes of a frame")
        self._carried.combined.append((slot, frame, np.arange(len(self._frames)) == index))

    def _to_radio_ns(self, length: int) -> int:
        """How long after the order a radio has a packet, ns; a constant delay moves arrivals alone."""
        return self._airtime.to_radio_ns(length) if self._airtime.line.serial else 0

    def _begin(self, packet: _Packet, at_ns: int, now_ns: int) -> None:
        """A radio has a packet from ``at_ns`` on, and begins to send it as soon as it can."""
        index, length = packet.sender - 1, len(packet.note) + len(packet.frame)
        if not 1 <= length <= self._airtime.longest:
            policy = self._swarm.policies[index].name
            raise PluginError(f"{policy}, wake", f"sent {length} bytes; allowed: 1 to {self._airtime.longest}")
        self._resolve(now_ns)
        self._count += 1
        self._air.begin(self._count, packet.sender, at_ns, length)
        self._free_ns[index] = at_ns + self._airtime.total_ns(length)
        self._on_air[self._count] = packet
        if packet.frame:
            self._began.add(index)
        self._carried.lengths.append(length)

    def _resolve(self, until_ns: int) -> None:
        for verdict in self._air.resolve(until_ns, self._swarm.position):
            packet = self._on_air.pop(verdict.frame_id)
            if verdict.received.any():
                heappush(self._arriving, (verdict.arrival_ns, verdict.frame_id, packet, verdict.received))
            disturbed = verdict.collided or self._carried.outcome == COLLISION
            self._carried.outcome = COLLISION if disturbed else SUCCESS

    def _deliver(self, until_ns: int) -> None:
        """What has arrived is heard; policies that react do so."""
        while self._arriving and self._arriving[0][0] <= until_ns:
            now_ns, _, packet, received = heappop(self._arriving)
            if packet.frame:
                mask = received & (np.arange(len(received)) == packet.to - 1) if packet.to else received
                self._carried.heard.append((self._slot, packet.frame, mask))
            if not self._reacts:
                continue
            for index in np.flatnonzero(received & (self._swarm.present > 0)).tolist():
                policy, table = self._swarm.policies[index], self._swarm.tables[index]
                answer = policy.received(table, now_ns, packet.sender, packet.note)
                self._call_at(index, _next_wake(policy, answer, now_ns, "received"))


class Radio:
    """The radio of an agent that is not bound to slots, while its policy acts. It sends one packet at a time."""

    __slots__ = ("_index", "_now_ns", "_traffic")

    def __init__(self, traffic: UnslottedTraffic, index: int, now_ns: int) -> None:
        self._traffic, self._index, self._now_ns = traffic, index, now_ns

    def send(self, note: bytes = b"", to: int = 0) -> bool:
        """Begin to send the agent's frame, with its state at the start of the slot; False: another one is on the air.

        A radio that senses the carrier keeps the frame, and begins when the policy's ``sensed`` returns 0.

        :param note: header of the policy's own, before the frame.
        :param to: id of the only agent that receives it, 0: all.
        """
        return self._traffic.send(self._index, self._now_ns, note, to)

    def send_note(self, note: bytes) -> bool:
        """Begin to send a packet without a frame; False: another one is on the air."""
        return self._traffic.transmit(_Packet(self._index + 1, b"", note), self._now_ns)

    def frame(self) -> bytes:
        """Return the agent's frame for the policy's own packets; it counts as sent. Empty: the agent has none."""
        return self._traffic.frame(self._index)

    def receive_frame(self, frame: bytes, slot: int) -> None:
        """Pass a frame to the agent that its policy has decoded from packets; ``slot``: that of the state in it."""
        self._traffic.receive_frame(self._index, frame, slot)


def _next_wake(policy: Guarded, answer: object, now_ns: int, method: str = "wake") -> int:
    """Return when a policy wants to be called next, ns: later than now."""
    return _whole_ns(policy, answer, method, now_ns + 1, f"whole numbers above {now_ns}, the present time")


def _whole_ns(policy: Guarded, answer: object, method: str, least: int, allowed: str) -> int:
    """Return the number of ns that a policy has answered, ``least`` or more."""
    try:
        number = operator.index(answer)  # type: ignore[arg-type]
    except Exception:  # whatever its __index__ raises
        number = least - 1
    if number < least:
        raise PluginError(f"{policy.name}, {method}", f"gave {shown(answer)} ns; allowed: {allowed}")
    return number
