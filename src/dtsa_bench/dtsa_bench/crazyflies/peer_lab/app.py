"""A flight in the laboratory: its settings, and the app with its sources."""

from __future__ import annotations

import glob
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, check, setting
from dtsa_agent.yaml_file import read_yaml
from dtsa_bench.crazyflies.simulated.fleet_config import start_positions
from dtsa_bench.crazyflies.simulated.radio.air import BITRATES

BUILT_IN = Path(__file__).parent / "apps"
_KEYS = ("sources", "include", "flags", "parameters", "text")


def _always(data: bytes, receiver: int) -> bool:
    return True


def _dtr_state(data: bytes, receiver: int) -> bool:
    """Byte 1 is the kind of a packet (0: a state), byte 3 the id of its receiver."""
    return len(data) > 3 and data[1] == 0 and data[3] == receiver


@dataclass(frozen=True, slots=True)
class App:
    """An app.

    :param name: what errors call it.
    :param sources: C files.
    :param include: directories with its headers.
    :param flags: more for the compiler.
    :param parameters: values of the app's parameters, set when a vehicle is switched on.
    :param carries_state: whether a packet without its port tells a receiver (id) its sender's state: ages are those.
    """

    name: str
    sources: tuple[Path, ...]
    include: tuple[Path, ...] = ()
    flags: tuple[str, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    carries_state: Callable[[bytes, int], bool] = _always


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
    settings: Any = read_yaml(directory / "app.yaml", "app") if (directory / "app.yaml").exists() else {}
    if not isinstance(settings, Mapping):
        raise ConfigError("app.yaml", str(directory), "a mapping")
    for key in settings:
        if key not in _KEYS:
            raise ConfigError(f"app.yaml, {key}", settings[key], "a key of " + ", ".join(_KEYS))
    patterns = _texts(settings, "sources") or ("*.c", "src/*.c")
    files = [Path(name) for pattern in patterns for name in sorted(glob.glob(str(directory / pattern)))]
    files += [Path(name) for name in sources]
    if not files:
        raise ConfigError("app", str(directory), f"a directory with C files ({', '.join(patterns)})")
    for path in files:
        if not path.is_file():
            raise ConfigError("source", str(path), "a C file")
    parameters = settings.get("parameters", {})
    if not isinstance(parameters, Mapping) or not all(
        isinstance(value, (int, float)) and not isinstance(value, bool) for value in parameters.values()
    ):
        raise ConfigError("app.yaml, parameters", parameters, "numbers by name")
    places = [directory / name for name in _texts(settings, "include")]
    return App(
        directory.resolve().name,
        tuple(path.resolve() for path in files),
        tuple(path.resolve() for path in (directory, *places, *map(Path, include))),
        (*_texts(settings, "flags"), *flags),
        dict(parameters),
        _dtr_state if directory == BUILT_IN / "dtr" else _always,
    )


def _texts(settings: Mapping[str, Any], key: str) -> tuple[str, ...]:
    value = settings.get(key, ())
    if isinstance(value, str):
        value = value.split()
    if not isinstance(value, (list, tuple)) or not all(isinstance(text, str) for text in value):
        raise ConfigError(f"app.yaml, {key}", value, "a list of texts")
    return tuple(value)


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
            circle = start_positions("ellipse", self.agents, (self.radius_m, self.radius_m))
            object.__setattr__(self, "start", circle)
        if self.polls * self.agents > 5000:
            raise ConfigError("polls", self.polls, f"at most {5000 / self.agents:g} for {self.agents} vehicles")
