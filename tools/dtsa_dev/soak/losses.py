"""Losses are flown in simulated channels and learnt again: how many intervals hold what was flown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.recordings.losses.chain_fit import NUMBERS
from dtsa_bench.recordings.losses.learn import OWN, learn
from dtsa_bench.recordings.losses.observed import Observed
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.gilbert import GilbertElliott
from dtsa_channel_sim.model.loss_record import HEARD, LOST, UNKNOWN
from dtsa_channel_sim.model.loss_table import LossTable

from .item import Item, NotMet, Soak

_LOSS, _AGENTS, _FLIGHTS, _ITEMS = 0.2, 3, 10, 6
_LEAST_HELD = 0.75  # of an item's intervals
_EDGE = 1e-5
#: Scope of bursts, their mean length in slots (0: none), loss in a good phase and in a bad one, slots of a flight.
_CHANNELS: dict[str, tuple[str, float, float, float, int]] = {
    "independent": ("link", 0.0, 0.0, 1.0, 6000),
    "short bursts of links": ("link", 3.0, 0.0, 1.0, 6000),
    "bursts of links": ("link", 10.0, 0.0, 1.0, 6000),
    "bursts of links that lose a part": ("link", 12.0, 0.05, 0.8, 9000),
    "bursts of receivers": ("receiver", 15.0, 0.0, 1.0, 6000),
}


def _items() -> tuple[Item, ...]:
    return tuple(
        Item(f"{name} {part}", {"channel": name}, 1000 * part + 1, 20.0, sample=part == 0)
        for name in _CHANNELS
        for part in range(_ITEMS)
    )


def flown(config: ChannelConfig, slots: int, place: int, places: int) -> LossTable:
    """Who heard whom in a channel, in a round robin.

    :param config: the channel.
    :param slots: how many slots.
    :param place: which of several flights side by side this is: agents of each have ids of their own.
    :param places: number of those flights.
    """
    channel, agents = Channel(config), config.agents
    senders = np.arange(slots) % agents
    outcome = np.full((slots, agents * places + 1), UNKNOWN, np.uint8)
    for slot, sender in enumerate(senders.tolist()):
        heard = channel.arbitrate(slot, (sender + 1,)).mask(agents)[0]
        own = outcome[slot, 1 + agents * place : 1 + agents * (place + 1)]
        own[:] = np.where(heard, HEARD, LOST)
        own[sender] = UNKNOWN
    return LossTable(np.arange(slots), senders + 1 + agents * place, outcome)


def _run(item: Item, directory: Path) -> dict[str, Any]:
    name = str(item.settings["channel"])
    scope, length, good, bad, slots = _CHANNELS[name]
    bursts = {"burst_length": length, "burst_scope": scope, "p_good": good, "p_bad": bad} if length else {}
    flights = []
    for place in range(_FLIGHTS):
        config = ChannelConfig(agents=_AGENTS, seed=item.seed + place, loss=_LOSS, **bursts)
        table = flown(config, slots, place, _FLIGHTS)
        flights.append(Observed(f"flight {place}", "", "table", config.slot_ns, table.agents, table))
    learnt = learn(flights)
    if length and learnt["scope"] != scope:
        raise NotMet(f"{item.name}: bursts of {learnt['scope']}s were learnt")
    rows = learnt["receivers" if learnt["scope"] == "receiver" else "links"]
    found: dict[str, Any] = {"channel": name, "chains": len(rows), "own": sum(row["chain"] == OWN for row in rows)}
    for level in (0.05, 0.01):
        found[f"below {level}"] = sum(row["p_value"] < level for row in rows)
    found["rate"] = sum(_holds(row["loss_interval"], _LOSS) for row in learnt["links"]) / len(learnt["links"])
    found["links"] = len(learnt["links"])
    if length:
        model = GilbertElliott.from_means(_LOSS, length, good, bad)
        own = [row for row in rows if row["chain"] == OWN]
        for number, truth in zip(NUMBERS, (model.enter, model.leave, good, bad), strict=True):
            held = found[number] = sum(_holds(row[f"{number}_interval"], truth) for row in own)
            if held < _LEAST_HELD * len(own):
                raise NotMet(f"{item.name}: {held} of {len(own)} intervals of {number} hold {truth:.4g}")
    if found["rate"] < _LEAST_HELD:
        raise NotMet(f"{item.name}: {100 * found['rate']:.0f} % of the intervals of rates hold {_LOSS:g}")
    return found


def _holds(interval: Sequence[float], truth: float) -> bool:
    return interval[0] - _EDGE <= truth <= interval[1] + _EDGE


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in _CHANNELS:
        parts = [row["summary"] for row in rows if row["summary"].get("channel") == name]
        if not parts:
            continue
        chains, own, links = (sum(part[key] for part in parts) for key in ("chains", "own", "links"))
        figures = {"chains": chains, "own": own}
        figures |= {key: sum(part[key] for part in parts) / chains for key in ("below 0.05", "below 0.01")}
        figures["rate"] = sum(part["rate"] * part["links"] for part in parts) / links
        figures |= {key: sum(part[key] for part in parts) / own for key in NUMBERS if key in parts[0] and own}
        found[name] = figures
    return found


SOAK = Soak(
    "losses",
    "What is learnt from a simulated channel is that channel: of the intervals of an item, 95 % each, three in four or "
    "more hold the number that was flown, and bursts of receivers are told from those of links.",
    _items(),
    _run,
    _figures,
)
