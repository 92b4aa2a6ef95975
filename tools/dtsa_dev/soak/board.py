"""The protocol on board for an hour of virtual time, with faults: twelve apps in the peer-to-peer laboratory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_bench.crazyflies.peer_lab.onboard import OnBoard
from dtsa_bench.crazyflies.peer_lab.settings import LabSettings
from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.recordings.merge.agent_bag import read
from dtsa_bench.recordings.merge.merge import Merge

from .item import Item, NotMet, Soak

_AGENTS, _SECONDS, _ENABLED_S = 12, 300.0, 8.0
_EACH_S = 12.0  # from one change of goals to the next
_NEAREST_M = 0.2
_ONE = 5  # agent of the faults that befall one
_AWAY_S, _BACK_S = 60.0, 75.0
_FOREIGN_HZ = 20.0
#: Faults by name: settings of the laboratory.
_FAULTS: dict[str, dict[str, float]] = {
    "clocks off by 50 ppm": {},
    "30 % lost": {"loss": 0.3},
    "polls, 50 a second each": {"polls": 50.0},
    "an app that is reset": {},
    "a brown-out in flight": {},
    "a foreign sender": {},
}


def _items() -> tuple[Item, ...]:
    whole = (
        Item(f"{fault}, {part}", {"fault": fault, "seconds": _SECONDS}, 100 * part + 1, 150.0)
        for fault in _FAULTS
        for part in (1, 2)
    )
    return (*whole, Item("sample", {"fault": "an app that is reset", "seconds": 90.0}, 7, 40.0, sample=True))


def _fly_to_and_fro(flight: OnBoard, seconds: float) -> None:
    """Agents fly between start and target; nobody is told where the others fly to."""
    places = (np.array(flight.scenario.start), np.array(flight.scenario.target))
    for turn in range(1, int((seconds - _ENABLED_S) / _EACH_S)):
        for agent in range(1, flight.swarm.agents + 1):
            goal = places[(turn + 1) % 2][:, agent - 1]
            flight.lab.at(_ENABLED_S + turn * _EACH_S, lambda a=agent, g=goal: flight.send_goal(a, g))  # type: ignore[misc]


def _befall(flight: OnBoard, fault: str, seconds: float, seed: int) -> None:
    lab = flight.lab
    if fault == "a brown-out in flight":
        lab.at(_AWAY_S, lambda: lab.switch_off(_ONE))
    elif fault == "an app that is reset":  # on the floor: a reset takes the motors with it
        lab.at(_AWAY_S - 12.0, lambda: lab.send(_ONE, b"L") and None)
        lab.at(_AWAY_S, lambda: lab.switch_off(_ONE))
        lab.at(_AWAY_S + 1.0, lambda: flight.come_back(_ONE, _BACK_S - _AWAY_S))
    elif fault == "a foreign sender":
        random = np.random.default_rng(seed)
        for at in np.cumsum(random.exponential(1.0 / _FOREIGN_HZ, int(seconds * _FOREIGN_HZ))):
            data, port = random.bytes(int(random.integers(1, 61))), int(random.integers(0, 16))
            lab.at(float(at), lambda data=data, port=port: lab.transmit(data, port))  # type: ignore[misc]


def _run(item: Item, directory: Path) -> dict[str, Any]:
    fault, seconds = str(item.settings["fault"]), float(item.settings["seconds"])
    settings = LabSettings(seed=item.seed, drift_ppm=50.0, **_FAULTS[fault])  # type: ignore[arg-type]
    swarm = SwarmConfig(agents=_AGENTS, policy="lease", seed=item.seed, targets_known=False)
    with OnBoard(swarm, settings, directory, enable_s=_ENABLED_S) as flight:
        _fly_to_and_fro(flight, seconds)
        _befall(flight, fault, seconds, item.seed)
        flight.lab.run(seconds)
        summary = flight.finish()
    found = Merge([read(path) for path in sorted(directory.glob("cf*.mcap"))]).judge()
    again, turns = found["decisions_again"], found["turns"]
    figures = {
        "fault": fault, "seconds": seconds, "crashed": [int(agent) for agent in summary["crashed"]],
        "min_distance_m": summary["min_distance_m"], "decisions_again": again["equal"],
        "differences": len(again["differences"]), "slots_with_two_senders": turns["slots_with_two_senders"],
        "sent": summary["sent"], "heard_share": summary["heard"] / summary["sent"] / (_AGENTS - 1),
        "mean_age_ms": summary["mean_age_ms"],
    }  # fmt: skip
    expected = [_ONE] if fault == "a brown-out in flight" else []
    if figures["crashed"] != expected:
        raise NotMet(f"{item.name}: crashed {figures['crashed']}, expected {expected}")
    if figures["differences"]:
        raise NotMet(f"{item.name}: {again['differences'][0]}")
    if figures["min_distance_m"] < _NEAREST_M:
        raise NotMet(f"{item.name}: two came as near as {figures['min_distance_m']:.3f} m")
    return figures


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for fault in _FAULTS:
        parts = [row["summary"] for row in rows if row["summary"].get("fault") == fault]
        if parts:
            found[fault] = {
                "seconds": sum(part["seconds"] for part in parts),
                "crashed": sum(len(part["crashed"]) for part in parts),
                "min_distance_m": min(part["min_distance_m"] for part in parts),
                "decisions_again": sum(part["decisions_again"] for part in parts),
                "slots_with_two_senders": sum(part["slots_with_two_senders"] for part in parts),
                "heard_share": sum(part["heard_share"] for part in parts) / len(parts),
                "mean_age_ms": sum(part["mean_age_ms"] for part in parts) / len(parts),
            }
    return found


SOAK = Soak(
    "board",
    "Twelve apps on board fly to and fro, with clocks that drift, losses, polls of the ground, a reset, a brown-out "
    "and a foreign sender: nobody falls but the one without power, nobody comes nearer than 0.2 m to another, and all "
    "decisions made again are equal.",
    _items(),
    _run,
    _figures,
)
