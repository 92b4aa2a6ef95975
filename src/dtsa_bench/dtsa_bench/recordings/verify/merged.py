"""Checks a bag that was merged from the bags of agents on a network: all its messages, and all decisions made again."""

from __future__ import annotations

from itertools import zip_longest
from typing import Any

from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_bench.recordings.bag.merged import merged_from
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.merge.merge import clocks_apart, verified
from dtsa_bench.recordings.merge.merged_messages import MergedMessages, Out
from dtsa_bench.recordings.merge.merged_run import read
from dtsa_bench.runs.config import RunConfig

from .result import Difference, Mismatch, Result
from .stream import Streams


class MergedCheck:
    """Checks a merged flight.

    Reports and frames on the air say what each agent did and heard. All else in the bag must follow from them, byte by
    byte, and so must each decision, which the core makes again.

    :raises UnusableBag: if a part of the bag is lost, or its reports do not fit together.
    """

    def __init__(self, bag: Bag, result: Result) -> None:
        found = merged_from(bag)
        assert found is not None
        if result.broken_off:
            raise UnusableBag(bag.given, "it was merged, and a part of it is lost: merge the agents' bags again")
        self._bag, self._result = bag, result
        self._run = read(found, RunConfig.from_dict(bag.config).swarm, bag.path)

    def check(self) -> None:
        """Goes through the bag.

        :raises Mismatch: at the first difference.
        """
        result, config = self._result, self._run.config
        self._messages()
        result.slots = result.checked.get("reception", 0)
        result.simulated_s = result.slots * config.slot_s
        Streams(self._bag, lambda topic: False).check_digest(result)
        self._judge(self._run.judge())
        if config.auth:
            result.skipped["tags of frames"] = "the agents have checked them; the key of a flight is in no bag"
        result.skipped["motion"] = "each agent has recorded where it was"
        result.skipped["why a frame was not heard"] = "a network does not say"

    def _messages(self) -> None:
        """Each message follows from reports and frames."""
        expected = MergedMessages(self._run, self._bag.config)
        for recorded, right in zip_longest(self._bag.messages(), expected):
            if recorded is None or right is None or not _equal(recorded, right):
                place = recorded if recorded is not None else right
                raise Mismatch(Difference(
                    place.topic, _said(right), _said(recorded), "it follows from the agents' reports and frames",
                ))  # fmt: skip
            self._result.count(recorded.topic.rpartition("/")[2])

    def _judge(self, found: dict[str, Any]) -> None:
        result, turns = self._result, found["turns"]
        differences = found["decisions_again"]["differences"]
        if differences:
            one = differences[0]
            raise Mismatch(Difference(
                f"report.{one['field']}", str(one["again"]), str(one["recorded"]),
                "follows from what the agent says to have heard", one["slot"], one["agent"],
            ))  # fmt: skip
        result.count("decisions made again", found["decisions_again"]["equal"])
        if others := found["frames_heard_not_as_sent"]:
            why = "nobody hears what was not sent"
            raise Mismatch(Difference("frames heard", "as they were sent", f"{others} others", why))
        if apart := found["not_determined"]:
            raise Mismatch(Difference("time line", "one of all agents", f"{len(apart)} groups", clocks_apart(apart)))
        if not verified(found):
            why = "all bags are there and whole"
            raise Mismatch(Difference("frames in turn", "no rule broken", "; ".join(turns["which"]), why))
        if found["missing"] or found["broken_off"] or found["nothing_written"]:
            result.skipped["turns"] = "bags are missing or break off: who was given a turn is not known of all"
        else:
            result.count("frames in turn", turns["frames_judged"])
        result.safety |= {
            "frames": turns["frames_judged"],
            "slots_with_two_senders": turns["slots_with_two_senders"],
            "missing": found["missing"],
            "broken_off_bags": found["broken_off"],
        }


def _equal(recorded: Any, right: Out) -> bool:
    return (recorded.topic, recorded.log_time_ns, recorded.data) == (right.topic, right.time_ns, right.data)


def _said(message: Any) -> str:
    """A message, short enough for one line."""
    if message is None:
        return "no message"
    at = getattr(message, "log_time_ns", None) or message[0]
    return f"{message.topic} at {at} ns, {len(message.data)} bytes ending in {message.data[-8:].hex()}"
