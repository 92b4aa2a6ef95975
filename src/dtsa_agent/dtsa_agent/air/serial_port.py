"""A modem on a serial line as the port of an agent. It was never run on hardware.

A datagram on the line: COBS between zeros, with a check sum, found again after whatever came between.

| bytes | what |
|---|---|
| 0 | zero: what came before is over |
| 1-.. | datagram and its CRC-16 (CCITT, as of ``binascii.crc_hqx``, little-endian), by COBS without zeros |
| last | zero |

Big-endian, a frame that lacks the last byte of its check sum would be whole where that byte is zero. COBS adds one byte
to up to 254 others, whatever they are: a frame takes the same time each time.
"""

from __future__ import annotations

import errno
import os
import termios
import time
from binascii import crc_hqx
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import serial
from cobs import cobs

from dtsa_agent.core.errors import ConfigError

from .device_port import DevicePort
from .serial_modems import LONGEST
from .settings import SerialSettings

_CRC = 2
_TOO_LONG = LONGEST + _CRC + 2  # bytes between zeros; a frame has one less at most
_WAIT_S = 0.1  # an end is noticed after this time at the latest
_ECHOES = 8  # own datagrams that are remembered: a modem that echoes gives them back at once
_MUCH_GARBLED = 2_000  # bytes, without one datagram among them
_MAVLINK = (0xFD, 0xFE)  # first bytes of its messages
_LATENCY_MS = 2  # an adapter may keep bytes for so long
_REASONS = {
    **dict.fromkeys((errno.ENOENT, errno.ENODEV, errno.ENXIO), "a device that is there"),
    **dict.fromkeys((errno.EBUSY, errno.EWOULDBLOCK), "a device that no other process uses"),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM), "a device that this user may open: add the user to its group, mostly dialout"
    ),
    errno.ENOTTY: "a serial device",
    errno.EINVAL: "a speed that the device has",
}


def to_line(datagram: bytes) -> bytes:
    """Return the bytes of a datagram of at most ``LONGEST`` bytes on the line."""
    return b"\0" + cobs.encode(datagram + crc_hqx(datagram, 0xFFFF).to_bytes(_CRC, "little")) + b"\0"


class LineReader:
    """Finds datagrams in what comes over a line. It keeps a frame that is not whole yet, and little more."""

    def __init__(self) -> None:
        self._rest = b""  # since the last zero
        self.garbled = 0  # pieces between zeros that are no datagrams
        self.garbled_bytes = 0

    def feed(self, chunk: bytes) -> Iterator[tuple[bytes, int]]:
        """Yield the datagrams that end in a chunk, and how many bytes of it follow each."""
        *pieces, rest = (self._rest + chunk).split(b"\0")
        too_long = max(0, len(rest) - _TOO_LONG)
        self._rest = rest[too_long:]
        after = len(rest) + sum(len(piece) + 1 for piece in pieces)
        for piece in pieces:
            after -= len(piece) + 1
            datagram = _datagram_in(piece)
            if datagram:
                yield datagram, after
            elif piece:  # not between the zero at the end of a frame and that at the beginning of the next
                self.garbled += 1
                self.garbled_bytes += len(piece)
        self.garbled_bytes += too_long


def _datagram_in(piece: bytes) -> bytes:
    """Return the datagram between two zeros; empty if there is none."""
    with suppress(cobs.DecodeError):
        content = cobs.decode(piece) if len(piece) < _TOO_LONG else b""
        datagram = content[:-_CRC]
        if crc_hqx(datagram, 0xFFFF) == int.from_bytes(content[-_CRC:], "little"):
            return datagram
    return b""


class SerialPort(DevicePort):
    """A modem.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self._settings = settings
        self._reader = LineReader()
        self._sent: deque[bytes] = deque(maxlen=_ECHOES)
        self._echoes = self._datagrams = 0
        self._clean = (0, 0)  # datagrams, and garbled bytes when the last of them came
        self._mavlink = 0  # pieces that may be its messages
        self._latency_ms = 0  # for which an adapter keeps bytes to itself; 0: it does not say
        self._printed: set[str] = set()
        super().__init__(f"device {settings.device}", "device", settings.properties)

    def counts(self) -> dict[str, int]:
        """Return what came that was no datagram, what the modem echoed, and how often the device was unplugged."""
        return {
            "garbled_pieces": self._reader.garbled,
            "garbled_bytes": self._reader.garbled_bytes,
            "echoes": self._echoes,
            "dropped_by_computer": self.overflowed,
            "times_unplugged": self.unplugged,
        }

    def _open(self) -> serial.Serial:
        path = self._settings.device
        try:
            # exclusive: a second process, or a second agent of this one, is refused.
            device = serial.Serial(path, self._settings.baud, timeout=_WAIT_S, write_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            # pyserial gives no number for one that cannot be configured.
            number = errno.ENOTTY if "Could not configure" in str(error) else getattr(error, "errno", None) or 0
            allowed = _REASONS.get(number) or f"a serial device that can be used ({error})"
            raise ConfigError("device", path, allowed) from None
        with suppress(OSError, ValueError, NotImplementedError):
            device.set_low_latency_mode(True)
        timer = Path("/sys/class/tty") / os.path.basename(os.path.realpath(path)) / "device" / "latency_timer"
        with suppress(OSError):
            timer.write_text("1")
        with suppress(OSError, ValueError):
            self._latency_ms = int(timer.read_text())
        return device

    def _close(self, device: serial.Serial) -> None:
        _clear_output(device)  # else to close waits until a line that is held up has sent
        with suppress(OSError):
            device.close()

    def _write(self, device: serial.Serial, data: bytes) -> None:
        """Give the device all bytes of a datagram or none of them, without waiting."""
        self._sent.append(data)  # before: an echo may be quicker than this thread
        line, written, refusal = to_line(data), 0, "the line takes no more bytes"
        with suppress(BlockingIOError):
            if device.out_waiting > len(line):
                refusal = "earlier frames still wait for the line"  # their slots are over
            else:
                written = os.write(device.fileno(), line)
        if written < len(line):
            _clear_output(device)
            raise OSError(refusal)

    def _read(self, device: serial.Serial) -> None:
        while not self._stopped.is_set():
            chunk = device.read(1)
            if chunk:
                self._receive(chunk + device.read(device.in_waiting), time.monotonic_ns())
            if self._latency_ms > _LATENCY_MS:
                self._print_once(
                    f"keeps bytes for up to {self._latency_ms} ms: as root write 1 to latency_timer of the device in"
                    " /sys/class/tty, see docs/how-to/radios.md"
                )

    def _receive(self, chunk: bytes, now_ns: int) -> None:
        self._mavlink += sum(chunk.count(first) for first in _MAVLINK)
        for datagram, after in self._reader.feed(chunk):
            self._datagrams += 1
            if datagram in self._sent:
                self._echoes += 1
                self._print_once("gives back what it is given: own frames are left out")
            else:  # the bytes after it in the same chunk have taken their time on the line
                self._queue(datagram, now_ns - after * self._settings.line_byte_ns)
        before, garbled = self._clean
        if self._datagrams != before:
            self._clean, self._mavlink = (self._datagrams, self._reader.garbled_bytes), 0
        elif self._reader.garbled_bytes - garbled > _MUCH_GARBLED:
            guess = "bytes of MAVLink" if self._mavlink > _MUCH_GARBLED // 100 else "another speed of the line"
            text = f"gives {_MUCH_GARBLED} bytes and no frame among them: perhaps"
            self._print_once(text, f" {guess}, or another program's")

    def _print_once(self, text: str, more: str = "") -> None:
        if self.log is not None and text not in self._printed:
            self._printed.add(text)
            self.print(text + more)


def _clear_output(device: serial.Serial) -> None:
    with suppress(OSError, termios.error):
        device.reset_output_buffer()
