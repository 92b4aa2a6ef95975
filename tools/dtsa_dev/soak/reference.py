"""The compiled core beside the specification: 200 random flights, equal in every frame, decision and position."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.proofs.both_statements import Differs, fly_both, random_setting

from .item import Item, NotMet, Soak

_SETTINGS = 200
_SAMPLE = 10


def _items() -> tuple[Item, ...]:
    return tuple(Item(f"setting {seed}", {}, seed, 2.0, sample=seed <= _SAMPLE) for seed in range(1, _SETTINGS + 1))


def _run(item: Item, directory: Path) -> dict[str, Any]:
    setting = random_setting(item.seed)
    try:
        figures = fly_both(setting)
    except Differs as difference:
        raise NotMet(f"{setting.name()}: {difference}") from difference
    return {**figures, "policy": setting.swarm.policy, "agents": setting.swarm.agents, "faults": len(setting.faults)}


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["summary"] for row in rows if "slots" in row["summary"]]
    reasons: Counter[str] = Counter()
    for one in found:
        reasons.update(one["reasons"])
    sums = {name: sum(one[name] for one in found) for name in ("slots", "frames", "heard", "collisions", "faults")}
    policies = Counter(one["policy"] for one in found)
    decisions = sum(one["slots"] * one["agents"] for one in found)
    return {"settings": len(found), **sums, "decisions": decisions, "policies": policies, "reasons": reasons}


SOAK = Soak(
    "reference",
    "Random flights are equal on the compiled core and on the specification, in every frame, table, decision, reason, "
    "digest and position.",
    _items(),
    _run,
    _figures,
)
