"""A Crazyradio as the port of an agent, and what listens by one."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from dtsa_agent.air import _queue
from dtsa_agent.air.port import Datagram
from dtsa_agent.air.precision import going_first
from dtsa_agent.core.errors import ConfigError

from .dongle import Dongle, DongleError
from .packets import Packet, PacketReader, broadcast, datagram_in
from .settings import CrazyradioSettings
from .stamps import DongleClock

_END_S = 2.0  # a dongle that hangs ends with the process
_SECOND = 1_000_000_000
_PRIORITY = 20
_LOOK_S = 0.5  # between two looks whether a dongle that has gone is back
_UNPLUGGED = "the dongle is not there"


class CrazyradioPort:
    """See the module; a :class:`~dtsa_agent.air.port.DatagramPort` and a :class:`~dtsa_agent.air.port.Listener`.

    A thread reads the dongle. One that is unplugged is used again when it is back.

    :param settings: which dongle, and to what it is tuned.
    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: CrazyradioSettings) -> None:
        self.properties = settings.properties
        self.say: Callable[[str], None] | None = None  # is told a line when the dongle goes, and when it is back
        #: Is told each packet that the dongle has heard and when (ns, CLOCK_MONOTONIC), by the thread that reads.
        self.heard: Callable[[Packet, int], None] | None = None
        self._settings = settings
        self.compiled = _queue.open_queue()
        self._dongle: Dongle | None = Dongle(settings)
        self._others = self._dropped = self._dropped_before = self._unplugged = self._garbled = self._strange = 0
        self._lock = threading.Lock()  # the thread that reads closes the dongle, another one writes to it
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="crazyradio", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""
        return _queue.descriptor(self.compiled)

    def send(self, data: bytes) -> str:
        """Hands a datagram to the dongle; why that was not possible, or an empty text.

        :param data: the datagram.
        """
        with self._lock:
            if self._dongle is None:
                return _UNPLUGGED
            try:
                self._dongle.write(broadcast(data, self._settings.p2p_port))
            except DongleError as error:
                return str(error)
        return ""

    def receive(self, most: int) -> list[Datagram]:
        """What has arrived, in this order; empty if nothing has.

        :param most: unused: 16 datagrams at most come at a time.
        """
        return [Datagram(*one) for one in _queue.get(self.compiled)]

    def counts(self) -> dict[str, int]:
        """What the dongle has lost, what else was on the air, and how often it was unplugged."""
        return {
            "dropped_by_dongle": self._dropped_before + self._dropped,
            "dropped_by_computer": _queue.overflowed(self.compiled),
            "other_packets": self._others,
            "garbled_transfers": self._garbled,
            "strange_stamps": self._strange,
            "times_unplugged": self._unplugged,
        }

    # -- the thread that reads --------------------------------------------------------------------------------------
    def _run(self) -> None:
        with going_first(_PRIORITY):  # as agents do: what they wait for comes by this thread
            self._serve()

    def _serve(self) -> None:
        while not self._stopped.is_set():
            dongle = self._dongle
            if dongle is None:
                if not self._stopped.wait(_LOOK_S):
                    self._come_back()
                continue
            try:
                self._read(dongle)
            except DongleError as error:
                self._go(dongle, str(error))

    def _read(self, dongle: Dongle) -> None:
        """Reads until the end, or until the dongle goes.

        :raises DongleError: if it goes.
        """
        reader, clock = PacketReader(), DongleClock()
        garbled, strange = self._garbled, self._strange
        look = 0
        while not self._stopped.is_set():
            data = dongle.read()
            now = time.monotonic_ns()
            for packet in reader.feed(data):
                self._take(packet, clock.arrival_ns(packet.stamp_us, now))
            if now >= look:
                look = now + _SECOND
                self._dropped = dongle.dropped()
                self._garbled, self._strange = garbled + reader.garbled, strange + clock.strange

    def _take(self, packet: Packet, arrival_ns: int) -> None:
        if self.heard is not None:
            self.heard(packet, arrival_ns)
        datagram = datagram_in(packet.payload, self._settings.p2p_port)
        if datagram is None:
            self._others += 1
        else:
            _queue.put(self.compiled, datagram, arrival_ns, False)

    def _go(self, dongle: Dongle, why: str) -> None:
        with self._lock:
            self._dongle = None
        dongle.close()
        self._dropped_before, self._dropped = self._dropped_before + self._dropped, 0
        self._unplugged += 1
        self._tell(f"has gone ({why}): no frame leaves or arrives until it is back")

    def _come_back(self) -> None:
        try:
            self._dongle = Dongle(self._settings)
        except ConfigError:  # not yet
            return
        self._tell("is back")

    def _tell(self, what: str) -> None:
        if self.say is not None:
            self.say(f"dongle {self._settings.uri} {what}")

    def close(self) -> None:
        """Ends the thread; the dongle is free for others."""
        self._stopped.set()
        self._thread.join(_END_S)
        if self._dongle is not None:
            self._dongle.close()
            self._dongle = None

    def __enter__(self) -> CrazyradioPort:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()
