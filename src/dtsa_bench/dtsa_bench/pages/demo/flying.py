"""Flies the demo: the flights in lockstep two at a time, then the one in real time alone."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from dtsa_agent.ros.common.process.loop import Stop
from dtsa_bench.flights.flight import Flight, fly
from dtsa_bench.flights.options import FlightOptions
from dtsa_bench.flights.progress import ProgressLine

from .live import Killing, Times, Until
from .story import KILLED, Step, Take

AT_ONCE = 2  # starting a flight is mostly waiting; more at once only wait for each other
RESPAWN_S = 6.0  # after that its turns are used by others, for as long as its process needs to start


@dataclass(frozen=True, slots=True)
class Landed:
    """A flight that is over."""

    flight: Flight
    times: Times | None = None


class _Silent(ProgressLine):
    """Says nothing: several flights at once have one line for all."""

    def show(self, text: str) -> None:
        self._next = time.monotonic() + 3600.0

    def say(self, text: str) -> None:
        pass


def fly_all(steps: Sequence[Step], directory: Path, stop: Stop, stream: TextIO) -> dict[str, Landed]:
    """Flies all flights of the demo.

    :param steps: the steps of the demo.
    :param directory: each flight gets a directory in it.
    :param stop: ends everything early.
    :param stream: for the progress lines.
    :returns: the flights by key; not all if `stop` came.
    :raises DtsaError: when a node dies, hangs or sends garbage.
    """
    takes = [take for step in steps for take in step.takes]
    lockstep = [take for take in takes if not take.live]
    landed = _fly_lockstep(lockstep, directory, stop, ProgressLine("flights in lockstep", stream))
    for take in takes:
        if take.live and not stop:
            landed[take.key] = _fly_live(take, directory, stop)
    return landed


def _fly_lockstep(takes: Sequence[Take], directory: Path, stop: Stop, line: ProgressLine) -> dict[str, Landed]:
    failed = threading.Event()
    over = Until(stop, failed.is_set)
    options = FlightOptions(processes=1, pictures=False)

    def one(take: Take) -> Landed | None:
        if over:
            return None
        return Landed(fly(take.run, directory / take.key, options, over, progress=_Silent(take.key)))

    landed: dict[str, Landed] = {}
    with ThreadPoolExecutor(AT_ONCE) as pool:
        futures: dict[Future[Landed | None], Take] = {pool.submit(one, take): take for take in takes}
        waiting = set(futures)
        while waiting:
            done, waiting = wait(waiting, timeout=0.1, return_when=FIRST_COMPLETED)
            if any(future.exception() for future in done):
                failed.set()
            landed |= {
                futures[future].key: result
                for future in done
                if not future.exception() and (result := future.result()) is not None
            }
            if done or line.due():
                line.show(f"{len(landed)} of {len(takes)} flown")
    line.end()
    for future in futures:
        future.result()  # raises what went wrong
    return {take.key: landed[take.key] for take in takes if take.key in landed}


def _fly_live(take: Take, directory: Path, stop: Stop) -> Landed:
    killing = Killing(KILLED)
    options = FlightOptions(respawn=RESPAWN_S, pictures=False)
    over = Until(stop, lambda: killing.seen)
    flight = fly(
        take.run, directory / take.key, options, over, "flight in real time", killing.started, observers=[killing]
    )
    return Landed(flight, killing.times())
