"""The radio chip of a Crazyflie, and the line between it and the flight processor.

One loop does all: it hands one reception over to the flight processor, byte by byte, then looks whether there is a
packet to be sent. Receptions wait in a queue; what finds it full is lost. It sends at once, whatever it receives
meanwhile: the medium says what that destroys. Times: :mod:`dtsa_channel_sim.model.radio_table`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from dtsa_bench.crazyflies.simulated.radio import esb
from dtsa_bench.crazyflies.simulated.radio.agenda import Agenda
from dtsa_bench.crazyflies.simulated.radio.air import RadioAir
from dtsa_channel_sim.model.airtime import HEADER_BYTES, Line
from dtsa_channel_sim.model.medium import OnAir


@dataclass(frozen=True, slots=True)
class Packet:
    """A peer-to-peer packet, or one of the ground's.

    :param sender: id of its sender; 0: the ground.
    :param raw: port and data.
    :param ordered_ns: when the app ordered to send it.
    """

    sender: int
    raw: bytes
    ordered_ns: int

    @property
    def data(self) -> bytes:
        """Without the port."""
        return self.raw[1:]


class Nrf51:
    """One radio chip.

    :param agent: id on the air.
    :param air: where it sends. :param agenda: what happens when.
    :param line: the way to and from the flight processor.
    :param tuned: channel and data rate.
    :param left: called with a packet and its transmission when it has left the air.
    :param deliver: takes a packet that has come to the flight processor.
    """

    def __init__(
        self,
        agent: int,
        air: RadioAir,
        agenda: Agenda,
        line: Line,
        tuned: tuple[int, str],
        left: Callable[[Packet, OnAir], None],
        deliver: Callable[[int, Packet], None],
    ) -> None:
        self._agent, self._air, self._agenda, self._line, self._tuned = agent, air, agenda, line, tuned
        self._left, self._deliver = left, deliver
        self.overflows = 0  # receptions that found the queue full
        self._life = 0
        self.reset()

    def reset(self) -> None:
        """Power off and on."""
        self._life += 1
        self._queue: deque[Packet] = deque()
        self._orders: deque[Packet] = deque()
        self._handing: Packet | None = None
        self._sending = False

    def order(self, packet: Packet, now_ns: int) -> None:
        """A packet of the flight processor's has come over the line: it is to be sent."""
        self._orders.append(packet)
        self._work(now_ns)

    def receive(self, packet: Packet, now_ns: int) -> None:
        """A packet has been received."""
        held = len(self._queue) + (self._handing is not None)
        if self._line.queue and held >= self._line.queue:
            self.overflows += 1
            return
        self._queue.append(packet)
        self._work(now_ns)

    def _work(self, now_ns: int) -> None:
        """One turn of the loop after the other, until it has to wait."""
        life = self._life
        if self._handing is not None:
            return
        if self._orders and not self._sending:  # after each packet handed over there is time for one of these
            packet = self._orders.popleft()
            frame = self._air.send(*self._tuned, self._agent, now_ns, HEADER_BYTES + len(packet.data), esb.TURN_NS)
            self._sending = True
            self._agenda.at(frame.end_ns, lambda: self._end(packet, frame, life))
        if self._queue:
            packet = self._handing = self._queue.popleft()
            done = now_ns + self._line.from_radio_ns(len(packet.data))
            self._agenda.at(done, lambda: self._handed(done, life))

    def _end(self, packet: Packet, frame: OnAir, life: int) -> None:
        if life == self._life:
            self._sending = False
        self._left(packet, frame)
        if life == self._life:
            self._work(frame.end_ns)

    def _handed(self, now_ns: int, life: int) -> None:
        if life != self._life or self._handing is None:
            return
        packet, self._handing = self._handing, None
        self._deliver(now_ns, packet)
        self._work(now_ns)
