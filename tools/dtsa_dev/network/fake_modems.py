"""Simulated modems on pseudo terminals: half duplex, on the one medium of the simulator, in wall-clock time.

A program opens the pseudo terminal of a modem as it opens a real one. Bytes that it writes take their time on the line,
wait in the modem's buffer, are on the air as one packet or several, and come out of all modems that have received them
after their time on those lines. The medium says what overlaps, who is deaf and what is lost.
"""

from __future__ import annotations

import os
import random
import select
import termios
import threading
import time
import tty
from contextlib import suppress
from dataclasses import dataclass
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

from dtsa_agent.air.serial_modems import MODEMS, Modem
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.medium import OnAir

_SECOND = 1_000_000_000
_BITS = 10  # of a byte on the line
_SLOT_NS = 1_000_000  # of the channel: losses are drawn anew in each
_PATIENCE_S = 0.2
_READ = 4096
_SEND, _END, _OUT = range(3)  # kinds of event


@dataclass(frozen=True, slots=True)
class FakeModemSettings:
    """Simulated modems."""

    modem: str = "sik-64k"  # which of MODEMS they are
    count: int = 2
    baud: int | None = None  # bit/s of their lines; None: as of their kind
    latency_ms: float = 0.0  # for how long a USB adapter keeps bytes,
    jitter_ms: float = 0.0  # and up to so much longer, anew each time
    garbage: float = 0.0  # share of packets before which other bytes come out
    echo: bool = False  # modems give back what they are given

    @property
    def kind(self) -> Modem:
        """The modem's row."""
        return MODEMS[self.modem]

    @property
    def line_baud(self) -> int:
        """Speed of the lines."""
        return self.kind.baud if self.baud is None else self.baud


@dataclass(slots=True)
class _FakeModem:
    """One modem."""

    master: int = -1  # of its pseudo terminal; -1: it is unplugged
    slave: int = -1  # held open, so that its program may come and go
    buffer: bytes = b""
    last_ns: int = 0  # when the last byte in the buffer has come over the line
    sending_ns: int = 0  # until then it sends
    out_ns: int = 0  # until then its line to the computer is in use
    due_ns: int = 0  # when it sends next; 0: it has nothing


class FakeModems:
    """Modems that hear each other, in a thread of their own.

    `channel` has losses, and groups that do not hear each other; in `directory` ``modem1``, ``modem2``, ... lead to
    the devices.
    """

    def __init__(self, settings: FakeModemSettings, channel: ChannelConfig, directory: Path) -> None:
        self.settings, self._kind = settings, settings.kind
        self._byte_ns = _BITS * _SECOND // settings.line_baud
        self._channel, self._began_ns = Channel(channel), time.monotonic_ns()
        self._draw = random.Random(channel.seed)
        self._ones = [_FakeModem() for _ in range(settings.count)]
        #: Paths of the devices.
        self.devices = [directory / f"modem{number}" for number in range(1, settings.count + 1)]
        self._events: list[tuple[int, int, int, int, bytes]] = []  # a heap: ns, entry, kind, modem, bytes
        self._entry = 0
        self._air: list[OnAir] = []  # packets that may still overlap others
        self._round = (0, 0)  # of their own time division: from when on whose turn it is
        self._lock = threading.Lock()
        self._wake_read, self._wake_write = os.pipe()
        self._stopped = False
        #: Packets sent, received, lost and destroyed; bytes for which a buffer had no room.
        self.counts = dict.fromkeys(("packets", "received", "lost", "collided", "overflowed_bytes"), 0)
        #: Packets sent, by number of the modem.
        self.packets_of = dict.fromkeys(range(1, settings.count + 1), 0)
        for index in range(settings.count):
            self._plug(index)
        self._thread = threading.Thread(target=self._run, name="modems", daemon=True)

    @staticmethod
    def channel(count: int, **values: Any) -> ChannelConfig:
        """Settings of the channel of so many modems: ``loss``, ``partition``, ``seed`` and others by name."""
        return ChannelConfig.from_dict({"agents": count, "slot_ns": _SLOT_NS, **values})

    # -- from outside -----------------------------------------------------------------------------------------------
    def set(self, **values: Any) -> None:
        """Change the channel from now on: ``loss``, ``partition`` and others by name."""
        with self._lock:
            self._channel.advance(self._slot(time.monotonic_ns()))
            self._channel.set(**values)

    def unplug(self, number: int) -> None:
        """Take a modem away from its computer; what it holds is lost."""
        with self._lock:
            modem = self._ones[number - 1]
            self.devices[number - 1].unlink()
            os.close(modem.master)
            os.close(modem.slave)
            modem.master = modem.slave = -1
            modem.buffer = b""
        self._wake()

    def plug(self, number: int) -> None:
        """Put a modem back, as another device."""
        with self._lock:
            self._plug(number - 1)
        self._wake()

    def __enter__(self) -> FakeModems:
        self._thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self._stopped = True
        self._wake()
        if self._thread.ident is not None:
            self._thread.join()
        for index, modem in enumerate(self._ones):
            if modem.master >= 0:
                self.devices[index].unlink(missing_ok=True)
                os.close(modem.master)
                os.close(modem.slave)
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _plug(self, index: int) -> None:
        modem = self._ones[index]
        modem.master, modem.slave = os.openpty()
        tty.setraw(modem.slave)
        os.set_blocking(modem.master, False)
        path = self.devices[index]
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(modem.slave))

    def _wake(self) -> None:
        os.write(self._wake_write, b"x")

    # -- the thread -------------------------------------------------------------------------------------------------
    def _run(self) -> None:
        while not self._stopped:
            with self._lock:
                masters = {modem.master: index for index, modem in enumerate(self._ones) if modem.master >= 0}
                wait_ns = self._events[0][0] - time.monotonic_ns() if self._events else _SECOND
            wait_s = min(max(wait_ns, 0) / _SECOND, _PATIENCE_S)
            ready = select.select([self._wake_read, *masters], [], [], wait_s)[0]
            now = time.monotonic_ns()
            with self._lock:
                for descriptor in ready:
                    if descriptor == self._wake_read:
                        os.read(self._wake_read, _READ)
                    elif self._ones[masters[descriptor]].master == descriptor:
                        self._read(masters[descriptor], now)
                while self._events and self._events[0][0] <= now:
                    self._happen(*heappop(self._events))

    def _at(self, when_ns: int, kind: int, index: int, data: bytes = b"") -> None:
        self._entry += 1
        heappush(self._events, (when_ns, self._entry, kind, index, data))

    def _happen(self, when_ns: int, _entry: int, kind: int, index: int, data: bytes) -> None:
        if kind == _SEND:
            if when_ns == self._ones[index].due_ns:  # else it was put off
                self._send(index, when_ns)
        elif kind == _END:
            self._end(when_ns, index, data)
        else:
            self._write(index, data)

    def _read(self, index: int, now_ns: int) -> None:
        """A program has written: its bytes come over the line one after the other."""
        modem = self._ones[index]
        try:
            data = os.read(modem.master, _READ)
        except OSError:
            return
        if self._wrong_speed(modem):
            data = bytes(self._draw.randrange(256) for _ in data)
        if self.settings.echo:
            self._out(index, data, now_ns)
        room = self._kind.buffer - len(modem.buffer)
        self.counts["overflowed_bytes"] += max(0, len(data) - room)
        data = data[: max(room, 0)]
        modem.buffer += data
        modem.last_ns = max(modem.last_ns, now_ns) + len(data) * self._byte_ns
        self._plan(index, now_ns)

    def _wrong_speed(self, modem: _FakeModem) -> bool:
        """Whether the program has set another speed than the modem's."""
        with suppress(termios.error):
            speed: int = termios.tcgetattr(modem.slave)[5]
            return speed != getattr(termios, f"B{self.settings.line_baud}", speed)
        return False

    def _plan(self, index: int, now_ns: int) -> None:
        """When a modem sends next what it has."""
        modem, kind = self._ones[index], self._kind
        if not modem.buffer:
            modem.due_ns = 0
            return
        # Bytes that a program wrote at once are on the line one after the other: a packet is full before the last.
        first_ns = modem.last_ns - max(0, len(modem.buffer) - kind.packet) * self._byte_ns
        ready_ns = first_ns if len(modem.buffer) >= kind.packet else modem.last_ns + kind.gap_bytes * self._byte_ns
        due_ns = max(ready_ns, modem.sending_ns, now_ns)
        if kind.turn_ns:
            due_ns = self._turn(index, due_ns)
        modem.due_ns = due_ns
        self._at(due_ns, _SEND, index)

    def _turn(self, index: int, when_ns: int) -> int:
        """When a modem's next turn begins in a time division of their own: who has nothing passes its turn on."""
        since_ns, whose = self._round
        turn_ns = self._kind.turn_ns
        passed = max(0, -(-(when_ns - since_ns) // turn_ns))
        ahead = (index - whose - passed) % len(self._ones)
        return since_ns + (passed + ahead) * turn_ns

    def _send(self, index: int, now_ns: int) -> None:
        modem, kind = self._ones[index], self._kind
        packet, modem.buffer = modem.buffer[: kind.packet], modem.buffer[kind.packet :]
        if not packet:
            modem.due_ns = 0
            return
        air_ns = now_ns + kind.turn_round_ns
        end_ns = air_ns + kind.on_air_ns(len(packet))
        modem.sending_ns = end_ns
        self._air.append(OnAir(index + 1, now_ns, air_ns, end_ns))
        self.counts["packets"] += 1
        self.packets_of[index + 1] += 1
        self._at(end_ns, _END, index, packet)
        if kind.turn_ns:
            self._round = (end_ns, (index + 1) % len(self._ones))
            for other in range(len(self._ones)):
                if self._ones[other].due_ns:
                    self._plan(other, end_ns)
        else:
            self._plan(index, end_ns)

    def _end(self, now_ns: int, index: int, data: bytes) -> None:
        """A packet has left the air: the medium says who has it."""
        frame = next(burst for burst in self._air if burst.sender == index + 1 and burst.end_ns == now_ns)
        others = [
            each
            for each in self._air
            if each is not frame and each.start_ns < frame.end_ns and each.end_ns > frame.start_ns
        ]
        slot = self._slot(frame.start_ns)
        received, lost, collided = self._channel.medium(slot).resolve(slot, frame, others)
        self._channel.advance(slot)
        self.counts["lost"] += lost
        self.counts["collided"] += collided
        for receiver in received.nonzero()[0].tolist():
            self.counts["received"] += 1
            self._out(receiver, data, now_ns)
        oldest_ns = min((burst.start_ns for burst in self._air if burst.end_ns >= now_ns), default=now_ns)
        self._air = [burst for burst in self._air if burst.end_ns > oldest_ns]

    def _out(self, index: int, data: bytes, now_ns: int) -> None:
        """A modem gives its computer what it has, and a USB adapter keeps it for a while."""
        settings, modem = self.settings, self._ones[index]
        if self._draw.random() < settings.garbage:
            data = self._draw.randbytes(self._draw.randrange(1, 60)) + data
        modem.out_ns = max(modem.out_ns, now_ns) + len(data) * self._byte_ns
        late_ms = settings.latency_ms + settings.jitter_ms * self._draw.random()
        self._at(modem.out_ns + round(late_ms * 1e6), _OUT, index, data)

    def _write(self, index: int, data: bytes) -> None:
        modem = self._ones[index]
        if modem.master >= 0:
            if self._wrong_speed(modem):
                data = self._draw.randbytes(len(data))
            with suppress(OSError):  # its program reads nothing: a real line would lose it, too
                os.write(modem.master, data)

    def _slot(self, now_ns: int) -> int:
        return max(0, now_ns - self._began_ns) // _SLOT_NS
