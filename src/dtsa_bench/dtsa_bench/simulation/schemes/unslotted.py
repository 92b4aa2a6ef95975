"""Schemes without slots."""

from __future__ import annotations

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.plugins import Table
from dtsa_bench.simulation.unslotted import Radio
from dtsa_channel_sim.model.airtime import Airtime

from .knowledge import has_arrived

_MS = 1_000_000  # ns


def _random(config: SwarmConfig, agent: int, stream: int) -> np.random.Generator:
    return np.random.default_rng([config.seed, stream, agent])


class Beacons:
    """Every agent sends at a fixed rate, by a timer of its own that begins at random (Bitcraze's decentralised demo).

    Options: ``beacons.period_ms`` (N slots: as many frames as TDMA; the demo's is 100) and ``beacons.jitter_ms`` (0: of
    each period, up to so much more or less).
    """

    options = ("period_ms", "jitter_ms")
    may_join = True
    port = ("send", "received")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self._period_ns = max(1, round(config.options.get("beacons.period_ms", config.agents * config.slot_ms) * _MS))
        self._jitter_ns = config.options.get("beacons.jitter_ms", 0.0) * _MS
        self._random = _random(config, agent, 10)
        self._begun = False

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Sends, and waits for a period."""
        if not self._begun:
            self._begun = True
            return now_ns + 1 + int(self._random.random() * self._period_ns)
        radio.send()
        jitter = round(self._random.uniform(-1.0, 1.0) * self._jitter_ns) if self._jitter_ns else 0
        return now_ns + max(1, self._period_ns + jitter)


class PureAloha:
    """Every agent sends at random instants: a Poisson process each. At most 1 / (2 e) of the air carries whole frames.

    Option: ``pure-aloha.load``: frames begun by all agents in the time of one frame; unless said, one a slot.
    """

    options = ("load",)
    may_join = True
    port = ("send", "received")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        frame_ns = Airtime().on_air_ns(config.frame_length)
        load = max(1e-6, config.options.get("pure-aloha.load", frame_ns / config.slot_ns))
        self._mean_ns = frame_ns * config.agents / load
        self._random = _random(config, agent, 1970)
        self._begun = False

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Sends, and waits for an exponentially distributed time."""
        if self._begun:
            radio.send()
        self._begun = True
        return now_ns + 1 + int(self._random.exponential(self._mean_ns))


class Csma:
    """Non-persistent carrier sense (Kleinrock and Tobagi 1975) whose back-off shrinks with the age of its last frame.

    Where the air is free at the end of a wait, it sends, and waits for half to one and a half periods; else it waits
    from zero to a window divided by the age of its last frame in periods. Agents at rest send every tenth period.
    Options: ``csma.period_ms`` (N slots) and ``csma.window_ms`` (N times 0.25 ms).
    """

    options = ("period_ms", "window_ms")
    may_join = True
    port = ("send", "sent", "received", "busy")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self._period_ns = max(1.0, config.options.get("csma.period_ms", config.agents * config.slot_ms) * _MS)
        self._window_ns = max(1.0, config.options.get("csma.window_ms", 0.25 * config.agents) * _MS)
        self._random = _random(config, agent, 1975)
        self._agent, self._r_min = agent, config.r_min
        self._begun = self._rests = False

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Hands a frame over to the radio, which listens first."""
        if self._begun:
            radio.send()
            self._rests = has_arrived(table, self._r_min) and not table.in_ap[self._agent - 1]
            return now_ns + 1  # does not count: the radio says when
        self._begun = True
        return now_ns + 1 + int(self._random.random() * self._period_ns)

    def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> int:
        """Begins if the air is free, else waits."""
        if not busy:
            return 0
        periods_old = max(0.1, (now_ns - sent_ns) / self._period_ns)
        return 1 + int(self._random.random() * self._window_ns / periods_old)

    def sent(self, table: Table, now_ns: int) -> int:
        """Waits for a period."""
        rest = 10.0 if self._rests else 1.0
        return now_ns + 1 + int(self._random.uniform(0.5, 1.5) * self._period_ns * rest)
