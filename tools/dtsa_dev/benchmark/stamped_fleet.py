"""Simulated Crazyflies that note when each streamed velocity command arrives: the far end of the bridge's benchmark.

    python -m dtsa_dev.benchmark.stamped_fleet COUNT BASE_PORT FILE [CONFIG SOCKET LOSS]

The times are the kernel's, or those of the simulated air, so they do not depend on what the simulation is busy with.
"""

from __future__ import annotations

import signal
import socket
import struct
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.crazyflie.settings.config import load_swarm
from dtsa_agent.ros.common.process.node_process import follow_supervisor
from dtsa_agent.ros.common.process.priority import take_priority
from dtsa_bench.crazyflies.simulated import crtp
from dtsa_bench.crazyflies.simulated.fleet import Fleet
from dtsa_bench.crazyflies.simulated.fleet_config import FleetConfig
from dtsa_bench.crazyflies.simulated.radio.settings import RadioSettings, Station

PRIORITY = 30
READY = "the simulated Crazyflies are there"
# A command's number travels in its velocity along x: far below anything that moves a vehicle.
STEP_MPS = 1e-6
_VELOCITY = 8  # type byte of a velocity along the world's axes
_SO_TIMESTAMPNS = 35  # Linux; the module `socket` has no name for it before Python 3.14


class _Stamped(socket.socket):
    """A UDP socket that notes commands with the time of their arrival (s, system clock)."""

    arrivals: list[tuple[int, int, float]]
    index: int

    def recvfrom(self, size: int, flags: int = 0) -> tuple[bytes, Any]:  # type: ignore[override]
        data, extra, _, address = self.recvmsg(size, 64, flags)
        number = number_of(data)
        if number is not None:
            for level, kind, value in extra:
                if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                    seconds, nanoseconds = struct.unpack("@ll", value)
                    self.arrivals.append((self.index, number, seconds + 1e-9 * nanoseconds))
        return data, address


def number_of(data: bytes) -> int | None:
    """Number of the command in a packet; None: it is no streamed velocity."""
    packet = crtp.unpack(data)
    if packet is None or packet[:2] != (crtp.GENERIC_COMMANDER, 0) or packet[2][:1] != bytes((_VELOCITY,)):
        return None
    return round(struct.unpack_from("<f", packet[2], 1)[0] / STEP_MPS)


class StampedFleet(Fleet):
    """A fleet that notes arrivals: rows of vehicle (from 0), number of the command, time (s)."""

    def __init__(self, config: FleetConfig) -> None:
        self.arrivals: list[tuple[int, int, float]] = []
        super().__init__(config)

    def _hear(self, index: int, packet: bytes, t: float) -> None:
        number = number_of(packet)
        if number is not None and self.radio is not None:
            self.arrivals.append((index, number, time.time() - self.radio.now_ns() / 1e9 + t))
        super()._hear(index, packet, t)

    def _bind(self, port: int) -> socket.socket:
        plain = super()._bind(port)
        plain.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        stamped = _Stamped(fileno=plain.detach())
        stamped.arrivals, stamped.index = self.arrivals, port - self.config.base_port
        return stamped


def main() -> int:
    """Flies until SIGINT or SIGTERM, then writes the arrivals (NumPy, shape (n, 3))."""
    count, base_port, path = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    follow_supervisor()
    take_priority(PRIORITY)  # as simulated Crazyflies do: the world waits for nobody
    radio = RadioSettings()
    if len(sys.argv) > 4:
        stations = tuple(Station.of(robot.uri) for robot in load_swarm(Path(sys.argv[4])).robots)
        radio = RadioSettings(loss=float(sys.argv[6]), path=Path(sys.argv[5]), stations=stations)
    fleet = StampedFleet(FleetConfig(count=count, base_port=base_port, radio=radio))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: fleet.stop())
    print(READY, flush=True)
    fleet.run()
    np.save(path, np.array(fleet.arrivals, dtype=float).reshape(-1, 3))
    return 0


if __name__ == "__main__":
    sys.exit(main())
