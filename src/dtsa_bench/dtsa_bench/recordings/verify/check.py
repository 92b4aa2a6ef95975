"""Verifies one bag, whatever kind of run it holds."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.recordings.bag.errors import BagError, UnusableBag
from dtsa_bench.recordings.bag.metadata import MERGED_FROM, RECOVERED_FROM
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.bag.run import RECEPTION, missing_slots
from dtsa_bench.recordings.bag.writer import BROKEN_OFF
from dtsa_bench.runs.hearing import recorded_problem

from .lockstep import LockstepCheck
from .result import Difference, Mismatch, Result


def verify_bag(path: str | Path, progress: Callable[[int], None] | None = None) -> Result:
    """Checks a recorded run.

    :raises UnusableBag: if it cannot be read as a bag of this project at all.
    """
    begin = time.perf_counter()
    with Bag(path) as bag:
        mode = "merged" if MERGED_FROM in bag.custom_data else str(bag.config.get("mode", "lockstep"))
        result = Result(str(path), mode, broken_off=BROKEN_OFF in bag.custom_data)
        try:
            _check(bag, mode, result, progress)
        except Mismatch as mismatch:
            result.difference = _hole(bag, result) or mismatch.difference
        except UnusableBag as error:
            result.difference = Difference("the file", "a readable bag", "a damaged one", str(error))
        except ConfigError as error:
            result.difference = Difference("the recorded configuration", error.allowed, repr(error.value), error.field)
        except BagError as error:
            other = Difference("a message", "valid CDR of its type", "other bytes", str(error))
            result.difference = _hole(bag, result) or other
        result.unheard = result.unheard or recorded_problem(bag.path)
    result.wall_time_s = time.perf_counter() - begin
    return result


def _hole(bag: Bag, result: Result) -> Difference | None:
    """Slots that a recovered bag does not have: whatever differs after them, they are why. The others are counted."""
    if RECOVERED_FROM not in bag.custom_data or RECEPTION not in bag.topics:
        return None
    try:
        slots = np.unique(bag.tables([RECEPTION], ["slot"])[RECEPTION]["slot"])
    except (BagError, UnusableBag):  # what cannot be read either does not say what is missing
        return None
    missing = missing_slots(slots)
    if not missing:
        return None
    result.slots = min(result.slots, len(slots))
    first = int(np.flatnonzero(slots != np.arange(len(slots)))[0])
    why = "this bag was recovered, and they were lost with what was damaged"
    return Difference("slots", "all from 0 to the last", f"{missing} are missing", why, first)


def _check(bag: Bag, mode: str, result: Result, progress: Callable[[int], None] | None) -> None:
    if mode == "lockstep":
        LockstepCheck(bag, result, progress).check()
        return
    if mode == "merged":
        from .merged import MergedCheck

        MergedCheck(bag, result).check()
        return
    from .realtime import RealtimeCheck

    RealtimeCheck(bag, result).check()
