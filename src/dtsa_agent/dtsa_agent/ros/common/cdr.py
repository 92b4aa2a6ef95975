"""Messages as plain CDR, little endian: what stands at the same place in all, frames, receivers. Needs no ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

REPRESENTATION = b"\x00\x01\x00\x00"  # stands before each body: plain CDR, little endian
SECOND = 1_000_000_000  # ns

# Where the run's id lies in the messages that carry one, as CDR: after 4 bytes of representation and a header in frame
# "map". It is random, and so outside all that is compared between flights.
RUN_BYTES = slice(20, 24)
_WITH_RUN = "Slot Transmission Frame Report Configuration RunStatus SlotRecord"
RUN_MESSAGES = frozenset(f"dtsa_msgs/msg/{name}" for name in _WITH_RUN.split())


def ns_of(stamp: Any) -> int:
    """Return the time of a builtin_interfaces/Time, of ROS or of another decoder, ns."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


# Covariances are row-major 6 x 6 over (x, y, z, rotation about x, y, z), in m^2 and rad^2, (m/s)^2 and (rad/s)^2. Zeros
# would mean that a value is exact.
PRECISION = 1e-6  # m^2 or (m/s)^2: a millimetre, a millimetre per second
UNKNOWN = 1e6  # nothing is known about this value


def diagonal(linear: float, angular: float) -> NDArray[np.float64]:
    """Return a covariance without correlations, (36,), by the variances of the first and of the last three values."""
    return np.diag([linear] * 3 + [angular] * 3).ravel()


POSE_COVARIANCE = TWIST_COVARIANCE = diagonal(PRECISION, UNKNOWN)  # of simulated bodies: the attitude is not modelled


def without_run(data: bytes | memoryview) -> bytes:
    """Return a message of :data:`RUN_MESSAGES`, as CDR, with the run's id blanked."""
    return b"".join((data[: RUN_BYTES.start], bytes(4), data[RUN_BYTES.stop :]))


def pack_received(mask: NDArray[np.bool_]) -> bytes:
    """Return the field ``received``, one bit an agent and frame, of a mask (F, N) by frame and agent."""
    return np.packbits(mask, axis=1, bitorder="little").tobytes()


def unpack_received(data: bytes | memoryview, frames: int, agents: int) -> NDArray[np.uint8]:
    """Return the mask (F, N), 0 or 1, that :func:`pack_received` packed; ValueError: the length does not fit."""
    rows = np.frombuffer(data, dtype=np.uint8).reshape(frames, (agents + 7) // 8)
    return np.unpackbits(rows, axis=1, count=agents, bitorder="little")


def split_frames(data: bytes | memoryview, lengths: Sequence[int]) -> list[bytes]:
    """Return the frames that lie one after the other in ``data``, by their lengths in bytes; 0 gives an empty one.

    ValueError: the lengths do not add up to the data.
    """
    frames, at, whole = [], 0, bytes(data)
    for length in lengths:
        frames.append(whole[at : at + length])
        at += length
    if at != len(whole):
        raise ValueError(f"{len(whole)} bytes of frames, {at} in their lengths")
    return frames
