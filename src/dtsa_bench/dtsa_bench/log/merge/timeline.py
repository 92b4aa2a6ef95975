"""One time line for the bags of several agents, from the frames that they share.

Agent i sends a frame when its clock shows s, and agent j has it when its own shows a. Clocks are taken to run evenly:
common time is t = c - o - d (c - c0), with an offset o and a drift d for each but the first, whose clock is the common
one. The time that a frame is under way is one more number, the same for all; frames go both ways, so it does not pass
for an offset. Least squares, without the frames that a busy computer has held up. Between groups whose frames go one
way only an offset cannot be told from time under way: the line then has the clocks of the largest group alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Process = tuple[int, int]  # an agent's id, and which of its processes: 0, 1, ...
Times = NDArray[np.int64]

_MOST_FRAMES = 40_000  # in the fit
_ROUNDS = 6
_SIGMAS = 4.0
_LEAST_NS = 20_000.0  # a frame that is off by less is never left out
_PPM = 1e6


class Crossings(NamedTuple):
    """Frames that one process has sent and another one heard; times of their own clocks, ns."""

    sender: NDArray[np.int64]  # (F,) numbers of processes
    receiver: NDArray[np.int64]
    sent_ns: Times
    arrival_ns: Times


@dataclass(frozen=True, slots=True)
class Clock:
    """What the clock of an agent shows at a common time."""

    coarse_ns: int  # common time 0, about
    offset_ns: float
    drift: float

    def common_ns(self, local_ns: Any) -> Any:
        """The common times, int64, at which it shows times, ns."""
        since = local_ns - np.int64(self.coarse_ns)
        return since - np.rint(self.offset_ns + self.drift * since).astype(np.int64)


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


def fit(processes: Sequence[Process], crossings: Crossings, flight_ns: int) -> TimeLine:
    """The time line of the largest group of processes whose frames go both ways, directly or by way of others.

    :param processes: those that crossings have numbers of, ascending.
    :param flight_ns: from the order to send a frame to its arrival, as supposed.
    """
    groups = both_ways(len(processes), crossings)
    named = [tuple(processes[one] for one in group) for group in groups]
    if not groups or len(groups[0]) < 2:
        return TimeLine({}, np.zeros(0), 0, float(flight_ns), named)
    sender, receiver, sent_ns, arrival_ns = _frames_of_fit(crossings, groups[0])
    coarse = _coarse(sender, receiver, sent_ns, arrival_ns, flight_ns)
    column = {process: k for k, process in enumerate(groups[0])}
    zero_ns, place = np.zeros((2, len(processes)), np.int64)
    for process, k in column.items():
        zero_ns[process], place[process] = coarse[process], k
    sent, arrival = sent_ns - zero_ns[sender], arrival_ns - zero_ns[receiver]
    late, row = (arrival - sent - flight_ns).astype(np.float64), np.arange(len(sent))
    matrix = np.zeros((len(sent), 2 * len(column) + 1))  # offset and drift (ns/s) of each, and the time under way
    matrix[row, 2 * place[receiver]] = 1.0
    matrix[row, 2 * place[receiver] + 1] = arrival / 1e9
    matrix[row, 2 * place[sender]] -= 1.0
    matrix[row, 2 * place[sender] + 1] -= sent / 1e9
    matrix[:, -1] = 1.0
    matrix = matrix[:, 2:]  # the first clock is the common one
    good, solution = np.ones(len(sent), dtype=np.bool_), np.zeros(matrix.shape[1])
    for _ in range(_ROUNDS):
        solution = np.linalg.lstsq(matrix[good], late[good], rcond=None)[0]
        residual = late - matrix @ solution
        spread = 1.4826 * float(np.median(np.abs(residual[good])))
        kept = np.abs(residual) <= max(_SIGMAS * spread, _LEAST_NS)
        if (kept == good).all() or not kept.any():
            break
        good = kept
    residual = (late - matrix @ solution)[good]
    offsets = np.concatenate(([0.0, 0.0], solution[:-1])).reshape(-1, 2).tolist()
    clocks = {processes[one]: Clock(coarse[one], offsets[k][0], offsets[k][1] / 1e9) for one, k in column.items()}
    return TimeLine(clocks, residual, int((~good).sum()), flight_ns + float(solution[-1]), named)


def both_ways(count: int, crossings: Crossings) -> list[tuple[int, ...]]:
    """Groups of processes between any two of which frames go both ways, directly or by way of others; largest first.

    :param count: of all processes.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.ones(len(crossings.sender), np.bool_), (crossings.sender, crossings.receiver)
    _, label = connected_components(coo_matrix(edges, (count, count)), connection="strong")
    sharing = np.union1d(crossings.sender, crossings.receiver)
    groups = [tuple(sharing[label[sharing] == one].tolist()) for one in np.unique(label[sharing])]
    return sorted(groups, key=lambda group: (-len(group), group))


def _frames_of_fit(crossings: Crossings, group: Sequence[int]) -> Crossings:
    """The frames within a group; of many every k-th of each pair, so that both ways stay."""
    within = np.isin(crossings.sender, group) & np.isin(crossings.receiver, group)
    frames = Crossings(*(values[within] for values in crossings))
    pair = frames.sender * (max(group) + 1) + frames.receiver
    order = np.argsort(pair, kind="stable")
    number = np.empty(len(pair), np.int64)  # of each among the frames of its pair
    number[order] = np.arange(len(pair)) - np.searchsorted(pair[order], pair[order])
    used = number % max(1, len(pair) // _MOST_FRAMES) == 0
    return Crossings(*(values[used] for values in frames))


def _coarse(
    sender: NDArray[np.int64], receiver: NDArray[np.int64], sent_ns: Times, arrival_ns: Times, flight_ns: int
) -> dict[int, int]:
    """What each clock shows at about the same time, from frame to frame."""
    lead = arrival_ns - sent_ns - flight_ns
    ahead = []  # by how much a clock is ahead of another, by the median frame
    for one, other in dict.fromkeys(zip(sender.tolist(), receiver.tolist(), strict=True)):
        values = np.sort(lead[(sender == one) & (receiver == other)])
        median = int(values[len(values) // 2])
        ahead += [(one, other, median), (other, one, -median)]
    first = int(min(sender.min(), receiver.min()))
    shown, waiting = {first: int(min([*sent_ns[sender == first], *arrival_ns[receiver == first]]))}, [first]
    while waiting:
        process = waiting.pop()
        for known, new, by in ahead:
            if known == process and new not in shown:
                shown[new] = shown[process] + by
                waiting.append(new)
    return shown
