"""Faults of the channel, as its settings have them: partitions, and schedules of jams and partitions at random."""

from __future__ import annotations

from typing import Any

import numpy as np


def random_schedule(random: np.random.Generator, agents: int, slots: int) -> list[dict[str, Any]]:
    """Jams and partitions, one after the other."""
    entries: list[dict[str, Any]] = []
    slot = 0
    while slot < slots:
        slot += int(random.integers(50, 800))
        length = int(random.integers(5, 600))
        kind = random.integers(0, 3)
        if kind == 0:
            entries.append({"slot": slot, "until": slot + length, "jam": True})
        elif kind == 1 and agents > 3:
            ids = [int(k) + 1 for k in random.permutation(agents)]
            cut = int(random.integers(1, agents))
            entries.append({"slot": slot, "until": slot + length, "partition": [ids[:cut], ids[cut:]]})
        slot += length
    return entries
