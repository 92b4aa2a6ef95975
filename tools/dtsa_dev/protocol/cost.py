"""What a slot of policy ``lease`` costs: all decisions, one frame made, and taken in by everybody else."""

from __future__ import annotations

import time

from dtsa_agent.core import Swarm, SwarmConfig

from .experiment import FAR, still_scenario


def slot_cost_us(agents: int = 70, movers: int = 70, rounds: int = 5, slots: int = 1000) -> float:
    """Time of a slot on one thread, us: decide for all agents, encode one frame, decode it at all others. No flight.

    :param agents: number of agents N.
    :param movers: number of agents that have something to say.
    :param rounds: measured so often; the fastest counts, others were disturbed.
    :param slots: slots per round.
    """
    swarm = Swarm(SwarmConfig(agents=agents, moving=0, policy="lease", avoider="none"), still_scenario(agents, 1))
    swarm.active[:] = 0
    swarm.goal[0, :movers] = FAR
    begin, hear, end, frame = swarm.begin, swarm.hear, swarm.end, swarm.frame
    slot, best = 0, float("inf")
    for _ in range(rounds + 1):  # the first one fills the tables
        begun = time.perf_counter()
        for _ in range(slots):
            for index in begin(slot):
                hear(slot, frame(index))
            end(slot)
            slot += 1
        best = min(best, (time.perf_counter() - begun) / slots)
    return best * 1e6
