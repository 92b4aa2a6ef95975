"""Chains of Gilbert and Elliott by maximum likelihood, for all links at once, with profile-likelihood intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .sequences import Floats, Sequences

#: Points of chi-square with one degree of freedom: 95 % of it is below.
CHI2_95 = 3.841458820694124
NUMBERS = ("enter", "leave", "loss_good", "loss_bad")
_FAR = 14.0  # logits beyond this are taken as this: a probability below 1e-6
_MEMORIES = (1.05, 1.5, 2.0, 3.0, 5.0, 8.0, 13.0, 20.0, 40.0, 80.0, 160.0, 400.0, 1000.0)  # slots
_STEPS = np.array([1.0, 0.25, 0.03])
_LONGEST = 3.0  # step
_DIFFERENCE = 1e-4
_MOST_STEPS = 12  # towards the end of an interval
_CLOSE = 0.03  # an end is found where the root of the likelihood ratio is so near to that of chi-square
_TOGETHER = 16_000  # numbers that are worked on at once: they should fit into a processor's cache
_BATCH = 400  # pieces of sequences whose links are fitted at once

#: (S, M, d) points of M problems -> (S, M) values.
Function = Callable[[Floats], Floats]
#: The function of some of the problems, by their indices.
Choice = Callable[[NDArray[np.int64]], Function]


@dataclass(frozen=True, slots=True, eq=False)
class Chains:
    """Fitted chains, one for each of L links.

    :param numbers: (4, L) p, r, loss in the good state, loss in the bad one.
    :param low: (4, L) lower ends of their intervals.
    :param high: (4, L) upper ends.
    :param log_likelihood: (L,).
    """

    numbers: Floats
    low: Floats
    high: Floats
    log_likelihood: Floats


def sigmoid(x: Floats) -> Floats:
    """1 / (1 + exp(-x)), within what probabilities are told apart."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(x, -_FAR, _FAR))))


def logit(p: Floats) -> Floats:
    """The inverse of :func:`sigmoid`."""
    low = 1.0 / (1.0 + math.exp(_FAR))
    p = np.clip(p, low, 1.0 - low)
    return np.asarray(np.log(p / (1.0 - p)))


def independent(data: Sequences) -> Floats:
    """(L,) log-likelihood of independent losses, at the rate that was seen."""
    lost, heard = data.lost, data.sent - data.lost
    rate = data.rate
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            np.where(lost > 0, lost * np.log(rate), 0.0) + np.where(heard > 0, heard * np.log1p(-rate), 0.0)
        )


def bursts(data: Sequences) -> tuple[Floats, Floats, float, float]:
    """Likelihood ratios (L,) of losses in bursts against independent ones, and how probable larger ones are without.

    The last two are the same of all links together, with one memory.

    The chain is Gilbert's: it loses all in the bad state and none in the good one, at the rate that was seen. Its one
    more number is what is left of the state after a slot, 0 or more: at the edge half the ratios are 0, the others
    have a chi-square distribution with one degree of freedom.
    """
    rate = np.clip(data.rate, 1e-9, 1.0 - 1e-9)
    kept = 1.0 - 1.0 / np.array(_MEMORIES)[:, None]
    values = []
    for rows in _portions(len(kept), data):
        enter, leave = (1.0 - kept[rows]) * rate, (1.0 - kept[rows]) * (1.0 - rate)
        zero = np.zeros_like(enter)
        values.append(data.log_likelihood(enter, leave, zero, zero + 1.0))
    gain = np.concatenate(values) - independent(data)
    gain[:, (data.lost == 0) | (data.lost == data.sent)] = 0.0
    ratio = np.maximum(0.0, 2.0 * gain.max(axis=0))
    of_all = max(0.0, 2.0 * float(gain.sum(axis=1).max()))
    return ratio, np.array([_chance(value) for value in ratio]), of_all, _chance(of_all)


def _chance(ratio: float) -> float:
    return 0.5 * math.erfc(math.sqrt(ratio / 2.0)) if ratio > 0.0 else 1.0


def fit(data: Sequences) -> Chains:
    """The chain of each link, with intervals of 95 %.

    :param data: links with losses and with frames that were heard.
    """
    pieces = np.cumsum(np.bincount(data.link, minlength=len(data.sent)))
    parts = [_fit(data.some(links)) for links in np.split(np.arange(len(pieces)), _cuts(pieces))]
    return Chains(*(
        np.concatenate([getattr(part, name) for part in parts], axis=-1)
        for name in ("numbers", "low", "high", "log_likelihood")
    ))  # fmt: skip


def _cuts(pieces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where batches of links begin, the first apart."""
    return np.flatnonzero(np.diff((pieces - 1) // _BATCH)) + 1


def _fit(data: Sequences) -> Chains:
    links = len(data.sent)

    def numbers(x: Floats) -> tuple[Floats, ...]:
        """Mean loss, what is left of the state, and where the losses of both states are on their sides of the mean."""
        mean, kept, low, high = np.moveaxis(sigmoid(x), -1, 0)
        good, bad = mean * low, mean + (1.0 - mean) * high
        share = (mean - good) / (bad - good)
        return (1.0 - kept) * share, (1.0 - kept) * (1.0 - share), good, bad

    def value(x: Floats) -> Floats:
        return -_in_portions(data, numbers(x))

    mean = logit(np.clip(data.rate, 1e-6, 1.0 - 1e-6))
    grid = np.array([
        (float(logit(np.array(1.0 - 1.0 / memory))), low, high)
        for memory in _MEMORIES for low in (-4.0, 0.0) for high in (4.0, 0.0)
    ])  # fmt: skip
    start = np.concatenate(
        [np.broadcast_to(mean[None, :, None], (len(grid), links, 1)), np.repeat(grid[:, None], links, axis=1)], axis=2
    )
    first = np.argmin(value(start), axis=0)
    x, values = minimise(value, start[first, np.arange(links)], 60)
    found = np.array(numbers(x))
    low, high = _intervals(data, found, -values)
    return Chains(found, low, high, -values)


def fit_pooled(data: Sequences) -> tuple[float, float, float, float, tuple[float, float]]:
    """One memory and one pair of losses for all links, each link with its own rate.

    :returns: what is left of the state after a slot, loss in the good state, in the bad one, the likelihood ratio
        against independent losses, and the interval of the first.
    """
    rate, mean = data.rate, float(data.lost.sum() / data.sent.sum())

    def numbers(x: Floats) -> tuple[Floats, ...]:
        kept, low, high = np.moveaxis(sigmoid(x), -1, 0)  # (S, M)
        return of_rate(
            kept.reshape(-1, 1), (mean * low).reshape(-1, 1), (mean + (1 - mean) * high).reshape(-1, 1), rate
        )

    def value(x: Floats) -> Floats:
        return -_in_portions(data, numbers(x)).sum(axis=-1).reshape(x.shape[:-1])

    grid = np.array([
        (float(logit(np.array(1.0 - 1.0 / memory))), low, high)
        for memory in _MEMORIES for low in (-4.0, 0.0) for high in (4.0, 0.0)
    ])[:, None]  # fmt: skip
    first = int(np.argmin(value(grid)[:, 0]))
    x, values = minimise(value, grid[first], 40)
    ratio = max(0.0, 2.0 * float(-values[0] - independent(data).sum()))

    def of_some(chosen: NDArray[np.int64]) -> Function:
        return lambda points: np.concatenate([value(points[:, k : k + 1]) for k in range(len(chosen))], axis=1)

    ends = _profile(of_some, np.repeat(x, 2, axis=0), np.array([-1.0, 1.0]), np.repeat(values, 2))
    kept, good, bad = float(sigmoid(x[0, :1])[0]), float(mean * sigmoid(x[0, 1:2])[0]), 0.0
    bad = float(mean + (1.0 - mean) * sigmoid(x[0, 2:])[0])
    return kept, good, bad, ratio, (float(ends[0]), float(ends[1]))


def of_rate(kept: Floats, good: Floats, bad: Floats, rate: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """The four numbers of chains with these rates; where a rate is beyond a state's loss, the chain stays there.

    :param kept: what is left of the state after a slot.
    :param good: loss in the good state.
    :param bad: loss in the bad state.
    :param rate: mean loss of each link.
    """
    share = np.clip((rate - good) / (bad - good), 1e-9, 1.0 - 1e-9)
    enter, leave = (1.0 - kept) * share, (1.0 - kept) * (1.0 - share)
    return enter, leave, good + 0.0 * enter, bad + 0.0 * enter


def minimise(value: Function, start: Floats, iterations: int, tolerance: float = 1e-4) -> tuple[Floats, Floats]:
    """The least values of M functions of d numbers, by BFGS, all side by side; points (M, d) and values (M,).

    :param value: the functions.
    :param start: (M, d) where each begins.
    :param iterations: at most so many.
    :param tolerance: a gain below this, twice, ends it.
    """
    x = start.copy()
    count, size = x.shape
    unit = np.eye(size)
    shifts = np.concatenate([np.zeros((1, size)), _DIFFERENCE * unit])[:, None]

    def look(point: Floats) -> tuple[Floats, Floats]:
        values = value(point + shifts)
        return values[0], (values[1:] - values[0]).T / _DIFFERENCE

    found, slope = look(x)
    inverse = unit / np.maximum(1.0, np.linalg.norm(slope, axis=1))[:, None, None]
    quiet = np.zeros(count, np.int64)
    for _ in range(iterations):
        way = -np.einsum("mij,mj->mi", inverse, slope)
        uphill = (way * slope).sum(axis=1) >= 0.0
        norm = np.maximum(np.linalg.norm(slope, axis=1), 1e-300)
        way[uphill] = -slope[uphill] / norm[uphill, None]
        inverse[uphill] = unit / norm[uphill, None, None]
        way *= np.minimum(1.0, _LONGEST / np.maximum(np.linalg.norm(way, axis=1), 1e-300))[:, None]
        trials = np.clip(x + _STEPS[:, None, None] * way, -_FAR, _FAR)
        values = value(trials)
        best = np.argmin(values, axis=0)
        index = np.arange(count)
        better = values[best, index] < found
        move = np.where(better[:, None], trials[best, index] - x, 0.0)
        inverse[~better] = unit / norm[~better, None, None]
        x = x + move
        before, before_slope = found, slope
        found, slope = look(x)
        turn = slope - before_slope
        curvature = (move * turn).sum(axis=1)
        good = curvature > 1e-10
        if good.any():
            inverse[good] = _updated(inverse[good], move[good], turn[good], curvature[good])
        quiet = np.where(before - found < tolerance, quiet + 1, 0)
        if (quiet >= 2).all():
            break
    return x, found


def _updated(inverse: Floats, move: Floats, turn: Floats, curvature: Floats) -> Floats:
    """The inverse Hessians after a step, by the formula of Broyden, Fletcher, Goldfarb and Shanno."""
    unit = np.eye(move.shape[1])
    left = unit - np.einsum("mi,mj->mij", move, turn) / curvature[:, None, None]
    return np.asarray(
        left @ inverse @ left.transpose(0, 2, 1) + np.einsum("mi,mj->mij", move, move) / curvature[:, None, None]
    )


def _intervals(data: Sequences, found: Floats, best: Floats) -> tuple[Floats, Floats]:
    """Lower and upper ends (4, L) of the profile-likelihood intervals of all four numbers."""
    links = len(best)
    enter, leave, good, bad = found
    starts = np.array(
        [
            np.stack(
                [logit(enter), logit(leave / (1.0 - enter)), logit(good / np.maximum(bad, 1e-12)), logit(bad)], -1
            ),
            np.stack(
                [logit(leave), logit(enter / (1.0 - leave)), logit(good / np.maximum(bad, 1e-12)), logit(bad)], -1
            ),
            np.stack([logit(good), logit(enter), logit(leave / (1.0 - enter)), logit((bad - good) / (1.0 - good))], -1),
            np.stack(
                [logit(bad), logit(enter), logit(leave / (1.0 - enter)), logit(good / np.maximum(bad, 1e-12))], -1
            ),
        ]
    )  # fmt: skip  (4, L, 4): the number in question comes first

    problems = np.arange(8 * links)  # lower ends, then upper ones; in each the four numbers; in each the links
    number, link = problems // links % 4, problems % links

    def of_some(chosen: NDArray[np.int64]) -> Function:
        kind, own = number[chosen], data.some(link[chosen])

        def value(points: Floats) -> Floats:
            first, second, third, fourth = np.moveaxis(sigmoid(points), -1, 0)
            enter = np.choose(kind, [first, second * (1.0 - first), second, second])
            leave = np.choose(kind, [second * (1.0 - first), first, third * (1.0 - second), third * (1.0 - second)])
            good = np.choose(kind, [third * fourth, third * fourth, first, first * fourth])
            bad = np.choose(kind, [fourth, fourth, first + (1.0 - first) * fourth, first])
            return -_in_portions(own, (enter, leave, good, bad))

        return value

    both = np.concatenate([starts.reshape(-1, 4)] * 2)
    ends = _profile(of_some, both, np.repeat([-1.0, 1.0], 4 * links), np.tile(-best, 8)).reshape(2, 4, links)
    return ends[0], ends[1]


def _profile(function: Choice, start: Floats, sides: Floats, least: Floats) -> Floats:
    """Ends of intervals (M,): where the least value with the first number fixed lies half of chi-square above.

    :param function: the functions, of logits.
    :param start: (M, d) where each is least.
    :param sides: (M,) -1: lower end, 1: upper end.
    :param least: (M,) values there.
    """
    count = len(start)
    here = np.clip(start[:, 0], -_FAR, _FAR)
    limit = sides * _FAR
    target = math.sqrt(CHI2_95)

    # Where all other numbers are kept, the value rises soonest: the end lies there or beyond.
    parts = np.linspace(0.0, 1.0, 24)[1:] ** 2
    grid = here + parts[:, None] * (limit - here)
    points = np.repeat(start[None], len(parts), axis=0)
    points[:, :, 0] = grid
    above = _root(function(np.arange(count))(points), least) >= target
    crossed = np.where(above.any(axis=0), np.argmax(above, axis=0), len(parts) - 1)
    z = grid[crossed, np.arange(count)]
    inner, inner_root = here.copy(), np.zeros(count)  # the farthest point known to be inside
    outer, outer_root = limit.copy(), np.full(count, np.inf)  # the nearest one known to be outside
    others, todo = start[:, 1:].copy(), np.arange(count)
    for _ in range(_MOST_STEPS):
        value, own = function(todo), z[todo]

        def fixed(rest: Floats, value: Function = value, own: Floats = own) -> Floats:
            return value(np.concatenate([np.broadcast_to(own[None, :, None], (*rest.shape[:2], 1)), rest], axis=2))

        others[todo], values = minimise(fixed, others[todo], 8, 1e-3)
        now = _root(values, least[todo])
        inside = now < target
        near = todo[inside]
        inner[near], inner_root[near] = z[near], now[inside]
        far = todo[~inside]
        outer[far], outer_root[far] = z[far], now[~inside]
        # An end at the edge of what is told apart is known, too.
        at_edge = inside & (np.abs(z[todo] - limit[todo]) < 1e-9)
        todo = todo[(np.abs(now - target) > _CLOSE) & ~at_edge]
        if not len(todo):
            break
        with np.errstate(invalid="ignore", divide="ignore"):
            share = np.clip((target - inner_root) / (outer_root - inner_root), 0.1, 0.9)
            between = inner + (outer - inner) * share
            beyond = inner + sides * np.clip(np.abs(inner - here) * (target / inner_root - 1.0), 0.2, 4.0)
        beyond = np.where(sides > 0, np.minimum(beyond, limit), np.maximum(beyond, limit))
        z[todo] = np.where(np.isfinite(outer_root), between, beyond)[todo]
    edge = ~np.isfinite(outer_root) & (np.abs(z - limit) < 1e-9)
    return np.where(edge, np.where(sides > 0, 1.0, 0.0), sigmoid(z))


def _root(values: Floats, least: Floats) -> Floats:
    """Roots of likelihood ratios."""
    return np.asarray(np.sqrt(np.maximum(0.0, 2.0 * (values - least))))


def _portions(count: int, data: Sequences) -> list[slice]:
    """Slices of so many rows that together are worked on at once."""
    step = max(1, _TOGETHER // max(1, len(data.link)))
    return [slice(start, start + step) for start in range(0, count, step)]


def _in_portions(data: Sequences, numbers: tuple[Floats, ...]) -> Floats:
    """Log-likelihoods (..., L) of numbers (..., L)."""
    shape = numbers[0].shape
    flat = [number.reshape(-1, shape[-1]) for number in numbers]
    parts = [data.log_likelihood(*(number[rows] for number in flat)) for rows in _portions(len(flat[0]), data)]
    return np.concatenate(parts).reshape(shape)


def wilson(lost: NDArray[np.float64], sent: NDArray[np.float64]) -> tuple[Floats, Floats]:
    """Wilson's interval of 95 % for a share.

    :param lost: how many were lost.
    :param sent: of how many.
    """
    z2 = CHI2_95
    share = lost / sent
    middle, scale = (share + z2 / (2 * sent)) / (1 + z2 / sent), math.sqrt(z2) / (1 + z2 / sent)
    half = scale * np.sqrt(share * (1 - share) / sent + z2 / (4 * sent * sent))
    return np.maximum(0.0, middle - half), np.minimum(1.0, middle + half)
