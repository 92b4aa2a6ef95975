"""What a report shows of one run, reduced to what a page can hold and a screen can show."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_bench.pages.html import BINS, flatten, pack, reduce_bins, thin
from dtsa_bench.recordings.bag.metadata import RECOVERED_FROM
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.bag.run import OUTCOMES, RecordedRun, load_run
from dtsa_bench.recordings.tables.ages import follow_run
from dtsa_bench.recordings.tables.followed import Ages
from dtsa_bench.runs.hearing import recorded_problem, sentence

from .distances import collision_m, distance_chart, list_crashes, pair_distances

SCENE_HZ = 20.0  # frames of the 3-D replay in a simulated second
SCENE_VALUES = 600_000  # most numbers in the replay: longer runs of larger swarms get fewer frames
UNKNOWN = -32768  # in the replay: it is not known where the agent was
VEHICLE_VALUES = ("battery_first_v", "battery_least_v", "link_quality_least", "log_age_most_s", "latency_most_ms")
MAX_EVENTS = 1000  # of a mission

Array = NDArray[np.float64]


def run_data(path: str | Path) -> dict[str, Any]:
    """Return all that the page shows of one run (run directory, bag directory or .mcap file), as JSON types.

    :raises UnusableBag: if it has no run of a swarm.
    """
    with Bag(path) as bag:
        run = load_run(bag)
        version = bag.custom_data.get("version", "")
        recovered, file = RECOVERED_FROM in bag.custom_data, bag.path
    notes = ["This bag was recovered: its recorder was killed or its file was damaged."] if recovered else []
    distances = pair_distances(run, collision_m(run))
    followed = follow_run(run)
    scenario, ages = followed.scenario, followed.ages
    notes += followed.notes
    problem = sentence(recorded_problem(file))
    if problem and not any(note.startswith(problem.partition(":")[0]) for note in notes):
        notes.append(problem)
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
        "crashes": list_crashes(distances, run, summary),
        "moving": scenario.moving.tolist() if scenario else [True] * run.agents,
        "slot_s": run.slot_ns / 1e9,
        "duration_s": _duration_s(run),
        "summary": summary,
        "scene": _scene(run, scenario),
        "slots": _slots(run),
        "channel": _channel_use(run),
        "decisions": _reasons(run),
        "sent_for": _sent_for(run),
        "distances": distance_chart(distances, run),
        "ages": _ages(ages, run),
        "table": _table(run, ages, scenario),
    }


def _duration_s(run: RecordedRun) -> float:
    last_slot = (int(run.slots[-1]) + 1) * run.slot_ns if len(run.slots) else 0
    last_position = int(run.motion.time_ns[-1]) - run.start_ns if len(run.motion.time_ns) else 0
    return max(last_slot, last_position) / 1e9


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
    position = np.nan_to_num(motion.position[index])
    scale = max(1.0, float(np.abs(position).max())) / 32000
    targets = scenario.target if scenario else position[-1]
    position = np.where(known, position, scale * UNKNOWN)
    return {
        "ids": motion.ids.tolist(),
        "time": pack(((motion.time_ns[index] - run.start_ns) / 1e9).astype("<f4")),
        "position": pack(np.round(position / scale).astype("<i2")),
        "scale": scale,
        "target": np.round(targets, 3).T.tolist(),
    }


def _slots(run: RecordedRun) -> dict[str, Any]:
    """Every frame: its slot, sender, reason, outcome and share of receivers."""
    frames = run.frames
    outcome = np.zeros(len(frames.slot), np.uint8)
    if len(run.slots):
        row = np.minimum(np.searchsorted(run.slots, frames.slot), len(run.slots) - 1)
        outcome = run.outcome[row].astype(np.uint8)
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
    """Reason of each frame's sender; 255 where it was not recorded."""
    decisions, frames = run.decisions, run.frames
    reason = np.full(len(frames.slot), 255, np.int64)
    if not len(decisions.slot) or not len(frames.slot):
        return reason
    row = np.minimum(np.searchsorted(decisions.slot, frames.slot), len(decisions.slot) - 1)
    is_sender = decisions.agent[row] == frames.sender[:, None]
    known = (decisions.slot[row] == frames.slot) & is_sender.any(axis=1)
    reason[known] = decisions.reason[row[known], is_sender[known].argmax(axis=1)]
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


def _channel_use(run: RecordedRun) -> dict[str, Any] | None:
    if not len(run.slots):
        return None
    bins, count, middle = _bin_of(run, run.slots)
    shares = np.zeros((len(OUTCOMES), count))
    np.add.at(shares, (run.outcome, bins), run.outcome_known)
    shares /= np.maximum(1, np.bincount(bins, minlength=count))
    frames = run.frames
    lost, offered = np.zeros(count), np.zeros(count)
    if len(frames.slot):
        frame_bins, _, _ = _bin_of(run, frames.slot)
        np.add.at(lost, frame_bins, frames.lost)
        np.add.at(offered, frame_bins, np.maximum(run.told is None, run.known_receivers))
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


def _table(run: RecordedRun, ages: Ages | None, scenario: Scenario | None) -> list[dict[str, Any]]:
    """One row an agent."""
    frames, motion = run.frames, run.motion
    rows = []
    for agent in range(1, run.agents + 1):
        own = frames.sender == agent
        offered = int(run.known_receivers[own].sum())
        known_share = own.any() and (offered or run.told is None)
        row: dict[str, Any] = {
            "id": agent,
            "moving": bool(scenario.moving[agent - 1]) if scenario else None,
            "sent": int(own.sum()),
            "heard": round(float(frames.received[own].sum()) / max(1, offered), 4) if known_share else None,
            "collided": int((frames.collided[own] > 0).sum()) if run.merged is None else None,
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
            track = track[np.isfinite(track).all(axis=1)]
            if len(track):
                row["path"] = round(float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum()), 3)
        rows.append(row)
    return rows


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
