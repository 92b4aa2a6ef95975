"""A summary for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dtsa_agent.core.settings.declaration import Settings, settings_of

from .config import FROM_SWARM, RunConfig
from .metrics import COMPLETED, CRASHED


def describe(summary: Mapping[str, Any]) -> str:
    """A summary in a few lines."""
    return "".join(f"{name:25}{text}\n" for name, text in result_rows(summary))


def result_rows(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """All results as rows of name and text."""
    rows = []
    for key, value in summary.items():
        if isinstance(value, dict):
            value = ", ".join(f"{count} {name}" for name, count in value.items())
        elif isinstance(value, float):
            value = f"{value:.6g}"
        elif isinstance(value, list):
            value = " and ".join(str(item) for item in value)
        rows.append((key.replace("_", " "), "-" if value is None else str(value)))
    return rows


def setting_rows(run: RunConfig) -> list[tuple[str, str]]:
    """All settings of a run as rows of name and text, those of swarm, channel and limits one after the other."""
    sections: tuple[tuple[str, Settings], ...] = (("swarm", run.swarm), ("channel", run.air), ("limits", run.limits))
    rows = []
    for section, settings in sections:
        for spec in settings_of(type(settings)):
            unit = "" if spec.unit in ("", "1") else f" {spec.unit}"
            rows.append((f"{section}.{spec.name}", _short(getattr(settings, spec.name)) + unit))
    return rows


def what_flew(run: RunConfig) -> str:
    """A run in one line: its policy, estimator, avoider, agents, what they do, and the seed."""
    swarm = run.swarm
    moving = "all" if swarm.movers == swarm.agents else str(swarm.movers)
    return (
        f"{swarm.policy}, {swarm.estimator}, {swarm.avoider}; {swarm.agents} agents, {moving} of them moving "
        f"({swarm.scenario}); seed {swarm.seed}"
    )


def what_came_of_it(summary: Mapping[str, Any], run: RunConfig) -> list[tuple[str, str]]:
    """The results that are asked for first, as rows of name and text; what is not known is left out."""
    known = {name: value for name, value in summary.items() if value is not None}
    rows = [("outcome", _outcome(known))]
    for name, key in (("ages", "age"), ("from waking", "waking_age")):
        if f"{key}_mean_slots" in known:
            values = [(known[f"{key}_{of}_slots"], known[f"{key}_{of}_ms"]) for of in ("mean", "max")]
            mean, most = (f"{_three(slots)} slots ({_three(ms)} ms)" for slots, ms in values)
            rows.append((name, f"{mean} on average, {most} at most"))
    if "estimate_error_mean_m" in known:
        mean, most = (f"{_three(1000 * known[f'estimate_error_{of}_m'])} mm" for of in ("mean", "max"))
        rows.append(("errors", f"{mean} on average, {most} at most, of where the others are thought to be"))
    if "min_distance_m" in known:
        pair = " and ".join(map(str, known.get("min_distance_pair", ())))
        where = f" (agents {pair} at {known['min_distance_time_s']:.2f} s)" if pair else ""
        limit = f"closer than {run.limits.collision_m:g} m is a crash"
        rows.append(("distance", f"{known['min_distance_m']:.3f} m at least{where}; {limit}"))
    if "slots" in known:
        count = known["slots"]
        parts = ", ".join(f"{count[name]} {name}" for name in ("success", "collision", "idle"))
        rows.append(("slots", f"{count['total']} of {run.swarm.slot_ms:g} ms: {parts}"))
    return [*rows, ("channel", _channel(known, run))]


def _outcome(known: Mapping[str, Any]) -> str:
    if "end" not in known:
        return "not known"
    after = known["completion_time_s"] if known["end"] == COMPLETED else known["flight_time_s"]
    pair = " and ".join(map(str, known.get("collided_pair", ())))
    if known["end"] == CRASHED:
        text = f"crashed after {after:.2f} s: agents {pair}"
    else:
        crash = f"agents {pair} crashed" if known["collided"] else "no crash"
        text = f"{known['end']} after {after:.2f} s, {crash}"
    if "efficiency_mean" in known:
        text += f"; efficiency {known['efficiency_mean']:.3f}"
    lost = ", ".join(map(str, known.get("lost_agents", ())))
    return f"{text}; lost agents: {lost}" if lost else text


def _channel(known: Mapping[str, Any], run: RunConfig) -> str:
    changed = {name: value for name, value in run.air.not_default().items() if name not in FROM_SWARM}
    parts = [", ".join(f"{name} {_short(value)}" for name, value in changed.items()) or "loss 0"]
    if "frames_per_s" in known:
        parts.append(f"{_three(known['frames_per_s'])} frames/s")
    if "channel_load" in known:
        parts.append(f"on the air {_three(100 * known['channel_load'])} % of the time")
    return "; ".join(parts)


def _three(value: float) -> str:
    """Three digits, all of a larger number."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def _short(value: object) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."
