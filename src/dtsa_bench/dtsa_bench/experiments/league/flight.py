"""One flight of a league: its row, and the digest of all that happened in it. Imports no figures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.experiments.batch.task import Row, Task, attempt
from dtsa_bench.experiments.sweep.spec import run_config
from dtsa_bench.simulation.simulate import Trace, simulate

from .cells import League, league

#: What a row says of a flight besides seed and status, from its summary; None: there is no such value.
VALUES = (
    "slots", "completion_time_s", "waking_age_mean_ms", "age_mean_ms", "channel_load", "min_distance_m",
)  # fmt: skip


def fly_one(task: Task) -> Row:
    """Flies one run of a league.

    :param task: the run; ``settings`` are the names of league and cell, the scheme, and the seed.
    :returns: its row; what goes wrong becomes the reason in it.
    """
    return attempt(task, _fly)


def _fly(task: Task) -> tuple[str, Row]:
    there = league(task.settings["league"])
    return flown(there, task.settings["cell"], task.settings["scheme"], task.seed)


def flown(there: League, cell: str, scheme: Mapping[str, Any], seed: int) -> tuple[str, Row]:
    """How a flight ended, and what it was worth.

    :param there: the league.
    :param cell: name of the cell.
    :param scheme: what the entry sets.
    :param seed: seed of the flight.
    """
    flight = simulate(run_config(there.settings(there.cell(cell), scheme, seed)), trace=True)
    summary = flight.summary()
    values = {name: summary[name] for name in VALUES if name != "slots"}
    assert flight.trace is not None
    return summary["end"], {"slots": summary["slots"]["total"], **values, "digest": digest_of(flight.trace)}


def digest_of(trace: Trace) -> str:
    """The first 64 bits of SHA-256 over senders, outcomes and true positions of all slots, hexadecimal.

    :param trace: what happened in every slot.
    """
    digest = hashlib.sha256(json.dumps([list(map(int, ids)) for ids in trace.senders]).encode())
    digest.update(bytes(trace.outcomes))
    digest.update(np.ascontiguousarray(trace.positions(), dtype="<f8").tobytes())
    return digest.hexdigest()[:16]


@cache
def golden_digest(there: League) -> str:
    """A digest of some flights with practice seeds: another one where the simulator computes something else.

    :param there: the league.
    """
    digest = hashlib.sha256()
    for scheme in there.golden["schemes"]:
        for cell in there.golden["cells"]:
            seed = there.seed(there.practice, cell, 0)
            digest.update(flown(there, cell, {"policy": scheme}, seed)[1]["digest"].encode())
    return digest.hexdigest()[:16]


def check_golden(there: League) -> None:
    """Whether this simulator flies as the one with which the league was frozen.

    :param there: the league.
    :raises ConfigError: if it does not.
    """
    found = golden_digest(there)
    if found != there.golden["digest"]:
        allowed = f"a simulator that flies {there.name} as it was frozen ({there.golden['digest']})"
        raise ConfigError("league.golden", found, allowed)
