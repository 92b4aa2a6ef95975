"""Losses of each directed link, learnt from recorded flights: rates, and two-state chains where losses come in bursts.

A chain has no loss in its good state and ``loss_bad`` in its bad one. With the link's rate m, two observations d slots
apart are both losses with probability m (m + (loss_bad - m) k^d), where k is what is left of the state after a slot.
Both are fitted by maximum likelihood to pairs of an observation and one of the next eight.
"""

from __future__ import annotations

import datetime
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_bench import __version__
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_channel_sim import Channel
from dtsa_channel_sim.model.measured import FORMAT, NUMBERS

from .arrays import FlightArrays
from .merged_bag import open_log

HEARD, LOST, UNKNOWN = 0, 1, 2
LEAST_LOST = 20  # lost and heard frames that a link needs for a chain of its own
_LEAST_P = 0.01  # bursts that independent losses would show less often than this are taken for bursts
_LAGS = 8  # observations that are compared with each one

Array = NDArray[Any]
Outcomes = tuple[Array, Array, Array]  # (F,) slots, (F,) ids of senders, (F, N) HEARD, LOST or UNKNOWN by receiver


def learn(paths: list[str]) -> dict[str, Any]:
    """Return what recorded flights of one swarm say of losses, as plain values: the content of a file of losses.

    :param paths: run directories, bag directories or .mcap files; also merged ones.
    :raises ConfigError: if they do not go together.
    :raises DtsaError: if one cannot be used.
    """
    runs = [open_log(path) for path in paths]
    for name, text in (("agents", "{} agents"), ("slot_ns", "slots of {} ns")):
        for run in runs:
            first, other = getattr(runs[0], name), getattr(run, name)
            if other != first:
                raise ConfigError(name, f"{text.format(other)} in {run.name}", f"{first}, as in {runs[0].name}")
    left_out: Counter[str] = Counter()
    flights = [observe(run, path, left_out) for run, path in zip(runs, paths, strict=True)]
    return {
        "format": FORMAT,
        "made": {
            "with": f"dtsa {__version__}",
            "on": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
            "from": [run.name for run in runs],
        },
        "agents": runs[0].agents,
        "slot_ns": runs[0].slot_ns,
        "frames": sum(len(slots) for slots, _, _ in flights),
        "left_out": {reason: count for reason, count in sorted(left_out.items()) if count},
        **fit_links(flights, runs[0].agents),
    }


def observe(run: FlightArrays, path: str | Path, left_out: Counter[str]) -> Outcomes:
    """Return the frames of a flight and who lost them, without those of which that is not known.

    :param path: of the flight, for errors.
    :param left_out: frames that do not count, by reason; added to.
    :raises UnusableBag: if nothing is left.
    """
    frames = run.sent_frames
    outcome = np.where(frames.received, HEARD, LOST).astype(np.uint8)
    outcome[np.arange(len(frames.row)), frames.sender - 1] = UNKNOWN
    if run.merged is not None:  # agents have told what they heard
        outcome[~run.known[frames.row]] = UNKNOWN
        _, which, count = np.unique(frames.row, return_inverse=True, return_counts=True)
        good = count[which] == 1
        left_out["two senders in the slot"] += int(np.count_nonzero(~good))
        left_out["no record of the sender"] += int(np.count_nonzero(good & ~run.sender_known))
        good &= run.sender_known
    else:  # the channel has told how many lost a frame, and at how many it collided
        good = frames.collided == 0
        left_out["collided somewhere"] += int(np.count_nonzero(~good))
        partly = good & (frames.received.sum(axis=1) + frames.lost < run.agents - 1)
        clear = _without_unreached(run, outcome, np.flatnonzero(partly))
        left_out["receivers in reach not known"] += int(np.count_nonzero(partly & ~clear))
        good &= ~partly | clear
    good &= (outcome != UNKNOWN).any(axis=1)
    if not good.any():
        raise UnusableBag(Path(path), "of no frame are the receivers known")
    order = np.flatnonzero(good)
    return frames.row[order], frames.sender[order], outcome[order]


def _without_unreached(run: FlightArrays, outcome: Array, rows: Array) -> Array:
    """Mark receivers as unknown that a frame did not reach, by the recorded channel; (F,) whether the numbers agree."""
    clear = np.zeros(len(outcome), np.bool_)
    if run.usable_config is None:
        return clear
    frames, channel = run.sent_frames, Channel(run.config.air)
    for row in rows.tolist():
        slot, heard = int(frames.row[row]), frames.received[row]
        reached = channel.medium(slot).reach(int(frames.sender[row]), run.track[slot, -1])
        clear[row] = reached.sum() == heard.sum() + frames.lost[row] and not (heard & ~reached).any()
        outcome[row, ~reached & clear[row]] = UNKNOWN
    return clear


def fit_links(flights: list[Outcomes], agents: int) -> dict[str, Any]:
    """Return counts and chains of all links, (N, N) lists with row = sender: sent, lost, and :data:`NUMBERS`."""
    sent, lost = np.zeros((2, agents, agents), np.int64)
    pairs: dict[tuple[int, int], list[Array]] = {}
    for slots, senders, outcome in flights:
        for sender, receiver in np.ndindex(agents, agents):
            known = (senders == sender + 1) & (outcome[:, receiver] != UNKNOWN)
            gone, when = outcome[known, receiver] == LOST, slots[known]
            sent[sender, receiver] += len(gone)
            lost[sender, receiver] += gone.sum()
            for lag in range(1, min(_LAGS + 1, len(gone))):
                row = when[lag:] - when[:-lag], gone[:-lag], gone[lag:], np.full(len(gone) - lag, lag)
                pairs.setdefault((sender, receiver), []).append(np.array(row))
    if not sent.any():
        raise ConfigError("runs", None, "a flight with one frame sent at least")
    mean = float(lost.sum() / sent.sum())
    rate = np.where(sent > 0, lost / np.maximum(sent, 1), mean)
    tables: dict[tuple[int, int], Array] = {}  # equal pairs once, with the link's rate before and their number after
    for link, parts in pairs.items():
        if 0.0 < rate[link] < 1.0:
            rows, count = np.unique(np.concatenate(parts, axis=1), axis=1, return_counts=True)
            tables[link] = np.vstack([np.full(len(count), rate[link]), rows, count])
    common = _fit(np.concatenate(list(tables.values()), axis=1)) if tables else None
    chains = np.empty((4, agents, agents))
    for row, column in np.ndindex(agents, agents):
        link = row, column
        enough = link in tables and min(lost[link], sent[link] - lost[link]) >= LEAST_LOST
        chains[:, row, column] = _chain(float(rate[link]), (_fit(tables[link]) if enough else None) or common)
    short = np.vectorize(lambda value: float(f"{value:.6g}"))(chains)
    short[1] = np.minimum(short[1], 1.0 - short[0])  # both stay at most 1 together when they are rounded
    for matrix in (*short, sent, lost):
        np.fill_diagonal(matrix, 0)
    return {"loss": float(f"{mean:.6g}"), "memory_slots": common and float(f"{1.0 / (1.0 - common[1]):.3g}"),
            "sent": sent.tolist(), "lost": lost.tolist(),
            **{name: matrix.tolist() for name, matrix in zip(NUMBERS, short, strict=True)}}  # fmt: skip


def _chain(rate: float, fitted: tuple[float, float] | None) -> tuple[float, float, float, float]:
    """Return enter, leave, loss_good and loss_bad of a link; one that never leaves its good state without a fit."""
    if fitted is None or not 0.0 < rate < 1.0:
        return 0.0, 1.0, rate, rate
    way, kept = fitted
    bad = rate + way * (1.0 - rate)
    return (1.0 - kept) * rate / bad, (1.0 - kept) * (1.0 - rate / bad), 0.0, bad


def _fit(table: Array) -> tuple[float, float] | None:
    """Return how far loss_bad is from the rate to 1, and k, for links that share both; None: no bursts.

    Bursts are found by a chain that loses all in its bad state, beside independent losses at the same rates.

    :param table: (6, P) pairs: rate of the link, gap in slots, whether each was lost, observations on, how many pairs.
    """
    from scipy.optimize import minimize, minimize_scalar
    from scipy.stats import chi2

    rate, gap, first, second, lag, count = table
    alike = np.where(first == second, 1.0, -1.0) * rate * (1.0 - rate)
    apart = np.where(first, rate, 1.0 - rate) * np.where(second, rate, 1.0 - rate)

    def cost(numbers: Array, chosen: Any = slice(None)) -> float:
        way, kept = numbers
        likelihood = apart[chosen] + way * alike[chosen] * kept ** gap[chosen]
        return -float(count[chosen] @ np.log(np.maximum(likelihood, 1e-12)))

    next_ones, most = np.flatnonzero(lag == 1), 1.0 - 1e-6
    bursts = minimize_scalar(lambda kept: cost(np.array((1.0, kept)), next_ones), bounds=(0.0, most), method="bounded")
    if chi2.sf(2.0 * (cost(np.zeros(2), next_ones) - bursts.fun), 1) > _LEAST_P:
        return None
    starts = ((way, kept) for way in (0.5, 0.9) for kept in (0.5, float(bursts.x)))
    fits = [minimize(cost, start, bounds=((0.0, 1.0), (0.0, most)), method="L-BFGS-B") for start in starts]
    best = min(fits, key=lambda found: float(found.fun))
    return float(best.x[0]), float(best.x[1])
