"""Errors of recording and reading bags."""

from __future__ import annotations

from dtsa_agent.core.errors import ConfigError, DtsaError


class BagError(DtsaError):
    """Recording or reading went wrong for a reason outside the settings, a full disk for example."""


class UnusableBag(ConfigError):
    """What was given as a bag is not one, or is damaged. The text says what is wrong and what would help."""

    def __init__(self, path: object, reason: str) -> None:
        super().__init__("bag", str(path), "a recorded run (bag directory or .mcap file)")
        self.args = (f"bag {str(path)!r}: {reason}",)
        self.reason = reason

    def __reduce__(self) -> tuple[type[UnusableBag], tuple[object, str]]:  # type: ignore[override]
        return (type(self), (self.value, self.reason))


class NothingWritten(UnusableBag):
    """A process was started, and ended before it wrote anything."""
