"""Senders that listen first, on the simulated channel, with one receiver that never sends: agent 1."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.plugins.entry_points import make_swarm, plug_ins_of
from dtsa_agent.core.plugins.guard import Guarded
from dtsa_agent.core.plugins.kinds import Radio
from dtsa_agent.core.plugins.table import Table
from dtsa_bench.simulation.unslotted import UnslottedTraffic
from dtsa_channel_sim import ChannelConfig

from .carry import NotingChannel

_US = 1_000  # ns
_NEVER_NS = 10**15
#: IEEE 802.15.4 at 2.4 GHz: unit of the back-off, time of listening; 20 and 8 symbols of 16 us.
BACKOFF_NS, LISTEN_NS = 320 * _US, 128 * _US


def waits_ns(seed: int, agent: int, mean_ns: float, count: int) -> NDArray[np.int64]:
    """How long a sender waits before each of its frames: (count,) ns, exponentially distributed.

    :param seed: of the run.
    :param agent: id of the sender.
    :param mean_ns: ns.
    :param count: of frames.
    """
    random = np.random.default_rng([seed, 15, agent])
    return 1 + random.exponential(mean_ns, count).astype(np.int64)


class CsmaCa:
    """Unslotted CSMA/CA of IEEE 802.15.4, as a policy: this soak's own, beside ns-3's.

    A sender waits for a whole number of back-off units, from 0 to 2^BE - 1, then listens for 8 symbols. It sends if the
    air is free at the end of that, as in ns-3 3.44. Otherwise BE grows by 1, up to ``max_be``, and it tries again. It
    gives a frame up that has found the air in use more than ``backoffs`` times, and goes on with the next. Options
    beside these: ``min_be``; ``mean_ms`` between a frame's end and the next frame; ``sent_ms`` from the order to send
    to the last bit.
    """

    options = ("mean_ms", "min_be", "max_be", "backoffs", "sent_ms")
    port = ("send", "sent", "received", "busy")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        given = {name: config.options[f"csma-ca.{name}"] for name in self.options}
        self._min_be, self._max_be, self._backoffs = (int(given[name]) for name in ("min_be", "max_be", "backoffs"))
        self._sent_ns = round(given["sent_ms"] * 1e6)
        self._waits = iter(waits_ns(config.seed, agent, given["mean_ms"] * 1e6, 100_000).tolist())
        self._random = np.random.default_rng([config.seed, 154, agent])
        self._begun = False
        self._tries, self._be = 0, self._min_be  # back-offs for the present frame
        self.handed_ns = 0
        """When the present frame was handed over."""
        self.given_up = 0
        """Number of frames."""

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Hands a frame over to the radio."""
        if self._begun:
            self.handed_ns = now_ns
            radio.send()
            return now_ns + 1
        self._begun = True
        return now_ns + next(self._waits)

    def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> int:
        """Begins, or waits and listens again."""
        if not self._tries:  # the frame has just come, so the air does not count
            return self._try_again(0)
        if not busy:
            self._tries, self._be = 0, self._min_be
            return 0
        self._be = min(self._be + 1, self._max_be)
        if self._tries <= self._backoffs:
            return self._try_again(0)
        self.given_up += 1
        self._tries, self._be = 0, self._min_be
        after_ns = next(self._waits)
        self.handed_ns = now_ns + after_ns
        return self._try_again(after_ns)

    def _try_again(self, after_ns: int) -> int:
        self._tries += 1
        return after_ns + BACKOFF_NS * int(self._random.integers(2**self._be)) + LISTEN_NS

    def sent(self, table: Table, now_ns: int) -> int:
        """Waits from the frame's end."""
        return now_ns + self._sent_ns + next(self._waits)


@dataclass(slots=True)
class Contention:
    """What came of it."""

    sent: list[tuple[int, int, int]] = field(default_factory=list)  # sender, ns handed over, ns of the last bit
    heard: list[int] = field(default_factory=list)  # ns of the last bit, at agent 1
    given_up: int = 0
    listened: int = 0  # times, by all senders


def contend(swarm_config: SwarmConfig, config: ChannelConfig, slots: int) -> Contention:
    """Lets all agents but the first one contend; nobody flies.

    :param swarm_config: the swarm, with its policy.
    :param config: the channel.
    :param slots: length of the run.
    """
    swarm, found = make_swarm(swarm_config), Contention()
    channel = NotingChannel(config)
    parts = plug_ins_of(swarm)
    assert parts is not None
    for agent, policy in enumerate(parts.policies, 1):
        _watched(agent, policy, config.airtime.total_ns(swarm_config.frame_length), found)
    traffic = UnslottedTraffic(swarm, channel)
    for slot in range(slots):
        traffic.slot(slot)
    found.heard = [frame.end_ns for frame, reception in channel.notes if reception.received[0]]
    found.given_up = sum(getattr(policy.made, "given_up", 0) for policy in parts.policies)
    return found


def _watched(agent: int, policy: Guarded, sent_ns: int, found: Contention) -> None:
    """Notes when frames are handed over and sent; agent 1 sends none."""
    wake, sent, sensed, made = policy.wake, policy.sent, policy.sensed, policy.made
    handed = [0]

    class Noting:
        def __init__(self, radio: Radio, now_ns: int) -> None:
            self._radio, self._now_ns = radio, now_ns

        def send(self) -> bool:
            handed[0] = self._now_ns
            return self._radio.send()

    def note_wake(table: Table, now_ns: int, radio: Radio) -> Any:
        return wake(table, now_ns, Noting(radio, now_ns)) if agent > 1 else now_ns + _NEVER_NS

    def note_sent(table: Table, now_ns: int) -> Any:
        found.sent.append((agent - 1, getattr(made, "handed_ns", handed[0]), now_ns + sent_ns))
        return sent(table, now_ns)

    def note_sensed(busy: bool, now_ns: int, sent_ns: int) -> Any:
        found.listened += 1
        return sensed(busy, now_ns, sent_ns)

    policy.wake, policy.sent, policy.sensed = note_wake, note_sent, note_sensed
