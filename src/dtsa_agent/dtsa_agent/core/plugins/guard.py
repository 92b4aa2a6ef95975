"""Calls of plug-ins: an error that a plug-in raises, or a wrong return value, becomes a PluginError with its name."""

from __future__ import annotations

import math
import operator
import traceback
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import DtsaError, PluginError, shown

# The method that a plug-in must have, by its kind; policies for comparison have another one instead.
_REQUIRED = {
    "policy": "choose(table, slot)",
    "estimator": "estimate(table, slot, step, position, velocity)",
    "avoider": "command(table, slot, step)",
}
_FOR_COMPARISON = ("senders(swarm, slot)", "wake(table, now_ns, radio)")
_OWN_DATA = ["own_data(table, slot)", "receive_data(table, slot, sender, data)"]  # with `own_bytes`


class Guarded:
    """One instance of a plug-in, of a kind as in ``_REQUIRED``, with the instance's methods.

    :raises PluginError: if the factory or a method raises an error, lacks the method of its kind, or returns a value
        that is not allowed. A ConfigError (of options, for instance) stays one.
    """

    def __init__(self, kind: str, name: str, factory: Callable[..., Any], *arguments: object) -> None:
        self.name = f"{kind} {name}"
        self.instance = _guarded(self.name, factory)(*arguments)
        required = [_REQUIRED[kind]]
        if kind == "policy":
            required = [next((text for text in _FOR_COMPARISON if _has(factory, text)), required[0])]
        if kind != "avoider" and getattr(factory, "own_bytes", None):
            required += _OWN_DATA
        missing = [text for text in required if not _has(self.instance, text)]
        if missing:
            raise PluginError(self.name, f"{type(self.instance).__name__} has no method {' and '.join(missing)}")

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """A method of the instance, guarded; made at the first call."""
        call = _guarded(f"{self.name}, {method}", getattr(self.instance, method))
        setattr(self, method, call)
        return call

    def check_choice(self, answer: object, slot: int, agents: int) -> int:
        """Check the return value of ``choose``: an id, or 0 for no agent."""
        return self._check_id(answer, "choose", slot, 0, agents, "0 (no agent)")

    def check_senders(self, answer: Any, slot: int, agents: int) -> list[int]:
        """Check the return value of ``senders``: ids."""
        try:
            ids = list(answer)
        except Exception:
            self._fail("senders", f"gave {shown(answer)} in slot {slot}; allowed: a list of the ids that send")
        return [self._check_id(agent, "senders", slot, 1, agents, "1") for agent in ids]

    def _check_id(self, answer: object, method: str, slot: int, low: int, high: int, least: str) -> int:
        try:
            number = operator.index(answer)  # type: ignore[arg-type]
        except Exception:  # whatever its __index__ raises
            number, least = low - 1, f"an integer, {least}"
        if not low <= number <= high:
            self._fail(method, f"chose agent {shown(answer)} in slot {slot}; allowed: {least} to {high}")
        return number

    def check_own_data(self, answer: object, size: int) -> bytes:
        """Check the return value of ``own_data``: as many bytes as ``own_bytes`` declares."""
        if not isinstance(answer, (bytes, bytearray)):
            self._fail("own_data", f"gave {shown(answer)}, declared {size}")
        if len(answer) != size:
            self._fail("own_data", f"gave {len(answer)} bytes, declared {size}")
        return bytes(answer)

    def check_command(self, answer: Any, slot: int) -> tuple[float, ...]:
        """Check the return value of ``command``: three finite numbers, m/s."""
        try:
            velocity = tuple(float(value) for value in answer)
        except Exception:
            velocity = ()
        if len(velocity) != 3 or not all(map(math.isfinite, velocity)):
            self._fail("command", f"gave {shown(answer)} in slot {slot}; allowed: three finite numbers")
        return velocity

    def check_estimates(self, *arrays: NDArray[np.float64], slot: int) -> None:
        """Check that ``estimate`` has written finite numbers."""
        if not all(np.isfinite(array).all() for array in arrays):
            self._fail("estimate", f"wrote a number that is not finite in slot {slot}")

    def _fail(self, method: str, fault: str) -> NoReturn:
        raise PluginError(f"{self.name}, {method}", fault) from None


def _has(part: object, method: str) -> bool:
    return callable(getattr(part, method.partition("(")[0], None))


def _guarded(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: object) -> Any:
        try:
            return function(*arguments)
        except DtsaError:
            raise
        except (Exception, SystemExit, GeneratorExit) as error:  # a plug-in does not end the program
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{frame.filename}:{frame.lineno}"
            raise PluginError(part, f"{type(error).__name__}: {error} ({place})") from error

    return call
