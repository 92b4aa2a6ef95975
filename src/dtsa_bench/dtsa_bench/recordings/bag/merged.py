"""What only a bag holds that was merged from the bags of agents on a network."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from .errors import UnusableBag
from .metadata import MERGED_FROM
from .reader import Bag

FRAME, REPORT = "/swarm/frame", "/swarm/report"


@dataclass(frozen=True, slots=True)
class MergedFrom:
    """What such a bag was merged from: all its other messages follow from these."""

    about: dict[str, Any]  # what it was merged from; see dtsa_bench.recordings.merge.merged_run
    reports: list[Any]  # dtsa_msgs/Report
    frames: list[Any]  # dtsa_msgs/Frame

    @property
    def first(self) -> int:
        """The first slot that all counted alike."""
        return int(self.about["common_slot"])


def _check(about: Any) -> None:
    """Whether what a bag says of its origin has the form that `merge` gives it."""
    if not isinstance(about["common_slot"], int) or about["common_slot"] < 0:
        raise ValueError("common_slot")
    for name in ("missing", "broken_off", "not_on_the_time_line", "processes"):
        if not isinstance(about[name], list):
            raise ValueError(name)
    if not all(isinstance(about["residual_us"][name], float) for name in ("p50", "p99")):
        raise ValueError("residual_us")
    if not isinstance(about["frames_heard_not_as_sent"], int):
        raise ValueError("frames_heard_not_as_sent")


def merged_from(bag: Bag) -> MergedFrom | None:
    """What a bag was merged from; None: it was recorded in flight.

    :raises UnusableBag: if what it says of that cannot be read.
    """
    if MERGED_FROM not in bag.custom_data:
        return None
    try:
        about = json.loads(bag.custom_data[MERGED_FROM])
        _check(about)
    except (ValueError, KeyError, TypeError) as error:
        raise UnusableBag(bag.given, f"what it says of the bags it was merged from cannot be read ({error})") from None
    found: dict[str, list[Any]] = {FRAME: [], REPORT: []}
    for message, said in bag.typed([FRAME, REPORT]):
        found[message.topic].append(said)
    return MergedFrom(about, found[REPORT], found[FRAME])
