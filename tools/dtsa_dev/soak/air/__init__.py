"""Agents over UDP: on hosts of their own over a switch that is the medium, and many of them on one computer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.soak.item import Item, Soak

from . import cost, flights, multirotor_flight, ros_hosts

_OTHERS = {"cost": cost, "rotorpy": multirotor_flight, "ros": ros_hosts}  # by a word among the settings


def _run(item: Item, directory: Path) -> dict[str, Any]:
    module = next((other for word, other in _OTHERS.items() if item.settings.get(word)), flights)
    found: dict[str, Any] = module.run(item, directory)
    return found


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    return {row["item"]: row["summary"] for row in rows}


SOAK = Soak(
    "air",
    "Twelve agents on hosts of their own, started in any order, with clocks of their own, up to a fifth of all frames "
    "lost: their bags verify, nobody crashes, frames overlap in at most 0.1 % of slots, in none without shortcuts, and "
    f"ages are the simulator's to {flights.AGE_MARGIN:.0%}; after kills, stand-stills, partitions, jamming, and among "
    "forged frames, all take part again. Seventy agents on one computer are as punctual as a bare timer, at half the "
    "cost of ROS nodes. As ROS nodes on four hosts of one domain, by multicast and by static peers, twelve fly the "
    "simulator's flight.",
    (*flights.cold_starts(), *flights.faults(), *cost.items(), *multirotor_flight.items(), *ros_hosts.items()),
    _run,
    _figures,
)
