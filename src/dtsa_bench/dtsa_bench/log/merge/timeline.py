"""One time line for the bags of several agents, from the frames that they share.

Agent i sends a frame when its clock shows s, and agent j has it when its own shows a. Clocks are taken to run evenly:
common time is t = c - o - d (c - c0), with an offset o and a drift d for each but the first, whose clock is the common
one. The time that a frame is under way is one more number, the same for all; frames go both ways, so it does not pass
for an offset. Least squares, without the frames that a busy computer has held up. Between groups whose frames go one
way only an offset cannot be told from time under way: the line then has the clocks of the largest group alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Process = tuple[int, int]  # an agent's id, and which of its processes: 0, 1, ...

_MOST_FRAMES = 40_000  # in the fit
_ROUNDS = 6
_SIGMAS = 4.0
_LEAST_NS = 20_000.0  # a frame that is off by less is never left out
_PPM = 1e6


@dataclass(frozen=True, slots=True)
class Crossing:
    """A frame that one agent has sent and another one heard; times of their own clocks, ns."""

    sender: Process
    receiver: Process
    sent_ns: int
    arrival_ns: int


@dataclass(frozen=True, slots=True)
class Clock:
    """What the clock of an agent shows at a common time."""

    coarse_ns: int  # common time 0, about
    offset_ns: float
    drift: float

    def common_ns(self, local_ns: int) -> int:
        """The common time at which it shows a time, ns."""
        since = local_ns - self.coarse_ns
        return since - round(self.offset_ns + self.drift * since)


@dataclass(frozen=True, slots=True)
class TimeLine:
    """The clocks of agents that have heard each other, directly or by way of others."""

    clocks: Mapping[Process, Clock]
    residual_ns: NDArray[np.float64]  # of the frames in the fit
    left_out: int  # frames that were held up
    flight_ns: float  # time under way, as fitted; as supposed, if there are no clocks
    groups: Sequence[tuple[Process, ...]]  # of all that share frames, connected both ways; the first has the clocks

    def summary(self) -> dict[str, Any]:
        """Offsets, drifts and residuals as plain values."""
        size = np.abs(self.residual_ns)
        zero_ns = self.clocks[min(self.clocks)].coarse_ns if self.clocks else 0
        return {
            "clocks": {
                process_name(process): {
                    "offset_ms": (clock.coarse_ns - zero_ns + clock.offset_ns) / 1e6,
                    "drift_ppm": clock.drift * _PPM,
                }
                for process, clock in sorted(self.clocks.items())
            },
            "frames": len(size),
            "frames_left_out": self.left_out,
            "flight_time_us": self.flight_ns / 1e3 if self.clocks else None,
            "residual_us": {
                name: float(np.quantile(size, share)) / 1e3 if len(size) else None
                for name, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))
            },
        }


def process_name(process: Process) -> str:
    """How an agent's process is called."""
    return f"cf{process[0]}" + (f" ({process[1] + 1})" if process[1] else "")


def fit(crossings: Sequence[Crossing], flight_ns: int) -> TimeLine:
    """The time line of the largest group of processes whose frames go both ways, directly or by way of others."""
    groups = both_ways(crossings)
    rows = _used(crossings, set(groups[0])) if groups else []
    coarse = _coarse(rows, flight_ns)
    if not coarse:
        return TimeLine({}, np.zeros(0), 0, float(flight_ns), groups)
    ids = sorted(coarse)
    column = {process: k for k, process in enumerate(ids)}
    sender = np.array([column[c.sender] for c in rows])
    receiver = np.array([column[c.receiver] for c in rows])
    sent = np.array([c.sent_ns - coarse[c.sender] for c in rows], dtype=np.float64)
    arrival = np.array([c.arrival_ns - coarse[c.receiver] for c in rows], dtype=np.float64)
    matrix, late = _equations(sender, receiver, sent, arrival, len(ids)), arrival - sent - flight_ns
    good, solution = np.ones(len(rows), dtype=np.bool_), np.zeros(matrix.shape[1])
    for _ in range(_ROUNDS):
        solution = np.linalg.lstsq(matrix[good], late[good], rcond=None)[0]
        residual = late - matrix @ solution
        spread = 1.4826 * float(np.median(np.abs(residual[good])))
        kept = np.abs(residual) <= max(_SIGMAS * spread, _LEAST_NS)
        if (kept == good).all() or not kept.any():
            break
        good = kept
    solution = np.concatenate(([0.0, 0.0], solution))
    clocks = {
        process: Clock(coarse[process], float(solution[2 * k]), float(solution[2 * k + 1]) / 1e9)
        for process, k in column.items()
    }
    residual = (late - matrix @ solution[2:])[good]
    return TimeLine(clocks, residual, int((~good).sum()), flight_ns + float(solution[-1]), groups)


def both_ways(crossings: Sequence[Crossing]) -> list[tuple[Process, ...]]:
    """Groups of processes between any two of which frames go both ways, directly or by way of others."""
    pairs = {(c.sender, c.receiver) for c in crossings}
    processes = sorted({process for pair in pairs for process in pair})
    column = {process: k for k, process in enumerate(processes)}
    reaches = np.eye(len(processes), dtype=np.float32)
    for sender, receiver in pairs:
        reaches[column[sender], column[receiver]] = 1.0
    for _ in range(len(processes).bit_length()):  # each round doubles the frames that a way may have
        reaches = (reaches @ reaches > 0).astype(np.float32)
    mutual = (reaches > 0) & (reaches.T > 0)
    groups = {tuple(processes[k] for k in np.flatnonzero(row)) for row in mutual}
    return sorted(groups, key=lambda group: (-len(group), group))


def _used(crossings: Sequence[Crossing], group: set[Process]) -> list[Crossing]:
    """The frames of the fit: those within a group, and of many every k-th of each pair, so that both ways stay."""
    within = [c for c in crossings if c.sender in group and c.receiver in group]
    every, seen, used = max(1, len(within) // _MOST_FRAMES), Counter[tuple[Process, Process]](), []
    for c in within:
        if seen[c.sender, c.receiver] % every == 0:
            used.append(c)
        seen[c.sender, c.receiver] += 1
    return used


def _equations(
    sender: NDArray[np.intp], receiver: NDArray[np.intp], sent: Any, arrival: Any, agents: int
) -> NDArray[np.float64]:
    """A row a frame: offset and drift (ns/s) of each agent but the first, and the time under way."""
    matrix = np.zeros((len(sender), 2 * agents + 1))
    row = np.arange(len(sender))
    matrix[row, 2 * receiver] = 1.0
    matrix[row, 2 * receiver + 1] = arrival / 1e9
    matrix[row, 2 * sender] -= 1.0
    matrix[row, 2 * sender + 1] -= sent / 1e9
    matrix[:, -1] = 1.0
    return matrix[:, 2:]


def _coarse(crossings: Sequence[Crossing], flight_ns: int) -> dict[Process, int]:
    """What each clock shows at about the same time, from frame to frame; empty without frames."""
    pairs: dict[tuple[Process, Process], list[int]] = {}
    for c in crossings:
        pairs.setdefault((c.sender, c.receiver), []).append(c.arrival_ns - c.sent_ns - flight_ns)
    if not pairs:
        return {}
    ahead = {pair: sorted(values)[len(values) // 2] for pair, values in pairs.items()}
    first = min(min(pair) for pair in pairs)
    start = min(c.sent_ns if c.sender == first else c.arrival_ns for c in crossings if first in (c.sender, c.receiver))
    found, waiting = {first: start}, [first]
    while waiting:
        process = waiting.pop()
        for (sender, receiver), by in ahead.items():
            for known, new, sign in ((sender, receiver, 1), (receiver, sender, -1)):
                if known == process and new not in found:
                    found[new] = found[process] + sign * by
                    waiting.append(new)
    return found
