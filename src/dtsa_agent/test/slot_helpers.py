"""Swarms flown slot by slot, for the tests of the core."""

from __future__ import annotations

import numpy as np

from dtsa_agent.core import Swarm


def one_slot(swarm: Swarm, slot: int, mask: np.ndarray | None = None) -> dict[int, bytes]:
    """One slot on a channel where simultaneous frames destroy each other; returns the frames sent, by id."""
    swarm.scenario.advance(slot, swarm)
    frames = {swarm.ids[index]: swarm.frame(index) for index in swarm.begin(slot)}
    swarm.fly(slot)
    if len(frames) == 1:
        assert swarm.hear(slot, *frames.values(), mask)
    swarm.end(slot)
    return frames
