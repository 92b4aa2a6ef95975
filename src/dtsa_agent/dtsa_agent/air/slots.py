"""Which slot it is for an agent on a network: a time base, and what makes it doubt a first frame that left late."""

from __future__ import annotations

from dtsa_agent.core.reference.alignment import ClockAligner
from dtsa_agent.core.reference.timebase import ALIGNED, LISTENING, TimeBase
from dtsa_agent.core.settings.config import SwarmConfig

_DOUBTS = 9  # frames in a row that do not fit the time that an agent has


class SlotTime(TimeBase):
    """A :class:`TimeBase` that takes the time of its own group anew when it fits nobody's.

    The frame that an agent has taken its time from may have left late, by less than half a slot but more than the
    alignment believes. Slot numbers stay as they are then, and so does what is known about turns.

    :param config: the settings that all agents share.
    :param agent: own id.
    :param trust_ns: ns by which a frame may be off its slot and still say what time it is.
    """

    __slots__ = ("_aligner_of_own", "corrected")

    def __init__(self, config: SwarmConfig, agent: int, trust_ns: int = 1_000_000) -> None:
        self._aligner_of_own = ClockAligner(limit_ns=trust_ns)
        #: How often the time of the own group was taken anew.
        self.corrected = 0
        super().__init__(
            agents=config.agents,
            anchor_every=config.anchor_every,
            slot_ns=config.slot_ns,
            agent=agent,
            seed=config.seed,
            aligner=self._aligner_of_own,
        )

    def hear(self, slot: int, start_ns: int) -> str:
        """As of :class:`TimeBase`.

        :param slot: slot that the frame says it was sent in.
        :param start_ns: ns, own clock, when its transmission started.
        """
        outcome = super().hear(slot, start_ns)
        if outcome == ALIGNED and self._aligner_of_own.ignored_in_a_row >= _DOUBTS:
            self._aligner_of_own.reset()
            self.state = LISTENING  # for this frame
            super().hear(slot, start_ns)
            self.corrected += 1
        return outcome

    @property
    def corrections(self) -> int:
        """How often the own slots have been moved a little."""
        return self._aligner_of_own.corrections
