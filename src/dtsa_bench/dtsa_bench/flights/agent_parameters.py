"""What the agents' processes of a run have to be told beside the swarm's settings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_channel_sim import make_clocks

# Process priority in real time where there is no real-time priority: agents give way to the channel, which goes first
# where it may.
AGENTS_NICE, CHANNEL_NICE = 5, -10


def clock_parameters(run: RunConfig, ids: Sequence[int], priority: int) -> dict[str, Any]:
    """The clocks of some agents, how long a frame takes, and who goes first, in real time; nothing in lockstep.

    :param run: the run.
    :param ids: the agents' ids.
    :param priority: real-time priority of their process; 0: none.
    """
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
