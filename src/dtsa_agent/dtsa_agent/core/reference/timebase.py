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

from dtsa_agent.core.errors import ConfigError

from .arithmetic import mix64

LISTENING, ALONE, JOINED = "listening", "alone", "joined"

# What came of a frame.
ALIGNED = "aligned"  # of the same time; the own slots may have moved a little
RESTARTED = "restarted"  # its time was taken over; whatever was known about turns is void
FOREIGN = "foreign"  # of an earlier time: its sender will come to us


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

    __slots__ = ("_limit_ns", "_offsets", "_receptions", "_share", "corrections", "ignored", "ignored_in_a_row")

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


class TimeBase:
    """The slots of one agent on its own clock.

    :param anchor_every: M; everybody alive is heard within M N slots where nothing is lost.
    :param seed: seed of the run; with the id it decides how long to wait in silence.
    :param aligner: keeps the slots of a group together; default: a :class:`ClockAligner`.
    :raises ConfigError: when a parameter is out of range.
    """

    __slots__ = ("_aligner", "_deadline_ns", "_origin_ns", "_round_ns", "_slot_ns", "_wait_ns", "restarts", "state")

    def __init__(
        self,
        *,
        agents: int,
        anchor_every: int,
        slot_ns: int,
        agent: int,
        seed: int = 0,
        aligner: ClockAligner | None = None,
    ) -> None:
        for name, value in (("agents", agents), ("anchor_every", anchor_every), ("slot_ns", slot_ns), ("agent", agent)):
            if value < 1:
                raise ConfigError(name, value, "a whole number of 1 or more")
        self._slot_ns = slot_ns
        self._round_ns = anchor_every * agents * slot_ns
        # Spread over a whole round of anchors, so that one is the first and the others hear it while they still listen.
        self._wait_ns = self._round_ns + _mixed(seed, agent) % self._round_ns
        self._aligner = ClockAligner() if aligner is None else aligner
        self._deadline_ns: int | None = None
        self._origin_ns = 0  # start of slot 0 by the own clock
        #: LISTENING, ALONE or JOINED.
        self.state = LISTENING
        #: How often another time was taken over.
        self.restarts = 0

    def start(self, now_ns: int) -> int:
        """Begin to listen; returns when to call :meth:`wake` at the latest, ns."""
        self.state = LISTENING
        self._aligner.reset()
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
            self._origin_ns += self._aligner.hear(-ahead)
            self.state = JOINED
            return ALIGNED
        if ahead < 0:
            return FOREIGN
        self._aligner.reset()
        self._origin_ns, self.state = origin, JOINED
        self.restarts += 1
        return RESTARTED


def _mixed(seed: int, agent: int) -> int:
    """A number that looks random, of 64 bits."""
    return mix64(seed * 0x9E3779B97F4A7C15 + agent * 0xD1B54A32D192ED03 - 0x9E3779B97F4A7C15)
