"""An air for agents that send at any instant: the port of an agent, carried by a simulated channel.

An event simulation without a clock of its own. Everything happens in the order of its time. At one instant, ends of
transmissions come first, then arrivals, then what agents do, then starts of transmissions; equal ones in the order in
which they were asked for. So the same calls give the same run.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from heapq import heappop, heappush

from dtsa_agent.air import AirListener, AirPort
from dtsa_agent.core.errors import LocalProtocolError

from .air import Air
from .channel import Channel
from .medium import Positions

_END, _ARRIVAL, _ACT, _START = range(4)  # order at one instant


class SimulatedAir:
    """A channel, and the agents on it.

    :param channel: the channel.
    :param positions: (3, N), m, frame map; needed with a limited range or capture; may be replaced as agents move.
    """

    def __init__(self, channel: Channel, positions: Positions | None = None) -> None:
        self.positions = positions
        self.now_ns = 0
        self._channel = channel
        self._air: Air[int] = Air(channel)
        self._listeners: dict[int, AirListener] = {}
        self._ends_ns: dict[int, int] = {}  # end of each agent's last transmission
        self._on_air: dict[int, bytes] = {}
        self._events: list[tuple[int, int, int, Callable[[], None]]] = []
        self._count = 0

    def join(self, agent: int, listener: AirListener) -> AirPort:
        """Connects an agent; its port to the air.

        :param agent: id, 1 to N.
        :param listener: is told what the air does.
        :raises LocalProtocolError: for an id that is not the channel's, or one that is connected already.
        """
        if not 1 <= agent <= self._channel.config.agents or agent in self._listeners:
            raise LocalProtocolError(f"agent {agent}: ids run from 1 to {self._channel.config.agents}, each once")
        self._listeners[agent] = listener
        return SimulatedPort(self, agent)

    def call(self, at_ns: int, action: Callable[[], None]) -> None:
        """Lets an agent act at an instant.

        :param at_ns: ns, now or later.
        :param action: what it does.
        """
        self._push(at_ns, _ACT, action)

    def run(self, until_ns: int) -> None:
        """Lets everything happen that is due before a time.

        :param until_ns: ns.
        """
        while self._events and self._events[0][0] < until_ns:
            self.now_ns, _, _, action = heappop(self._events)
            action()
        self.now_ns = max(self.now_ns, until_ns)

    def send(self, agent: int, frame: bytes, at_ns: int) -> None:
        """Takes an agent's order to send; see :class:`~dtsa_agent.air.AirPort`."""
        self._push(at_ns, _START, partial(self._start, agent, frame))

    def busy(self, agent: int, when_ns: int) -> bool:
        """Whether an agent's air is in use; see :class:`~dtsa_agent.air.AirPort`.

        :raises LocalProtocolError: for another time than now.
        """
        if when_ns != self.now_ns:
            raise LocalProtocolError(f"the air at {when_ns} ns: now it is {self.now_ns} ns")
        return self._air.busy(agent, when_ns, self.positions)

    def _push(self, at_ns: int, order: int, action: Callable[[], None]) -> None:
        if at_ns < self.now_ns:
            raise LocalProtocolError(f"something is to happen at {at_ns} ns: now it is {self.now_ns} ns")
        self._count += 1
        heappush(self._events, (at_ns, order, self._count, action))

    def _start(self, agent: int, frame: bytes) -> None:
        listener = self._listeners[agent]
        if self._ends_ns.get(agent, 0) > self.now_ns:  # the radio still sends
            listener.sent(frame, None)
            return
        self._count += 1
        self._air.begin(self._count, agent, self.now_ns, len(frame))
        self._on_air[self._count] = frame
        start_ns = self._air.begun_ns(self._count, self.now_ns, self.positions)
        end_ns = start_ns + self._channel.config.airtime.total_ns(len(frame))
        self._ends_ns[agent] = end_ns
        self._push(end_ns, _END, self._settle)
        if start_ns > self.now_ns:  # its radio hands a reception over first
            self._push(start_ns, _START, partial(listener.sent, frame, start_ns))
        else:
            listener.sent(frame, start_ns)

    def _settle(self) -> None:
        for verdict in self._air.settle(self.now_ns, self.positions):
            frame = self._on_air.pop(verdict.frame_id)
            receivers = [int(k) + 1 for k in verdict.received.nonzero()[0] if int(k) + 1 in self._listeners]
            if receivers:
                self._push(verdict.arrival_ns, _ARRIVAL, partial(self._arrive, frame, receivers))

    def _arrive(self, frame: bytes, receivers: list[int]) -> None:
        for agent in receivers:
            self._listeners[agent].received(frame, self.now_ns, None)


class SimulatedPort(AirPort):
    """One agent's port to a simulated air; its clock is the channel's.

    :param air: the air.
    :param agent: id of the agent.
    """

    def __init__(self, air: SimulatedAir, agent: int) -> None:
        self._air, self._agent = air, agent

    def send(self, frame: bytes, at_ns: int) -> None:
        self._air.send(self._agent, frame, at_ns)

    def busy(self, when_ns: int) -> bool:
        return self._air.busy(self._agent, when_ns)
