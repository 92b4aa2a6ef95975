"""Errors that say whose fault it was."""

from __future__ import annotations


class DtsaError(Exception):
    """Base of all errors that this project raises on purpose."""


class ConfigError(DtsaError, ValueError):
    """A setting is not usable: the user's to mend.

    :param field: name of the setting, as the user wrote it.
    :param value: the value that was given.
    :param allowed: what would have been allowed, in words.
    """

    def __init__(self, field: str, value: object, allowed: str) -> None:
        super().__init__(f"{field}: got {value!r}; allowed: {allowed}")
        self.field = field
        self.value = value
        self.allowed = allowed

    def __reduce__(self) -> tuple[type[ConfigError], tuple[str, object, str]]:
        return (ConfigError, (self.field, self.value, self.allowed))


class LocalProtocolError(DtsaError):
    """We broke the protocol ourselves: a bug on this side."""


class RemoteProtocolError(DtsaError):
    """A frame from outside is not usable: never stops a node, it is counted."""
