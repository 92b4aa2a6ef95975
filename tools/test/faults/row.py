"""One row of the table of faults, and how rows are declared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fly_helpers import ENDLESS, FlightProcess, start_flight

LOCKSTEP = ("--agents", "3", "--moving", "2")
REALTIME = ("--mode", "realtime", "--slot-ms", "20", "--policy", "lease", "--agents", "3", "--moving", "2")

Run = Callable[[Path], None]  # makes the fault happen in an empty directory, and asserts the reaction
Act = Callable[[FlightProcess], None]  # the same to a flight that does not end by itself


@dataclass(frozen=True, slots=True)
class Fault:
    what: str
    reaction: str
    run: Run
    name: str
    sample: bool  # the ordinary tests run it


FAULTS: list[Fault] = []


def fault(what: str, reaction: str, *, sample: bool = False) -> Callable[[Run], Run]:

    def declare(run: Run) -> Run:
        FAULTS.append(Fault(what, reaction, run, run.__name__, sample))
        return run

    return declare


def in_flight(what: str, reaction: str, *words: str, sample: bool = False, begun: bool = True) -> Callable[[Act], Act]:

    def declare(act: Act) -> Act:
        def run(directory: Path) -> None:
            with start_flight(directory, *words, *ENDLESS, begun=begun) as flight:
                act(flight)

        FAULTS.append(Fault(what, reaction, run, act.__name__, sample))
        return act

    return declare
