"""Between the core and parts from other packages: what they raise or answer wrongly is named as theirs."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from threading import get_ident
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import DtsaError, PluginError, shown

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
_FOR_COMPARISON = ("senders(swarm, slot)", "wake(table, now_ns, radio)")  # of policies, instead of choose


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
    :raises PluginError: if that raises an error, or makes something without the method of its kind; a ConfigError,
        of options for instance, stays one.
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
        missing = [text for text in _needed(kind, factory) if not _has(self.made, text)]
        if missing:
            raise PluginError(self.name, f"{type(self.made).__name__} has no method {' and '.join(missing)}")
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

    def sending(self, answer: Any, slot: int, agents: int) -> list[int]:
        """What ``senders`` has answered, as ids.

        :param answer: its answer.
        :param slot: the slot it is for.
        :param agents: number of agents.
        :raises PluginError: if these are no ids.
        """
        try:
            named = list(answer)
        except Exception:
            fault = f"gave {shown(answer)} in slot {slot}; allowed: a list of the ids that send"
            raise PluginError(f"{self.name}, senders", fault) from None
        return [self._whole(one, "senders", slot, 1, agents, "1") for one in named]

    def _whole(self, answer: object, method: str, slot: int, low: int, high: int, least: str) -> int:
        try:
            number = operator.index(answer)  # type: ignore[arg-type]
        except Exception:  # whatever its __index__ raises
            number, least = low - 1, f"an integer, {least}"
        if not low <= number <= high:
            fault = f"chose agent {shown(answer)} in slot {slot}; allowed: {least} to {high}"
            raise PluginError(f"{self.name}, {method}", fault)
        return number

    def bytes_said(self, answer: object, size: int) -> bytes:
        """What ``say`` has answered.

        :param answer: its answer.
        :param size: number of bytes that it has declared.
        :raises PluginError: if these are not so many bytes.
        """
        if not isinstance(answer, (bytes, bytearray)) or len(answer) != size:
            given = f"{len(answer)} bytes" if isinstance(answer, (bytes, bytearray)) else shown(answer)
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
        except Exception:
            velocity = ()
        if len(velocity) != 3 or not all(map(math.isfinite, velocity)):
            fault = f"gave {shown(answer)} in slot {slot}; allowed: three finite numbers"
            raise PluginError(f"{self.name}, command", fault)
        return velocity

    def estimated(self, *arrays: NDArray[np.float64], slot: int) -> None:
        """Looks at what ``estimate`` has written.

        :param arrays: of m and m/s.
        :param slot: the slot it is for.
        :raises PluginError: if it is not finite.
        """
        if not all(np.isfinite(array).all() for array in arrays):
            raise PluginError(f"{self.name}, estimate", f"wrote a number that is not finite in slot {slot}")


def _has(thing: object, method: str) -> bool:
    return callable(getattr(thing, method.partition("(")[0], None))


def _needed(kind: str, factory: object) -> list[str]:
    """The methods that an instance must have, as far as its factory says what it is."""
    main = {"estimator": "estimate(table, slot, step, position, velocity)", "avoider": "command(table, slot, step)"}
    if kind == "policy":
        main[kind] = next((text for text in _FOR_COMPARISON if _has(factory, text)), "choose(table, slot)")
    own: Any = 0 if kind == "avoider" else getattr(factory, "own_bytes", 0)
    speaks = ["say(table, slot)", "heard(table, slot, sender, data)"] if own else []
    return [main[kind], *speaks]


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
        except (Exception, SystemExit, GeneratorExit) as error:  # a plug-in does not end the program
            raise PluginError.raised(part, error) from error
        finally:
            RUNNING.pop(thread, None)

    return call
