"""The protocol's table: runs all cases, sums up, prints."""

from __future__ import annotations

import csv
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from multiprocessing import Pool
from pathlib import Path
from statistics import mean, median
from typing import Any

from ..sweep.work import live_with_the_parent
from .cases import LEASE, PROTOCOLS, Case, Result, cases, run_case
from .cost import slot_cost_us

SEEDS, SLOTS, FIRST_SEED = 8, 20_000, 1001


def run_all(rows: Sequence[Case], seeds: Sequence[int], slots: int, jobs: int) -> dict[tuple[str, str], list[Result]]:
    """Runs every case with every protocol and seed, in several processes; says on stderr how far it is.

    :param rows: the cases.
    :param seeds: seeds of the runs.
    :param slots: length of steady and stop-and-go runs.
    :param jobs: processes.
    :returns: results by case and protocol, in the order of the seeds.
    """
    tasks = [(case, protocol, seed) for case in rows for protocol in case.protocols for seed in seeds]
    # The longest first, so that all processes end at the same time.
    tasks.sort(
        key=lambda task: (
            -task[0].agents * task[0].slots(task[1], slots) * (20 if task[1] == "dtsa" and task[0].loss else 1)
        )
    )
    found: dict[tuple[str, str, int], Result] = {}
    begun = said = time.monotonic()
    for count, result in enumerate(_results(tasks, slots, jobs), 1):
        found[result.case, result.protocol, result.seed] = result
        now = time.monotonic()
        if now - said > 10.0:
            said = now
            print(f"protocol: {count} of {len(tasks)} runs in {now - begun:.0f} s", file=sys.stderr)
    return {(case.name, protocol): [found[case.name, protocol, seed] for seed in seeds]
            for case in rows for protocol in case.protocols}  # fmt: skip


def _results(tasks: list[tuple[Case, str, int]], slots: int, jobs: int) -> Iterator[Result]:
    if jobs == 1:
        for case, protocol, seed in tasks:
            yield run_case(case, protocol, seed, slots)
        return
    with Pool(jobs, live_with_the_parent, (os.getpid(),)) as pool:  # terminated when this is left, whatever the reason
        yield from pool.imap_unordered(_run_task, [(*task, slots) for task in tasks])


def _run_task(task: tuple[Case, str, int, int]) -> Result:
    return run_case(*task)


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
        row = _age_row(case, by) if case.kind in ("steady", "start", "stop-and-go") else _fault_row(case, by)
        slots = {name: sum(r.slots for r in results) for name, results in by.items()}
        row["collided share"] = {name: sum(r.collisions for r in by[name]) / slots[name] for name in by}
        strict, default = by.get("lease S=0", []), by.get("lease", [])
        row["broken rules"] = sum(r.broken for r in (*strict, *default))
        row["open collisions"], row["adopted collisions"] = (
            sum(getattr(r, f"{kind}_collisions") for r in default) for kind in ("open", "adopted")
        )
        row["ok"] = bool(row["ok"] and not row["broken rules"] and not any(r.collisions for r in strict))
        # A single fault is rarer in a flight than once in so short a run: the share counts where nothing is provoked.
        if case.kind in ("steady", "start", "stop-and-go") and default:
            row["ok"] = row["ok"] and row["collided share"]["lease"] <= 0.001
        table.append({"case": case.name, "kind": case.kind, "warm-up": case.warmup, "target": case.target, **row})
    return table


def as_text(table: Sequence[dict[str, Any]]) -> str:
    """The table for a terminal, and as Markdown.

    :param table: from :func:`summarise`.
    """
    names = list(PROTOCOLS)
    lines = [
        "Mean age of the movers' news, slots (collided slots per 1000)",
        "",
        "| case | warm-up | " + " | ".join(names) + " | lease / TDMA | asked | |",
        "|---" * (len(names) + 5) + "|",
    ]
    for row in table:
        for label, key in (("", "ages"), (", also before they are heard", "true ages")):
            if key not in row:
                continue
            ages = row[key]
            cells = [f"{ages[n]:.2f} ({1000 * row['collided share'][n]:.2g})" if n in ages else "" for n in names]
            last = [
                f"{ages['lease'] / ages['tdma']:.3f}",
                row["target"] if not label else "",
                _mark(row) if not label else "",
            ]
            lines.append("| " + " | ".join([row["case"] + label, str(row["warm-up"]), *cells, *last]) + " |")
    lines += [
        "",
        "Faults and changes, slots: median / largest",
        "",
        "| case | lease S=0 | lease | asked | |",
        "|---" * 5 + "|",
    ]
    for row in table:
        if "ages" not in row:
            cells = ["; ".join(f"{what} {_pair(v)}" for what, v in row.get(name, {}).items()) for name in LEASE]
            lines.append("| " + " | ".join([row["case"], *cells, row["target"], _mark(row)]) + " |")
    return "\n".join(lines)


def _pair(value: dict[str, float]) -> str:
    return f"{value['median']:g} / {value['max']:g}" + (f" (never: {value['never']})" if value["never"] else "")


def _mark(row: dict[str, Any]) -> str:
    return "yes" if row["ok"] else "NO"


def run_table(
    out: Path,
    seeds: int = SEEDS,
    slots: int = SLOTS,
    jobs: int | None = None,
    first_seed: int = FIRST_SEED,
    only: str = "",
) -> int:
    """Runs the preset, writes ``protocol.md``, ``protocol.csv`` and ``protocol.json``, prints the table.

    :param out: directory for the results.
    :param seeds: number of seeds.
    :param slots: length of steady and stop-and-go runs.
    :param jobs: processes; default: one a core.
    :param first_seed: first of the seeds.
    :param only: run only cases whose name contains this.
    :returns: 0 if everything that is asked for holds, 1 if not.
    """
    begun = time.monotonic()
    rows = [case for case in cases() if only in case.name]
    found = run_all(rows, range(first_seed, first_seed + seeds), slots, jobs or len(os.sched_getaffinity(0)))
    table = summarise(rows, found)
    text = as_text(table)
    total = sum(r.slots for (_, name), results in found.items() if name == "lease S=0" for r in results)
    missed = [row["case"] for row in table if not row["ok"]]
    text += (
        f"\n\n{total} slots with S = 0 and without adoption. {len(table) - len(missed)} of {len(table)} rows hold"
        + (f"; not: {'; '.join(missed)}" if missed else "")
        + "."
    )
    default = [r for (_, name), results in found.items() if name == "lease" for r in results]
    text += (
        f"\nlease, default, all rows: slots with two senders: {sum(r.open_collisions for r in default)} in OPEN and "
        f"{sum(r.adopted_collisions for r in default)} in adopted turns, of {sum(r.slots for r in default)}; the "
        "adopted ones are those of halves that do not hear each other, but for the few after each merge."
    )
    costs = ", ".join(f"{slot_cost_us(70, movers):.1f} us with {movers} moving" for movers in (70, 35))
    text += f"\nEncode, decide and decode for one slot of 70 agents, one thread: {costs}."
    out.mkdir(parents=True, exist_ok=True)
    (out / "protocol.md").write_text(text + "\n", encoding="utf-8")
    (out / "protocol.json").write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    with (out / "protocol.csv").open("w", newline="", encoding="utf-8") as file:
        results = [asdict(r) for group in found.values() for r in group]
        writer = csv.DictWriter(file, list(results[0]) if results else ["case"])
        writer.writeheader()
        writer.writerows(
            {k: " ".join(map(str, v)) if isinstance(v, tuple) else v for k, v in r.items()} for r in results
        )
    print(text)
    print(f"protocol: {len(table)} rows in {time.monotonic() - begun:.1f} s; {out / 'protocol.md'}")
    return 1 if missed else 0
