"""Many simulated flights over a grid of settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import REGISTRIES
from dtsa_bench.drawing.card import as_html, as_text
from dtsa_bench.experiments.batch import Journal, run_all
from dtsa_bench.experiments.provenance import code_digest
from dtsa_bench.experiments.sweep import Sweep, load_preset, make_sweep
from dtsa_bench.experiments.tables import SweepTable, table_html, table_text, write_results

if TYPE_CHECKING:
    import pandas as pd

SEEDS = 30
_SHOWN = ("age_mean_slots", "age_mean_ms", "min_distance_m")
_MOST, _MOST_IN_NOTEBOOKS = 6, 60  # settings that are shown


@dataclass(frozen=True)
class SweepResult:
    """All flights of a sweep, and what they sum up to."""

    name: str
    axes: tuple[str, ...]
    out: Path | None  # directory in which results.csv and results.json are; None: nothing was written
    command: str  # the call that makes it again
    _table: SweepTable
    _code: str

    def __repr__(self) -> str:
        groups = len(self._table.groups)
        left = f"\n... {groups - _MOST} more" if groups > _MOST else ""
        return as_text(self._title, self._rows(), table_text(self._table, shown=_SHOWN, most=_MOST) + left)

    def _repr_html_(self) -> str:
        return as_html(self._title, self._rows(), table=table_html(self._table, _SHOWN, _MOST_IN_NOTEBOOKS))

    @property
    def _title(self) -> str:
        sweep = self._table.sweep
        seeds = f"{len(sweep.seeds)} seeds" if len(sweep.seeds) > 1 else "1 seed"
        return f"Sweep {self.name}: {len(self._table.rows)} flights, {len(sweep.cells)} settings, {seeds}"

    def _rows(self) -> list[tuple[str, str]]:
        base = ", ".join(f"{name} {value}" for name, value in self._table.sweep.spec.base.items())
        where = "in memory (out=DIR keeps it)" if self.out is None else f"{self.out}: results.csv, results.json"
        more = "table(), runs(), write_paper(DIR); dtsa.plot_lines, dtsa.plot_bars, dtsa.plot_matrix"
        return [*([("base", base)] if base else []), ("kept", where), ("more", more)]

    def write_paper(self, directory: str | Path, figures: str = "pdf") -> list[Path]:
        """Write figures, `table.tex` (booktabs) and `table.csv` for a paper; `table.json` says how they were made.

        Figures and the LaTeX table say so, too: command, seeds, date, commit, versions.

        :param directory: where; made if needed.
        :param figures: pdf, svg or png. The figures are those of the preset; of other sweeps crashes and ages.
        :returns: the files.
        :raises ConfigError: for another format, or a directory that cannot be made.
        """
        from dtsa_bench.experiments.paper import write_paper  # draws with Matplotlib

        place = Path(directory)
        return [place / name for name in write_paper(self._table, place, figures, self._code, self.command)]

    def runs(self) -> pd.DataFrame:
        """A row a flight: the axes, seed, status, reason, collided, and its results with their units in the names."""
        return self._table.runs_frame()

    def table(self) -> pd.DataFrame:
        """A row a combination of the axes: the axes, how the flights ended, and means with their 95 % intervals.

        `runs`, `failed` and `timed_out` count flights; `crashed` is the share of those flown, with Wilson's interval in
        `crashed_low` and `crashed_high`. A measure has `<name>`, `<name>_low` and `<name>_high` (bootstrap over the
        seeds), and `<name>_count`: distances, efficiencies and times are those of completed flights without a crash.
        """
        return self._table.groups_frame()


def _refuse_registered(plan: Sweep, field: str, value: object) -> None:
    """Other processes do not know what was registered in this one, and no journal notices when it changes."""
    for kind, name in sorted(plan.batch.plug_ins):
        if name in REGISTRIES[kind].registered:
            allowed = f"{'1' if field == 'jobs' else 'None'} with the registered {kind} {name}"
            raise ConfigError(field, value, f"{allowed}; or announce it by an entry point (docs/reference/plug-ins.md)")


def sweep(
    preset: str | None = None, *, axes: Mapping[str, Sequence[Any] | Mapping[str, Mapping[str, Any]]] | None = None,
    base: Mapping[str, Any] | None = None, seeds: int | Sequence[int] | None = None, first_seed: int | None = None,
    jobs: int = 1, out: str | Path | None = None, progress: Callable[[int], None] | None = None,
) -> SweepResult:  # fmt: skip
    """Fly every combination of some settings with every seed.

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

    >>> result = sweep(axes={"loss": [0, 0.2], "policy": ["tdma", "lease"]}, base={"agents": 4}, seeds=2)
    >>> result.table()[["loss", "policy", "runs", "crashed"]].values.tolist()
    [[0.0, 'tdma', 2, 0.0], [0.0, 'lease', 2, 0.0], [0.2, 'tdma', 2, 0.0], [0.2, 'lease', 2, 0.0]]

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

    arguments = {"preset": preset, "axes": axes, "base": base, "seeds": seeds, "first_seed": first_seed}
    call = ", ".join(f"{name}={value!r}" for name, value in arguments.items() if value is not None)
    if jobs > 1 or out is not None:
        _refuse_registered(plan, "jobs" if jobs > 1 else "out", jobs if jobs > 1 else str(out))

    def advance(runs: int, cost: float) -> None:
        if progress is not None:
            progress(runs)

    code, place = code_digest(plan.batch.plug_ins), None if out is None else Path(out)
    if place is None:
        table = SweepTable(plan, run_all(plan.batch, jobs=jobs, advance=advance))
    else:
        with closing(Journal(place, plan.batch)) as journal:
            table = SweepTable(plan, run_all(plan.batch, journal, jobs=jobs, advance=advance))
        write_results(place, table, code)
    return SweepResult(plan.name, plan.axes, place, f"dtsa.sweep({call})", table, code)
