"""What the paper says, what we measured, and whether it holds:

one function for each preset that has such claims.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from dtsa_bench.experiments.statistics import Mean, paired_difference

from .aggregate import MEASURES, Group, Table

HOLDS, PARTLY, FAILS, OPEN = "holds", "in part", "does not hold", "not decided"


@dataclass(frozen=True, slots=True)
class Claim:
    """One row of the table in the report."""

    paper: str  # what the paper says; empty: a remark of ours
    measured: str
    verdict: str  # HOLDS, PARTLY, FAILS, OPEN, or empty
    why: str


def claims_of(table: Table) -> list[Claim]:
    """The claims of the sweep's preset; none for a sweep of one's own.

    :param table: its groups.
    """
    make = _CLAIMS.get(table.sweep.name)
    return make(table) if make is not None and table.runs else []


def difference(first: Group, second: Group, measure: str) -> Mean:
    """Mean of ``second - first`` over the seeds that both groups completed."""
    a, b = first.values(measure), second.values(measure)
    seeds = sorted(a.keys() & b.keys())
    return paired_difference([a[seed] for seed in seeds], [b[seed] for seed in seeds])


def _verdict(mean: Mean, better: int) -> str:
    if not mean.count:
        return OPEN
    low, high = sorted((better * mean.low, better * mean.high))
    return HOLDS if low > 0 else FAILS if high < 0 else OPEN


def _signed(mean: Mean, measure: str) -> str:
    spec = MEASURES[measure]
    if not mean.count:
        return "no pair of completed flights"
    unit = f" {spec.unit}" if spec.unit else ""
    d = spec.digits + 1
    return f"{mean.value:+.{d}f}{unit} [{mean.low:+.{d}f}, {mean.high:+.{d}f}] over {mean.count} seeds"


def _paper(table: Table) -> list[Claim]:
    """Orderings of the bar charts, and what is left of them once TDMA extrapolates too."""
    claims = []
    figure = "fig:12_sim" if "12" in table.sweep.name else "fig:18_sim"
    for moving in table.levels("moving"):
        hold, linear, dtsa = (
            table.where(moving=moving, scheme=name)[0] for name in ("TDMA, hold", "TDMA, linear", "DTSA, linear")
        )
        for measure in ("min_distance_m", "efficiency_mean", "completion_time_s"):
            gain = difference(hold, dtsa, measure)
            share = difference(linear, dtsa, measure)
            text = MEASURES[measure].label
            source = figure if measure != "completion_time_s" else "fig:12_exp, real quadcopters"
            claims.append(
                Claim(
                    f"{moving} moving: DTSA has the better {text} ({source})",
                    f"DTSA, linear against TDMA, hold: {_signed(gain, measure)}",
                    _verdict(gain, MEASURES[measure].better),
                    f"TDMA with the same extrapolation: DTSA {_signed(share, measure)}. " + _credit(share, measure),
                )
            )
    return claims


def _credit(share: Mean, measure: str) -> str:
    verdict = _verdict(share, MEASURES[measure].better)
    if verdict == HOLDS:
        return "This part is the scheduler's; the rest is the extrapolation's."
    if verdict == FAILS:
        return "The gain is the extrapolation's; the scheduler makes it a little worse."
    return "The gain is the extrapolation's; no difference between the schedulers is measurable."


def clean_up_to(groups: Mapping[int, Group]) -> int | None:
    """Largest level up to which no flight crashed; None if some did at the first.

    :param groups: number of quadcopters -> group, ascending.
    """
    largest = None
    for agents, group in groups.items():
        if group.crashed.count:
            break
        largest = agents
    return largest


def _crashes(groups: Mapping[int, Group]) -> str:
    """Counts of crashes from the first one on, until nearly all crash."""
    parts: list[str] = []
    for agents, group in groups.items():
        share = group.crashed
        if share.count or parts:
            parts.append(f"{share} with {agents}")
        if share.value > 0.9:
            break
    if not parts:
        return f"none of {group.crashed.total} each, up to {agents}"
    return ", ".join(parts)


_PAPER_LIMITS = {
    (10, "TDMA, hold"): 18, (10, "DTSA, linear"): 70, (20, "TDMA, hold"): 10, (20, "DTSA, linear"): 60,
}  # fmt: skip


def _limits(table: Table) -> list[Claim]:
    claims = []
    for slot_ms in table.levels("slot_ms"):
        for scheme in table.levels("scheme"):
            found = table.where(slot_ms=slot_ms, scheme=scheme)
            groups = {g.labels["agents"]: g for g in found if g.crashed.total}
            if not groups:
                continue
            largest = clean_up_to(groups)
            clean = f"no crash up to {largest}; " if largest is not None and largest < max(groups) else ""
            measured = f"{scheme}: {clean}crashed: {_crashes(groups)}"
            limit = _PAPER_LIMITS.get((round(slot_ms), scheme))
            if limit is None:
                claims.append(Claim("", f"{slot_ms:g} ms: {measured}", "", _REMARKS.get(scheme, "")))
                continue
            paper = f"{scheme.split(',')[0]} works up to {limit} at {slot_ms:g} ms slots, and not beyond"
            claims.append(Claim(paper, measured, _limit_verdict(limit, groups), _LIMIT_WHY[scheme]))
    return claims


RARE = 0.1  # share of crashes that ten flights, as in the paper, can easily miss


def _limit_verdict(limit: int, groups: Mapping[int, Group]) -> str:
    """HOLDS: none crashes up to the limit and some beyond; PARTLY: up to the limit crashes are rare."""
    levels = list(groups)
    if limit not in levels:
        return OPEN
    upto = [groups[level].crashed for level in levels if level <= limit]
    beyond = [groups[level].crashed for level in levels if level > limit]
    if any(share.value > RARE for share in upto):
        return FAILS
    if not any(share.count for share in upto) and (not beyond or beyond[0].count):
        return HOLDS
    return PARTLY


_LIMIT_WHY = {
    "TDMA, hold": "The limit is that of acting on where the others were last heard: DTSA with hold has it "
    "too, and TDMA with extrapolation goes as far as DTSA. Crashes become common gradually; ten flights "
    "easily miss the first.",
    "DTSA, linear": "Owed to the extrapolation, not to the slots: see the same policy with hold, and TDMA with linear.",
}
_REMARKS = {
    "DTSA, hold": "DTSA's slots without the extrapolation: no better than TDMA's.",
    "TDMA, linear": "TDMA's slots with the extrapolation: as good as DTSA's.",
    "oracle": "Perfect knowledge: the avoider alone.",
}


def _idle(table: Table) -> list[Claim]:
    claims = []
    for moving in table.levels("moving"):
        tdma, dtsa = (table.where(moving=moving, policy=policy)[0] for policy in ("tdma", "dtsa"))
        gain = difference(tdma, dtsa, "age_mean_slots")
        distance = difference(tdma, dtsa, "min_distance_m")
        a, b = tdma.mean("age_mean_slots"), dtsa.mean("age_mean_slots")
        claims.append(
            Claim(
                f"{moving} of 200 moving: N_p t_s instead of N t_s until an update (eq:update_time_NA)",
                f"the age is {b.value:.1f} slots with DTSA, {a.value:.1f} with TDMA; "
                + _signed(gain, "age_mean_slots"),
                _verdict(gain, -1),
                "Here the scheduler does it: both extrapolate. "
                f"Minimum distance: {_signed(distance, 'min_distance_m')}; "
                f"crashed: DTSA {dtsa.crashed}, TDMA {tdma.crashed}.",
            )
        )
    return claims


def _loss(table: Table) -> list[Claim]:
    claims = []
    for level in table.levels("channel"):
        groups = {str(g.labels["scheme"]): g for g in table.where(channel=level)}
        dtsa, tdma = groups["DTSA, linear"], groups["TDMA, linear"]
        wasted = dtsa.mean("wasted_share").value
        text = "" if math.isnan(wasted) else f"; {100 * wasted:.0f} % of DTSA's slots carry nothing"
        verdict = HOLDS if not dtsa.crashed.count else FAILS
        claims.append(
            Claim(
                f"All agents choose the same sender (loss {level})",
                f"DTSA crashed {dtsa.crashed}, TDMA {tdma.crashed}{text}",
                verdict,
                "The paper assumes that every frame is heard by all. One that is not makes the tables "
                "differ, "
                "and then the choices."
                if verdict == FAILS
                else "",
            )
        )
    return claims


def _epsilon(table: Table) -> list[Claim]:
    literal = table.where(variant="as the text says")
    crashed = ", ".join(f"{g.crashed} with {g.labels['moving']} moving" for g in literal)
    verdict = FAILS if any(g.crashed.count for g in literal) else HOLDS
    return [
        Claim(
            "The text as written flies without crashes",
            f"crashed: {crashed}",
            verdict,
            "Before anybody has spoken only the first sender has g > 0 and keeps the channel; "
            "whoever's estimate has "
            "flown away is never chosen again. Boot round and age cap, both on by default, mend that.",
        )
    ]


_CLAIMS: dict[str, Callable[[Table], list[Claim]]] = {
    "paper-12": _paper, "paper-18": _paper, "limits": _limits, "idle": _idle, "loss": _loss,
    "epsilon": _epsilon,
}  # fmt: skip
