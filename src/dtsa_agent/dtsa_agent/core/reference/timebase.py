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

from .alignment import ClockAligner
from .arithmetic import mix64

LISTENING, ALONE, JOINED = "listening", "alone", "joined"

# What came of a frame.
ALIGNED = "aligned"  # of the same time; the own slots may have moved a little
RESTARTED = "restarted"  # its time was taken over; whatever was known about turns is void
FOREIGN = "foreign"  # of an earlier time: its sender will come to us


class TimeBase:
    """The slots of one agent on its own clock.

    :param agents: number of agents N.
    :param anchor_every: M; everybody alive is heard within M N slots where nothing is lost.
    :param slot_ns: length of a slot, ns.
    :param agent: own id.
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
        """Begin to listen; returns when to call :meth:`wake` at the latest, ns.

        :param now_ns: ns, own clock.
        """
        self.state = LISTENING
        self._aligner.reset()
        self._deadline_ns = now_ns + self._wait_ns
        return self._deadline_ns

    def wake(self, now_ns: int) -> bool:
        """Whether slots begin now because nothing has been heard for long; True once.

        :param now_ns: ns, own clock.
        """
        if self.state != LISTENING or self._deadline_ns is None or now_ns < self._deadline_ns:
            return False
        # Not slot 0: that is for agents that are told to start together and may speak at once.
        self._origin_ns = now_ns - self._round_ns
        self.state = ALONE
        return True

    def slot(self, now_ns: int) -> int | None:
        """The slot at a time; None while listening.

        :param now_ns: ns, own clock.
        """
        return None if self.state == LISTENING else (now_ns - self._origin_ns) // self._slot_ns

    def slot_start_ns(self, slot: int) -> int:
        """When a slot starts, ns, own clock. It may still move a little with what is heard.

        :param slot: number of the slot.
        """
        return self._origin_ns + slot * self._slot_ns

    def hear(self, slot: int, start_ns: int) -> str:
        """Take in a frame; returns ALIGNED, RESTARTED or FOREIGN.

        :param slot: slot that the frame says it was sent in.
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
