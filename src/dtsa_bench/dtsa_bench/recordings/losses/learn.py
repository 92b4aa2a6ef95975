"""A file of losses: what each link lost, the chain that fits it, and where all that comes from."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_bench import __version__
from dtsa_channel_sim.model.loss_record import HEARD
from dtsa_channel_sim.model.loss_table import LossTable
from dtsa_channel_sim.model.measured import FORMAT, LINK, RECEIVER

from .chain_fit import CHI2_95, NUMBERS, bursts, fit, fit_pooled, of_rate, wilson
from .distance import by_distance
from .observed import Observed, together
from .sequences import Floats, Sequences, sequences

#: A link has a chain of its own where independent losses would look as it does less often than this,
LEAST_P = 0.01
#: and where it lost and heard so many frames at least.
LEAST_LOST = 20
_CLEARLY = 10.0  # chains of receivers are taken where their criterion is better by this
OWN, POOLED, INDEPENDENT = "own", "pooled", "independent"


@dataclass(frozen=True, slots=True, eq=False)
class _Learnt:
    """Chains of links, or of receivers.

    :param data: what was observed.
    :param ratio: (L,) likelihood ratios of bursts.
    :param chance: (L,) how probable larger ones are without bursts.
    :param of_all: both, of all together.
    :param numbers: (4, L) the chains.
    :param kinds: (L,) where each comes from.
    :param low: (4, L) lower ends of intervals, of chains of their own.
    :param high: (4, L) upper ends.
    :param pooled: what all share, see :func:`fit_pooled`; None: losses look independent.
    """

    data: Sequences
    ratio: Floats
    chance: Floats
    of_all: tuple[float, float]
    numbers: Floats
    kinds: NDArray[Any]
    low: Floats
    high: Floats
    pooled: tuple[float, float, float, float, tuple[float, float]] | None

    @property
    def criterion(self) -> float:
        """Akaike's: less is better."""
        likelihood = self.data.log_likelihood(*(np.clip(number, 1e-9, 1.0)[None] for number in self.numbers)).sum()
        free = 4 * np.count_nonzero(self.kinds == OWN) + np.count_nonzero(self.kinds != OWN) + 3 * bool(self.pooled)
        return float(2.0 * free - 2.0 * likelihood)

    def rows(self) -> list[dict[str, Any]]:
        """Each with its rate and its chain, for the file."""
        data, spread = self.data, _spread(self.data, self.numbers)
        low, high = wilson(data.lost / spread, data.sent / spread)
        found = []
        for k, (sender, receiver) in enumerate(data.ids.tolist()):
            row: dict[str, Any] = {
                "sender": sender, "receiver": receiver,
                "sent": int(data.sent[k]), "heard": int(data.sent[k] - data.lost[k]),
                "loss": _short(data.rate[k]), "loss_interval": [_short(low[k]), _short(high[k])],
                "likelihood_ratio": _short(self.ratio[k]), "p_value": _short(self.chance[k]),
                "chain": str(self.kinds[k]), **_row(self.numbers[:, k]),
            }  # fmt: skip
            if self.kinds[k] == OWN:
                for name, lower, upper in zip(NUMBERS, self.low[:, k], self.high[:, k], strict=True):
                    row[f"{name}_interval"] = [_short(lower), _short(upper)]
            found.append(row)
        return found


def _learn(data: Sequences) -> _Learnt:
    """The chains that fit sequences."""
    ratio, chance, *of_all = bursts(data)
    pooled = fit_pooled(data) if of_all[1] < LEAST_P else None
    if pooled is None:
        numbers, kinds = np.zeros((4, len(data.sent))), np.full(len(data.sent), INDEPENDENT, dtype=object)
    else:
        kept, good, bad = (np.full(len(data.sent), value) for value in pooled[:3])
        numbers, kinds = np.array(of_rate(kept, good, bad, data.rate)), np.full(len(data.sent), POOLED, dtype=object)
    kinds[(data.lost == 0) | (data.lost == data.sent)] = INDEPENDENT
    for k in np.flatnonzero(kinds == INDEPENDENT):
        numbers[:, k] = _steady(float(data.rate[k]))
    enough = (data.lost >= LEAST_LOST) & (data.sent - data.lost >= LEAST_LOST)
    own = np.flatnonzero(enough & (chance < LEAST_P))
    low, high = np.full_like(numbers, np.nan), np.full_like(numbers, np.nan)
    if len(own):
        chains = fit(data.some(own))
        numbers[:, own], low[:, own], high[:, own], kinds[own] = chains.numbers, chains.low, chains.high, OWN
    return _Learnt(data, ratio, chance, (of_all[0], of_all[1]), numbers, kinds, low, high, pooled)


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
    links = _learn(data)
    receivers = _of_receivers(tables, links)
    rows = links.rows()
    for row, signal, metres in zip(rows, *_means(flights, data), strict=True):
        row |= {name: _short(value) for name, value in (("rssi_dbm", signal), ("distance_m", metres))
                if np.isfinite(value)}  # fmt: skip
    rate = float(data.lost.sum() / data.sent.sum())
    best = links if receivers is None else receivers
    spread = float(np.average(_spread(best.data, best.numbers), weights=best.data.sent))
    ends = wilson(np.array([data.lost.sum() / spread]), np.array([data.sent.sum() / spread]))
    left_out: Counter[str] = sum((flight.left_out for flight in flights), Counter())
    pooled = best.pooled
    others = of_rate(*(np.array([value]) for value in pooled[:3]), np.array([rate])) if pooled else None
    return {
        "format": FORMAT,
        "agents": agents,
        "slot_ns": slot_ns,
        "scope": LINK if receivers is None else RECEIVER,
        "made": {
            "with": f"dtsa {__version__}",
            "on": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
            "from": [{"name": flight.name, "run": flight.run, "kind": flight.kind} for flight in flights],
        },
        "frames": sum(len(table.slots) for table in tables),
        "left_out": {reason: count for reason, count in sorted(left_out.items()) if count},
        "all": {
            "links": len(rows), "sent": int(data.sent.sum()), "heard": int((data.sent - data.lost).sum()),
            "loss": _short(rate), "loss_interval": [_short(ends[0][0]), _short(ends[1][0])],
            "likelihood_ratio": _short(best.of_all[0]), "p_value": _short(best.of_all[1]),
            "pooled": None if pooled is None else {
                "kept": _short(pooled[0]), "kept_interval": [_short(value) for value in pooled[4]],
                "loss_good": _edge(pooled[1]), "loss_bad": _edge(pooled[2]),
            },
        },
        "others": _row(np.array(_steady(rate)) if others is None else np.array(others)[:, 0]),
        **({} if receivers is None else {"receivers": receivers.rows()}),
        "links": rows,
        "distance": by_distance(tables, spread),
    }  # fmt: skip


def _of_receivers(tables: Sequence[LossTable], links: _Learnt) -> _Learnt | None:
    """Chains of receivers, where they say better what was lost than chains of links do."""
    data = sequences(tables, of_receivers=True)
    if len(data.sent) == len(links.data.sent) or bursts(data)[2] <= max(links.of_all[0], CHI2_95):
        return None
    found = _learn(data)
    return found if found.criterion < links.criterion - _CLEARLY else None


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
