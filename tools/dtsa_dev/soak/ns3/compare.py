"""What both sides make of the same load, as figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_bench.experiments.statistics import wilson

from .carry import Traffic

Bools = NDArray[np.bool_]
_BLOCKS = 20
_NORMAL = 1.96  # of a 95 % interval


def carried(traffic: Traffic, heard: Sequence[Sequence[int]]) -> dict[str, Any]:
    """Who received the same frames, as we say and as ns-3 says.

    :param traffic: the frames, with what our channel made of them.
    :param heard: of ns-3: frame, receiver, ns, for each reception.
    """
    ours = np.array(traffic.received)
    theirs = np.zeros_like(ours)
    starts = np.array([start for _, start in traffic.frames])
    frame, receiver, arrival = np.array(heard).T
    theirs[frame, receiver] = True
    # What our run has not judged yet at its end may disturb the last frames in ns-3 no more.
    whole = starts < traffic.judged_ns
    agents = ours.shape[1]
    return {
        "frames": int(whole.sum()),
        "pairs": int(whole.sum()) * (agents - 1),
        "received": [int(side[whole].sum()) for side in (ours, theirs)],
        "differ": int((ours != theirs)[whole].sum()),
        "arrivals_apart_ns": int(np.abs(arrival - starts[frame] - traffic.on_air_ns).max()),
        "offered": float(whole.sum()) / (traffic.judged_ns / traffic.unit_ns),
        "throughput": [_throughput(traffic, side & whole[:, None]) for side in (ours, theirs)],
        "age_ms": [_age_ms(traffic, side & whole[:, None]) for side in (ours, theirs)],
    }


def _throughput(traffic: Traffic, received: Bools) -> list[float]:
    """Frames that a receiver gets in the time of one, or in a slot, and half the width of the 95 % interval."""
    starts = np.array([start for _, start in traffic.frames])
    block = np.minimum(starts * _BLOCKS // traffic.judged_ns, _BLOCKS - 1)
    counts = np.bincount(block, weights=received.sum(axis=1), minlength=_BLOCKS)
    rates = counts * traffic.unit_ns * _BLOCKS / traffic.judged_ns / received.shape[1]
    return [float(rates.mean()), _NORMAL * float(rates.std(ddof=1)) / math.sqrt(_BLOCKS)]


def _age_ms(traffic: Traffic, received: Bools) -> float:
    """Mean age of what a receiver knows of a sender, over all pairs, from the first frame on, ms."""
    starts = np.array([start for _, start in traffic.frames], dtype=np.float64)
    senders = np.array([sender for sender, _ in traffic.frames])
    area = time = 0.0
    for sender in range(received.shape[1]):
        mine = np.flatnonzero(senders == sender)
        for receiver in range(received.shape[1]):
            made = starts[mine[received[mine, receiver]]]
            if not len(made):
                continue
            begin = made + traffic.on_air_ns
            end = np.append(begin[1:], traffic.judged_ns + traffic.on_air_ns)
            area += float(((end - made) ** 2 - (begin - made) ** 2).sum()) / 2.0
            time += float(end[-1] - begin[0])
    return area / time / 1e6


def contended(
    sent: Sequence[Sequence[int]], heard: Sequence[int], given_up: int, *, on_air_ns: int, end_ns: int
) -> dict[str, Any]:
    """What came of contention on one side.

    :param sent: sender, ns handed over, ns of the last bit, for each frame.
    :param heard: ns of the last bit of each frame that the receiver got.
    :param given_up: frames that were never sent.
    :param on_air_ns: of a frame.
    :param end_ns: of the run.
    """
    waits = np.array([over - handed - on_air_ns for _, handed, over in sent if over <= end_ns]) / 1e6
    arrived = sum(over <= end_ns for over in heard)
    share = wilson(arrived, len(waits))
    return {
        "sent": len(waits),
        "received": arrived,
        "received_share": [arrived / len(waits), share.low, share.high],
        "given_up": given_up,
        "throughput": arrived * on_air_ns / end_ns,
        "wait_ms": {
            "mean": float(waits.mean()),
            "half_width": _NORMAL * float(waits.std(ddof=1)) / math.sqrt(len(waits)),
            "p95": float(np.quantile(waits, 0.95)),
        },
    }


def pure_aloha(load: float, agents: int) -> float:
    """Throughput at a receiver of N senders that do not begin while they send; it is one of them.

    Each is silent for an exponentially distributed time, then sends. A frame arrives if all others are silent when it
    begins, and until it ends: G exp(-2 G) for many.

    :param load: frames that all would begin in the time of one, did they not send meanwhile.
    :param agents: N.
    """
    one = load / agents
    return (agents - 1) * one * math.exp(-(agents - 1) * one) / (1.0 + one) ** agents


def slotted_aloha(load: float, agents: int) -> float:
    """The same in slots, each sending with probability load / N."""
    return (agents - 1) / agents * load * (1.0 - load / agents) ** (agents - 1)


def non_persistent_csma(load: float, late: float) -> float:
    """Throughput of non-persistent CSMA for many senders (Kleinrock and Tobagi 1975).

    :param load: times that somebody listens in the time of a frame.
    :param late: time in which a sender that has begun is not sensed, in frames.
    """
    free = math.exp(-late * load)
    return load * free / (load * (1.0 + 2.0 * late) + free)
