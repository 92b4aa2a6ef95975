"""Many simulated flights over a grid of settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.experiments.batch.journal import Journal
from dtsa_bench.experiments.batch.pool import run_all
from dtsa_bench.experiments.sweep.aggregate import MEASURES, Group, Table, collected, write_table
from dtsa_bench.experiments.sweep.columns import COMMON, VALUES
from dtsa_bench.experiments.sweep.spec import Sweep, load_preset, make_sweep
from dtsa_bench.experiments.sweep.work import work_of

from ._frames import data_frame
from ._plugins import registered

if TYPE_CHECKING:
    import pandas as pd

SEEDS = 30


@dataclass(frozen=True)
class SweepResult:
    """All flights of a sweep, and what they sum up to."""

    name: str
    axes: tuple[str, ...]
    _table: Table

    def runs(self) -> pd.DataFrame:
        """A row a flight: the axes, seed, status, reason, collided, and its results with their units in the names.

        :raises ConfigError: if pandas is missing.
        """
        columns = [*self.axes, *COMMON, *VALUES]
        return data_frame({name: [row[name] for row in self._table.rows] for name in columns})

    def table(self) -> pd.DataFrame:
        """A row a combination of the axes: the axes, how the flights ended, and means with their 95 % intervals.

        `runs`, `failed` and `timed_out` count flights; `crashed` is the share of those flown, with Wilson's interval in
        `crashed_low` and `crashed_high`. A measure has `<name>`, `<name>_low` and `<name>_high` (bootstrap over the
        seeds), and `<name>_count`: distances, efficiencies and times are those of completed flights without a crash.

        :raises ConfigError: if pandas is missing.
        """
        rows = [_row(group) for group in self._table.groups]
        names = list(dict.fromkeys(name for row in rows for name in row))
        return data_frame({name: [row[name] for row in rows] for name in names})


def _row(group: Group) -> dict[str, Any]:
    share = group.crashed
    row: dict[str, Any] = {
        **group.labels,
        "runs": len(group.rows),
        "failed": group.failed,
        "timed_out": group.timed_out,
        "crashed": share.value,
        "crashed_low": share.low,
        "crashed_high": share.high,
    }
    for name in MEASURES:
        mean = group.mean(name)
        row |= {name: mean.value, f"{name}_low": mean.low, f"{name}_high": mean.high, f"{name}_count": mean.count}
    return row


def _refuse_registered(plan: Sweep, field: str, value: object) -> None:
    """Other processes do not know what was registered in this one, and no journal notices when it changes."""
    for kind, names in registered().items():
        for cell in plan.cells:
            name = getattr(cell.run(plan.seeds[0]).swarm, kind)
            if name in names:
                allowed = f"{'1' if field == 'jobs' else 'None'} with the registered {kind} {name}"
                raise ConfigError(
                    field, value, f"{allowed}; or announce it by an entry point (docs/reference/plug-ins.md)"
                )


def sweep(
    preset: str | None = None,
    *,
    axes: Mapping[str, Sequence[Any] | Mapping[str, Mapping[str, Any]]] | None = None,
    base: Mapping[str, Any] | None = None,
    seeds: int | Sequence[int] | None = None,
    first_seed: int | None = None,
    jobs: int = 1,
    out: str | Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> SweepResult:
    """Flies every combination of some settings with every seed.

    :param preset: a sweep that comes with the package (`dtsa sweep --list`), instead of axes.
    :param axes: name -> a list of values of the setting of that name, or names with settings each:
        `{"loss": [0, 0.1], "scheme": {"mine": {"policy": "lease"}}}`. Settings are those of :func:`run_config`.
    :param base: settings of all flights.
    :param seeds: how many, or which ones; None: 30, or the preset's. Equal seeds mean equal scenarios.
    :param first_seed: first of them; None: 1001.
    :param jobs: processes; 1: all flights in this one.
    :param out: directory for results.csv, results.json and a journal, with which an interrupted sweep goes on; None:
        nothing is written.
    :param progress: called with the number of flights done since the last call.
    :raises ConfigError: for a setting that is not usable; nothing has flown then.
    :raises DtsaError: if worker processes keep dying.
    """
    if (preset is None) == (axes is None):
        raise ConfigError("sweep", {"preset": preset, "axes": axes}, "a preset or axes")
    if not isinstance(jobs, int) or not 1 <= jobs <= 1024:
        raise ConfigError("jobs", jobs, "1 to 1024")
    if preset is not None:
        if seeds is not None and not isinstance(seeds, int):
            raise ConfigError("seeds", seeds, "a number of seeds with a preset")
        plan = load_preset(preset, seeds=seeds, first_seed=first_seed, base=base)
    else:
        plain = {name: dict(v) if isinstance(v, Mapping) else list(v) for name, v in (axes or {}).items()}
        chosen = SEEDS if seeds is None else seeds if isinstance(seeds, int) else list(seeds)
        content: dict[str, Any] = {"axes": plain, "base": dict(base or {}), "seeds": chosen}
        plan = make_sweep(content, "sweep", first_seed=first_seed)

    if jobs > 1 or out is not None:
        _refuse_registered(plan, "jobs" if jobs > 1 else "out", jobs if jobs > 1 else str(out))

    def advance(runs: int, cost: float) -> None:
        if progress is not None:
            progress(runs)

    work = work_of(plan)
    if out is None:
        table = Table(plan, collected(plan, run_all(plan, work, jobs=jobs, progress=advance)))
    else:
        with closing(Journal(Path(out), plan, work.code())) as journal:
            table = Table(plan, collected(plan, run_all(plan, work, journal, jobs=jobs, progress=advance)))
        write_table(Path(out), table, work.code())
    return SweepResult(plan.name, plan.axes, table)
