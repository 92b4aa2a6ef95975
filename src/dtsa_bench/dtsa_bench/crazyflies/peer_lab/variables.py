"""The variables of an app on board, as a ground station sees them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dtsa_bench.crazyflies.simulated.toc import LOG_TYPES, PARAM_TYPES, Entry

from .engine import Engine

_PARAM_NAMES = {code: name for name, (code, _) in PARAM_TYPES.items()}
_LOG_NAMES = {code: name for name, (code, _) in LOG_TYPES.items()}
_READ_ONLY = 0x40


class AppVariables:
    """Parameters, log variables and app channel of one vehicle's app.

    :param vehicle: its number in the engine. :param engine: where it runs.
    :param now: gives the time, ns. :param take: takes a packet of the app channel.
    """

    def __init__(self, vehicle: int, engine: Engine, now: Callable[[], int], take: Callable[[bytes], object]) -> None:
        self._vehicle, self._engine, self._now, self._take = vehicle, engine, now, take
        self.parameters = [self._entry(name, True) for name in engine.names(vehicle, parameters=True)]
        self.logs = [self._entry(name, False) for name in engine.names(vehicle, parameters=False)]

    def _entry(self, name: str, parameter: bool) -> Entry:
        group, _, rest = name.partition(".")
        code = self._engine.type(self._vehicle, name, parameter=parameter)
        text = (_PARAM_NAMES if parameter else _LOG_NAMES)[code & 15]
        value = self.parameter(name) if parameter else 0.0
        return Entry(group, rest, text, value, read_only=parameter and bool(code & _READ_ONLY))

    def parameter(self, name: str) -> float:
        """Value of one of its parameters."""
        return self._engine.get(self._vehicle, name, parameter=True)

    def set_parameter(self, name: str, value: float) -> None:
        """Set one."""
        self._engine.set(self._vehicle, self._now(), name, value)

    def log_values(self) -> Mapping[str, float]:
        """Values of its log variables, by their full names."""
        names = self._engine.names(self._vehicle, parameters=False)
        return {name: self._engine.get(self._vehicle, name, parameter=False) for name in names}

    def receive(self, data: bytes) -> None:
        """A packet of the app channel."""
        self._take(data)
