"""Verifies one bag, whatever kind of run it holds."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.recordings.bag.errors import BagError, UnusableBag
from dtsa_bench.recordings.bag.metadata import MERGED_FROM
from dtsa_bench.recordings.bag.reader import Bag
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
            result.difference = mismatch.difference
        except UnusableBag as error:
            result.difference = Difference("the file", "a readable bag", "a damaged one", str(error))
        except ConfigError as error:
            result.difference = Difference("the recorded configuration", error.allowed, repr(error.value), error.field)
        except BagError as error:
            result.difference = Difference("a message", "valid CDR of its type", "other bytes", str(error))
        result.unheard = result.unheard or recorded_problem(bag.path)
    result.wall_time_s = time.perf_counter() - begin
    return result


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
