"""What happened in a mission, as its ground station heard it: `mission.json`, written however it ends."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_msgs.msg import Status
from rcl_interfaces.msg import Log

from dtsa_bench.experiments.batch.table import write_whole

NAME = "mission.json"
MOST_EVENTS = 5000
_LEVELS = {10: "debug", 20: "info", 30: "warn", 40: "error", 50: "fatal"}


@dataclass(slots=True)
class VehicleLog:
    """One vehicle's part."""

    battery_first_v: float = math.nan
    battery_last_v: float = math.nan
    battery_least_v: float = math.inf
    link_quality_least: float = 1.0  # from arming on
    log_age_most_s: float = 0.0
    latency_most_ms: float = 0.0  # of a command, 99th percentile
    states: list[dict[str, Any]] = field(default_factory=list)  # t_s, state, reason: each change


class MissionLog:
    """Collects. For one thread, the executor's."""

    def __init__(self) -> None:
        self.began = time.time()
        self.vehicles: dict[str, VehicleLog] = {}
        self.events: list[dict[str, Any]] = []
        self.diagnostics: dict[str, dict[str, float | str]] = {}  # what the bridge said last about each
        self.dropped = 0

    def _now(self) -> float:
        return round(time.time() - self.began, 3)

    def status(self, name: str, message: Status) -> None:
        """A vehicle's status."""
        log = self.vehicles.setdefault(name, VehicleLog())
        volts = round(float(message.battery_voltage), 3)
        if volts > 0.0:
            log.battery_first_v = volts if math.isnan(log.battery_first_v) else log.battery_first_v
            log.battery_last_v, log.battery_least_v = volts, min(volts, log.battery_least_v)
        if message.state in (Status.STATE_ARMED, Status.STATE_FLYING, Status.STATE_LANDING, Status.STATE_LOST):
            log.link_quality_least = min(log.link_quality_least, round(float(message.link_quality), 3))
            log.log_age_most_s = max(log.log_age_most_s, round(float(message.log_age), 3))
            log.latency_most_ms = max(log.latency_most_ms, round(float(message.latency_ms), 2))
        if not log.states or log.states[-1]["state"] != message.state_name:
            log.states.append({"t_s": self._now(), "state": message.state_name, "reason": message.reason})

    def event(self, message: Log) -> None:
        """Something that the bridge did, or was ordered to do."""
        if len(self.events) < MOST_EVENTS:
            level = _LEVELS.get(int(message.level), str(message.level))
            when = message.stamp.sec + message.stamp.nanosec * 1e-9 - self.began
            self.events.append({"t_s": round(when, 3), "level": level, "text": message.msg})
        else:
            self.dropped += 1

    def to_dict(self, reason: str) -> dict[str, Any]:
        """Everything, JSON types only.

        :param reason: why the mission was cut short; empty: it was not.
        """
        vehicles = {}
        for name, log in sorted(self.vehicles.items()):
            values = {key: getattr(log, key) for key in VehicleLog.__dataclass_fields__}
            for key, value in values.items():
                if isinstance(value, float) and not math.isfinite(value):
                    values[key] = None
            vehicles[name] = values | {"last": self.diagnostics.get(name, {})}
        return {
            "began_unix_s": round(self.began, 3),
            "duration_s": self._now(),
            "cut_short": reason,
            "vehicles": vehicles,
            "events": sorted(self.events, key=lambda event: event["t_s"]),
            "events_left_out": self.dropped,
        }

    def write(self, directory: Path, reason: str) -> None:
        """`mission.json` in the flight's directory."""
        text = json.dumps(self.to_dict(reason), indent=1, allow_nan=False) + "\n"
        write_whole(directory / NAME, text)
