"""A serial device that one process uses alone, read and written without waiting."""

from __future__ import annotations

import errno
import os
import select
import termios
from contextlib import suppress
from pathlib import Path

import serial

from dtsa_agent.air.device_port import DeviceError
from dtsa_agent.core.errors import ConfigError

_READ = 4096  # bytes at a time
_REASONS = {
    errno.ENOENT: "a device that is there",
    errno.ENODEV: "a device that is there",
    errno.ENXIO: "a device that is there",
    errno.EACCES: "a device that this user may open: add the user to its group, mostly dialout",
    errno.EPERM: "a device that this user may open: add the user to its group, mostly dialout",
    errno.EBUSY: "a device that no other process uses",
    errno.EWOULDBLOCK: "a device that no other process uses",
    errno.ENOTTY: "a serial device",
    errno.EINVAL: "a speed that the device has",
}


class Device:
    """An open serial device.

    :raises ConfigError: if it cannot be used.
    """

    def __init__(self, path: str, baud: int) -> None:
        try:
            # exclusive: a second process, or a second agent of this one, is refused.
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # pyserial's own error is an OSError
            raise ConfigError("device", path, _allowed(error)) from None
        self._descriptor: int = self._port.fileno()
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)
        self._path = path
        #: ms, for how long an adapter keeps bytes to itself; None: it says nothing about that.
        self.latency_ms = self._hurry()

    def _hurry(self) -> int | None:
        """Asks a USB adapter not to keep bytes to itself; for how long it still does, ms."""
        with suppress(OSError, ValueError, NotImplementedError):
            self._port.set_low_latency_mode(True)
        timer = Path("/sys/class/tty") / os.path.basename(os.path.realpath(self._path)) / "device" / "latency_timer"
        with suppress(OSError):
            timer.write_text("1")
        try:
            return int(timer.read_text())
        except (OSError, ValueError):
            return None

    def read(self, patience_s: float) -> bytes:
        """What has come; empty if nothing comes for a while.

        :raises DeviceError: if the device has gone.
        """
        try:
            ready = self._poll.poll(patience_s * 1e3)
            if not ready:
                return b""
            found = os.read(self._descriptor, _READ)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise DeviceError(error.strerror or type(error).__name__) from None
        if not found and ready[0][1] & (select.POLLHUP | select.POLLERR):
            raise DeviceError("it hung up")
        return found

    def write(self, data: bytes) -> None:
        """Gives the device bytes, all or none of them, without waiting.

        :raises DeviceError: if it does not take them now.
        """
        try:
            waiting = self._port.out_waiting
            if waiting > len(data):  # older frames: their slots are over
                self._forget()
                raise DeviceError("earlier frames still wait for the line")
            taken = os.write(self._descriptor, data)
        except BlockingIOError:
            raise DeviceError("the line takes no more bytes") from None
        except OSError as error:
            raise DeviceError(error.strerror or type(error).__name__) from None
        if taken < len(data):
            self._forget()
            raise DeviceError("the line takes no more bytes")

    def _forget(self) -> None:
        """Drops what waits for the line."""
        with suppress(OSError, termios.error):
            self._port.reset_output_buffer()

    def close(self) -> None:
        """The device is free for others."""
        self._forget()  # else to close waits until a line that is held up has sent
        with suppress(OSError):
            self._port.close()


def _allowed(error: Exception) -> str:
    if "Could not configure" in str(error):  # pyserial names no number then
        return _REASONS[errno.ENOTTY]
    return _REASONS.get(getattr(error, "errno", None) or 0) or f"a serial device that can be used ({error})"
