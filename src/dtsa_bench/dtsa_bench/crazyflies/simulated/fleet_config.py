"""What a fleet of simulated Crazyflies is made of, and where they stand at the start."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, check, setting
from dtsa_agent.core.settings.flight_models import AVOIDERS, flight_model
from dtsa_agent.crazyflie.addresses import Address

from .peer import PROTOCOLS

MAX_COUNT = 200
HOST = "127.0.0.1"
DEVICES = {"pa": 0x0301, "2": 0x0504}  # Crazyradio PA, Crazyradio 2.0: version of the firmware as USB says it


def ellipse_positions(count: int, half_x_m: float = 1.2, half_y_m: float = 2.0) -> NDArray[np.float64]:
    """Start positions on the floor, (3, count), m, world: counter-clockwise from the x axis, by ids."""
    angle = 2 * math.pi * np.arange(count) / max(count, 1)
    return np.array([half_x_m * np.cos(angle), half_y_m * np.sin(angle), np.zeros(count)])


@dataclass(frozen=True, slots=True)
class RadioSettings(Settings):
    """Dongles and air.

    :param path: the Unix socket to which hosts connect; None: no radios.
    :param stations: where each Crazyflie listens.
    """

    dongles: int = setting(4, "number of simulated Crazyradios", minimum=1, maximum=16)
    device: str = setting("2", "kind of the dongles: Crazyradio PA, or Crazyradio 2.0", choices=tuple(DEVICES))
    loss: float = setting(
        0.0, "share of packets, and of acknowledgements, that are lost on the air", minimum=0.0, maximum=1.0
    )
    seed: int = setting(1, "seed of the losses on the air", minimum=0, maximum=2**63 - 1)
    usb_ms: float = setting(
        0.2, "turn-round of a packet on USB, both ways together", unit="ms", minimum=0.0, maximum=100.0
    )
    request_ms: float = setting(
        1.0, "a request on USB that sets channel, address or data rate", unit="ms", minimum=0.0, maximum=100.0
    )
    path: Path | None = None
    stations: tuple[Address, ...] = field(default=())

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class FleetConfig(Settings):
    """What the fleet is made of.

    :param start: start positions, (3, count), m, world; None: an ellipse.
    :param truth: file for the record of what really happened; None: no record.
    :param radio: simulated radios in place of UDP; without a path: UDP.
    """

    count: int = setting(12, "number of vehicles", minimum=0, maximum=MAX_COUNT)
    base_port: int = setting(19850, "UDP port of the first; vehicle k listens on base_port + k - 1", minimum=1024,
                             maximum=65535)  # fmt: skip
    start: Any = field(default=None, compare=False)
    seed: int = setting(1, "seed of noise and loss", minimum=0, maximum=2**63 - 1)
    protocol: int = setting(12, "version of the protocol told to the host", choices=PROTOCOLS)
    arming: str = setting(
        "auto",
        "how they are armed: by themselves (Crazyflie 2.1, 2.1+), as required by the ground station (2.1 brushless, "
        "Bolt), or every second one so",
        choices=("auto", "required", "mixed"),
    )
    model: str = setting("orca", "flight model that has their vehicle", choices=AVOIDERS.names, open_choices=True)
    truth: Path | None = None
    radio: RadioSettings = field(default_factory=RadioSettings)

    def __post_init__(self) -> None:
        check(self)
        if self.base_port > 65536 - self.count:
            raise ConfigError("base_port", self.base_port, f"1024 to {65536 - self.count} for {self.count} vehicles")
        if not self.count and self.radio.path is None:
            raise ConfigError("count", self.count, f"1 to {MAX_COUNT}")
        flight_model(self.model)
        if self.start is None:
            object.__setattr__(self, "start", ellipse_positions(self.count))
        elif np.shape(self.start) != (3, self.count):
            raise ConfigError("start", np.shape(self.start), f"an array of shape (3, {self.count})")
        if self.radio.path is not None and len(self.radio.stations) != self.count:
            raise ConfigError("radio", len(self.radio.stations), f"a station for each of {self.count} vehicles")

    @property
    def control_port(self) -> int:
        """UDP port for faults."""
        return self.base_port - 1

    @property
    def uris(self) -> list[str]:
        """Where cflib finds them."""
        if self.radio.path is not None:
            return [station.uri for station in self.radio.stations]
        return [f"udp://{HOST}:{self.base_port + k}" for k in range(self.count)]
