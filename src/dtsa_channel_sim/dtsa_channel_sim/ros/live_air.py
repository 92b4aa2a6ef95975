"""The air of a run in real time: frames are handed over ahead, and settled when they have left the air."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from heapq import heappop, heappush
from typing import Any, NamedTuple

import numpy as np

from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_agent.plugin_watch import watched
from dtsa_channel_sim.model.air import NEVER, Air, FrameVerdict
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.medium import Positions
from dtsa_channel_sim.model.radios import Radios, radio_rules
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS, Verdict

Sent = tuple[int, int]  # a frame: its slot as its sender counts, and the sender's id

_GRACE = 0.05  # of a slot: frames are handed over ahead of their start; who is late by less than this still collides
_WINDOW = 0.5  # of a slot: a frame that reaches the channel later than this after its start is dropped
_BEFORE = -(2**63)  # ns


class Begun(NamedTuple):
    """A frame that goes on the air."""

    key: Sent
    """The frame."""
    data: bytes
    """Its bytes."""
    start_ns: int
    """When its transmission starts, ns from the start of slot 0."""


class LiveAir:
    """One time line of frames, and the radios that hold those that may not begin yet.

    Time is settled a little behind the clock, when all that was handed over in time is known. Radios that listen do so
    then, one after the other in the order of their times, so none of them misses a frame that has begun before.

    :param channel: the medium.
    """

    def __init__(self, channel: Channel) -> None:
        config = channel.config
        self.air: Air[Sent] = Air(channel)
        # A delivery may come no earlier than the frame arrives.
        self.hold_ns = max(round(_GRACE * config.slot_ns), config.airtime.from_radio_ns(0))
        self.late = 0  # frames that came when the air had been settled past their start, and were dropped
        self.given_up = 0  # frames whose radios found no free air for a slot
        self._window_ns = round(_WINDOW * config.slot_ns)
        self._slot_ns = config.slot_ns
        self._frames: dict[Sent, bytes] = {}
        self._arriving: list[tuple[int, int, FrameVerdict[Sent]]] = []  # what lines still carry: a heap by arrival
        self._count = 0
        self._settled_ns = _BEFORE
        self._radios: Radios[Sent] | None = None
        self._held: dict[int, tuple[Sent, bytes]] = {}  # by id of the radio's agent
        self._listened_ns = _BEFORE  # what radios did before this is known

    @property
    def listens(self) -> bool:
        """Whether the radios listen before they send."""
        return self._radios is not None

    @property
    def waits(self) -> bool:
        """Whether a frame waits for its delivery."""
        return bool(self.air.pending or self._arriving)

    @property
    def patience_ns(self) -> int:
        """ns, for which a radio that listens tries to send a frame."""
        return self._slot_ns if self.listens else 0

    @contextmanager
    def radios(self, agreed: Mapping[str, Any]) -> Iterator[None]:
        """Within, agents have radios that listen before they send, if their policy asks for them.

        :param agreed: settings that all agents share, as plain values.
        :raises ConfigError: if the policy cannot be used here.
        """
        if "policy" not in agreed or not POLICIES.row(agreed["policy"]).listens:
            yield
            return
        known = {setting.name for setting in settings_of(SwarmConfig)}
        config = SwarmConfig.from_dict({name: value for name, value in agreed.items() if name in known})
        with watched(config):
            self._radios = Radios(self.air, radio_rules(config))
            yield

    def holds(self, key: Sent) -> bool:
        """Whether a frame has been handed over, and has no verdict that was asked for yet."""
        held = self._held.get(key[1])
        return key in self._frames or (held is not None and held[0] == key)

    def hand_over(self, key: Sent, start_ns: int, data: bytes) -> Begun | None:
        """Takes a frame, in place of one that its radio holds.

        :param key: the frame.
        :param start_ns: when it is to begin, ns from the start of slot 0; a radio that listens does so then.
        :param data: its bytes.
        :returns: the frame, if it goes on the air; None: its radio listens first, or it came too late.
        """
        if self._radios is None:
            return self._begin(key, start_ns, data)
        until_ns, agent = start_ns + self._slot_ns, key[1]
        if until_ns < self._listened_ns:
            self.late += 1
            return None
        self.given_up += agent in self._held
        self._held[agent] = key, data
        self._radios.hand_over(agent, max(start_ns, self._listened_ns), until_ns)
        return None

    def _begin(self, key: Sent, start_ns: int, data: bytes) -> Begun | None:
        if not self.air.begin(key, key[1], start_ns, len(data)):
            self.late += 1
            return None
        self._frames[key] = data
        return Begun(key, data, start_ns)

    def listen(self, now: int, positions: Positions) -> Iterator[Begun]:
        """Lets the radios listen whose time has come.

        :param now: ns from the start of slot 0.
        :param positions: (3, N), m, frame map.
        :returns: the frames that go on the air.
        :raises PluginError: if a policy tells its radio what cannot be.
        """
        if self._radios is None:
            return
        ripe = now - self.hold_ns
        while self._radios.next[0] <= ripe:
            released = self._radios.listen(positions)
            if released is None:
                continue
            key, data = self._held.pop(released.agent)
            begun = self._begin(key, released.now_ns, data) if released.begun else None
            if begun is None:
                self.given_up += 1
            else:
                yield begun
        self._listened_ns = max(self._listened_ns, ripe)

    def settle(self, now: int, positions: Positions) -> list[FrameVerdict[Sent]]:
        """The verdicts on all frames that have arrived; after :meth:`listen`.

        :param now: ns from the start of slot 0.
        :param positions: (3, N), m, frame map.
        """
        ripe, late = now - self.hold_ns, now - max(self.hold_ns, self._window_ns)
        while (due := self.air.due_ns) <= ripe:
            self._settle(due, positions)
        self._settle(late, positions)
        arrived = []
        while self._arriving and self._arriving[0][0] <= now:
            arrived.append(heappop(self._arriving)[2])
        return arrived

    def _settle(self, until_ns: int, positions: Positions) -> None:
        if until_ns <= self._settled_ns:
            return
        self._settled_ns = until_ns
        for verdict in self.air.settle(until_ns, positions):
            self._count += 1
            heappush(self._arriving, (verdict.arrival_ns, self._count, verdict))

    def frame(self, key: Sent) -> bytes:
        """The bytes of a frame that is or was on the air.

        :param key: the frame.
        """
        return self._frames[key]

    def forget(self, key: Sent) -> bytes:
        """The same, for the last time."""
        return self._frames.pop(key)

    def spare_ns(self, now: int, most_ns: int) -> int:
        """For how long there is nothing to do, ns.

        :param now: ns from the start of slot 0.
        :param most_ns: ns, at most.
        """
        due = self.air.due_ns
        if self._radios is not None:
            due = min(due, self._radios.next[0])
        arrival = self._arriving[0][0] if self._arriving else NEVER
        return min(max(0, min(due + self.hold_ns, arrival) - now), most_ns)


def slot_verdict(settled: Sequence[FrameVerdict[Sent]]) -> Verdict:
    """What the air did in a slot, frame by frame.

    :param settled: the verdicts on its frames.
    """
    if not settled:
        return Verdict(IDLE, (), None, None, None)
    return Verdict(
        COLLISION if any(verdict.collided for verdict in settled) else SUCCESS,
        tuple(verdict.sender for verdict in settled),
        np.array([verdict.received for verdict in settled]),
        tuple(verdict.lost for verdict in settled),
        tuple(verdict.collided for verdict in settled),
    )
