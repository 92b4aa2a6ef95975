"""Errors by their source: settings of the user, bugs of this software, plug-ins, frames of other agents."""

from __future__ import annotations

import re
from collections.abc import Iterable

SETTING_NAMES = "one of the settings "  # begins the allowed values of an error about an unknown setting
_MAX_SHOWN = 120  # characters of a value in an error's text


class DtsaError(Exception):
    """Base class of this project's errors."""


def shown(value: object) -> str:
    """Return a value's ``repr``, shortened and on one line, for an error's text; never raises."""
    try:
        text = " ".join(line.strip() for line in repr(value).splitlines())
    except Exception:
        text = f"<{type(value).__name__}>"
    return text if len(text) <= _MAX_SHOWN else text[:_MAX_SHOWN] + " ..."


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """Return a question that names the most similar of the allowed words; empty if none is similar."""
    import difflib  # not loaded in flight

    near = difflib.get_close_matches(word, list(words), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near and near[0] != word else ""


class ConfigError(DtsaError, ValueError):
    """A setting has a value that is not allowed.

    :param field: full name of the setting.
    :param allowed: the allowed values, in words; if it lists names, the error suggests the most similar one.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        text = value[:_MAX_SHOWN] if isinstance(value, str) else ""
        wrong_word = field.rpartition(".")[2] if allowed.startswith(SETTING_NAMES) else text
        words = re.split(r"\s*[,;]\s*|\s+or\s+", allowed.removeprefix(SETTING_NAMES))
        question = did_you_mean(wrong_word, [word for word in words if re.fullmatch(r"[A-Za-z][\w.-]*", word)])
        super().__init__(f"{field}: got {shown(value)}; allowed: {allowed}{question}")
        self.field, self.value, self.allowed = field, value, allowed

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, object, str]]:
        return (ConfigError, (self.field, self.value, self.allowed))


def range_text(low: float | None, high: float | None, unit: str = "") -> str:
    """Return a range in words, for ``allowed`` of an error; one of the bounds may be None."""
    first, last = (f"{bound:g}" if isinstance(bound, float) else str(bound) for bound in (low, high))
    text = f"{first} or more" if high is None else f"{last} or less" if low is None else f"{first} to {last}"
    return text if unit in ("", "1") else f"{text} {unit}"


class LocalProtocolError(DtsaError):
    """This software broke the protocol: a bug."""


class PluginError(DtsaError):
    """A plug-in raised an error, or returned a value that is not allowed.

    :param part: kind, name and method of the plug-in.
    """

    def __init__(self, part: str, fault: str) -> None:
        super().__init__(f"{part}: {fault}")

    def __reduce__(self) -> tuple[type[PluginError], tuple[str, str]]:
        part, _, fault = str(self).partition(": ")
        return (PluginError, (part, fault))


class RemoteProtocolError(DtsaError):
    """A frame from outside is not usable. Nodes count it and go on."""
