"""The emergency stop over the air, to all at once: by broadcast, without acknowledgements, again and again.

A Crazyflie listens to the address FFE7E7E7E7 besides its own. A dongle that no link uses sends there with
acknowledgements off, on each channel and data rate of the swarm in turn. Where there is none, the links' own dongles
send; they wait in vain for acknowledgements, which costs half a millisecond a packet.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from dtsa_agent.crazyflie.addresses import parse_address

BROADCAST = (0xFF, 0xE7, 0xE7, 0xE7, 0xE7)
# Emergency stop by the supervisor's port, and by the localization's, where firmware before protocol version 12 has it.
PACKETS = (b"\x9d\x03", b"\x6d\x03")
ROUNDS, PAUSE_S = 25, 0.02  # packets on each channel, and the time between two


class EmergencyRadio:
    """Stops all Crazyflies of the given links; those that need no radio are passed over."""

    def __init__(self, uris: Sequence[str], log: Callable[[str, str], None]) -> None:
        from cflib.crtp.radiodriver import RadioDriver

        radio_uris = [uri for uri in uris if parse_address(uri).radio]
        self._log = log
        self._links: list[tuple[int, int, int]] = []  # dongle, channel, data rate
        self._thread: threading.Thread | None = None
        self.rounds = 0  # sent since the start
        self.dongle: int | None = None  # that of no link
        self._radio: Any = None
        try:
            self._links = sorted({RadioDriver.parse_uri(uri)[:3] for uri in radio_uris})
            if self._links:
                self._open({link[0] for link in self._links})
        except Exception as error:  # no USB, a serial number that is not there: the links will say so, too
            self._log("warn", f"no emergency stop by broadcast: {error}")

    def _open(self, used: set[int]) -> None:
        """Take the first dongle that no link uses."""
        from cflib.drivers.crazyradio import Crazyradio, get_serials

        for number in range(len(get_serials())):
            if number in used:
                continue
            try:
                self._radio = Crazyradio(devid=number)
                self._radio.set_ack_enable(False)
                self._radio.set_address(BROADCAST)
            except Exception as error:  # in use by another program, or no right to use it
                self._radio = None
                self._log("warn", f"radio {number} cannot be used for emergency stops: {error}")
                continue
            self.dongle = number
            self._log("info", f"radio {number} is kept for emergency stops")
            return
        self._log("warn", "no radio is left for emergency stops: they go by the radios of the links")

    def stop_all(self) -> None:
        """Begin to send; returns at once."""
        if self._links and (self._thread is None or not self._thread.is_alive()):
            self._thread = threading.Thread(target=self._send, name="emergency-stop", daemon=True)
            self._thread.start()

    def _send(self) -> None:
        instances: dict[int, Any] = {}
        for _ in range(ROUNDS):
            began = time.monotonic()
            for number, channel, rate in self._links:
                with suppress(Exception):  # a dongle that has gone must not keep the others from sending
                    if self._radio is not None:
                        self._broadcast(channel, rate)
                    else:
                        self._by_link(instances, number, channel, rate)
            self.rounds += 1
            time.sleep(max(0.0, PAUSE_S - (time.monotonic() - began)))
        for instance in instances.values():
            instance.close()

    def _broadcast(self, channel: int, rate: int) -> None:
        self._radio.set_channel(channel)
        self._radio.set_data_rate(rate)
        for packet in PACKETS:
            self._radio.handle.write(endpoint=1, data=packet, timeout=100)

    @staticmethod
    def _by_link(instances: dict[int, Any], number: int, channel: int, rate: int) -> None:
        from cflib.crtp.radiodriver import RadioManager

        if number not in instances:
            instances[number] = RadioManager.open(number)
            instances[number].set_address(BROADCAST)
        instances[number].set_channel(channel)
        instances[number].set_data_rate(rate)
        for packet in PACKETS:
            instances[number].send_packet(packet)

    def close(self) -> None:
        """Wait until what is being sent has been sent, and release the dongle."""
        if self._thread is not None:
            self._thread.join(2.0 * ROUNDS * PAUSE_S)
        if self._radio is not None:
            self._radio.close()
            self._radio = None
