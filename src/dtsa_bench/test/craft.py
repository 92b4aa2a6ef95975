"""Firmware of a simulated Crazyflie on a test stand."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from dtsa_bench.crazyflies.simulated import crtp
from dtsa_bench.crazyflies.simulated.estimate import Estimate
from dtsa_bench.crazyflies.simulated.firmware import OFF, Firmware
from dtsa_bench.crazyflies.simulated.peer import CrtpPeer


class Craft:
    """Firmware of one Crazyflie on a test stand that follows every command at once."""

    def __init__(self, *, auto_arming: bool = False) -> None:
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.firmware = Firmware(
            lambda name, **details: self.events.append((name, details)), tau=0.0, auto_arming=auto_arming
        )
        self.estimate = Estimate()
        self.peer = CrtpPeer(self.firmware, self.estimate, 12)
        self.t = 0.0
        self.mode = OFF
        self.command = (0.0, 0.0, 0.0)

    def ask(self, port: int, channel: int, data: bytes) -> bytes | None:
        reply = self.peer.receive(crtp.pack(port, channel, data), self.t)
        return None if reply is None else reply[1:]

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.mode, self.command = self.firmware.step(self.t, 0.01, self.estimate.position, self.estimate.velocity)
            p = tuple(a + 0.01 * b for a, b in zip(self.estimate.position, self.command, strict=True))
            self.estimate.position, self.estimate.velocity = (p[0], p[1], max(p[2], 0.0)), self.command
            self.t += 0.01

    def velocity(self, *v: float) -> None:
        self.ask(crtp.GENERIC_COMMANDER, 0, struct.pack("<B4f", 8, *v, 0.0))

    def take_off(self) -> None:
        assert self.ask(crtp.SUPERVISOR, 1, b"\x01\x01") == b"\x81\x01\x01"
        self.fly(0.02)
        self.ask(crtp.HIGH_LEVEL, 0, struct.pack("<BBff?f", 7, 0, 1.0, 0.0, True, 1.0))
        self.fly(1.2)
        assert self.estimate.position[2] == pytest.approx(1.0, abs=0.1)

    @property
    def state(self) -> str:
        return self.firmware.supervisor.state
