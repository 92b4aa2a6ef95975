"""The channel: takes what is sent in a slot and says who receives it.

Pure code: no clock, no I/O. The node, the Monte Carlo engine and the verifier use this one implementation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError, LocalProtocolError

from .config import ChannelConfig
from .medium import Medium, OnAir
from .schedule import Change, Timeline
from .verdict import COLLISION, IDLE, SUCCESS, Verdict

Positions = NDArray[np.float64]


class Channel:
    """One radio channel that all agents share.

    Same settings, same changes, same calls: same verdicts. The losses of a slot depend on the seed, the slot
    and the link alone, so slots may be skipped or looked at again.

    :param config: the settings.
    """

    __slots__ = (
        "_airtime", "_alone", "_end", "_first", "_idle", "_last", "_losses", "_medium", "_near", "_shared", "_simple",
        "_spills", "_timeline", "config",
    )  # fmt: skip

    def __init__(self, config: ChannelConfig) -> None:
        self.config = config
        self._timeline = Timeline(config)
        self._airtime = config.airtime
        self._near: list[OnAir] = []  # of the slots before, what outlasts them
        self._last = -1
        # A frame sent at the slot's start may be longer than the slot.
        self._spills = self._airtime.total_ns(self._airtime.longest) > config.slot_ns
        self._idle = Verdict(IDLE, (), None, None, None)
        self._alone = {i: Verdict(SUCCESS, (i,), None, None, None) for i in range(1, config.agents + 1)}
        self._use(0)

    def set(self, *, slot: int | None = None, **values: Any) -> Change:
        """Change settings while the channel runs; return the change, to be recorded and made again.

        :param slot: first slot with the new values; None: the one after the last slot arbitrated.
        :param values: new values by name, of :data:`~dtsa_channel_sim.model.config.CHANGEABLE` settings.
        :raises ConfigError: when a value is not allowed, or the slot has already been arbitrated. Nothing is
            changed then.
        """
        if slot is None:
            slot = self._last + 1
        elif slot <= self._last:
            raise ConfigError("slot", slot, f"a slot that is still to come, {self._last + 1} or later")
        if not values:
            raise ConfigError("channel.set", values, "at least one setting to change")
        now = self._timeline.at(slot).config.changed(values)
        change = Change(slot, tuple((name, getattr(now, name)) for name in values))
        self._timeline.add(change)
        self._end = self._first  # look the settings up again
        return change

    def advance(self, slot: int) -> None:
        """Note that a slot has been dealt with (on an ``Air``): later changes of settings begin after it.

        :param slot: its number.
        """
        self._last = max(self._last, slot)

    def arbitrate(
        self, slot: int, senders: Sequence[int], lengths: Sequence[int] | None = None,
        positions: Positions | None = None,
    ) -> Verdict:  # fmt: skip
        """Return who received what in one slot.

        :param slot: number of the slot, 0 or more; usually one after the other.
        :param senders: ids (1 to N) of the agents that send in it, each once.
        :param lengths: bytes of each frame; None: nothing outlasts its slot. A frame that is still on air when its
            slot ends disturbs the next slot's frames; its own verdict has been given by then (an
            :class:`~dtsa_channel_sim.model.air.Air` waits with it).
        :param positions: (3, N), m, frame map; needed with a limited range or capture.
        :raises LocalProtocolError: when the arguments do not go together.
        """
        if not self._first <= slot < self._end:
            self._use(slot)
        last, self._last = self._last, slot
        if self._simple and not self._near:
            if len(senders) == 1 and senders[0] in self._alone:
                alone = self._alone[senders[0]]
                return alone if self._losses.none else self._arbitrate_one(slot, alone)
            if not len(senders):
                return self._idle
        if slot <= last:
            self._near = []
        return self._arbitrate_many(slot, senders, lengths, positions)

    def medium(self, slot: int) -> Medium:
        """Return the medium of a slot, with the settings that hold in it.

        :param slot: its number, 0 and more.
        """
        if not self._first <= slot < self._end:
            self._use(slot)
        return self._medium

    def fill_losses(self, slot: int, losses: Any) -> int:
        """Tell C which receivers lose a frame that is alone in its slot.

        :param losses: a ``sim_losses`` (``libdtsa_sim/run.h``), which is filled in.
        :returns: the slot up to which that holds; 0: :meth:`arbitrate` has to say what becomes of this slot's frames.
        """
        if not self._first <= slot < self._end:
            self._use(slot)
        return min(self._end, self._losses.fill(slot, losses)) if self._simple else 0

    def _use(self, slot: int) -> None:
        """Make the settings of a slot the present ones."""
        if slot < 0:
            raise LocalProtocolError(f"slot {slot}: slots count from 0")
        self._first, self._end, config = self._timeline.at(slot)
        self._medium = Medium(config)
        self._losses = self._medium.losses
        # Frames that start with their slot and do not outlast it, everybody in reach: no look at times and
        # places.
        self._shared = self._medium.everywhere and not self._spills
        self._simple = self._shared and not config.jam

    def _arbitrate_one(self, slot: int, alone: Verdict) -> Verdict:
        """Return the verdict on the only frame of a slot, everybody in reach."""
        (sender,) = alone.senders
        received = ~self._losses.lost(slot, sender)
        received[sender - 1] = False
        missing = len(self._alone) - 1 - int(np.count_nonzero(received))
        return Verdict(SUCCESS, alone.senders, received[None], (missing,), (0,)) if missing else alone

    def _arbitrate_many(
        self, slot: int, given: Sequence[int], lengths: Sequence[int] | None, positions: Positions | None
    ) -> Verdict:
        """Return the verdict on any number of frames, in full generality."""
        agents, start_ns, end_ns = len(self._alone), slot * self.config.slot_ns, (slot + 1) * self.config.slot_ns
        senders = tuple(map(int, given))
        for sender in senders:
            if sender not in self._alone:
                raise LocalProtocolError(f"sender {sender}: ids run from 1 to {agents}")
        if len(set(senders)) != len(senders):
            raise LocalProtocolError(f"senders {senders}: an agent sends once in a slot")
        if self._shared and not self._near and len(senders) > 1:
            others = (agents - 1,) * len(senders)
            return Verdict(COLLISION, senders, np.zeros((len(senders), agents), np.bool_), (0,) * len(senders), others)
        if lengths is None:
            frames = [OnAir(sender, start_ns, start_ns, end_ns) for sender in senders]
        elif len(lengths) == len(senders):
            sizes = zip(senders, map(int, lengths), strict=True)
            frames = [OnAir.of(self._airtime, sender, start_ns, length) for sender, length in sizes]
        else:
            raise LocalProtocolError(f"lengths: {len(lengths)} values for {len(senders)} frames")
        on_air = [*self._near, *frames]
        self._near = [frame for frame in on_air if frame.end_ns > end_ns]
        receptions = [
            self._medium.resolve(slot, frame, [other for other in on_air if other is not frame], positions)
            for frame in frames
        ]
        return Verdict.of(senders, receptions)
