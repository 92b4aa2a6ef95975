"""What a node does not take in: counted by reason, and said now and then."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from .checks import Unusable

_LOG_S = 5.0  # from one line in the log to the next
_LONGEST = 300  # characters of a line


class Intake:
    """Counts messages that were not taken in.

    :param logger: rclpy's logger of the node; None: nothing is said.
    """

    def __init__(self, logger: Any = None) -> None:
        self._logger = logger
        self._next_line = 0.0
        self.counts: dict[str, int] = {}  # by reason
        self.last = ""  # what was last dropped, and why

    @property
    def total(self) -> int:
        """Number of all messages dropped."""
        return sum(self.counts.values())

    def drop(self, reason: str, detail: str) -> None:
        """Counts a message that is not taken in.

        :param reason: one of those in :mod:`dtsa_agent.ros.common.wire.checks`.
        :param detail: what was wrong with it.
        """
        self.counts[reason] = self.counts.get(reason, 0) + 1
        self.last = detail
        now = time.monotonic()
        if self._logger is not None and now >= self._next_line:
            self._next_line = now + _LOG_S
            self._logger.warning(f"not taken in ({reason}): {detail}; {self.total} so far"[:_LONGEST])

    @contextmanager
    def guard(self) -> Iterator[None]:
        """What is :class:`Unusable` within is dropped and counted."""
        try:
            yield
        except Unusable as error:
            self.drop(error.reason, str(error))


def add_counts(total: dict[str, int], more: Mapping[str, int]) -> None:
    """Adds counts by reason.

    :param total: counts by reason; changed in place.
    :param more: counts by reason that are added.
    """
    for reason, count in more.items():
        total[reason] = total.get(reason, 0) + count
