"""What a report shows of one run, reduced to what a page can hold and a screen can show."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_bench.recordings.bag.metadata import RECOVERED_FROM
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.bag.run import OUTCOMES, RecordedRun, load_run, swarm_section
from dtsa_bench.recordings.tables.ages import follow_run
from dtsa_bench.recordings.tables.followed import Ages
from dtsa_bench.runs.hearing import recorded_problem, sentence

BINS = 400  # steps of the charts over time
SCENE_HZ = 20.0  # frames of the 3-D replay in a simulated second
SCENE_VALUES = 600_000  # most numbers in the replay: longer runs of larger swarms get fewer frames
CRASHES = 50  # most that are shown
PAIRS = 5  # closest pairs whose distance is drawn
MISSION_VALUES = ("battery_first_v", "battery_least_v", "link_quality_least", "log_age_most_s", "latency_most_ms")
MISSION_EVENTS = 1000  # most that are shown
UNKNOWN = -32768  # in the replay: nobody knows where it was
BLOCK = 512  # moments whose pair distances are computed at once

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Distances:
    """Distances of all pairs of agents over time."""

    time_s: Array  # (T,)
    least: Array  # (T,) m, of all pairs
    pairs: list[tuple[int, int]]  # ids, the closest first
    series: list[Array]  # (T,) m, one a pair
    crashes: list[tuple[int, int, int]]  # ids, and the first moment at which they were too close: index of time_s


def run_data(path: str | Path) -> dict[str, Any]:
    """Everything that the page needs to know about one run, as JSON types.

    :param path: run directory, bag directory or .mcap file.
    :raises UnusableBag: if it is none of a swarm's run.
    """
    with Bag(path) as bag:
        run = load_run(bag)
        version = bag.custom_data.get("version", "")
        recovered, file = RECOVERED_FROM in bag.custom_data, bag.path
    notes = ["This bag was recovered: its recorder was killed or its file was damaged."] if recovered else []
    distances = pair_distances(run, _collision_m(run))
    followed = follow_run(run)
    scenario, ages = followed.scenario, followed.ages
    notes += followed.notes
    told = sentence(recorded_problem(file))
    if told and not any(note.startswith(told.partition(":")[0]) for note in notes):
        notes.append(told)
    if unknown := int((~run.outcome_known).sum()):
        notes.append(f"Of {unknown} slots it is not known whether somebody sent: not all agents have told of them.")
    summary = followed.summary | _counts(run)
    if distances is not None and summary.get("min_distance_m") is None and len(distances.least):
        summary["min_distance_m"] = float(np.nanmin(distances.least))
    return {
        "name": run.name,
        "mission": mission_data(path),
        "version": version,
        "notes": notes,
        "config": flatten(run.config),
        "agents": run.agents,
        "crashes": _crashes(distances, run, summary),
        "moving": scenario.moving.tolist() if scenario else [True] * run.agents,
        "slot_s": run.slot_ns / 1e9,
        "duration_s": _duration_s(run),
        "summary": summary,
        "scene": _scene(run, scenario),
        "slots": _slots(run),
        "channel": _channel(run),
        "decisions": _reasons(run),
        "sent_for": _sent_for(run),
        "distances": _distances(distances, run),
        "ages": _ages(ages, run),
        "table": _table(run, ages, distances, scenario),
    }


def mission_data(path: str | Path) -> dict[str, Any] | None:
    """What `mission.json` beside a bag says of a mission with Crazyflies; None: there is none.

    :param path: run directory, bag directory or .mcap file.
    """
    place = Path(path)
    for directory in (place, place.parent, place.parent.parent):
        file = directory / "mission.json"
        if (directory == place or directory / "bag" in (place, place.parent)) and file.is_file():
            break
    else:
        return None
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        vehicles = [
            [
                str(name),
                *(values.get(key) for key in MISSION_VALUES),
                " → ".join(str(s["state"]) for s in values["states"]),
            ]
            for name, values in found["vehicles"].items()
        ]
        events = [[float(e["t_s"]), str(e["level"]), str(e["text"])] for e in found["events"]]
        return {"cut_short": str(found["cut_short"]), "vehicles": vehicles, "events": events[:MISSION_EVENTS]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def flatten(config: Mapping[str, Any], section: str = "") -> list[list[Any]]:
    """Settings as rows of section, name and value."""
    rows: list[list[Any]] = []
    for name, value in config.items():
        if isinstance(value, Mapping) and not section:
            rows.extend(flatten(value, str(name)))
        else:
            rows.append([section, str(name), value])
    return rows


def pair_distances(run: RecordedRun, collision_m: float = 0.2) -> Distances | None:
    """Distances at the recorded moments; None with fewer than two agents.

    :param run: the run.
    :param collision_m: m, below which two have crashed.
    """
    motion = run.motion
    count = len(motion.ids)
    if count < 2 or not len(motion.time_ns):
        return None
    first, second = np.triu_indices(count, 1)
    least = np.empty(len(motion.time_ns))
    closest = np.full(len(first), np.inf)
    touched = np.full(len(first), -1)
    for start in range(0, len(least), BLOCK):
        place = motion.position[start : start + BLOCK]
        apart = np.sqrt(((place[:, :, first] - place[:, :, second]) ** 2).sum(axis=1))
        apart[np.isnan(apart)] = np.inf
        least[start : start + BLOCK] = apart.min(axis=1)
        np.minimum(closest, apart.min(axis=0), out=closest)
        near = apart < collision_m
        new = near.any(axis=0) & (touched < 0)
        touched[new] = start + near[:, new].argmax(axis=0)
    chosen = [k for k in np.argsort(closest, kind="stable")[:PAIRS] if math.isfinite(closest[k])]
    series = []
    for k in chosen:
        gap = motion.position[:, :, first[k]] - motion.position[:, :, second[k]]
        series.append(np.sqrt((gap**2).sum(axis=1)))
    pairs = [(int(motion.ids[first[k]]), int(motion.ids[second[k]])) for k in chosen]
    ids = motion.ids
    crashes = [(int(ids[first[k]]), int(ids[second[k]]), int(touched[k])) for k in np.flatnonzero(touched >= 0)]
    crashes.sort(key=lambda crash: crash[2])
    return Distances((motion.time_ns - run.start_ns) / 1e9, least, pairs, series, crashes)


def _collision_m(run: RecordedRun) -> float:
    """Below this distance two agents have crashed, m."""
    limits = run.config.get("limits", {})
    return float(limits.get("collision_m", 0.2)) if isinstance(limits, Mapping) else 0.2


def _crashes(distances: Distances | None, run: RecordedRun, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Who crashed, when and where; the first ones if there are many."""
    if distances is None:
        return []
    found = list(distances.crashes)
    pair = tuple(summary.get("collided_pair") or ())
    motion = run.motion
    places = {int(number): place for place, number in enumerate(motion.ids)}
    if not found and len(pair) == 2 and set(pair) <= places.keys():
        # They crashed within a slot, and only its ends were recorded.
        gap = motion.position[:, :, places[pair[0]]] - motion.position[:, :, places[pair[1]]]
        found = [(*pair, int(np.nanargmin((gap**2).sum(axis=1))))]
    crashes = []
    for one, other, moment in found[:CRASHES]:
        a, b = (motion.position[moment, :, places[number]] for number in (one, other))
        crashes.append(
            {
                "ids": [one, other],
                "time_s": round(float(distances.time_s[moment]), 3),
                "place": thin((a + b) / 2, 3),
                "distance_m": round(float(np.linalg.norm(a - b)), 4),
            }
        )
    return crashes


def _duration_s(run: RecordedRun) -> float:
    ends = [0.0]
    if len(run.slots):
        ends.append((int(run.slots[-1]) + 1) * run.slot_ns / 1e9)
    if len(run.motion.time_ns):
        ends.append((int(run.motion.time_ns[-1]) - run.start_ns) / 1e9)
    return max(ends)


def _counts(run: RecordedRun) -> dict[str, Any]:
    counts = np.bincount(run.outcome[run.outcome_known], minlength=len(OUTCOMES))
    unknown = int((~run.outcome_known).sum())
    frames = run.frames
    offered = int(run.known_receivers.sum())
    return {
        "slots": {
            "total": len(run.slots),
            **dict(zip(OUTCOMES, counts.tolist(), strict=True)),
            **({"unknown": unknown} if unknown else {}),
        },
        "frames": len(frames.slot),
        "lost_fraction": float(frames.lost.sum()) / offered if offered else 0.0,
    }


def _scene(run: RecordedRun, scenario: Scenario | None) -> dict[str, Any] | None:
    motion = run.motion
    if not len(motion.ids) or not len(motion.time_ns):
        return None
    duration = (int(motion.time_ns[-1]) - int(motion.time_ns[0])) / 1e9
    frames = int(min(duration * SCENE_HZ, SCENE_VALUES / (3 * len(motion.ids)))) + 2
    index = np.unique(np.linspace(0, len(motion.time_ns) - 1, min(frames, len(motion.time_ns))).astype(int))
    known = np.isfinite(motion.position[index]) | (run.told is None)
    place = np.nan_to_num(motion.position[index])
    span = max(1.0, float(np.abs(place).max()))
    scale = span / 32000
    targets = scenario.target if scenario else place[-1]
    place = np.where(known, place, scale * UNKNOWN)
    return {
        "ids": motion.ids.tolist(),
        "time": pack(((motion.time_ns[index] - run.start_ns) / 1e9).astype("<f4")),
        "position": pack(np.round(place / scale).astype("<i2")),
        "scale": scale,
        "target": np.round(targets, 3).T.tolist(),
    }


def _slots(run: RecordedRun) -> dict[str, Any]:
    """Every frame that was sent: in which slot, by whom, why, and what became of it."""
    frames = run.frames
    outcome = np.zeros(len(frames.slot), np.uint8)
    if len(run.slots):
        place = np.minimum(np.searchsorted(run.slots, frames.slot), len(run.slots) - 1)
        outcome = run.outcome[place].astype(np.uint8)
    share = frames.received.sum(axis=1) / np.maximum(1, run.known_receivers)
    return {
        "slot": pack(frames.slot.astype("<u4")),
        "sender": pack(frames.sender.astype("<u2")),
        "outcome": pack(outcome),
        "reason": pack(_sender_reason(run).astype(np.uint8)),
        "received": pack(np.round(255 * np.minimum(share, 1)).astype(np.uint8)),
        **({} if run.outcome_known.all() else {"unknown": run.slots[~run.outcome_known].tolist()}),
        "first": int(run.slots[0]) if len(run.slots) else 0,
        "count": int(run.slots[-1] - run.slots[0]) + 1 if len(run.slots) else 0,
    }


def _sender_reason(run: RecordedRun) -> NDArray[np.int64]:
    """Why each frame was sent, as its sender decided; 255 where that was not recorded."""
    decisions, frames = run.decisions, run.frames
    reason = np.full(len(frames.slot), 255, np.int64)
    if not len(decisions.slot) or not len(frames.slot):
        return reason
    row = np.minimum(np.searchsorted(decisions.slot, frames.slot), len(decisions.slot) - 1)
    same = decisions.slot[row] == frames.slot
    mine = decisions.agent[row] == frames.sender[:, None]
    found = same & mine.any(axis=1)
    reason[found] = decisions.reason[row[found], mine[found].argmax(axis=1)]
    return reason


def _sent_for(run: RecordedRun) -> list[str]:
    """Reasons for which something was sent."""
    codes = np.unique(_sender_reason(run))
    return [run.decisions.names[code] for code in codes.tolist() if code < len(run.decisions.names)]


def _bin_of(run: RecordedRun, slots: NDArray[np.int64]) -> tuple[NDArray[np.int64], int, Array]:
    """Bin of each slot, number of bins, and the time in the middle of each bin, s."""
    first, last = int(run.slots[0]), int(run.slots[-1])
    count = max(1, min(BINS, (last - first + 1) // max(10, run.agents)))  # a few slots at least in each
    middle = (first + (np.arange(count) + 0.5) * (last - first + 1) / count) * run.slot_ns / 1e9
    return np.clip((slots - first) * count // (last - first + 1), 0, count - 1), count, middle


def _channel(run: RecordedRun) -> dict[str, Any] | None:
    if not len(run.slots):
        return None
    bins, count, middle = _bin_of(run, run.slots)
    shares = np.zeros((len(OUTCOMES), count))
    np.add.at(shares, (run.outcome, bins), run.outcome_known)
    shares /= np.maximum(1, np.bincount(bins, minlength=count))
    frames = run.frames
    lost, offered = np.zeros(count), np.zeros(count)
    if len(frames.slot):
        place, _, _ = _bin_of(run, frames.slot)
        np.add.at(lost, place, frames.lost)
        np.add.at(offered, place, np.maximum(run.told is None, run.known_receivers))
    return {
        "time": thin(middle),
        "share": {name: thin(shares[index]) for index, name in enumerate(OUTCOMES)},
        "lost": thin(lost / np.maximum(1, offered)),
    }


def _reasons(run: RecordedRun) -> dict[str, Any] | None:
    decisions = run.decisions
    if not len(decisions.slot) or not len(run.slots):
        return None
    bins, count, middle = _bin_of(run, decisions.slot)
    shares = np.zeros((len(decisions.names), count))
    np.add.at(shares, (decisions.reason, bins[:, None]), decisions.agent > 0)
    disagree = np.array([len(np.unique(row[row > 0])) > 1 for row in decisions.chosen])
    return {
        "names": list(decisions.names),
        "total": shares.sum(axis=1).astype(int).tolist(),
        "time": thin(middle),
        "share": [thin(row) for row in shares / np.maximum(1, shares.sum(axis=0))],
        "disagree": int(disagree.sum()),
    }


def _distances(distances: Distances | None, run: RecordedRun) -> dict[str, Any] | None:
    if distances is None:
        return None
    return {
        "time": thin(reduce_bins(distances.time_s, np.mean)),
        "least": thin(reduce_bins(distances.least, np.min), 4),
        "pairs": [
            {
                "ids": list(pair),
                "distance": thin(reduce_bins(series, np.nanmin), 4),
                "least": round(float(np.nanmin(series)), 4),
                "time": round(float(distances.time_s[int(np.nanargmin(series))]), 3),
            }
            for pair, series in zip(distances.pairs, distances.series, strict=True)
        ],
        "collision": _collision_m(run),
        "r_min": float(swarm_section(run.config).get("r_min", 0.3) or 0.3),
    }


def _ages(ages: Ages | None, run: RecordedRun) -> dict[str, Any] | None:
    if ages is None or not len(ages.slot):
        return None

    def chart(values: Array, digits: int) -> dict[str, Any]:
        known = np.isfinite(values)
        counts = np.maximum(1, known.sum(axis=1))
        mean = np.where(known.any(axis=1), np.nansum(values, axis=1) / counts, np.nan)
        most = np.where(known.any(axis=1), np.nan_to_num(values, nan=-1).max(axis=1), np.nan)
        heat = np.stack([reduce_bins(column, np.nanmax) for column in values.T])
        top = max(1e-9, float(np.nanmax(heat)) if np.isfinite(heat).any() else 1.0)
        level = np.where(np.isfinite(heat), np.round(254 * np.nan_to_num(heat) / top), 255).astype(np.uint8)
        return {
            "mean": thin(reduce_bins(mean, np.nanmean), digits),
            "most": thin(reduce_bins(most, np.nanmax), digits),
            "heat": pack(level),
            "top": round(top, digits),
        }

    time_s = run.time_s(ages.slot + 1)
    return {
        "time": thin(reduce_bins(time_s, np.mean)),
        "age": chart(ages.age, 2),
        "error": chart(ages.error, 4),
    }


def _table(
    run: RecordedRun, ages: Ages | None, distances: Distances | None, scenario: Scenario | None
) -> list[dict[str, Any]]:
    """One row an agent."""
    frames, motion = run.frames, run.motion
    rows = []
    for agent in range(1, run.agents + 1):
        mine = frames.sender == agent
        sent = int(mine.sum())
        row: dict[str, Any] = {
            "id": agent,
            "moving": bool(scenario.moving[agent - 1]) if scenario else None,
            "sent": sent,
            "heard": _heard_share(run, mine),
            "collided": int((frames.collided[mine] > 0).sum()) if run.merged is None else None,
        }
        if ages is not None:
            column = ages.results, agent - 1
            for name, values, digits in (("age", ages.age, 2), ("error", ages.error, 4)):
                known = values[column][np.isfinite(values[column])]
                row[f"{name}_mean"] = round(float(known.mean()), digits) if len(known) else None
                row[f"{name}_max"] = round(float(known.max()), digits) if len(known) else None
        place = np.flatnonzero(motion.ids == agent)
        if len(place) and len(motion.time_ns) > 1:
            track = motion.position[:, :, place[0]]
            known = np.isfinite(track).all(axis=1)
            steps = np.diff(track[known], axis=0)
            if known.any():
                row["path"] = round(float(np.sqrt((steps**2).sum(axis=1)).sum()), 3)
        rows.append(row)
    return rows


def _heard_share(run: RecordedRun, mine: NDArray[np.bool_]) -> float | None:
    """Share of an agent's receivers that received its frames; None without any of which it is known."""
    offered = int(run.known_receivers[mine].sum())
    if not mine.any() or (run.told is not None and not offered):
        return None
    return round(float(run.frames.received[mine].sum()) / max(1, offered), 4)


def reduce_bins(values: NDArray[Any], how: Any) -> Array:
    """(BINS or fewer,) from (T,): `how` applied to each of the bins; NaN where a bin holds nothing finite."""
    count = min(BINS, len(values))
    edges = np.linspace(0, len(values), count + 1).astype(int)
    result = np.full(count, np.nan)
    for index in range(count):
        part = values[edges[index] : edges[index + 1]]
        part = part[np.isfinite(part)]
        if len(part):
            result[index] = how(part)
    return result


def thin(values: NDArray[Any], digits: int = 4) -> list[float | None]:
    """Rounded numbers for JSON; None for what is not finite."""
    return [round(float(value), digits) if math.isfinite(value) else None for value in values]


def pack(values: NDArray[Any]) -> str:
    """The bytes of an array, base64, for the page's typed arrays."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
