"""An app: its sources, how it is compiled, what the ground does with it."""

from __future__ import annotations

import glob
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.yaml_file import read_yaml

BUILT_IN = Path(__file__).parent / "apps"
_KEYS = ("sources", "include", "flags", "parameters", "state", "orders", "text")
#: What the ground does at an instant, and the numbers that each needs.
ORDERS: dict[str, tuple[str, ...]] = {
    "arm": (),
    "disarm": (),
    "takeoff": ("height", "duration"),
    "land": ("height", "duration"),
    "goto": ("x", "y", "z", "duration"),
    "emergency": (),
    "off": (),
    "on": (),
    "parameter": ("value",),
    "send": (),
}


@dataclass(frozen=True, slots=True)
class StateRule:
    """Which peer-to-peer packets carry a state, and for whom: ages are those of these.

    :param where: values of bytes that such a packet has, by their positions.
    :param target: position of the byte with the id of the only vehicle that takes it in; None: all do.
    """

    where: Mapping[int, int] = field(default_factory=dict)
    target: int | None = None

    def counts(self, data: bytes, receiver: int) -> bool:
        """Whether a packet tells a receiver its sender's state.

        :param data: the packet without its port.
        :param receiver: id.
        """
        if any(place >= len(data) or data[place] != value for place, value in self.where.items()):
            return False
        return self.target is None or (self.target < len(data) and data[self.target] == receiver)


@dataclass(frozen=True, slots=True)
class Order:
    """What the ground does at an instant.

    :param at: s. :param order: a key of ORDERS. :param agents: ids. :param values: its numbers and texts.
    """

    at: float
    order: str
    agents: tuple[int, ...]  # empty: all
    values: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class App:
    """An app.

    :param name: what errors call it.
    :param sources: C files.
    :param include: directories with its headers.
    :param flags: more for the compiler.
    :param parameters: values of the app's parameters, set when a vehicle is switched on.
    :param state: which packets carry a state.
    :param orders: what the ground does.
    """

    name: str
    sources: tuple[Path, ...]
    include: tuple[Path, ...] = ()
    flags: tuple[str, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    state: StateRule = StateRule()
    orders: tuple[Order, ...] = ()


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
    found = [Path(name) for pattern in patterns for name in sorted(glob.glob(str(directory / pattern)))]
    found += [Path(name) for name in sources]
    if not found:
        raise ConfigError("app", str(directory), f"a directory with C files ({', '.join(patterns)})")
    for path in found:
        if not path.is_file():
            raise ConfigError("source", str(path), "a C file")
    places = [directory / name for name in _texts(settings, "include")]
    parameters = settings.get("parameters", {})
    if not isinstance(parameters, Mapping) or not all(map(_number, parameters.values())):
        raise ConfigError("app.yaml, parameters", parameters, "numbers by name")
    return App(
        directory.resolve().name,
        tuple(path.resolve() for path in found),
        tuple(path.resolve() for path in (directory, *places, *map(Path, include))),
        (*_texts(settings, "flags"), *flags),
        dict(parameters),
        _state(settings.get("state", {})),
        tuple(_order(index, entry) for index, entry in enumerate(settings.get("orders") or ())),
    )


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _texts(settings: Mapping[str, Any], key: str) -> tuple[str, ...]:
    value = settings.get(key, ())
    if isinstance(value, str):
        value = value.split()
    if not isinstance(value, (list, tuple)) or not all(isinstance(one, str) for one in value):
        raise ConfigError(f"app.yaml, {key}", value, "a list of texts")
    return tuple(value)


def _state(value: Any) -> StateRule:
    allowed = "`where`: bytes by their positions, and `target`: the position of a byte"
    if not isinstance(value, Mapping) or set(value) - {"where", "target"}:
        raise ConfigError("app.yaml, state", value, allowed)
    where, target = value.get("where", {}), value.get("target")
    numbers = [*where, *where.values()] if isinstance(where, Mapping) else [None]
    if not all(isinstance(number, int) and 0 <= number <= 255 for number in (*numbers, target or 0)):
        raise ConfigError("app.yaml, state", value, allowed)
    return StateRule(dict(where), target)


def _order(index: int, entry: Any) -> Order:
    name = f"app.yaml, orders[{index}]"
    if not isinstance(entry, Mapping) or entry.get("order") not in ORDERS or not _number(entry.get("at")):
        raise ConfigError(name, entry, "`at`: s, and `order`: one of " + ", ".join(ORDERS))
    values = {key: value for key, value in entry.items() if key not in ("at", "order", "agents")}
    kind = str(entry["order"])
    for key in ORDERS[kind]:
        if not _number(values.get(key)):
            raise ConfigError(f"{name}, {key}", values.get(key), "a number")
    for key, order in (("name", "parameter"), ("data", "send")):
        if kind == order and not isinstance(values.get(key), str):
            raise ConfigError(f"{name}, {key}", values.get(key), "a text (data: bytes as hexadecimal digits)")
    agents = entry.get("agents", ())
    agents = (agents,) if isinstance(agents, int) else agents
    if not isinstance(agents, (list, tuple)) or not all(isinstance(agent, int) for agent in agents):
        raise ConfigError(f"{name}, agents", agents, "an id, or a list of ids")
    return Order(float(entry["at"]), kind, tuple(agents), values)
