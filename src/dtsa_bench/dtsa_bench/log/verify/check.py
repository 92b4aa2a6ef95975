"""Is a recorded flight what the protocol gives? Slot by slot, agent by agent, field by field."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log.agent_bag import find_bags, read_all
from dtsa_bench.log.arrays import recorded_config
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.metadata import MERGED_FROM
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.writer import BROKEN_OFF
from dtsa_bench.log.merge.merge import Merge
from dtsa_bench.log.merged_flight import check_rules
from dtsa_bench.log.record import AGENT, SLOT_RECORD, SNIFFER, build_log, check_format
from dtsa_bench.runs.config import LOCKSTEP
from dtsa_bench.runs.delivery import recorded_problem

from .contents import EVENTS, MERGED, BagContents
from .flights import check_lockstep, check_merged, check_realtime
from .result import Difference, Mismatch, Result


def verify_bag(path: str | Path, progress: Callable[[int], None] | None = None) -> Result:
    """Check a recorded flight.

    :param progress: is called with the slot now and then.
    :raises UnusableBag: if it cannot be read as a bag of this project at all.
    """
    begin = time.perf_counter()
    if bags := find_bags(path):
        result = Result(str(path), AGENT)
        with _noting(result):
            _verify_agents(bags, result)
    else:
        with Bag(path) as bag:
            check_format(bag)
            keys = (key for key in _MODES if key in bag.custom_data)
            mode = next((_MODES[key] for key in keys), str(bag.config.get("mode", LOCKSTEP)))
            result = Result(str(path), mode, broken_off=BROKEN_OFF in bag.custom_data)
            with _noting(result):
                _verify(bag, result, progress)
            result.unheard = result.unheard or recorded_problem(bag.path)
    result.wall_time_s = time.perf_counter() - begin
    return result


_MODES = {MERGED_FROM: MERGED, AGENT: AGENT, SNIFFER: SNIFFER}  # by what custom data has in bags of other than flights


@contextmanager
def _noting(result: Result) -> Iterator[None]:
    """Note the first difference that a check finds."""
    try:
        yield
    except Mismatch as mismatch:
        result.difference = mismatch.difference
    except UnusableBag as error:
        result.difference = Difference("the file", "a readable bag", "a damaged one", str(error))
    except ConfigError as error:
        result.difference = Difference("the recorded configuration", error.allowed, repr(error.value), error.field)
    except BagError as error:
        result.difference = Difference("a message", "valid CDR of its type", "other bytes", str(error))


def _verify_agents(paths: Sequence[Path], result: Result) -> None:
    """The agents' bags of a flight, joined."""
    bags, nothing_written = read_all(paths)
    check_merged(Merge(bags, nothing_written).log, result)
    for bag in bags:
        if bag.damage:
            raise UnusableBag(bag.path, bag.damage)


def _verify(bag: Bag, result: Result, progress: Callable[[int], None] | None) -> None:
    mode = result.mode
    if mode == AGENT:
        _verify_agents([bag.path], result)
        return
    contents = BagContents(bag, recorded_config(bag.config).swarm, result)
    log = build_log(bag, contents.records)
    if mode == MERGED:
        check_merged(log, result)
    elif mode == LOCKSTEP:
        check_lockstep(log, contents, result, progress)
    elif mode == SNIFFER:  # frames tell of themselves whether they keep to the rules
        result.slots, result.simulated_s = len(log), len(log) * log.config.swarm.slot_s
        result.note_rules(check_rules(log, {}))
        result.skipped["decisions"] = "a listener does not know them"
    else:
        check_realtime(log, contents, result)
    contents.check_odometry(log)
    contents.check_digest()
    bag.check_files()
    for topic in bag.topics:
        if topic not in (SLOT_RECORD, EVENTS) and not topic.endswith("/odom"):
            result.skipped[topic] = "carries nothing that is not in other topics; covered by the digest"
