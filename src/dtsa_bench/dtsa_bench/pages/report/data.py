"""The report of recorded runs: what it shows of each, reduced to what a screen can show, and its one HTML file."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench.log.bag.errors import BagError
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.knowledge import MeanAges
from dtsa_bench.log.merged_bag import open_log
from dtsa_bench.pages.html import BINS, PALETTE, SCRIPTS, flatten, pack, reduce_bins, render_page, thin
from dtsa_bench.runs.delivery import as_sentence, recorded_problem
from dtsa_bench.runs.options import write_whole
from dtsa_channel_sim.model.verdict import OUTCOMES

from .distances import collision_m, distance_chart, list_crashes, pair_distances

SCENE_HZ = 20.0  # frames of the 3-D replay in a simulated second
SCENE_VALUES = 600_000  # most numbers in the replay: longer runs of larger swarms get fewer frames
UNKNOWN = -32768  # in the replay: it is not known where the agent was
VEHICLE_VALUES = ("battery_first_v", "battery_least_v", "link_quality_least", "log_age_most_s", "latency_most_ms")
MAX_EVENTS = 1000  # of a mission
MAX_RUNS = 8  # side by side

Array = NDArray[np.float64]


def run_data(path: str | Path) -> dict[str, Any]:
    """Return all that the page shows of one run (run directory, bag directory or .mcap file), as JSON types.

    :raises UnusableBag: if it has no run of a swarm.
    """
    run = open_log(path)
    distances = pair_distances(run, collision_m(run))
    followed, reasons = run.knowledge, _reasons(run)
    notes = [*run.notes, *followed.notes]
    recorded = as_sentence(recorded_problem(run.file or path))
    if recorded and not any(note.startswith(recorded.partition(":")[0]) for note in notes):
        notes.append(recorded)
    unknown = np.flatnonzero(run.recorded & ~run.outcome_known).tolist()
    if unknown:
        notes.append(
            f"Of {len(unknown)} slots it is not known whether an agent sent: not all agents have reported them."
        )
    summary = followed.summary | _counts(run, len(unknown))
    if distances is not None and summary.get("min_distance_m") is None and len(distances.least):
        summary["min_distance_m"] = float(np.nanmin(distances.least))
    return {
        "name": run.name,
        "mission": mission_data(path),
        "version": run.version,
        "notes": notes,
        "config": flatten(run.settings),
        "agents": run.agents,
        "crashes": list_crashes(distances, run, summary),
        "moving": run.moving.tolist(),
        "slot_s": run.slot_ns / 1e9,
        "duration_s": len(run) * run.slot_ns / 1e9,
        "summary": summary,
        "scene": _scene(run),
        "slots": _slots(run, reasons, unknown),
        "channel": _channel_use(run),
        "decisions": _decisions(run, reasons),
        "sent_for": [reasons.names[code] for code in np.unique(reasons.sent_for).tolist() if code < len(reasons.names)],
        "distances": distance_chart(distances, run),
        "ages": _ages(followed.ages, run),
        "table": [_agent_row(run, followed.ages, agent) for agent in range(1, run.agents + 1)],
    }


class _Reasons(NamedTuple):
    """Why agents decided as they did."""

    codes: NDArray[np.uint8]  # reasons that decisions had, ascending
    names: list[str]  # of these
    sent_for: NDArray[np.int64]  # why each frame was sent, as its sender decided: place in codes; 255: not recorded


def _reasons(run: FlightLog) -> _Reasons:
    codes, frames = np.unique(run.reason[run.known]), run.sent_frames
    sender = frames.row, frames.sender - 1
    sent_for = np.where(run.known[sender], np.searchsorted(codes, run.reason[sender]), 255)
    return _Reasons(codes, [REASONS[code] if code < len(REASONS) else str(code) for code in codes.tolist()], sent_for)


def _counts(run: FlightLog, unknown: int) -> dict[str, Any]:
    counts = np.bincount(run.outcome[run.outcome_known], minlength=len(OUTCOMES))
    frames, offered = run.sent_frames, int(run.known_receivers[run.sender_known].sum())
    return {
        "slots": {
            "total": int(run.recorded.sum()),
            **dict(zip(OUTCOMES, counts.tolist(), strict=True)),
            **({"unknown": unknown} if unknown else {}),
        },
        "frames": len(frames.row),
        "lost_fraction": float(frames.lost[run.sender_known].sum()) / offered if offered else 0.0,
    }


def _scene(run: FlightLog) -> dict[str, Any] | None:
    time_s, path = run.instants_s, run.path
    if not len(time_s):
        return None
    frames = int(min(float(time_s[-1] - time_s[0]) * SCENE_HZ, SCENE_VALUES / (3 * run.agents))) + 2
    index = np.unique(np.linspace(0, len(time_s) - 1, min(frames, len(time_s))).astype(int))
    place = np.nan_to_num(path[index])
    scale = max(1.0, float(np.abs(place).max())) / 32000
    targets = run.scenario.target if run.scenario else place[-1]
    whole = np.where(np.isfinite(path[index]), np.round(place / scale), UNKNOWN)
    return {
        "ids": list(range(1, run.agents + 1)),
        "time": pack(time_s[index].astype("<f4")),
        "position": pack(whole.astype("<i2")),
        "scale": scale,
        "target": np.round(targets, 3).T.tolist(),
    }


def _slots(run: FlightLog, reasons: _Reasons, unknown: list[int]) -> dict[str, Any]:
    """Every frame that was sent: in which slot, by whom, why, and what became of it."""
    frames, receivers = run.sent_frames, run.receivers.sum(axis=1)
    level = np.round(254 * run.reached.sum(axis=1) / np.maximum(1, receivers))
    return {
        "slot": pack(frames.row.astype("<u4")),
        "sender": pack(frames.sender.astype("<u2")),
        "outcome": pack(np.minimum(run.outcome[frames.row], len(OUTCOMES) - 1)),
        "reason": pack(reasons.sent_for.astype(np.uint8)),
        "received": pack(np.where(receivers > 0, level, 255).astype(np.uint8)),  # 255: not known
        **({"unknown": unknown} if unknown else {}),
        "first": 0,
        "count": len(run),
    }


def _sum_in_bins(run: FlightLog, slots: NDArray[np.int64], kinds: Any, values: Any, count: int) -> tuple[Array, Array]:
    """Sums of values over time by kind, (count, bins), and the time in the middle of each bin, s."""
    bins = max(1, min(BINS, len(run) // max(10, run.agents)))  # a few slots at least in each
    sums = np.zeros((count, bins))
    np.add.at(sums, (kinds, np.clip(slots * bins // max(1, len(run)), 0, bins - 1)), values)
    return sums, (np.arange(bins) + 0.5) * len(run) / bins * run.slot_ns / 1e9


def _channel_use(run: FlightLog) -> dict[str, Any] | None:
    slots, frames = np.flatnonzero(run.recorded), run.sent_frames
    if not len(slots):
        return None
    kinds = np.minimum(run.outcome[slots], len(OUTCOMES) - 1)
    shares, middle = _sum_in_bins(run, slots, kinds, run.outcome_known[slots], len(OUTCOMES))
    (recorded,), _ = _sum_in_bins(run, slots, 0, 1, 1)
    rows = frames.row[run.sender_known]
    (lost,), _ = _sum_in_bins(run, rows, 0, frames.lost[run.sender_known], 1)
    (offered,), _ = _sum_in_bins(run, rows, 0, run.known_receivers[run.sender_known], 1)
    return {
        "time": thin(middle),
        "share": {name: thin(row / np.maximum(1, recorded)) for name, row in zip(OUTCOMES, shares, strict=True)},
        "lost": thin(lost / np.maximum(1, offered)),
    }


def _decisions(run: FlightLog, reasons: _Reasons) -> dict[str, Any] | None:
    slots, column = np.nonzero(run.known)
    if not len(slots):
        return None
    kinds = np.searchsorted(reasons.codes, run.reason[slots, column])
    shares, middle = _sum_in_bins(run, slots, kinds, 1, len(reasons.names))
    least = np.where(run.known, run.chosen, np.iinfo(np.uint16).max).min(axis=1)
    most = np.where(run.known, run.chosen, 0).max(axis=1)
    return {
        "names": reasons.names,
        "total": shares.sum(axis=1).astype(int).tolist(),
        "time": thin(middle),
        "share": [thin(row) for row in shares / np.maximum(1, shares.sum(axis=0))],
        "disagree": int((run.known.any(axis=1) & (least != most)).sum()),
    }


def _ages(ages: MeanAges | None, run: FlightLog) -> dict[str, Any] | None:
    if ages is None or not len(run):
        return None

    def chart(values: Array, digits: int) -> dict[str, Any]:
        known = np.isfinite(values)
        some = known.any(axis=1)
        mean = np.where(some, np.nansum(values, axis=1) / np.maximum(1, known.sum(axis=1)), np.nan)
        most = np.where(some, np.nan_to_num(values, nan=-1).max(axis=1), np.nan)
        heat = np.stack([reduce_bins(column, np.nanmax) for column in values.T])
        top = max(1e-9, float(np.nanmax(heat)) if np.isfinite(heat).any() else 1.0)
        level = np.where(np.isfinite(heat), np.round(254 * np.nan_to_num(heat) / top), 255).astype(np.uint8)
        return {
            "mean": thin(reduce_bins(mean, np.nanmean), digits),
            "most": thin(reduce_bins(most, np.nanmax), digits),
            "heat": pack(level),
            "top": round(top, digits),
        }

    time_s = run.time_s(np.arange(1, len(run) + 1))
    return {"time": thin(reduce_bins(time_s, np.mean)), "age": chart(ages.age, 2), "error": chart(ages.error, 4)}


def _agent_row(run: FlightLog, ages: MeanAges | None, agent: int) -> dict[str, Any]:
    """The row of an agent in the table."""
    frames, is_merged = run.sent_frames, run.merged is not None
    own = frames.sender == agent
    known = own & run.sender_known
    receivers = run.receivers[known]
    heard = round(float(run.reached[known].sum()) / max(1, int(receivers.sum())), 4)
    row: dict[str, Any] = {
        "id": agent,
        "moving": bool(run.scenario.moving[agent - 1]) if run.scenario else None,
        "sent": int(own.sum()),
        "heard": heard if receivers.any() else None,
        "collided": None if is_merged else int((frames.collided[own] > 0).sum()),
    }
    for name, digits in (("age", 2), ("error", 4)) if ages else ():
        values, observers = getattr(ages, name)[:, agent - 1], ages.observers[:, agent - 1]
        known = np.isfinite(values) & ages.results
        values, observers = values[known], observers[known]
        mean = float(values @ observers) / max(1, int(observers.sum()))  # over pairs, as in the results
        row[f"{name}_mean"] = round(mean, digits) if len(values) else None
        row[f"{name}_max"] = round(float(values.max()), digits) if len(values) else None
    track = run.path[:, :, agent - 1]
    track = track[np.isfinite(track).all(axis=1)]
    if len(run.path) > 1 and len(track):
        row["path"] = round(float(np.sqrt((np.diff(track, axis=0) ** 2).sum(axis=1)).sum()), 3)
    return row


def mission_data(path: str | Path) -> dict[str, Any] | None:
    """Return the contents of `mission.json` beside the bag of a mission with Crazyflies; None: there is none."""
    place = Path(path)
    for directory in (place, place.parent, place.parent.parent):
        file = directory / "mission.json"
        if (directory == place or directory / "bag" in (place, place.parent)) and file.is_file():
            break
    else:
        return None
    try:
        mission = json.loads(file.read_text(encoding="utf-8"))
        vehicles = []
        for name, values in mission["vehicles"].items():
            states = " → ".join(str(state["state"]) for state in values["states"])
            vehicles.append([str(name), *(values.get(key) for key in VEHICLE_VALUES), states])
        events = [[float(event["t_s"]), str(event["level"]), str(event["text"])] for event in mission["events"]]
        return {"cut_short": str(mission["cut_short"]), "vehicles": vehicles, "events": events[:MAX_EVENTS]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


# -- the page ---------------------------------------------------------------------------------------------------------
def render(runs: Sequence[dict[str, Any]]) -> str:
    """The page of what `run_data` gave for each run."""
    title = " · ".join(run["name"] for run in runs) + " – DTSA report"
    data = {"runs": list(runs), "palette": PALETTE, "reasons": dict(REASON_TEXTS)}
    return render_page("report", title, (*SCRIPTS, "report.js"), data)


def write_report(bags: Sequence[str | Path], out: str | Path, progress: Callable[[str], None] | None = None) -> Path:
    """Write the report of one bag, or of several side by side.

    :param bags: one to eight bags.
    :param out: the HTML file; an older one is replaced.
    :param progress: called with each bag before it is read.
    :raises ConfigError: for unusable bags, too many of them, or an unusable output path.
    :raises BagError: if the file cannot be written.
    """
    if not 1 <= len(bags) <= MAX_RUNS:
        raise ConfigError("bags", len(bags), f"1 to {MAX_RUNS} side by side")
    target = Path(out)
    if target.is_dir():
        raise ConfigError("out", str(out), "the name of a file; this is a directory")
    runs = []
    for bag in bags:
        if progress:
            progress(str(bag))
        runs.append(run_data(bag))
    _number_equal_names(runs)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_whole(target, render(runs))
    except OSError as error:
        raise BagError(f"cannot write {target}: {error.strerror or error}") from error
    return target


def _number_equal_names(runs: list[dict[str, Any]]) -> None:
    names = [run["name"] for run in runs]
    for index, run in enumerate(runs):
        if names.count(run["name"]) > 1:
            run["name"] = f"{names[index]} ({names[: index + 1].count(names[index])})"
