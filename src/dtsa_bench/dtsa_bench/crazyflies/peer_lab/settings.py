"""What a flight in the laboratory is made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, check, setting
from dtsa_bench.crazyflies.simulated.fleet_config import start_positions
from dtsa_bench.crazyflies.simulated.radio.esb import BITRATES


@dataclass(frozen=True, slots=True)
class LabSettings(Settings):
    """Vehicles, air and ground.

    :param start: start positions, (3, agents), m, world; None: as `radius_m` says.
    :raises ConfigError: a value is out of range.
    """

    agents: int = setting(12, "number of vehicles; the last byte of the radio address of each is its id", minimum=1,
                          maximum=120)  # fmt: skip
    seed: int = setting(1, "seed of losses, noise, and of the instants at which vehicles are switched on", minimum=0,
                        maximum=2**63 - 1)  # fmt: skip
    loss: float = setting(0.0, "share of frames that a receiver loses", minimum=0.0, maximum=1.0)
    channel: int = setting(80, "radio channel", minimum=0, maximum=125)
    rate: str = setting("2M", "data rate", choices=tuple(BITRATES))
    boot_s: float = setting(
        1.0, "vehicles are switched on at random within the first so many seconds", unit="s", minimum=0.0, maximum=600.0
    )
    drift_ppm: float = setting(
        0.0, "each vehicle's clock is fast or slow by at most so much", unit="ppm", minimum=0.0, maximum=1000.0
    )
    polls: float = setting(
        0.0, "packets a second that the ground station sends to each vehicle; 0: no ground station on the air",
        unit="1/s", minimum=0.0, maximum=1000.0,
    )  # fmt: skip
    noise: bool = setting(True, "estimates have noise")
    arming: str = setting(
        "auto", "how vehicles are armed: by themselves, or as required by the ground", choices=("auto", "required")
    )
    spin_ms: float = setting(
        500.0, "an app's task that does not wait for so long ends the flight", unit="ms", minimum=1.0, maximum=1e6
    )
    radius_m: float = setting(
        0.0, "vehicles start on a circle of this radius around the origin; 0: on an ellipse of 1.2 m by 2 m", unit="m",
        minimum=0.0, maximum=100.0,
    )  # fmt: skip
    start: Any = field(default=None, compare=False)

    def __post_init__(self) -> None:
        check(self)
        if self.start is None and self.radius_m:
            circle = start_positions("ellipse", self.agents, (self.radius_m, self.radius_m))
            object.__setattr__(self, "start", circle)
        if self.polls * self.agents > 5000:
            raise ConfigError("polls", self.polls, f"at most {5000 / self.agents:g} for {self.agents} vehicles")
