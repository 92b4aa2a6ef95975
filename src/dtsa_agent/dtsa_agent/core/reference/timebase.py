"""Which slot it is, where no channel says so: taken from the first frame heard, or from the own clock in silence.

No clock is read here: every method is told what the own clock shows. States::

    LISTENING --- a frame ---> JOINED            the frame says which slot it was sent in
        |                        ^  |
        | silence                |  +-- a frame of a later time: take that one, forget what was given away (RESTARTED)
        v                        |
      ALONE ------ a frame ------+               of the same time, or of a later one (RESTARTED)

Of two groups that meet the one whose slots have the larger numbers stays as it is, and the other takes its time over,
agent by agent, as each hears a first frame of it. Whoever changes its time knows nothing about the turns of the new
one: it has to restart its part of the protocol (``Swarm.restart``), which then uses its anchors only until it may take
part.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from .arithmetic import mix64

LISTENING, ALONE, JOINED = "listening", "alone", "joined"

# What came of a frame.
ALIGNED = "aligned"  # of the same time; the own slots may have moved a little
RESTARTED = "restarted"  # its time was taken over; whatever was known about turns is void
FOREIGN = "foreign"  # of an earlier time: its sender will come to us


@dataclass(slots=True)
class ClockAligner:
    """Turns arrival offsets of heard frames into small shifts of the own slots: ``slot_start += aligner.hear(offset)``.

    After every ``receptions`` usable offsets the own slots move by ``gain`` times their median. A median
    shrugs off single delays, and since everybody moves towards everybody else, the swarm agrees on a common
    time that drifts with the mean of its clocks. A correction of the frequency as well is not needed at
    crystal accuracy and lets the common time run away.
    """

    receptions: int = 9  # offsets per correction
    gain: float = 0.5  # share of the median by which the slots move
    limit_ns: int = 1_000_000  # ns; offsets beyond this, either way, are not trusted: a late frame, another swarm
    corrections: int = 0  # made so far
    ignored: int = 0  # offsets that were not trusted so far
    ignored_in_a_row: int = 0  # ... up to now: a clock that is off by more than the limit shows here
    offsets: list[int] = field(default_factory=list)

    def hear(self, offset_ns: int) -> int:
        """Take in one frame and return by how much the own slots move now, ns (0 most of the time).

        :param offset_ns: ns, when the frame arrived minus when the own clock expected it; positive: the
            sender is later.
        """
        if not -self.limit_ns <= offset_ns <= self.limit_ns:
            self.ignored += 1
            self.ignored_in_a_row += 1
            return 0
        self.ignored_in_a_row = 0
        self.offsets.append(offset_ns)
        if len(self.offsets) < self.receptions:
            return 0
        ordered, self.offsets = sorted(self.offsets), []
        middle = len(ordered) // 2
        twice = ordered[middle] + ordered[~middle]
        self.corrections += 1
        # In 1/65536, rounded half away from zero: the same on every machine, and both directions weigh the same.
        size = (abs(twice) * max(1, round(self.gain * 65536)) + 65536) // 131072
        return size if twice >= 0 else -size

    def reset(self) -> None:
        """Forget the offsets collected so far (after the own slots have been set anew)."""
        self.offsets.clear()
        self.ignored_in_a_row = 0


class TimeBase:
    """The slots of one agent on its own clock.

    :param anchor_every: M; everybody alive is heard within M N slots where nothing is lost.
    :param seed: seed of the run; with the id it decides how long to wait in silence.
    :param aligner: keeps the slots of a group together; default: a :class:`ClockAligner`.
    """

    def __init__(
        self, *, agents: int, anchor_every: int, slot_ns: int, agent: int, seed: int = 0,
        aligner: ClockAligner | None = None,
    ) -> None:  # fmt: skip
        self._slot_ns = slot_ns
        self._round_ns = anchor_every * agents * slot_ns
        # Spread over a whole round of anchors, so that one is the first and the others hear it while they still listen.
        self._wait_ns = self._round_ns + _mixed(seed, agent) % self._round_ns
        self._deadline_ns: int | None = None
        self._origin_ns = 0  # start of slot 0 by the own clock
        self.aligner = ClockAligner() if aligner is None else aligner
        self.state = LISTENING  # or ALONE, JOINED
        self.restarts = 0  # how often another time was taken over

    def start(self, now_ns: int) -> int:
        """Begin to listen; returns when to call :meth:`wake` at the latest, ns."""
        self.state = LISTENING
        self.aligner.reset()
        self._deadline_ns = now_ns + self._wait_ns
        return self._deadline_ns

    def wake(self, now_ns: int) -> bool:
        """Whether slots begin now because nothing has been heard for long; True once."""
        if self.state != LISTENING or self._deadline_ns is None or now_ns < self._deadline_ns:
            return False
        # Not slot 0: that is for agents that are told to start together and may speak at once.
        self._origin_ns = now_ns - self._round_ns
        self.state = ALONE
        return True

    def slot(self, now_ns: int) -> int | None:
        """The slot at a time; None while listening."""
        return None if self.state == LISTENING else (now_ns - self._origin_ns) // self._slot_ns

    def slot_start_ns(self, slot: int) -> int:
        """When a slot starts, ns, own clock. It may still move a little with what is heard."""
        return self._origin_ns + slot * self._slot_ns

    def hear(self, slot: int, start_ns: int) -> str:
        """Take in a frame; returns ALIGNED, RESTARTED or FOREIGN.

        :param start_ns: ns, own clock, when its transmission started: arrival minus airtime and link delays.
        """
        origin = start_ns - slot * self._slot_ns  # where the sender's slot 0 lies
        if self.state == LISTENING:
            self._origin_ns, self.state = origin, JOINED
            return RESTARTED
        ahead = self._origin_ns - origin
        if abs(ahead) < self._slot_ns // 2:
            # Slot starts move towards the sender's: a frame that came later than expected moves them back.
            self._origin_ns += self.aligner.hear(-ahead)
            self.state = JOINED
            return ALIGNED
        if ahead < 0:
            return FOREIGN
        self.aligner.reset()
        self._origin_ns, self.state = origin, JOINED
        self.restarts += 1
        return RESTARTED


def _mixed(seed: int, agent: int) -> int:
    """A number that looks random, of 64 bits."""
    return mix64(seed * 0x9E3779B97F4A7C15 + agent * 0xD1B54A32D192ED03 - 0x9E3779B97F4A7C15)
