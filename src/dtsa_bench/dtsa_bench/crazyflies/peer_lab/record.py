"""What was observed of a flight in the laboratory: packets, ages, distances, and the digest of all of it."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

_FLYING_M = 0.05  # higher than that it is in the air


@dataclass(frozen=True, slots=True)
class PeerPacket:
    """A peer-to-peer packet on its way."""

    sender: int  # id; 0: a foreign one
    raw: bytes  # port and data
    ordered_ns: int  # when the app ordered to send it

    @property
    def data(self) -> bytes:
        """Without the port."""
        return self.raw[1:]


class StateAges:
    """How old what each vehicle knows of each other one is, from the first packet that it heard of it on."""

    def __init__(self, agents: int) -> None:
        shape = (agents, agents)  # receiver, sender
        self._stamp = np.full(shape, -1, dtype=np.int64)  # ns, when the newest was ordered
        self._since = np.zeros(shape, dtype=np.int64)
        self._last = np.zeros(shape, dtype=np.int64)
        self._area = np.zeros(shape)  # ms s
        self._worst = np.zeros(shape, dtype=np.int64)

    def add_state(self, receiver: int, sender: int, stamp_ns: int, now_ns: int) -> None:
        """A state of a sender (id) has come to a receiver (id)."""
        pair = receiver - 1, sender - 1
        if stamp_ns <= self._stamp[pair]:
            return
        if self._stamp[pair] < 0:
            self._since[pair] = now_ns
        else:
            self._advance(pair, now_ns)
        self._stamp[pair], self._last[pair] = stamp_ns, now_ns

    def _advance(self, pairs: Any, now_ns: int) -> None:
        first, last = self._last[pairs] - self._stamp[pairs], now_ns - self._stamp[pairs]
        self._area[pairs] += (first + last) / 2e6 * (now_ns - self._last[pairs]) / 1e9
        self._worst[pairs] = np.maximum(self._worst[pairs], last)
        self._last[pairs] = now_ns

    def summary(self, now_ns: int) -> dict[str, Any]:
        """Mean and largest age in ms until the end, and the share of pairs that know each other."""
        known, pairs = self._stamp >= 0, len(self._stamp) * (len(self._stamp) - 1)
        self._advance(known, now_ns)
        seconds = sum(((now_ns - self._since[known]) / 1e9).tolist())
        return {
            "mean_age_ms": sum(self._area[known].tolist()) / seconds if seconds else None,
            "largest_age_ms": int(self._worst[known].max()) / 1e6 if known.any() else None,
            "pairs_known": int(known.sum()) / pairs if pairs else 1.0,
        }


#: Gets what happens: kind, id of the agent (0: all), time (ns), content. The kinds: `sent` and `heard` (a packet, as
#: an app has ordered it, or its callback gets it), `command` (number as of engine.Command, and its bytes), `print`
#: (text), `record` (bytes of peerLabRecord), `app_channel` (bytes to the ground), `event` (name of what happened to a
#: vehicle), and `positions` (true places every 10 ms, (3, N), m, world).
Observer = Callable[[str, int, int, Any], None]


#: Codes of kinds in the digest; an app's command has the code 2 and more.
_CODES = {"sent": 0, "heard": 1, "command": 2, "print": 20, "event": 21, "positions": 22, "record": 23}


class Record:
    """Counts, ages, distances, and the digest of all of it; with a directory, a file of all packets."""

    def __init__(self, agents: int, addressed: bool, directory: Path | None = None) -> None:
        self._addressed, self._ages, self._digest = addressed, StateAges(agents), hashlib.sha256()
        self.agents = agents
        self.sent, self.heard = [0] * agents, [0] * agents
        self.setpoints = 0
        self.on_air_ns = 0
        self.nearest: tuple[float, float, int, int] | None = None  # m, s, ids
        self.crashed: dict[int, float] = {}  # s, by id
        self.console: list[tuple[float, int, str]] = []  # s, id, line
        self._lines: dict[int, str] = {}
        self._file: IO[str] | None = None
        if directory is not None:
            self._file = (directory / "packets.jsonl").open("w", encoding="utf-8")

    def __call__(self, kind: str, agent: int, now_ns: int, content: Any) -> None:
        """See `Observer`."""
        if kind not in _CODES:
            return
        code, data = _CODES[kind], content
        if kind in ("sent", "heard"):
            data = content.raw
            self._add_packet(kind, agent, now_ns, content)
        elif kind == "command":
            code, data = code + content[0], content[1]
        elif kind == "print":
            data = content.encode()
            *lines, rest = (self._lines.get(agent, "") + content).split("\n")
            self._lines[agent] = rest
            self.console += [(now_ns / 1e9, agent, line) for line in lines]
        elif kind == "event":
            data = content.encode()
            if content in ("crash", "hard landing"):
                self.crashed.setdefault(agent, now_ns / 1e9)
        elif kind == "positions":
            data = np.ascontiguousarray(content).tobytes()
            self._add_positions(now_ns, content)
        self._digest.update(struct.pack("<BHqI", code, agent, now_ns, len(data)) + data)

    def _add_packet(self, kind: str, agent: int, now_ns: int, packet: PeerPacket) -> None:
        (self.sent if kind == "sent" else self.heard)[agent - 1] += 1
        if self._file is not None:
            sender = {"sender": packet.sender} if kind == "heard" else {}
            line = {"t_ns": now_ns, kind: agent, **sender, "port": packet.raw[0], "data": packet.data.hex()}
            self._file.write(json.dumps(line) + "\n")
        data = packet.data
        is_state = not self._addressed or (len(data) > 3 and data[1] == 0 and data[3] == agent)
        if kind == "heard" and packet.sender and is_state:
            self._ages.add_state(agent, packet.sender, packet.ordered_ns, now_ns)

    def _add_positions(self, now_ns: int, position: NDArray[np.float64]) -> None:
        flying = np.flatnonzero(position[2] > _FLYING_M)
        if len(flying) > 1:
            p = position[:, flying]
            first, second = np.triu_indices(len(flying), 1)
            distance = np.sqrt(((p[:, first] - p[:, second]) ** 2).sum(axis=0))
            k = int(distance.argmin())
            if self.nearest is None or distance[k] < self.nearest[0]:
                pair = int(flying[first[k]]) + 1, int(flying[second[k]]) + 1
                self.nearest = float(distance[k]), now_ns / 1e9, *pair

    def close(self) -> None:
        """End of the record."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def summary(self, now_ns: int) -> dict[str, Any]:
        """What came of it until the end."""
        near = self.nearest
        return {
            "agents": self.agents,
            "seconds": now_ns / 1e9,
            **self._ages.summary(now_ns),
            "sent": sum(self.sent),
            "heard": sum(self.heard),
            "share_of_air": self.on_air_ns / now_ns if now_ns else 0.0,
            "setpoints": self.setpoints,
            "min_distance_m": near[0] if near else None,
            "min_distance_time_s": near[1] if near else None,
            "min_distance_pair": list(near[2:]) if near else None,
            "crashed": sorted(self.crashed),
            "digest": self._digest.hexdigest(),
        }
