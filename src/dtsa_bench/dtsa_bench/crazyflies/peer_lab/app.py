"""A flight in the laboratory: its settings, and the app with its sources."""

from __future__ import annotations

import glob
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, check, setting
from dtsa_agent.yaml_file import read_yaml
from dtsa_bench.crazyflies.simulated.fleet_config import ellipse_positions
from dtsa_bench.crazyflies.simulated.radio.air import BITRATES

BUILT_IN = Path(__file__).parent / "apps"


@dataclass(frozen=True, slots=True)
class App:
    """An app: C files, directories with its headers, and more for the compiler."""

    name: str  # what errors call it
    sources: tuple[Path, ...]
    include: tuple[Path, ...] = ()
    flags: tuple[str, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)  # set when a vehicle is switched on
    addressed: bool = False  # byte 1 of a packet is its kind (0: a state), byte 3 the id of its receiver


def read_app(
    place: str | Path, *, sources: tuple[str, ...] = (), include: tuple[str, ...] = (), flags: tuple[str, ...] = ()
) -> App:
    """The app in a directory; a file app.yaml in it may say more than that all its C files are the app's.

    :param place: the directory, or the name of an app that comes with the laboratory.
    :param sources: further C files. :param include: further directories. :param flags: further ones.
    :raises ConfigError: there is none, or app.yaml is not usable.
    """
    directory = BUILT_IN / place if (BUILT_IN / place).is_dir() else Path(place)
    if not directory.is_dir():
        names = ", ".join(sorted(path.name for path in BUILT_IN.iterdir() if path.is_dir()))
        raise ConfigError("app", str(place), f"a directory with C files, or one of {names}")
    own = _read_settings(directory / "app.yaml")
    files = [Path(name) for pattern in own["sources"] for name in sorted(glob.glob(str(directory / pattern)))]
    files += [Path(name) for name in sources]
    if not files:
        raise ConfigError("app", str(directory), f"a directory with C files ({', '.join(own['sources'])})")
    for path in files:
        if not path.is_file():
            raise ConfigError("source", str(path), "a C file")
    places = [directory / name for name in own["include"]]
    return App(
        directory.resolve().name,
        tuple(path.resolve() for path in files),
        tuple(path.resolve() for path in (directory, *places, *map(Path, include))),
        (*own["flags"], *flags),
        own["parameters"],
        addressed=directory == BUILT_IN / "dtr",
    )


def _read_settings(path: Path) -> dict[str, Any]:
    settings: dict[str, Any] = {"sources": ["*.c", "src/*.c"], "include": [], "flags": [], "parameters": {}}
    given = read_yaml(path, "app") if path.exists() else {}
    if not isinstance(given, Mapping):
        raise ConfigError("app.yaml", str(path), "a mapping")
    for key, value in given.items():
        if key not in settings:
            raise ConfigError(f"app.yaml, {key}", value, "a key of " + ", ".join(settings))
        if key == "parameters":
            if not isinstance(value, Mapping) or any(type(number) not in (int, float) for number in value.values()):
                raise ConfigError(f"app.yaml, {key}", value, "numbers by name")
        elif not isinstance(value, list) or not all(isinstance(text, str) for text in value):
            raise ConfigError(f"app.yaml, {key}", value, "a list of texts")
        settings[key] = value
    return settings


@dataclass(frozen=True, slots=True)
class LabSettings(Settings):
    """Vehicles, air and ground.

    :param start: start positions, (3, agents), m, world; None: as `radius_m` says.
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
            object.__setattr__(self, "start", ellipse_positions(self.agents, self.radius_m, self.radius_m))
        if self.polls * self.agents > 5000:
            raise ConfigError("polls", self.polls, f"at most {5000 / self.agents:g} for {self.agents} vehicles")
