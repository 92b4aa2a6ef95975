"""A file of losses: what each link lost, the chain that fits it, and where all that comes from."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_bench import __version__
from dtsa_channel_sim.model.loss_record import HEARD
from dtsa_channel_sim.model.measured import FORMAT

from .chain_fit import NUMBERS, bursts, fit, fit_pooled, of_rate, wilson
from .distance import by_distance
from .observed import Observed, together
from .sequences import Floats, Sequences, sequences

#: A link has a chain of its own where independent losses would look as it does less often than this,
LEAST_P = 0.01
#: and where it lost and heard so many frames at least.
LEAST_LOST = 20
OWN, POOLED, INDEPENDENT = "own", "pooled", "independent"


def learn(flights: list[Observed]) -> dict[str, Any]:
    """What flights say of losses, as plain values: a file of losses.

    :param flights: what was observed.
    :raises ConfigError: if they do not go together.
    """
    agents, slot_ns = together(flights)
    tables = [flight.table for flight in flights]
    data = sequences(tables)
    if not len(data.sent):
        raise ConfigError("runs", ", ".join(flight.name for flight in flights), "a flight with one frame sent at least")
    ratio, chance, ratio_of_all, chance_of_all = bursts(data)
    enough = (data.lost >= LEAST_LOST) & (data.sent - data.lost >= LEAST_LOST)
    own = np.flatnonzero(enough & (chance < LEAST_P))
    chains = fit(data.some(own)) if len(own) else None
    numbers, pooled = _shared(data, chance_of_all)
    kinds = np.full(len(data.sent), POOLED if pooled else INDEPENDENT, dtype=object)
    kinds[(data.lost == 0) | (data.lost == data.sent)] = INDEPENDENT
    for link in np.flatnonzero(kinds == INDEPENDENT):
        numbers[:, link] = _steady(float(data.rate[link]))
    if chains is not None:
        numbers[:, own], kinds[own] = chains.numbers, OWN
    rate = float(data.lost.sum() / data.sent.sum())
    spread = _spread(data, numbers)
    low, high = wilson(data.lost / spread, data.sent / spread)
    signal, metres = _means(flights, data)
    links = []
    for k, (sender, receiver) in enumerate(data.ids.tolist()):
        link: dict[str, Any] = {
            "sender": sender, "receiver": receiver,
            "sent": int(data.sent[k]), "heard": int(data.sent[k] - data.lost[k]),
            "loss": _short(data.rate[k]), "loss_interval": [_short(low[k]), _short(high[k])],
            "likelihood_ratio": _short(ratio[k]), "p_value": _short(chance[k]), "chain": str(kinds[k]),
            **_row(numbers[:, k]),
        }  # fmt: skip
        if kinds[k] == OWN and chains is not None:
            place = int(np.flatnonzero(own == k)[0])
            for name, lower, upper in zip(NUMBERS, chains.low[:, place], chains.high[:, place], strict=True):
                link[f"{name}_interval"] = [_short(lower), _short(upper)]
        link |= {name: _short(values[k]) for name, values in (("rssi_dbm", signal), ("distance_m", metres))
                 if np.isfinite(values[k])}  # fmt: skip
        links.append(link)
    middle = float(np.average(spread, weights=data.sent))
    ends = wilson(np.array([data.lost.sum() / middle]), np.array([data.sent.sum() / middle]))
    left_out: Counter[str] = sum((flight.left_out for flight in flights), Counter())
    others = of_rate(*(np.array([value]) for value in pooled[:3]), np.array([rate])) if pooled else None
    return {
        "format": FORMAT,
        "agents": agents,
        "slot_ns": slot_ns,
        "made": {
            "with": f"dtsa {__version__}",
            "on": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
            "from": [{"name": flight.name, "run": flight.run, "kind": flight.kind} for flight in flights],
        },
        "frames": sum(len(table.slots) for table in tables),
        "left_out": {reason: count for reason, count in sorted(left_out.items()) if count},
        "all": {
            "links": len(links), "sent": int(data.sent.sum()), "heard": int((data.sent - data.lost).sum()),
            "loss": _short(rate), "loss_interval": [_short(ends[0][0]), _short(ends[1][0])],
            "likelihood_ratio": _short(ratio_of_all), "p_value": _short(chance_of_all),
            "pooled": None if pooled is None else {
                "kept": _short(pooled[0]), "kept_interval": [_short(value) for value in pooled[4]],
                "loss_good": _edge(pooled[1]), "loss_bad": _edge(pooled[2]),
            },
        },
        "others": _row(np.array(_steady(rate)) if others is None else np.array(others)[:, 0]),
        "links": links,
        "distance": by_distance(tables, middle),
    }  # fmt: skip


def _shared(
    data: Sequences, chance: float
) -> tuple[Floats, tuple[float, float, float, float, tuple[float, float]] | None]:
    """(4, L) the chains with one memory for all links, each with its own rate; None: losses look independent."""
    if chance >= LEAST_P:
        return np.zeros((4, len(data.sent))), None
    pooled = fit_pooled(data)
    kept, good, bad = (np.full(len(data.sent), value) for value in pooled[:3])
    return np.array(of_rate(kept, good, bad, data.rate)), pooled


def _steady(rate: float) -> tuple[float, float, float, float]:
    """The chain of independent losses: it never leaves its good state."""
    return 0.0, 1.0, rate, rate


def _spread(data: Sequences, numbers: Floats) -> Floats:
    """(L,) how many times more each rate varies than that of independent losses."""
    enter, leave, good, bad = numbers
    bad_share = enter / np.maximum(enter + leave, 1e-300)
    variance = np.maximum(data.rate * (1.0 - data.rate), 1e-300)
    share = np.minimum(bad_share * (1.0 - bad_share) * (bad - good) ** 2 / variance, 1.0)
    return np.clip(data.spread(share, 1.0 - enter - leave), 1.0, None)


def _means(flights: Sequence[Observed], data: Sequences) -> tuple[Floats, Floats]:
    """(L,) mean signal of the frames that each link's receiver heard, and mean distance; NaN: not known."""
    results = []
    for name, heard_only in (("rssi_dbm", True), ("distance_m", False)):
        total, count = np.zeros(len(data.sent)), np.zeros(len(data.sent))
        for flight in flights:
            values: NDArray[np.float32] | None = getattr(flight.table, name)
            if values is None:
                continue
            for k, (sender, receiver) in enumerate(data.ids.tolist()):
                if receiver >= values.shape[1]:
                    continue
                rows = flight.table.senders == sender
                found = values[rows, receiver].astype(np.float64)
                use = np.isfinite(found)
                if heard_only:
                    use &= flight.table.outcome[rows, receiver] == HEARD
                total[k] += found[use].sum()
                count[k] += np.count_nonzero(use)
        results.append(np.where(count > 0, total / np.maximum(count, 1), np.nan))
    return results[0], results[1]


def _row(numbers: Floats) -> dict[str, float]:
    """A chain's numbers for the file; enter and leave stay at most 1 together when they are rounded."""
    row = {name: min(1.0, max(0.0, _short(value))) for name, value in zip(NUMBERS, numbers, strict=True)}
    row["leave"] = min(row["leave"], 1.0 - row["enter"])
    return row | {name: _edge(row[name]) for name in ("loss_good", "loss_bad")}


def _edge(loss: float) -> float:
    """A state's loss; what is not told apart from never and always is that."""
    return 0.0 if loss < 2e-6 else 1.0 if loss > 1.0 - 2e-6 else _short(loss)


def _short(value: Any) -> float:
    """Six digits: the file says what the channel does, to the last bit, on all machines."""
    return float(f"{float(value):.6g}")
