"""Recorded flights for the tests: the real core flies, a seeded channel loses frames, a bag is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from bag_helpers import SyntheticRun

from dtsa_agent.core import SwarmConfig


def flight_bag(directory: Path, slots: int = 400, loss: float = 0.0, **settings: Any) -> None:
    """Fly and record a number of slots with fields of `SwarmConfig`; a receiver loses a frame with a probability."""
    run = SyntheticRun(directory, SwarmConfig(**settings), loss, whole=False)
    with run.writer:
        for slot in range(slots):
            run.slot(slot)
        # The last slot is answered too: with it the agents say where they are at its end.
        run.answer(slots, np.zeros(0, np.uint8))
