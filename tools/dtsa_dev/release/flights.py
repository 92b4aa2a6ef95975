"""Digests of flights, for equal bits everywhere. A script of its own: it runs where `dtsa` alone is installed."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from dtsa_agent.core.registry import POLICIES
from dtsa_bench.experiments.sweep.spec import run_config
from dtsa_bench.simulation.simulate import simulate

FLOWN = {
    "plain": {"agents": 12, "timeout_s": 10, "seed": 3},
    "lossy": {
        "agents": 12,
        "timeout_s": 10,
        "seed": 3,
        "estimator": "intent",
        "avoider": "bvc",
        "loss": 0.1,
        "moving": 5,
    },
}


def digest(policy: str, settings: dict[str, object]) -> str:
    """Everything that happened in a flight: positions, senders, outcomes, choices, priorities.

    :param policy: its name.
    :param settings: of the run.
    """
    trace = simulate(run_config({"policy": policy, **settings}), trace=True).trace
    assert trace is not None
    whole = hashlib.sha256(trace.positions().tobytes())
    whole.update(json.dumps([trace.senders, trace.outcomes, trace.chosen]).encode())
    whole.update(np.array(trace.scores).tobytes())
    return whole.hexdigest()[:16]


if __name__ == "__main__":
    found = {f"{policy}, {name}": digest(policy, FLOWN[name]) for policy in POLICIES.names for name in FLOWN}
    print(json.dumps({"all": hashlib.sha256(json.dumps(found).encode()).hexdigest()[:16], **found}))
