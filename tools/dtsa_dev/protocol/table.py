"""The protocol's table: runs all cases, sums up, prints."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from statistics import mean, median
from typing import Any

from dtsa_agent.core.errors import DtsaError
from dtsa_bench.experiments.batch.progress import run_batch
from dtsa_bench.experiments.batch.table import by_cell, markdown, write_results
from dtsa_bench.experiments.batch.task import FAILED, Row

from .cases import AGED, LEASE, PROTOCOLS, Case, Result, cases
from .cost import slot_cost_us
from .plan import FIRST_SEED, NAME, WORK, ProtocolPlan, result_of

# In stop-and-go a second line counts ages from the waking on, heard or not.
_AGES = (("", "ages"), (", also before they are heard", "true ages"))


def _age_row(case: Case, by: dict[str, list[Result]]) -> dict[str, Any]:
    """Mean ages; in stop-and-go also those over all that truly move."""
    ages = {name: mean(r.age for r in results) for name, results in by.items()}
    row: dict[str, Any] = {"ages": ages}
    if case.kind == "stop-and-go":
        row["true ages"] = {name: mean(r.true_age for r in results) for name, results in by.items()}
        waits = [slots for r in by["lease"] for slots in r.first if slots >= 0]
        row["first frame"] = {"median": median(waits), "max": max(waits)}
    tdma = ages["tdma"]
    row["ok"] = all(ages[name] <= limit * tdma for name, limit in case.limits.items())
    return row


def _fault_row(case: Case, by: dict[str, list[Result]]) -> dict[str, Any]:
    row: dict[str, Any] = {"ok": True}
    for name, results in by.items():
        if case.kind in ("wake", "join"):
            first = [slots for r in results for slots in r.first]
            heard = [slots for r in results for slots in r.all]
            row[name] = {"first frame": _spread(first), "heard by all": _spread(heard)}
            if case.kind == "join":
                row["ok"] &= min(first) >= 0 and max(first) <= 7 * case.agents
        else:
            values = [r.value for r in results]
            row[name] = {"slots until reused" if case.kind == "death" else "collisions afterwards": _spread(values)}
            top = {"death": max(1000, 30 * case.agents) + 10 * case.agents, "jam": 0, "merge": 10}[case.kind]
            row["ok"] &= min(values) >= 0 and max(values) <= top
    return row


def _spread(values: list[int]) -> dict[str, float]:
    known = [value for value in values if value >= 0]
    return {
        "median": median(known) if known else -1,
        "max": max(known) if known else -1,
        "never": len(values) - len(known),
    }


def summarise(rows: Sequence[Case], found: dict[tuple[str, str], list[Result]]) -> list[dict[str, Any]]:
    """One entry a case: what came out, what was asked, whether it holds.

    :param rows: the cases.
    :param found: results by case and protocol.
    """
    table = []
    for case in rows:
        by = {protocol: found[case.name, protocol] for protocol in case.protocols}
        row = _age_row(case, by) if case.kind in AGED else _fault_row(case, by)
        slots = {name: sum(r.slots for r in results) for name, results in by.items()}
        row["collided share"] = {name: sum(r.collisions for r in by[name]) / slots[name] for name in by}
        strict, default = by.get("lease S=0", []), by.get("lease", [])
        row["broken rules"] = sum(r.broken for r in (*strict, *default))
        row["open collisions"], row["adopted collisions"] = (
            sum(getattr(r, f"{kind}_collisions") for r in default) for kind in ("open", "adopted")
        )
        row["ok"] = bool(row["ok"] and not row["broken rules"] and not any(r.collisions for r in strict))
        # A single fault is rarer in a flight than once in so short a run: the share counts where nothing is provoked.
        if case.kind in AGED and default:
            row["ok"] = row["ok"] and row["collided share"]["lease"] <= 0.001
        table.append({"case": case.name, "kind": case.kind, "warm-up": case.warmup, "target": case.target, **row})
    return table


def as_text(table: Sequence[dict[str, Any]]) -> str:
    """The table for a terminal, and as Markdown.

    :param table: from :func:`summarise`.
    """
    names = list(PROTOCOLS)
    ages, faults = [], []
    for row in table:
        if "ages" in row:
            ages += _age_lines(row, names)
        else:
            cells = ["; ".join(f"{what} {_pair(v)}" for what, v in row.get(name, {}).items()) for name in LEASE]
            faults.append([row["case"], *cells, row["target"], _mark(row)])
    return "\n".join(
        (
            "Mean age of the movers' states, slots (collided slots per 1000)\n",
            markdown(["case", "warm-up", *names, "lease / TDMA", "asked", ""], ages),
            "\nFaults and changes, slots: median / largest\n",
            markdown(["case", *LEASE, "asked", ""], faults),
        )
    )


def _age_lines(row: dict[str, Any], names: Sequence[str]) -> list[list[str]]:
    """Cells of a row with ages; in stop-and-go a second line counts those that have not been heard yet."""
    lines = []
    for label, key in _AGES:
        if key in row:
            ages = row[key]
            cells = [f"{ages[n]:.2f} ({1000 * row['collided share'][n]:.2g})" if n in ages else "" for n in names]
            last = ["", ""] if label else [row["target"], _mark(row)]
            factor = f"{ages['lease'] / ages['tdma']:.3f}"
            lines.append([row["case"] + label, str(row["warm-up"]), *cells, factor, *last])
    return lines


_LONG = {
    "tdma": "TDMA", "tdma+gossip": "TDMA + gossip", "dtsa": "DTSA",
    "genie (age)": "genie (age)", "genie (error)": "genie (error)", "lease": "lease",
}  # fmt: skip


def long_table(table: Sequence[dict[str, Any]]) -> str:
    """Mean ages alone, as docs/evidence/protocol.md shows them, in Markdown.

    :param table: from :func:`summarise`.
    """
    lines = []
    for row in table:
        for label, key in _AGES:
            if key in row:
                ages = row[key]
                cells = [_digits(ages[name]) if name in ages else "" for name in _LONG]
                lines.append([row["case"] + label, *cells, f"{ages['lease'] / ages['tdma']:.2f}"])
    return markdown(["agents/moving, loss", *_LONG.values(), "lease / TDMA"], lines)


def _digits(age: float) -> str:
    return f"{age:.2f}" if age < 100 else f"{age:.0f}"


def _pair(value: dict[str, float]) -> str:
    return f"{value['median']:g} / {value['max']:g}" + (f" (never: {value['never']})" if value["never"] else "")


def _mark(row: dict[str, Any]) -> str:
    return "yes" if row["ok"] else "NO"


def run_table(
    out: Path,
    seeds: int | None = None,
    slots: int | None = None,
    jobs: int | None = None,
    first_seed: int = FIRST_SEED,
    only: str = "",
) -> int:
    """Runs the preset, writes ``protocol.md``, ``long.md``, ``protocol.csv`` and ``protocol.json``, prints the table.

    :param out: directory for the results.
    :param seeds: number of seeds; None: each column's own.
    :param slots: length of steady and stop-and-go runs; None: each column's own.
    :param jobs: processes; default: one a core.
    :param first_seed: first of the seeds.
    :param only: run only cases whose name contains this.
    :returns: 0 if everything that is asked for holds, 1 if not.
    """
    begun = time.monotonic()
    rows = [case for case in cases() if only in case.name]
    plan = ProtocolPlan(rows, seeds, slots, first_seed)
    finished = run_batch(plan, WORK, out, jobs=jobs)
    failed = [row for row in finished.values() if row["status"] == FAILED]
    if failed:
        raise DtsaError(f"{len(failed)} runs failed: {failed[0]['reason']}; the same command tries them again")
    found = by_case(plan, finished)
    table = summarise(rows, found)
    missed = [row["case"] for row in table if not row["ok"]]
    text = f"{as_text(table)}\n\n{_sums(table, found, missed)}"
    (out / "protocol.md").write_text(text + "\n", encoding="utf-8")
    (out / "long.md").write_text(long_table(table) + "\n", encoding="utf-8")
    values = [asdict(result) for group in found.values() for result in group]
    write_results(out, NAME, [spec.name for spec in fields(Result)] if values else ["case"], values, table)
    print(text)
    print(f"protocol: {len(table)} rows in {time.monotonic() - begun:.1f} s; {out / 'protocol.md'}")
    return 1 if missed else 0


def by_case(plan: ProtocolPlan, finished: Mapping[str, Row]) -> dict[tuple[str, str], list[Result]]:
    """Results by case and protocol, in the order of the seeds.

    :param plan: all runs.
    :param finished: rows by key; all are there.
    """
    rows = by_cell(plan, [finished[task.key] for task in plan.tasks()])
    return {
        (cell.labels["case"], cell.labels["protocol"]): [result_of(row) for row in part]
        for cell, part in zip(plan.cells, rows, strict=True)
    }


def _sums(
    table: Sequence[dict[str, Any]], found: Mapping[tuple[str, str], Sequence[Result]], missed: Sequence[str]
) -> str:
    """What holds over all rows, and what a slot costs."""
    strict = [r for (_, name), results in found.items() if name == "lease S=0" for r in results]
    default = [r for (_, name), results in found.items() if name == "lease" for r in results]
    costs = ", ".join(f"{slot_cost_us(70, movers):.1f} us with {movers} moving" for movers in (70, 35))
    return (
        f"{sum(r.slots for r in strict)} slots with S = 0 and without adoption. "
        f"{len(table) - len(missed)} of {len(table)} rows hold"
        + (f"; not: {'; '.join(missed)}" if missed else "")
        + f".\nlease, default, all rows: slots with two senders: {sum(r.open_collisions for r in default)} in OPEN and "
        f"{sum(r.adopted_collisions for r in default)} in adopted turns, of {sum(r.slots for r in default)}; the "
        "adopted ones are those of halves that do not hear each other, but for the few after each merge."
        f"\nEncode, decide and decode for one slot of 70 agents, one thread: {costs}."
    )
