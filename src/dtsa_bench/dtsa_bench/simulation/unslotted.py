"""Flights in which agents send at any instant: what is on the air in a slot, and who hears it.

Slots are the ticks of the flight: frames carry the state at the start of the slot in which they begin, and are heard in
the slot in which they arrive.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass, field
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_agent.core.errors import PluginError, shown
from dtsa_agent.core.plugins import Guarded, PluginSwarm
from dtsa_channel_sim import Channel
from dtsa_channel_sim.model.air import NEVER, Air, Arrivals
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

_MOST_LISTENS = 10_000  # for one frame
_WAKE, _LISTEN = 0, 1  # kinds of events: a policy acts, a radio listens


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


@dataclass(frozen=True, slots=True, eq=False)
class _Packet:
    """What a radio sends: a frame, bytes of the policy's own before it, or both."""

    sender: int
    frame: bytes
    note: bytes = b""
    to: int = 0  # id of the one agent that receives the frame; 0: all


class Radio:
    """The radio of an agent that is not bound to slots, for its policy while it acts. It sends one packet at a time."""

    def __init__(self, traffic: UnslottedTraffic, index: int) -> None:
        self._traffic, self._index = traffic, index
        self._policy = traffic.swarm.policies[index].name

    def send(self, note: bytes = b"", to: int = 0) -> bool:
        """Begin to send the agent's frame, with its state at the start of the slot; False: another one is on the air.

        A radio that senses the carrier keeps the frame, and begins when the policy's ``sensed`` returns 0.

        :param note: header of the policy's own, before the frame.
        :param to: id of the only agent that receives it, 0: all.
        """
        traffic, frame = self._traffic, self._traffic.frames[self._index]
        if frame and traffic.listen_counts is not None:
            traffic.listen_counts[self._index] = 0
            traffic.schedule(self._index, _LISTEN, traffic.now_ns + traffic.to_radio_ns(len(frame)))
            return True
        return bool(frame) and self._transmit(_Packet(self._index + 1, frame, note, to))

    def send_note(self, note: bytes) -> bool:
        """Begin to send a packet without a frame; False: another one is on the air."""
        return self._transmit(_Packet(self._index + 1, b"", note))

    def frame(self) -> bytes:
        """Return the agent's frame for the policy's own packets; it counts as sent. Empty: the agent has none."""
        frame = self._traffic.frames[self._index]
        if frame:
            self._traffic.began.add(self._index)
        return frame

    def receive_frame(self, frame: bytes, slot: int) -> None:
        """Pass a frame to the agent that its policy has decoded from packets; ``slot``: that of the state in it."""
        if not isinstance(frame, bytes) or not frame:
            raise PluginError(f"{self._policy}, wake", f"received {shown(frame)}; allowed: bytes of a frame")
        receivers = np.arange(len(self._traffic.frames)) == self._index
        self._traffic.carried.combined.append((slot, frame, receivers))

    def _transmit(self, packet: _Packet) -> bool:
        traffic, agents = self._traffic, len(self._traffic.frames)
        if not isinstance(packet.note, bytes) or packet.to not in range(agents + 1):
            given = f"{shown(packet.note)}, {shown(packet.to)}"
            raise PluginError(f"{self._policy}, wake", f"sent ({given}); allowed: bytes, to 0 (all) to {agents}")
        if traffic.now_ns < traffic.free_ns[self._index]:
            return False
        traffic.begin(packet, traffic.now_ns + traffic.to_radio_ns(len(packet.note) + len(packet.frame)))
        return True


class UnslottedTraffic:
    """Lets the policies of all agents act, on one medium; each agent has a table of its own.

    At one instant arrivals come first, then what agents and radios do, in the order of their ids. Radios that listen
    before they send hold one frame each until the policy's ``sensed`` says that it may begin.
    """

    def __init__(self, swarm: Swarm, channel: Channel) -> None:
        assert isinstance(swarm, PluginSwarm)
        self.swarm, self._airtime = swarm, channel.config.airtime
        self._air: Air[_Packet] = Air(channel)
        row, agents = swarm.config.policy_row, range(len(swarm.ids))
        self._reacts = row.reacts
        self.free_ns, self._sent_ns = [0 for _ in agents], [0 for _ in agents]  # of radios: done, began, with the last
        # How often each radio has listened for the frame that it holds; None: they do not listen.
        self.listen_counts = [0 for _ in agents] if row.listens else None
        self._events = [(0, index, _WAKE) for index in agents]  # heap: ns, index, kind
        self._due_ns = {(index, _WAKE): 0 for index in agents}  # by index and kind: the one in that heap that counts
        self._arriving = Arrivals()  # ns, packets and (N,) their receivers
        self._slot = self.now_ns = 0
        self.frames: list[bytes] = []  # of this slot
        self.began: set[int] = set()  # indices of agents whose frames began in this slot
        self.carried = SlotTraffic()

    def slot(self, slot: int) -> SlotTraffic:
        """What happens on the air in the slot after the last one; tables are as they were at its start."""
        swarm, end_ns, self._slot = self.swarm, (slot + 1) * self.swarm.config.slot_ns, slot
        self.carried, self.began = SlotTraffic(), set()
        swarm.sends[:] = swarm.present > 0
        swarm.emit(slot)
        self.frames = [swarm.frame(index) for index in range(len(swarm.ids))]
        self._act(end_ns)
        self._resolve(end_ns)
        self._deliver(end_ns)
        self.carried.senders = tuple(swarm.ids[index] for index in sorted(self.began))
        swarm.sends[:] = 0
        swarm.sends[sorted(self.began)] = 1
        swarm.emit(slot)
        return self.carried

    def _act(self, end_ns: int) -> None:
        """Lets policies and radios act until the end of a slot."""
        while True:
            while self._events and self._due_ns.get(self._events[0][1:]) != self._events[0][0]:
                heappop(self._events)  # another one has replaced it
            next_ns, index, kind = self._events[0] if self._events else (NEVER, 0, _WAKE)
            if self._reacts and self._air.due_ns <= min(next_ns, end_ns):
                self._resolve(self._air.due_ns)
            elif self._reacts and self._arriving.next_ns <= min(next_ns, end_ns - 1):
                self._deliver(self._arriving.next_ns)
            elif next_ns >= end_ns:
                return
            else:
                heappop(self._events)
                del self._due_ns[index, kind]
                self.now_ns = next_ns
                if not self.swarm.present[index]:
                    self.schedule(index, _WAKE, end_ns)
                elif kind == _WAKE:
                    self._wake(index)
                else:
                    self._listen(index)

    def schedule(self, index: int, kind: int, at_ns: int) -> None:
        """Let a policy wake or a radio listen at a time, and at no other one."""
        self._due_ns[index, kind] = at_ns
        heappush(self._events, (at_ns, index, kind))

    def _wake(self, index: int) -> None:
        policy = self.swarm.policies[index]
        answer = policy.wake(self.swarm.tables[index], self.now_ns, Radio(self, index))
        if (index, _LISTEN) not in self._due_ns:  # else it wakes when the frame has begun
            self.schedule(index, _WAKE, _next_wake(policy, answer, self.now_ns))

    def _listen(self, index: int) -> None:
        """Lets a radio listen, and its policy know if it has begun to send the agent's frame of this slot."""
        policy, now_ns = self.swarm.policies[index], self.now_ns
        busy = self._air.busy(index + 1, now_ns, self.swarm.position)
        answer = policy.sensed(busy, now_ns, self._sent_ns[index])
        allowed = "whole numbers from 1, as the air is in use" if busy else "whole numbers from 0"
        if wait_ns := _whole_ns(policy, answer, "sensed", int(busy), allowed):
            assert self.listen_counts is not None
            self.listen_counts[index] += 1
            if self.listen_counts[index] >= _MOST_LISTENS:
                raise PluginError(f"{policy.name}, sensed", f"listened {_MOST_LISTENS} times for one frame")
            self.schedule(index, _LISTEN, now_ns + wait_ns)
            return
        self._sent_ns[index] = now_ns
        self.begin(_Packet(index + 1, self.frames[index]), now_ns)
        answer = policy.sent(self.swarm.tables[index], now_ns)
        self.schedule(index, _WAKE, _next_wake(policy, answer, now_ns, "sent"))

    def to_radio_ns(self, length: int) -> int:
        """How long after the order a radio has a packet, ns; a constant delay moves arrivals alone."""
        return self._airtime.to_radio_ns(length) if self._airtime.line.serial else 0

    def begin(self, packet: _Packet, at_ns: int) -> None:
        """A radio has a packet from ``at_ns`` on, and begins to send it as soon as it can."""
        index, length = packet.sender - 1, len(packet.note) + len(packet.frame)
        if not 1 <= length <= self._airtime.longest:
            policy = self.swarm.policies[index].name
            raise PluginError(f"{policy}, wake", f"sent {length} bytes; allowed: 1 to {self._airtime.longest}")
        self._resolve(self.now_ns)
        self._air.begin(packet, packet.sender, at_ns, length)
        self.free_ns[index] = at_ns + self._airtime.total_ns(length)
        if packet.frame:
            self.began.add(index)
        self.carried.lengths.append(length)

    def _resolve(self, until_ns: int) -> None:
        for verdict in self._air.resolve(until_ns, self.swarm.position):
            if verdict.received.any():
                arrival_ns = verdict.arrival_ns
                self._arriving.add(arrival_ns, (arrival_ns, verdict.frame_id, verdict.received))
            disturbed = verdict.collided or self.carried.outcome == COLLISION
            self.carried.outcome = COLLISION if disturbed else SUCCESS

    def _deliver(self, until_ns: int) -> None:
        """What has arrived is heard; policies that react do so."""
        for now_ns, packet, received in self._arriving.pop(until_ns):
            if packet.frame:
                mask = received & (np.arange(len(received)) == packet.to - 1) if packet.to else received
                self.carried.heard.append((self._slot, packet.frame, mask))
            if not self._reacts:
                continue
            for index in np.flatnonzero(received & (self.swarm.present > 0)).tolist():
                policy, table = self.swarm.policies[index], self.swarm.tables[index]
                answer = policy.received(table, now_ns, packet.sender, packet.note)
                self.schedule(index, _WAKE, _next_wake(policy, answer, now_ns, "received"))


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
