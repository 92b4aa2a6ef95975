"""The laboratory in real time: programs of the ground connect to its simulated Crazyradios.

The bridge and every other program with cflib talks to the vehicles by CRTP, with the app's parameters, log variables
and app channel. Dongles in sniffer mode hear what the apps say to each other, and take part. Times on the air are as
exact as in virtual time; only the programs see them as late as this machine is. On a machine that is too busy the
laboratory is slower than real time: caught up at once, the lost time would be a gap of all links.
"""

from __future__ import annotations

import dataclasses
import selectors
from functools import partial

from dtsa_bench.crazyflies.simulated import crtp
from dtsa_bench.crazyflies.simulated.radio.settings import RadioSettings, Station
from dtsa_bench.crazyflies.simulated.radio.side import RadioSide
from dtsa_bench.crazyflies.simulated.radio.sniffer_mode import Tuned
from dtsa_channel_sim.model.medium import OnAir

from .laboratory import ADDRESS, TICK_NS, Laboratory
from .packet import Packet
from .record import Observer
from .settings import LabSettings

_WAIT_S = 0.001
_BEHIND_NS = 20_000_000  # caught up at once; what is more is lost
_APP_CHANNEL = 2  # of CRTP's platform port


def stations(settings: LabSettings) -> tuple[Station, ...]:
    """Where the vehicles listen."""
    tuned = settings.channel, settings.rate
    found = []
    for agent in range(1, settings.agents + 1):
        address = (ADDRESS + agent).to_bytes(5, "big")
        uri = f"radio://0/{settings.channel}/{settings.rate}/{address.hex().upper()}"
        found.append(Station(uri, *tuned, address))
    return tuple(found)


class Live(Observer):
    """Dongles on the air of a laboratory, which is made with `side` and then attached.

    :param settings: vehicles and air.
    :param radio: the dongles, and their socket.
    """

    lab: Laboratory

    def __init__(self, settings: LabSettings, radio: RadioSettings) -> None:
        radio = dataclasses.replace(radio, stations=stations(settings), loss=settings.loss, seed=settings.seed)
        self.side = RadioSide(radio, self._hear, lambda index, up: self.lab.is_on(index + 1), listen=False)
        self.lost_s = 0.0  # s, by which its time has fallen behind
        self._ticks = 0
        self._stopped = False

    def attach(self, lab: Laboratory) -> None:
        """The laboratory whose air this is."""
        self.lab = lab
        lab.observe(self)
        for agent, receiver in enumerate(self.side.receivers, 1):
            receiver.taken = partial(self.lab.polled, agent)
        for dongle in self.side.dongles:
            dongle.between = self._between
        self.side.agenda.at(TICK_NS, self._log)

    def stop(self) -> None:
        """Ends :meth:`run`; also from a signal's handler."""
        self._stopped = True

    def run(self, seconds: float) -> None:
        """Flies in real time.

        :param seconds: s, how long.
        :raises AppError: an app did what no app may do. :raises ConfigError: the socket cannot be made.
        """
        self.side.listen()  # not before: the app has been compiled
        selector = selectors.SelectSelector()  # waits to the microsecond; epoll to the millisecond
        selector.register(self.side.listener, selectors.EVENT_READ, None)
        try:
            while not self._stopped and self.lab.time < seconds:
                for key, _ in selector.select(_WAIT_S):
                    self.side.take(key.data, selector)
                self._keep_up()
                self.lab.run(min(seconds, self.side.now_ns() / 1e9))
        finally:
            for key in list(selector.get_map().values()):
                if key.data is not None:
                    self.side.leave(key.data)
            selector.close()

    def _keep_up(self) -> None:
        behind = self.side.now_ns() - self.lab.now_ns - _BEHIND_NS
        if behind > 0:
            self.side.origin_ns += behind
            self.lost_s += behind / 1e9

    def close(self) -> None:
        """The socket goes."""
        self.side.close()

    # -- between ground and apps ------------------------------------------------------------------------------------
    def _hear(self, index: int, packet: bytes, t: float) -> None:
        reply = self.lab.peers[index].receive(packet, t)
        if reply is not None:
            self.side.receivers[index].push(reply)
        self.lab.show(index)

    def _between(self, packet: bytes, heard: set[int], tuned: Tuned, frame: OnAir) -> None:
        if (tuned.channel, tuned.rate) == (self.lab.settings.channel, self.lab.settings.rate):
            self.lab.hear(Packet(0, bytes((packet[1] & 0x0F,)) + packet[2:], 0), heard, frame)

    def on_app_channel(self, agent: int, now_ns: int, data: bytes) -> None:
        self.side.receivers[agent - 1].push(crtp.pack(crtp.PLATFORM, _APP_CHANNEL, data))

    def on_print(self, agent: int, now_ns: int, text: str) -> None:
        data = text.encode()
        for first in range(0, len(data), crtp.MAX_DATA):
            self.side.receivers[agent - 1].push(crtp.pack(crtp.CONSOLE, 0, data[first : first + crtp.MAX_DATA]))

    def _log(self) -> None:
        self._ticks += 1
        now = self._ticks * TICK_NS
        self.side.agenda.at(now + TICK_NS, self._log)
        for index, (peer, receiver) in enumerate(zip(self.lab.peers, self.side.receivers, strict=True)):
            if not peer.blocks or not self.lab.is_on(index + 1):
                continue
            if not receiver.connected(now / 1e9):  # nobody is there: the log ends
                peer.blocks.clear()
                receiver.silent()
                continue
            for packet in peer.log_packets(self._ticks, now / 1e9):
                receiver.push(packet)
