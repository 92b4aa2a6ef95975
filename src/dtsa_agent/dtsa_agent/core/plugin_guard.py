"""Between the core and parts from other packages: what they raise or answer wrongly is named as theirs."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from threading import get_ident
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DtsaError, PluginError

_METHODS = (
    "choose",
    "senders",
    "wake",
    "sensed",
    "sent",
    "received",
    "say",
    "heard",
    "slot_over",
    "estimate",
    "command",
)


class Overdue(BaseException):
    """Ends a call that does not return. No plug-in that catches its own errors catches it."""


class Call:
    """One call of a plug-in.

    :param part: what is called: kind, name and method.
    """

    __slots__ = ("fault", "part")

    def __init__(self, part: str) -> None:
        self.part = part
        self.fault = ""  # said by whoever ends it


#: The call of a plug-in that each thread is in, by the thread's identifier: for a watch, which has a clock.
RUNNING: dict[int, Call] = {}


class Guarded:
    """One instance of a plug-in. It has the methods that the instance has.

    :param kind: ``policy``, ``estimator`` or ``avoider``.
    :param name: its name.
    :param factory: makes it.
    :param arguments: of the factory.
    :raises PluginError: if that raises an error; a ConfigError, of options for instance, stays one.
    """

    choose: Callable[..., Any]
    senders: Callable[..., Any]
    wake: Callable[..., Any]
    sensed: Callable[..., Any]
    sent: Callable[..., Any]
    received: Callable[..., Any]
    say: Callable[..., Any]
    heard: Callable[..., Any]
    slot_over: Callable[..., Any]
    estimate: Callable[..., Any]
    command: Callable[..., Any]

    def __init__(self, kind: str, name: str, factory: Callable[..., Any], *arguments: object) -> None:
        self.name = f"{kind} {name}"
        self.made = _guarded(self.name, factory)(*arguments)
        for method in _METHODS:
            function = getattr(self.made, method, None)
            if function is not None:
                setattr(self, method, _guarded(f"{self.name}, {method}", function))

    def chosen(self, answer: object, slot: int, agents: int) -> int:
        """What ``choose`` has answered, as an id; 0: nobody.

        :param answer: its answer.
        :param slot: the slot it is for.
        :param agents: number of agents.
        :raises PluginError: if it is no id.
        """
        return self._whole(answer, "choose", slot, 0, agents, "0 (nobody)")

    def sender(self, answer: object, slot: int, agents: int) -> int:
        """One of those whom ``senders`` has named.

        :param answer: one of its answers.
        :param slot: the slot it is for.
        :param agents: number of agents.
        :raises PluginError: if it is no id.
        """
        return self._whole(answer, "senders", slot, 1, agents, "1")

    def _whole(self, answer: object, method: str, slot: int, low: int, high: int, least: str) -> int:
        try:
            number = operator.index(answer)  # type: ignore[arg-type]
        except TypeError:
            number = low - 1
        if not low <= number <= high:
            fault = f"chose agent {answer!r} in slot {slot}; allowed: {least} to {high}"
            raise PluginError(f"{self.name}, {method}", fault)
        return number

    def bytes_said(self, answer: object, size: int) -> bytes:
        """What ``say`` has answered.

        :param answer: its answer.
        :param size: number of bytes that it has declared.
        :raises PluginError: if these are not so many bytes.
        """
        if not isinstance(answer, (bytes, bytearray)) or len(answer) != size:
            given = f"{len(answer)} bytes" if isinstance(answer, (bytes, bytearray)) else repr(answer)
            raise PluginError(f"{self.name}, say", f"gave {given}, declared {size}")
        return bytes(answer)

    def commanded(self, answer: Any, slot: int) -> tuple[float, ...]:
        """What ``command`` has answered, m/s.

        :param answer: its answer.
        :param slot: the slot it is for.
        :raises PluginError: if these are not three finite numbers.
        """
        try:
            velocity = tuple(float(value) for value in answer)
        except (TypeError, ValueError):
            velocity = ()
        if len(velocity) != 3 or not all(map(math.isfinite, velocity)):
            raise PluginError(f"{self.name}, command", f"gave {answer!r} in slot {slot}; allowed: three finite numbers")
        return velocity

    def estimated(self, *arrays: NDArray[np.float64], slot: int) -> None:
        """Looks at what ``estimate`` has written.

        :param arrays: of m and m/s.
        :param slot: the slot it is for.
        :raises PluginError: if it is not finite.
        """
        if not all(np.isfinite(array).all() for array in arrays):
            raise PluginError(f"{self.name}, estimate", f"wrote a number that is not finite in slot {slot}")


def _guarded(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: object) -> Any:
        thread, running = get_ident(), Call(part)
        RUNNING[thread] = running
        try:
            return function(*arguments)
        except DtsaError:
            raise
        except Overdue:
            raise PluginError(part, running.fault) from None
        except Exception as error:
            raise PluginError.raised(part, error) from error
        finally:
            RUNNING.pop(thread, None)

    return call
