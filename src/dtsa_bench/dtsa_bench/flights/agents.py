"""The agents' processes of a run and what each is given, beside the swarm's settings; for `fly` and the launch file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.ros.common import names
from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_channel_sim import make_clocks

# Process priority in real time where there is no real-time priority: agents give way to the channel, which goes first
# where it may.
AGENTS_NICE, CHANNEL_NICE = 5, -10


@dataclass(frozen=True, slots=True)
class AgentProcess:
    """One process with some agents in it."""

    executable: str  # of dtsa_agent
    namespace: str
    node: str  # its name
    ids: tuple[int, ...]
    parameters: dict[str, Any]


def process_count(text: str, agents: int) -> int | None:
    """In how many processes agents live, from ``per-agent`` or a number; None: one an agent.

    :raises ConfigError: for another text, or more processes than agents.
    """
    if text == "per-agent":
        return None
    if not text.isdecimal() or not 1 <= int(text) <= agents:
        raise ConfigError("processes", text, f"per-agent, or 1 to {agents}, the number of agents")
    return int(text)


def agent_processes(
    run: RunConfig, processes: int | None, priority: int, space: str = names.SWARM
) -> list[AgentProcess]:
    """The processes in which a run's agents live.

    :param processes: how many, with as many agents each as can be; None: one an agent.
    :param priority: real-time priority of the agents; 0: none.
    """
    agents = run.swarm.agents
    if processes is None:
        return [
            AgentProcess(
                "agent", names.agent_namespace(agent, space), "agent", (agent,),
                {"id": agent, **_clocks(run, [agent], priority)},
            )
            for agent in range(1, agents + 1)
        ]  # fmt: skip
    bounds = [agents * number // processes for number in range(processes + 1)]
    groups = [tuple(range(first + 1, last + 1)) for first, last in pairwise(bounds)]
    return [
        AgentProcess(
            "swarm_host", space, f"swarm_host_{number}", ids, {"ids": list(ids), **_clocks(run, ids, priority)}
        )
        for number, ids in enumerate(groups, 1)
    ]


def _clocks(run: RunConfig, ids: Sequence[int], priority: int) -> dict[str, Any]:
    """The clocks of some agents, how long a frame takes, and who goes first, in real time; nothing in lockstep."""
    if run.mode == LOCKSTEP:
        return {}
    all_clocks = make_clocks(run.clocks, run.swarm.agents)
    clocks = [all_clocks[agent - 1] for agent in ids]
    airtime = run.air.airtime
    under_way = [airtime.total_ns(length) + airtime.from_radio_ns(length) for length in (0, 1)]
    return {
        "clock_offset_ns": [clock.offset_ns for clock in clocks],
        "clock_drift_ppb": [clock.drift_ppb for clock in clocks],
        "clock_jitter_ns": float(run.clocks.jitter_ns),
        "align": run.align,
        "flight_time_ns": [under_way[0], under_way[1] - under_way[0]],
        "nice": AGENTS_NICE,
        "priority": priority,
    }
