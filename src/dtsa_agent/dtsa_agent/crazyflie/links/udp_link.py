"""What a link over UDP needs beyond cflib's: it outlives a port that is closed for a while, and ends at once.

UDP has no connection. A packet to a port that is closed comes back as an error of a later call, and the same socket
goes on as soon as the port is open again. cflib's driver takes such an error for the end of the link, and waits up to a
second for its thread when it closes: the emergency watchdog of a Crazyflie in flight does not wait as long. Here a link
over which something was heard stays open, as over the air; that nothing is heard any more is noticed by the log's age.

Imported only where cflib is; checked against cflib 0.1.34, whose public methods alone are used.

Upstream: not reported; cflib's links over UDP are for simulators.
Delete when: cflib's driver goes on after an error of the socket, and closes without waiting.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable
from typing import Any

import cflib.crtp
from cflib.crtp.udpdriver import UdpDriver

CLOSED_S = 0.05  # who still asks a closed driver for packets waits that long; longer than it takes to be told to end


class LastingUdpDriver(UdpDriver):  # type: ignore[misc]
    """cflib's driver, but errors end a link only before something was heard over it."""

    def __init__(self) -> None:
        super().__init__()
        self._heard = self._closed = False

    def connect(
        self, uri: str, radio_link_statistics_callback: Any, link_error_callback: Callable[[str], None] | None
    ) -> None:
        def trouble(message: str) -> None:
            if not self._heard and not self._closed and link_error_callback is not None:
                link_error_callback(message)

        super().connect(uri, radio_link_statistics_callback, trouble)

    def send_packet(self, pk: Any) -> None:
        sock, report = self.socket, self.link_error_callback
        if sock is None or report is None:
            return
        data = bytes((pk.header,)) + bytes(pk.data)
        try:
            try:
                sock.send(data)
            except ConnectionRefusedError:  # the answer to an earlier packet; this one was not sent
                sock.send(data)
        except OSError as error:
            report(f"UdpDriver: could not send: {error}")

    def receive_packet(self, wait: float = 0) -> Any:
        if self._closed:
            time.sleep(CLOSED_S)
            return None
        packet = super().receive_packet(wait)
        self._heard |= packet is not None
        return packet

    def close(self) -> None:
        self._closed = True
        if self.in_queue is not None:
            self.in_queue.put(None)  # wakes who waits for a packet
        if self.socket is not None:
            with contextlib.suppress(OSError):
                self.socket.shutdown(socket.SHUT_RDWR)  # ... and the driver's thread, for which `close` waits
        super().close()


def install() -> None:
    """Let cflib open links over UDP by this driver."""
    cflib.crtp.CLASSES[:] = [LastingUdpDriver if driver is UdpDriver else driver for driver in cflib.crtp.CLASSES]
