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
import select
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

from .device_port import DeviceError, DevicePort
from .serial_modems import LONGEST
from .settings import SerialSettings

_CRC = 2
_READ_BYTES = 4096  # at a time
_WAIT_S = 0.1  # an end is noticed after this time at the latest
_ECHOES = 8  # own datagrams that are remembered: a modem that echoes gives them back at once
_MUCH_GARBLED = 2_000  # bytes, without one datagram among them
_MAVLINK = (0xFD, 0xFE)  # first bytes of its messages
_LATENCY_MS = 2  # an adapter may keep bytes for so long
_ABSENT = dict.fromkeys((errno.ENOENT, errno.ENODEV, errno.ENXIO), "a device that is there")
_REASONS = _ABSENT | {
    errno.EACCES: "a device that this user may open: add the user to its group, mostly dialout",
    errno.EPERM: "a device that this user may open: add the user to its group, mostly dialout",
    errno.EBUSY: "a device that no other process uses",
    errno.EWOULDBLOCK: "a device that no other process uses",
    errno.ENOTTY: "a serial device",
    errno.EINVAL: "a speed that the device has",
}


def to_line(datagram: bytes) -> bytes:
    """Return the bytes of a datagram of at most ``LONGEST`` bytes on the line."""
    return b"\0" + cobs.encode(datagram + crc_hqx(datagram, 0xFFFF).to_bytes(_CRC, "little")) + b"\0"


class LineReader:
    """Finds datagrams in what comes over a line. It keeps a frame that is not whole yet, and no more."""

    def __init__(self) -> None:
        self._piece = bytearray()  # since the last zero
        self._skipping = False  # that was too long for a frame
        self.garbled = 0  # pieces between zeros that are no datagrams
        self.garbled_bytes = 0

    def feed(self, chunk: bytes) -> Iterator[tuple[bytes, int]]:
        """Yield the datagrams that end in a chunk, and how many bytes of it follow each."""
        at = 0
        while (end := chunk.find(0, at)) >= 0:
            self._add(chunk[at:end])
            at = end + 1
            datagram = self._decode()
            if datagram:
                yield datagram, len(chunk) - at
        self._add(chunk[at:])

    def _add(self, piece: bytes) -> None:
        self._piece += piece
        if self._skipping or len(self._piece) > LONGEST + _CRC + 1:
            self.garbled_bytes += len(self._piece)
            self._piece.clear()
            self._skipping = True

    def _decode(self) -> bytes:
        """Return the datagram between the last two zeros; empty if there is none."""
        piece, skipped = bytes(self._piece), self._skipping
        self._piece.clear()
        self._skipping = False
        if not piece and not skipped:
            return b""  # the zero at the end of a frame, and that at the beginning of the next
        with suppress(cobs.DecodeError):
            content = cobs.decode(piece)
            datagram = content[:-_CRC]
            if datagram and crc_hqx(datagram, 0xFFFF) == int.from_bytes(content[-_CRC:], "little"):
                return datagram
        self.garbled_bytes += len(piece)
        self.garbled += 1
        return b""


class SerialDevice:
    """A serial device that one process uses alone, read and written without waiting.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, path: str, baud: int) -> None:
        try:
            # exclusive: a second process, or a second agent of this one, is refused.
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # pyserial's own error is an OSError
            # It gives no number for one that cannot be configured.
            number = errno.ENOTTY if "Could not configure" in str(error) else getattr(error, "errno", None) or 0
            allowed = _REASONS.get(number) or f"a serial device that can be used ({error})"
            raise ConfigError("device", path, allowed) from None
        self._descriptor: int = self._port.fileno()
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)
        #: ms, for how long a USB adapter keeps bytes to itself although it is asked not to; 0: it does not say.
        self.latency_ms = 0
        with suppress(OSError, ValueError, NotImplementedError):
            self._port.set_low_latency_mode(True)
        timer = Path("/sys/class/tty") / os.path.basename(os.path.realpath(path)) / "device" / "latency_timer"
        with suppress(OSError):
            timer.write_text("1")
        with suppress(OSError, ValueError):
            self.latency_ms = int(timer.read_text())

    def read(self, wait_s: float) -> bytes:
        """Return what has come; empty if nothing comes for a while.

        :raises DeviceError: if the device has gone.
        """
        try:
            ready = self._poll.poll(wait_s * 1e3)
            data = os.read(self._descriptor, _READ_BYTES) if ready else b""
        except BlockingIOError:
            return b""
        except OSError as error:
            raise DeviceError(error.strerror or type(error).__name__) from None
        if ready and not data and ready[0][1] & (select.POLLHUP | select.POLLERR):
            raise DeviceError("it hung up")
        return data

    def write(self, data: bytes) -> None:
        """Give the device bytes, all or none of them, without waiting.

        :raises DeviceError: if it refuses them now.
        """
        try:
            if self._port.out_waiting > len(data):  # older frames: their slots are over
                self._clear_output()
                raise DeviceError("earlier frames still wait for the line")
            written = os.write(self._descriptor, data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise DeviceError(error.strerror or type(error).__name__) from None
        if written < len(data):
            self._clear_output()
            raise DeviceError("the line takes no more bytes")

    def _clear_output(self) -> None:
        with suppress(OSError, termios.error):
            self._port.reset_output_buffer()

    def close(self) -> None:
        """Free the device for others."""
        self._clear_output()  # else to close waits until a line that is held up has sent
        with suppress(OSError):
            self._port.close()


class SerialPort(DevicePort[SerialDevice]):
    """A modem; see :class:`~dtsa_agent.air.device_port.DevicePort`.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, settings: SerialSettings) -> None:
        self._settings, self._byte_ns = settings, settings.line_byte_ns
        self._reader = LineReader()
        self._sent: deque[bytes] = deque(maxlen=_ECHOES)
        self._echoes = self._datagrams = 0
        self._clean = (0, 0)  # datagrams, and garbled bytes when the last of them came
        self._mavlink = 0  # pieces that may be its messages
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

    def _open(self) -> SerialDevice:
        return SerialDevice(self._settings.device, self._settings.baud)

    def _write(self, device: SerialDevice, data: bytes) -> None:
        self._sent.append(data)  # before: an echo may be quicker than this thread
        device.write(to_line(data))

    def _read(self, device: SerialDevice) -> None:
        while not self._stopped.is_set():
            chunk = device.read(_WAIT_S)
            if chunk:
                self._receive(chunk, time.monotonic_ns())
            if device.latency_ms > _LATENCY_MS:
                self._print_once(
                    f"keeps bytes for up to {device.latency_ms} ms: as root write 1 to latency_timer of the device in"
                    " /sys/class/tty, see docs/how-to/radios.md"
                )

    def _receive(self, chunk: bytes, now_ns: int) -> None:
        self._mavlink += sum(chunk.count(first) for first in _MAVLINK)
        for datagram, after in self._reader.feed(chunk):
            own = datagram in self._sent
            self._echoes += own
            self._datagrams += 1
            # The bytes after it in the same chunk have taken their time on the line.
            self._queue(datagram, now_ns - after * self._byte_ns, own)
            if own:
                self._print_once("gives back what it is given: own frames are left out")
        self._check_garbage()

    def _check_garbage(self) -> None:
        """Print what may be wrong when many bytes come and no datagram is among them."""
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
            self._print(text + more)
