"""Which flights the demo consists of, and what each step says."""

from __future__ import annotations

from dataclasses import dataclass

from dtsa_agent.core import SwarmConfig
from dtsa_bench.runs.config import REALTIME, RunConfig, RunLimits, from_swarm
from dtsa_channel_sim import ChannelConfig

AGENTS = 12
LOSS = 0.1
LIVE_AGENTS, LIVE_SLOT_MS = 4, 6.0  # few processes and short slots: what is shown takes 1040 slots
KILLED = 3  # id of the agent that is killed


@dataclass(frozen=True, slots=True)
class Take:
    """One flight of the demo."""

    key: str  # name of its directory
    scheme: str  # as readers know it
    run: RunConfig

    @property
    def live(self) -> bool:
        """Whether it is flown in real time, with a process for each agent."""
        return self.run.mode == REALTIME


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the story: flights that are compared."""

    letter: str
    title: str  # one sentence: what is to be seen
    takes: tuple[Take, ...]

    @property
    def number(self) -> int:
        """Its place in the story, from 1."""
        return "abcd".index(self.letter) + 1


def _take(
    key: str, scheme: str, policy: str, moving: int, seed: int, estimator: str = "linear", loss: float = 0
) -> Take:
    swarm = SwarmConfig(agents=AGENTS, moving=moving, policy=policy, estimator=estimator, seed=seed)
    return Take(key, scheme, RunConfig(swarm, ChannelConfig(loss=loss, **from_swarm(swarm))))


def _live(seed: int) -> Take:
    swarm = SwarmConfig(
        agents=LIVE_AGENTS, policy="lease", slot_ms=LIVE_SLOT_MS, seed=seed,
        scenario="waypoints", stops=100, pause_slots=0, axis_x_m=6.0,
    )  # fmt: skip
    limits = RunLimits(timeout_s=60.0, stop_on_crash=False)
    return Take("killed-lease", "lease", RunConfig(swarm, limits=limits, mode=REALTIME))


def story(seed: int) -> tuple[Step, ...]:
    """The steps of the demo.

    :param seed: of all flights.
    """
    return (
        Step(
            "a",
            "Between two messages, let the others fly on.",
            (
                _take("all-tdma-hold", "TDMA", "tdma", 12, seed, "hold"),
                _take("all-tdma", "TDMA + extrapolation", "tdma", 12, seed),
            ),
        ),
        Step(
            "b",
            "Let those speak who have something to say.",
            (
                _take("two-tdma", "TDMA", "tdma", 2, seed),
                _take("two-dtsa", "DTSA", "dtsa", 2, seed),
                _take("two-lease", "lease", "lease", 2, seed),
            ),
        ),
        Step(
            "c",
            "Lose one message in ten, and DTSA falls apart.",
            (
                _take("loss-tdma", "TDMA", "tdma", 4, seed, loss=LOSS),
                _take("loss-dtsa", "DTSA", "dtsa", 4, seed, loss=LOSS),
                _take("loss-lease", "lease", "lease", 4, seed, loss=LOSS),
            ),
        ),
        Step(
            "d",
            "One is killed in flight, and comes back.",
            (_live(seed),),
        ),
    )
