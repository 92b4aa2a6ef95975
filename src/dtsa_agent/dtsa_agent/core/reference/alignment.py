"""Keeping the slots of a swarm together without a master: every agent moves towards what it hears."""

from __future__ import annotations

from dtsa_agent.core.errors import ConfigError


class ClockAligner:
    """Turns arrival offsets of heard frames into small shifts of the own slots.

    After every ``receptions`` usable offsets the own slots move by ``gain`` times their median. A median
    shrugs off single delays, and since everybody moves towards everybody else, the swarm agrees on a common
    time that drifts with the mean of its clocks. A correction of the frequency as well is not needed at
    crystal accuracy and lets the common time run away.

    The caller keeps its own slot time: ``slot_start += aligner.hear(offset)``.

    :param receptions: offsets per correction, 1 or more.
    :param gain: share of the median by which the slots move, above 0, up to 1.
    :param limit_ns: ns; offsets beyond this, either way, are not trusted (a late frame, another swarm) and
        are counted.
    :raises ConfigError: when a parameter is out of range.
    """

    __slots__ = (
        "_limit_ns",
        "_offsets",
        "_receptions",
        "_share",
        "corrections",
        "ignored",
        "ignored_in_a_row",
    )

    def __init__(self, receptions: int = 9, gain: float = 0.5, limit_ns: int = 1_000_000) -> None:
        if receptions < 1:
            raise ConfigError("align_receptions", receptions, "a whole number of 1 or more")
        if not 0.0 < gain <= 1.0:
            raise ConfigError("align_gain", gain, "a number above 0, up to 1")
        if limit_ns <= 0:
            raise ConfigError("align_limit_ns", limit_ns, "a number of ns above 0")
        self._receptions = receptions
        # In 1/65536: the correction is integer arithmetic, the same on every machine.
        self._share = max(1, round(gain * 65536))
        self._limit_ns = limit_ns
        self._offsets: list[int] = []
        #: Corrections made so far.
        self.corrections = 0
        #: Offsets that were not trusted so far.
        self.ignored = 0
        #: Of these, how many came one after the other up to now: a clock that is off by more than the limit
        #: shows here.
        self.ignored_in_a_row = 0

    def hear(self, offset_ns: int) -> int:
        """Take in one frame and return by how much the own slots move now, ns (0 most of the time).

        :param offset_ns: ns, when the frame arrived minus when the own clock expected it; positive: the
            sender is later.
        """
        if not -self._limit_ns <= offset_ns <= self._limit_ns:
            self.ignored += 1
            self.ignored_in_a_row += 1
            return 0
        self.ignored_in_a_row = 0
        offsets = self._offsets
        offsets.append(offset_ns)
        if len(offsets) < self._receptions:
            return 0
        offsets.sort()
        middle = len(offsets) // 2
        twice = offsets[middle] + offsets[~middle]
        offsets.clear()
        self.corrections += 1
        # Rounded half away from zero, so that both directions weigh the same.
        size = (abs(twice) * self._share + 65536) // 131072
        return size if twice >= 0 else -size

    def reset(self) -> None:
        """Forget the offsets collected so far (after the own slots have been set anew)."""
        self._offsets.clear()
        self.ignored_in_a_row = 0
