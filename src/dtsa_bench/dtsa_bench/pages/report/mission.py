"""What a mission with Crazyflies has left beside its bag."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

VALUES = ("battery_first_v", "battery_least_v", "link_quality_least", "log_age_most_s", "latency_most_ms")
EVENTS = 1000  # most that are shown


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
                *(values.get(key) for key in VALUES),
                " → ".join(str(s["state"]) for s in values["states"]),
            ]
            for name, values in found["vehicles"].items()
        ]
        events = [[float(e["t_s"]), str(e["level"]), str(e["text"])] for e in found["events"]]
        return {"cut_short": str(found["cut_short"]), "vehicles": vehicles, "events": events[:EVENTS]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
