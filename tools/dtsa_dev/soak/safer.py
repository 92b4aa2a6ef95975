"""Is `lease` anywhere less safe than TDMA? A search at random, on seeds that no tuning has seen."""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.experiments.statistics import wilson
from dtsa_bench.experiments.sweep.spec import run_config
from dtsa_bench.simulation.simulate import simulate

from .item import Item, Soak

SEED = 2500  # of the settings
_SETTINGS = 300
_SAMPLE = 3
_FLIGHTS = 10  # a scheme and setting
_FIRST_SEED = 6001
SCHEMES: dict[str, dict[str, Any]] = {
    "TDMA": {"policy": "tdma"},
    "TDMA + gossip": {"policy": "tdma", "frame": "extended"},
    "lease": {"policy": "lease"},
}
_SHOWN = ("collided", "waking_age_mean_slots", "age_mean_slots", "first_heard_95_slots")


def setting(number: int) -> dict[str, Any]:
    """One setting of the search, as options of `simulate`.

    :param number: from 1 on.
    """
    draw = random.Random(f"{SEED} {number}")
    scenario = draw.choice(("staggered", "staggered", "stop-and-go", "waypoints", "streams", "exchange"))
    agents = draw.choice((6, 8, 12, 16, 18, 24, 32, 40))
    found: dict[str, Any] = {
        "scenario": scenario,
        "agents": agents,
        "avoider": draw.choice(("orca", "bvc", "jerky", "potential", "crazyflie")),
        "estimator": draw.choice(("linear", "linear", "intent", "hold")),
        "slot_ms": draw.choice((10, 15, 20, 30, 40, 50, 60)),
        "loss": draw.choice((0.0, 0.0, 0.05, 0.2)),
        "timeout_s": 40.0,
    }
    if scenario in ("stop-and-go", "waypoints"):
        found |= {"stops": draw.choice((1, 2)), "pause_slots": draw.choice((0, 20, 50, 150, 400))}
    if draw.random() < 0.4:
        found["moving"] = draw.randrange(2, agents + 1)
    if found["loss"] and draw.random() < 0.3:
        found["burst_length"] = draw.choice((3, 10))
    return found


def _items() -> tuple[Item, ...]:
    return tuple(Item(f"setting {k}", setting(k), k, 15.0, sample=k <= _SAMPLE) for k in range(1, _SETTINGS + 1))


def _run(item: Item, directory: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, scheme in SCHEMES.items():
        flights = [
            simulate(run_config({**item.settings, **scheme, "seed": seed})).summary()
            for seed in range(_FIRST_SEED, _FIRST_SEED + _FLIGHTS)
        ]
        found[name] = {key: [flight[key] for flight in flights] for key in _SHOWN}
    return {"setting": item.settings, "schemes": found}


def _crashes(row: dict[str, Any], scheme: str) -> int:
    return sum(row["schemes"][scheme]["collided"])


def _mean(rows: Sequence[dict[str, Any]], scheme: str, key: str) -> float | None:
    values = [value for row in rows for value in row["schemes"][scheme][key] if value is not None]
    return round(sum(values) / len(values), 3) if values else None


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["summary"] for row in rows if "schemes" in row["summary"]]
    schemes = {}
    for name in SCHEMES:
        share = wilson(sum(_crashes(row, name) for row in found), _FLIGHTS * len(found))
        schemes[name] = {
            "crashed": str(share),
            "interval": [round(share.low, 4), round(share.high, 4)],
            **{key: _mean(found, name, key) for key in _SHOWN[1:]},
        }
    worse = sorted(found, key=lambda row: _crashes(row, "TDMA") - _crashes(row, "lease"))
    told = [
        {"setting": row["setting"], **{name: f"{_crashes(row, name)}/{_FLIGHTS}" for name in SCHEMES}}
        for row in worse
        if _crashes(row, "lease") > _crashes(row, "TDMA")
    ]
    better = sum(_crashes(row, "lease") < _crashes(row, "TDMA") for row in found)
    settings = {"all": len(found), "lease crashes more": len(told), "lease crashes less": better}
    return {"settings": settings, "flights_each": _FLIGHTS, "first_seed": _FIRST_SEED, "schemes": schemes, "more": told}


SOAK = Soak(
    "safer",
    "In settings drawn at random `lease` crashes no more than TDMA: those in which it does are listed.",
    _items(),
    _run,
    _figures,
)
