"""One row of the table of faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

LOCKSTEP = ("--agents", "3", "--moving", "2")
REALTIME = ("--mode", "realtime", "--slot-ms", "20", "--policy", "lease", "--agents", "3", "--moving", "2")


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault, and how the system reacts to it.

    :param name: short, for the journal.
    :param fault: what happens, in words.
    :param reaction: what the system does, in words.
    :param run: makes it happen to real processes in an empty directory; raises ``NotMet`` for another reaction.
    :param sample: whether the ordinary tests run it.
    """

    name: str
    fault: str
    reaction: str
    run: Callable[[Path], None]
    sample: bool = False
