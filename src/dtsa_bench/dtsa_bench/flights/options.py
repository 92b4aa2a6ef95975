"""How a flight is carried out: its options, and the processes in which its agents live; also for the launch file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import check, setting
from dtsa_agent.ros.common import names
from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_channel_sim import make_clocks
from dtsa_channel_sim.model.config import AnswerLimits

# Where there is no real-time priority: agents give way to the channel, which goes first where it may.
AGENTS_NICE, CHANNEL_NICE = 5, -10


@dataclass(frozen=True, slots=True)
class FlightOptions(AnswerLimits):
    """How a flight is carried out; none of it changes what happens in it.

    :raises ConfigError: for values that are not allowed.
    """

    processes: int | None = setting(
        None, "the agents live in so many processes; None: one an agent", minimum=1, maximum=1024
    )
    domain: int | None = setting(None, "ROS_DOMAIN_ID of the flight; None: a free one", minimum=0, maximum=232)
    respawn: float | None = setting(
        None,
        "real time: a process that died is started again after so long, and its agents come back; default: never",
        unit="s", minimum=0, maximum=3600,
    )  # fmt: skip
    late: Mapping[int, float] = setting(
        {}, "real time: agents that are started so long after slot 0, s by id", kind="structure", custom=True
    )
    wall_timeout_s: float | None = setting(
        None,
        "a flight that takes longer by the clock on the wall is ended; default: ten times timeout_s, at least 120",
        unit="s", minimum=1, maximum=864000,
    )  # fmt: skip
    priority: int = setting(
        10, "real time: real-time priority of the agents, one more for the channel, where allowed; 0: none",
        minimum=0, maximum=90,
    )  # fmt: skip
    pictures: bool = setting(True, "draw trajectories.png")

    def wall_limit_s(self, timeout_s: float) -> float:
        """How long a flight may take by the clock on the wall, s."""
        return max(120.0, 10.0 * timeout_s) if self.wall_timeout_s is None else self.wall_timeout_s

    def __post_init__(self) -> None:
        check(self)
        if not all(0.0 <= seconds <= 86400.0 for seconds in self.late.values()):
            raise ConfigError("late", self.late, "0 to 86400 s after slot 0")


@dataclass(frozen=True, slots=True)
class AgentProcess:
    """One process with some agents in it."""

    executable: str  # of dtsa_agent
    namespace: str
    node: str  # its name
    ids: tuple[int, ...]
    parameters: dict[str, Any]


def process_count(text: str, agents: int) -> int | None:
    """Return in how many processes agents live, from ``per-agent`` or a number; None: one an agent."""
    if text == "per-agent":
        return None
    if not text.isdecimal() or not 1 <= int(text) <= agents:
        raise ConfigError("processes", text, f"per-agent, or 1 to {agents}, the number of agents")
    return int(text)


def agent_processes(
    run: RunConfig, processes: int | None, priority: int, space: str = names.SWARM
) -> list[AgentProcess]:
    """Return the processes in which a run's agents live, with real-time priority unless it is 0.

    ``processes``: how many, with as many agents each as can be; None: one an agent.
    """
    agents = run.swarm.agents
    clocks, airtime = make_clocks(run.clocks, agents), run.air.airtime
    under_way = [airtime.total_ns(length) + airtime.from_radio_ns(length) for length in (0, 1)]
    bounds = [agents * number // (processes or agents) for number in range((processes or agents) + 1)]
    result = []
    for number, (first, last) in enumerate(pairwise(bounds), 1):
        own: dict[str, Any] = {} if run.mode == LOCKSTEP else {
            "clock_offset_ns": [clock.offset_ns for clock in clocks[first:last]],
            "clock_drift_ppb": [clock.drift_ppb for clock in clocks[first:last]],
            "clock_jitter_ns": float(run.clocks.jitter_ns),
            "align": run.align,
            "flight_time_ns": [under_way[0], under_way[1] - under_way[0]],
            "nice": AGENTS_NICE,
            "priority": priority,
        }  # fmt: skip
        ids = tuple(range(first + 1, last + 1))
        if processes is None:
            place = names.agent_namespace(number, space)
            result.append(AgentProcess("agent", place, "agent", ids, {"id": number, **own}))
        else:
            result.append(AgentProcess("swarm_host", space, f"swarm_host_{number}", ids, {"ids": list(ids), **own}))
    return result
