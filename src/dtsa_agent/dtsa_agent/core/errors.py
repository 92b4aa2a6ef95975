"""Errors that say whose fault it was."""

from __future__ import annotations

import re
from collections.abc import Iterable

UNKNOWN = "one of the settings "  # what is allowed begins with it where no setting has the name of the field
_LONGEST = 120  # characters of a value that an error repeats


class DtsaError(Exception):
    """Base of all errors that this project raises on purpose."""


def shown(value: object) -> str:
    """A value as errors repeat it: not too long, whatever its own ``__repr__`` does."""
    try:
        text = repr(value)
    except Exception:
        text = f"<{type(value).__name__}>"
    return text if len(text) <= _LONGEST else text[:_LONGEST] + " ..."


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """A question that names the nearest of the words that would have been right; empty if none is near."""
    import difflib  # an agent in flight needs none

    near = difflib.get_close_matches(word, list(words), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near and near[0] != word else ""


class ConfigError(DtsaError, ValueError):
    """A setting, as the user wrote it, is not usable.

    ``allowed`` says in words what would have been; where it lists names, the nearest one is asked for.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        given = value[:_LONGEST] if isinstance(value, str) else ""
        wrong = field.rpartition(".")[2] if allowed.startswith(UNKNOWN) else given
        listed = re.split(r"\s*[,;]\s*|\s+or\s+", allowed.removeprefix(UNKNOWN))
        near = did_you_mean(wrong, [word for word in listed if re.fullmatch(r"[A-Za-z][\w.-]*", word)])
        super().__init__(f"{field}: got {shown(value)}; allowed: {allowed}{near}")
        self.field, self.value, self.allowed = field, value, allowed

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, object, str]]:
        return (ConfigError, (self.field, self.value, self.allowed))


def range_text(low: float | None, high: float | None, unit: str = "") -> str:
    """A range in words, as ``allowed`` of an error says it; one of the bounds may be None."""
    first, last = (f"{bound:g}" if isinstance(bound, float) else str(bound) for bound in (low, high))
    tail = f" {unit}" if unit not in ("", "1") else ""
    if high is None:
        return f"{first} or more{tail}"
    if low is None:
        return f"{last} or less{tail}"
    return f"{first} to {last}{tail}"


class LocalProtocolError(DtsaError):
    """We broke the protocol ourselves: a bug on this side."""


class PluginError(DtsaError):
    """A part from another package (kind, name and method) raised an error, or gave what it may not give."""

    def __init__(self, part: str, fault: str) -> None:
        super().__init__(f"{part}: {fault}")

    @classmethod
    def raised(cls, part: str, error: BaseException) -> PluginError:
        """An error that the part raised, with the place in it."""
        trace = error.__traceback__
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        place = f" ({trace.tb_frame.f_code.co_filename}:{trace.tb_lineno})" if trace else ""
        return cls(part, f"{type(error).__name__}: {error}{place}")

    def __reduce__(self) -> tuple[type[PluginError], tuple[str, str]]:
        part, _, fault = str(self).partition(": ")
        return (PluginError, (part, fault))


class RemoteProtocolError(DtsaError):
    """A frame from outside is not usable: never stops a node, it is counted."""
