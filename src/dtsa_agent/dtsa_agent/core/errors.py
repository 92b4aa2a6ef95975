"""Errors that say whose fault it was."""

from __future__ import annotations

_LONGEST = 120  # characters of a value that an error repeats


class DtsaError(Exception):
    """Base of all errors that this project raises on purpose."""


class ConfigError(DtsaError, ValueError):
    """A setting is not usable: the user's to mend.

    :param field: name of the setting, as the user wrote it.
    :param value: the value that was given.
    :param allowed: what would have been allowed, in words.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        given = repr(value)
        if len(given) > _LONGEST:
            given = given[:_LONGEST] + " ..."
        super().__init__(f"{field}: got {given}; allowed: {allowed}")
        self.field = field
        self.value = value
        self.allowed = allowed

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, object, str]]:
        return (ConfigError, (self.field, self.value, self.allowed))


def range_text(low: float | None, high: float | None, unit: str = "") -> str:
    """A range in words, as ``allowed`` of an error says it.

    :param low: smallest allowed number, or None.
    :param high: largest allowed number, or None; at least one of the two is given.
    :param unit: unit of both; empty or "1": none.
    """
    first, last = (f"{bound:g}" if isinstance(bound, float) else str(bound) for bound in (low, high))
    tail = f" {unit}" if unit not in ("", "1") else ""
    if high is None:
        return f"{first} or more{tail}"
    if low is None:
        return f"{last} or less{tail}"
    return f"{first} to {last}{tail}"


class LocalProtocolError(DtsaError):
    """We broke the protocol ourselves: a bug on this side."""


class RemoteProtocolError(DtsaError):
    """A frame from outside is not usable: never stops a node, it is counted."""
