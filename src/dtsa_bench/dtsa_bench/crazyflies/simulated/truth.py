"""The record of what really happened: one JSON object a line, positions at 100 Hz and events."""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

FLUSH_S = 0.1


class TruthLog:
    """Writes the truth of one fleet; without a path it only keeps the events in memory.

    Lines: `{"fleet": ...}` first, then `{"t": s, "p": [[x...], [y...], [z...]]}` (m, world) every 10 ms, and
    `{"t": s, "cf": id, "event": name, ...}`. What was written up to 0.1 s ago survives the process.
    """

    def __init__(self, path: Path | None, header: dict[str, Any]) -> None:
        self.events: list[dict[str, Any]] = []
        self._file: IO[str] | None = None
        self._flushed = 0.0
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("w", encoding="utf-8")
            self._file.write(json.dumps({"fleet": header}) + "\n")

    def event(self, t: float, cf: int, name: str, **details: Any) -> None:
        """Something happened to vehicle `cf` (id from 1; 0: the fleet) at t (s)."""
        entry = {"t": round(t, 3), "cf": cf, "event": name, **details}
        self.events.append(entry)
        if self._file is not None:
            self._file.write(json.dumps(entry) + "\n")
            self._file.flush()

    def positions(self, t: float, position: NDArray[np.float64]) -> None:
        """True positions at t (s), (3, N) m, world."""
        if self._file is None:
            return
        rows = ",".join("[" + ",".join(f"{v:.4f}" for v in row) + "]" for row in position.tolist())
        self._file.write(f'{{"t":{t:.2f},"p":[{rows}]}}\n')
        if t - self._flushed >= FLUSH_S:
            self._file.flush()
            self._flushed = t

    def close(self) -> None:
        """End of the record."""
        if self._file is not None:
            self._file.close()
            self._file = None


def read_truth(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], list[dict[str, Any]]]:
    """Times (T,), positions (T, 3, N) and events of a record. A last line that was cut off is ignored."""
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    entries = [json.loads(line) for line in lines]
    moments = [entry for entry in entries if "p" in entry]
    events = [entry for entry in entries if "event" in entry]
    return np.array([entry["t"] for entry in moments]), np.array([entry["p"] for entry in moments]), events
