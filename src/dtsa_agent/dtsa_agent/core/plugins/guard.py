"""Between the core and parts from other packages: what they raise or answer wrongly is named as theirs."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import DtsaError, PluginError, shown

# The method that a plug-in must have, by its kind; policies for comparison have another one instead.
_NEEDED = {
    "policy": "choose(table, slot)",
    "estimator": "estimate(table, slot, step, position, velocity)",
    "avoider": "command(table, slot, step)",
}
_FOR_COMPARISON = ("senders(swarm, slot)", "wake(table, now_ns, radio)")
_SPEAKS = ["say(table, slot)", "heard(table, slot, sender, data)"]  # with bytes of its own in frames


class Guarded:
    """One instance of a plug-in, of a kind as in ``_NEEDED``, with the methods that the instance has.

    :raises PluginError: in place of errors of its factory and its methods, and if it lacks the method of its kind; a
        ConfigError, of options for instance, stays one. So do those below that check an answer, if it is none.
    """

    def __init__(self, kind: str, name: str, factory: Callable[..., Any], *arguments: object) -> None:
        self.name = f"{kind} {name}"
        self.instance = _guarded(self.name, factory)(*arguments)
        needed = [_NEEDED[kind]]
        if kind == "policy":
            needed = [next((text for text in _FOR_COMPARISON if _has(factory, text)), needed[0])]
        if kind != "avoider" and getattr(factory, "own_bytes", None):
            needed += _SPEAKS
        missing = [text for text in needed if not _has(self.instance, text)]
        if missing:
            raise PluginError(self.name, f"{type(self.instance).__name__} has no method {' and '.join(missing)}")

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """A method of the instance, guarded; made at the first call."""
        call = _guarded(f"{self.name}, {method}", getattr(self.instance, method))
        setattr(self, method, call)
        return call

    def chosen(self, answer: object, slot: int, agents: int) -> int:
        """What ``choose`` has answered, as an id; 0: nobody."""
        return self._whole(answer, "choose", slot, 0, agents, "0 (nobody)")

    def sending(self, answer: Any, slot: int, agents: int) -> list[int]:
        """What ``senders`` has answered, as ids."""
        try:
            named = list(answer)
        except Exception:
            fault = f"gave {shown(answer)} in slot {slot}; allowed: a list of the ids that send"
            raise PluginError(f"{self.name}, senders", fault) from None
        return [self._whole(agent, "senders", slot, 1, agents, "1") for agent in named]

    def _whole(self, answer: object, method: str, slot: int, low: int, high: int, least: str) -> int:
        try:
            number = operator.index(answer)  # type: ignore[arg-type]
        except Exception:  # whatever its __index__ raises
            number, least = low - 1, f"an integer, {least}"
        if not low <= number <= high:
            fault = f"chose agent {shown(answer)} in slot {slot}; allowed: {least} to {high}"
            raise PluginError(f"{self.name}, {method}", fault)
        return number

    def checked_bytes(self, answer: object, size: int) -> bytes:
        """What ``say`` has answered: as many bytes as it has declared."""
        if not isinstance(answer, (bytes, bytearray)) or len(answer) != size:
            size_text = f"{len(answer)} bytes" if isinstance(answer, (bytes, bytearray)) else shown(answer)
            raise PluginError(f"{self.name}, say", f"gave {size_text}, declared {size}")
        return bytes(answer)

    def commanded(self, answer: Any, slot: int) -> tuple[float, ...]:
        """What ``command`` has answered, m/s: three finite numbers."""
        try:
            velocity = tuple(float(value) for value in answer)
        except Exception:
            velocity = ()
        if len(velocity) != 3 or not all(map(math.isfinite, velocity)):
            fault = f"gave {shown(answer)} in slot {slot}; allowed: three finite numbers"
            raise PluginError(f"{self.name}, command", fault)
        return velocity

    def estimated(self, *arrays: NDArray[np.float64], slot: int) -> None:
        """Check that what ``estimate`` has written is finite."""
        if not all(np.isfinite(array).all() for array in arrays):
            raise PluginError(f"{self.name}, estimate", f"wrote a number that is not finite in slot {slot}")


def _has(part: object, method: str) -> bool:
    return callable(getattr(part, method.partition("(")[0], None))


def _guarded(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: object) -> Any:
        try:
            return function(*arguments)
        except DtsaError:
            raise
        except (Exception, SystemExit, GeneratorExit) as error:  # a plug-in does not end the program
            raise PluginError.raised(part, error) from error

    return call
