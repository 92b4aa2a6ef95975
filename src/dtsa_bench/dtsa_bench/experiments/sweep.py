"""Content of a sweep: a base, axes that are combined with each other, and seeds. See docs/how-to/sweep.md."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import SETTING_NAMES, ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import Setting, Settings, check, setting, settings_of
from dtsa_agent.yaml_file import read_yaml
from dtsa_bench.runs.config import FROM_SWARM, RunConfig, RunLimits, from_swarm
from dtsa_channel_sim import ChannelConfig, MeasuredLosses

from .batch import Batch, Row, Task, key_of

PRESETS = Path(__file__).resolve().parent / "presets"
FIRST_SEED = 1001  # of reports; those below are for tuning and tests
#: Results of one run as columns, in this order; ``slots_...`` are parts of ``slots`` in the summary.
VALUES = (
    "min_distance_m", "efficiency_mean", "completion_time_s", "flight_time_s", "age_mean_slots",
    "age_max_slots", "age_mean_ms", "age_max_ms", "waking_age_mean_slots", "waking_age_max_slots",
    "waking_age_mean_ms", "waking_age_max_ms", "wakings", "wakings_unheard", "first_heard_median_slots",
    "first_heard_95_slots", "first_heard_max_slots", "frames_per_s", "bytes_per_s", "channel_load",
    "estimate_error_mean_m", "estimate_error_max_m", "slots_total", "slots_success", "slots_collision", "slots_idle",
    "agreement_share", "equal_tables_share", "first_divergence_slot", "wall_time_s",
)  # fmt: skip
COMMON = ("seed", "status", "reason", "collided")


@dataclass(frozen=True, slots=True)
class Measure:
    """A number that a flight has, and which flights count for it."""

    name: str
    label: str
    unit: str
    digits: int
    complete_only: bool  # only flights that were completed without a crash, as in the paper
    head: str = ""  # in tables on a terminal; empty: not shown there


MEASURES = {
    measure.name: measure
    for measure in (
        Measure("min_distance_m", "minimum distance", "m", 3, True, "dist m"),
        Measure("efficiency_mean", "trajectory efficiency", "", 3, True, "effic"),
        Measure("completion_time_s", "completion time", "s", 2, True, "time s"),
        Measure("age_mean_slots", "age", "slots", 2, False, "age slots"),
        Measure("age_mean_ms", "age", "ms", 1, False, "age ms"),
        Measure("waking_age_mean_slots", "age from waking on", "slots", 2, False, "waking age"),
        Measure("waking_age_mean_ms", "age from waking on", "ms", 1, False),
        Measure("first_heard_95_slots", "95 % of wakings heard after", "slots", 1, False),
        Measure("channel_load", "share of time on the air", "", 4, False),
        Measure("estimate_error_mean_m", "error of estimates", "m", 4, False),
        Measure("wasted_share", "slots without a frame", "", 3, False),
    )
}
CRASHED = "crashed"  # a share, not a mean; may stand where a measure's name stands
#: Names that no axis may have.
RESERVED = frozenset(("key", "cell", "summary", "runs", "timed_out", "left_out", CRASHED, *MEASURES, *COMMON, *VALUES))
#: Axes that figures need and those that they may have, by kind; the first three are of measures.
FIGURES = {
    "bars": (("x",), ("series",)), "lines": (("x",), ("series", "facets")),
    "matrix": (("rows", "columns"), ("facets",)), "trajectories": (("facets",), ()),
    "estimate": (("facets",), ()),
}  # fmt: skip
# Settings by section. Those of the channel that follow from the swarm's are left out.
_SECTIONS: dict[str, dict[str, Setting]] = {
    "swarm": {spec.name: spec for spec in settings_of(SwarmConfig)},
    "channel": {spec.name: spec for spec in settings_of(ChannelConfig) if spec.name not in FROM_SWARM},
    "limits": {spec.name: spec for spec in settings_of(RunLimits)},
}


@dataclass(frozen=True, slots=True)
class SweepSpec(Settings):
    """Content of a sweep's YAML file.

    :raises ConfigError: naming what is not usable.
    """

    title: str = setting("", "heading of the report; empty: the sweep's name")
    text: str = setting("", "what the report says before its tables")
    seeds: int | list[int] = setting(30, "a number of seeds, or a list of whole numbers", kind="structure", custom=True)
    base: Mapping[str, Any] = setting({}, "settings of all flights, by name", kind="structure", custom=True)
    axes: Mapping[str, Any] = setting(
        {}, "lists of values by the name of a setting, or settings by names by an axis", kind="structure", custom=True
    )
    figures: tuple[Mapping[str, Any], ...] = setting((), "figures of the report", kind="structure", custom=True)

    def __post_init__(self) -> None:
        check(self)
        object.__setattr__(self, "base", _mapping(self.base, "base"))
        axes = {axis: _levels(axis, values) for axis, values in _mapping(self.axes, "axes").items()}
        object.__setattr__(self, "axes", axes)
        if not isinstance(self.figures, (list, tuple)):
            raise ConfigError("figures", self.figures, "a list")
        figures = tuple(_figure(entry, index, axes) for index, entry in enumerate(self.figures))
        object.__setattr__(self, "figures", figures)
        _seeds(self.seeds, None, None)


@dataclass(frozen=True, slots=True)
class Cell:
    """One combination of the axes, flown with every seed."""

    labels: dict[str, Any]  # axis -> value or name
    settings: dict[str, Any]  # flat names -> values

    def run(self, seed: int) -> RunConfig:
        """Return the run with one seed.

        :raises ConfigError: if the settings do not fit together.
        """
        return run_config({**self.settings, "seed": seed})


@dataclass(frozen=True)
class Sweep:
    """Cells, seeds, and what the report shows of them."""

    name: str
    title: str
    text: str
    cells: tuple[Cell, ...]
    seeds: tuple[int, ...]
    axes: tuple[str, ...]
    figures: tuple[Mapping[str, Any], ...]
    spec: SweepSpec  # as it was read, with what the command line changed

    @cached_property
    def tasks(self) -> list[Task]:
        """All runs, cell by cell, with ascending seeds in each."""
        tasks = []
        for index, cell in enumerate(self.cells):
            for seed in self.seeds:
                settings = {**cell.settings, "seed": seed}
                tasks.append(Task(key_of(settings), index, seed, settings, cost_of(settings)))
        return tasks

    @cached_property
    def batch(self) -> Batch:
        """The runs, with the plug-ins that they name."""
        named = {named for cell in self.cells for named in cell.run(self.seeds[0]).swarm.plug_ins}
        return Batch(self.name, self.tasks, fly, frozenset(named))


def fly(task: Task) -> tuple[str, Row]:
    """Fly one run; return how it ended, and its summary."""
    from dtsa_bench.simulation.simulate import simulate

    summary = simulate(run_config(task.settings)).summary()
    return summary["end"], summary


def cost_of(settings: Mapping[str, Any]) -> float:
    """Return a rough guess of the work in a run, about 1 us of a core."""
    agents = float(settings.get("agents", 12))
    slot_ms = float(settings.get("slot_ms", 10.0))
    slots = min(float(settings.get("timeout_s", 60.0)), 3.0 + agents / 5) * 1000.0 / slot_ms
    lossy = any(settings.get(name) for name in ("loss", "burst_length", "range_m", "loss_matrix", "losses", "schedule"))
    policy = POLICIES.row(settings.get("policy", "dtsa"))
    tables = 1.0 if policy.may_share and not lossy else agents
    priority = 0.05 if policy.weighs_all else 0.002
    return slots * (4.0 + 0.3 * agents + 0.006 * agents * agents + tables * priority * agents * (agents + 4) / 10)


def run_config(settings: Mapping[str, Any]) -> RunConfig:
    """Return a run from flat names: settings of the swarm, of the channel and of the limits side by side.

    ``seed`` is that of the swarm and of the channel.

    :raises ConfigError: for names that do not exist and values that are not allowed.
    """
    parts: dict[str, dict[str, Any]] = {section: {} for section in _SECTIONS}
    for name, value in settings.items():
        section = section_of(name)
        if section is None:
            raise ConfigError(name, value, SETTING_NAMES + ", ".join(setting_specs()))
        parts[section][name] = value
    swarm = SwarmConfig.from_dict(parts["swarm"])
    channel = {**from_swarm(swarm), **parts["channel"]}
    return RunConfig(swarm, ChannelConfig.from_dict(channel), RunLimits(**parts["limits"]))


def setting_specs() -> dict[str, Setting]:
    """Return the settings of a run by their flat names."""
    return {name: spec for section in _SECTIONS.values() for name, spec in section.items()}


def section_of(name: str) -> str | None:
    """Return the section of a flat name: swarm, channel or limits; None: there is no such setting."""
    return next((section for section, names in _SECTIONS.items() if name in names), None)


def preset_names() -> list[str]:
    """Names of the sweeps that come with the package."""
    return sorted(path.stem for path in PRESETS.glob("*.yaml"))


def load_preset(name: str, **changes: Any) -> Sweep:
    """Return a sweep that comes with the package; changes are those of :func:`make_sweep`.

    :raises ConfigError: if there is none of that name.
    """
    if name not in preset_names():
        raise ConfigError("preset", name, ", ".join(preset_names()))
    return load_file(PRESETS / f"{name}.yaml", **changes)


def load_file(path: str | Path, **changes: Any) -> Sweep:
    """Return the sweep in a YAML file; changes are those of :func:`make_sweep`.

    :raises ConfigError: if it cannot be read, or does not describe a sweep.
    """
    content = read_yaml(path, "file")
    if not isinstance(content, dict):
        raise ConfigError("file", str(path), "a mapping with axes, and base, seeds, title, text, figures as you like")
    return make_sweep(content, Path(path).stem, **changes)


def make_sweep(
    content: Mapping[str, Any],
    name: str,
    *,
    seeds: int | None = None,
    first_seed: int | None = None,
    base: Mapping[str, Any] | None = None,
) -> Sweep:
    """Return a sweep from the content of its YAML file; `seeds` and `base` win over those of the file.

    Every run is checked here, before anything flies.

    :raises ConfigError: naming what is not usable.
    """
    spec = SweepSpec.from_dict(content)
    chosen = _seeds(spec.seeds, seeds, first_seed)
    spec = dataclasses.replace(spec, base={**spec.base, **(base or {})}, seeds=list(chosen))
    levels = [
        [(label, own) for label, own in values.items()]
        if isinstance(values, dict)
        else [(value, {axis: value}) for value in values]
        for axis, values in spec.axes.items()
    ]
    cells = []
    for combination in itertools.product(*levels):
        labels = dict(zip(spec.axes, (label for label, _ in combination), strict=True))
        cells.append(Cell(labels, {**spec.base, **{k: v for _, own in combination for k, v in own.items()}}))
    _check(cells, chosen[0])
    title, axes = spec.title or name, tuple(spec.axes)
    return Sweep(name, title, spec.text.strip(), tuple(cells), chosen, axes, spec.figures, spec)


def _check(cells: list[Cell], seed: int) -> None:
    """Check every run; put what files of losses say into its settings, because a worker may not have the files.

    :raises ConfigError: naming what is not usable.
    """
    read: dict[tuple[Any, Any], dict[str, Any]] = {}  # by file and length of a slot
    for cell in cells:
        losses = cell.settings.get("losses")
        if not losses or isinstance(losses, Mapping):
            cell.run(seed)
            continue
        key = str(losses), cell.settings.get("slot_ms")
        cell.settings["losses"] = read.get(key, losses)
        losses_of_run = cell.run(seed).air.losses
        if isinstance(losses_of_run, MeasuredLosses):
            cell.settings["losses"] = read.setdefault(key, losses_of_run.to_dict())


def _levels(axis: str, values: object) -> list[Any] | dict[str, dict[str, Any]]:
    """Levels of an axis: a list of values of the setting it is named after, or names with settings each."""
    if axis in RESERVED:
        raise ConfigError(f"axes.{axis}", values, "another name: results have one of this name")
    if isinstance(values, Mapping) and values:
        return {str(name): _mapping(settings, f"axes.{axis}.{name}") for name, settings in values.items()}
    if isinstance(values, list) and values:
        if section_of(axis) is None:
            raise ConfigError(f"axes.{axis}", values, "names with settings, or an axis named after a setting")
        return list(values)
    raise ConfigError(f"axes.{axis}", values, "a list of values, or names with settings each")


def _seeds(listed: object, count: int | None, first: int | None) -> tuple[int, ...]:
    """Seeds that a file lists, or a number of them from the first one on."""
    if isinstance(listed, list):
        if not listed or not all(isinstance(seed, int) and not isinstance(seed, bool) for seed in listed):
            raise ConfigError("seeds", listed, "a number of seeds, or a list of whole numbers")
        if count is None and first is None:
            return tuple(listed)
        listed = len(listed)
    number = listed if count is None else count
    if not isinstance(number, int) or isinstance(number, bool) or not 1 <= number <= 1_000_000:
        raise ConfigError("seeds", number, "1 to 1000000")
    start = FIRST_SEED if first is None else first
    return tuple(range(start, start + number))


def _figure(entry: object, index: int, axes: Mapping[str, Any]) -> dict[str, Any]:
    place = f"figures[{index}]"
    figure = _mapping(entry, place)
    check_figure(figure, axes, f"{place}.")
    figure.setdefault("name", figure["kind"] if index == 0 else f"{figure['kind']}-{index + 1}")
    if not re.fullmatch(r"\w[\w.-]*", str(figure["name"])):
        raise ConfigError(f"{place}.name", figure["name"], "letters, digits, dots and hyphens: it names files")
    return figure


def check_figure(figure: Mapping[str, Any], axes: Mapping[str, Any], place: str = "") -> None:
    """Check a figure of a sweep with some axes and their levels; `place` is where it stands, for errors.

    :raises ConfigError: naming what is not usable.
    """
    kind = figure.get("kind")
    if kind not in list(FIGURES):
        raise ConfigError(f"{place}kind", kind, ", ".join(FIGURES))
    needed, more = FIGURES[kind]
    lists = ("y", "log") if kind in ("bars", "lines", "matrix") else ()
    for name, value in figure.items():
        if name not in (allowed := (*needed, *more, *lists, "kind", "name", "caption")):
            raise ConfigError(f"{place}{name}", value, f"of {kind}: {', '.join(allowed)}")
    for role in (*needed, *(name for name in more if name in figure)):
        if figure.get(role) not in list(axes):
            raise ConfigError(f"{place}{role}", figure.get(role), "one of the axes " + ", ".join(axes))
    if kind == "lines" and not all(is_number(level) for level in axes[figure["x"]]):
        raise ConfigError(f"{place}x", figure["x"], "an axis of numbers")
    for name in lists:
        measures = figure.get(name, [])
        if not isinstance(measures, (list, tuple)) or (name == "y" and not measures):
            raise ConfigError(f"{place}{name}", figure.get(name), "a list of measures")
        for measure in measures:
            if measure not in (CRASHED, *MEASURES):
                raise ConfigError(f"{place}{name}", measure, ", ".join((CRASHED, *MEASURES)))


def is_number(level: object) -> bool:
    """Whether a level of an axis is a number."""
    return isinstance(level, (int, float)) and not isinstance(level, bool)


def _mapping(value: object, name: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(name, value, "names with values")
    return {str(key): item for key, item in value.items()}
