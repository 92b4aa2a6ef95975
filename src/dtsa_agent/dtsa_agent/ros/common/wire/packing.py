"""How frames and receiver bits lie in the messages of dtsa_msgs. Needs no ROS: recorders and verifiers use it too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

# Where the run's id lies in the messages that carry one, as CDR: after 4 bytes of representation and a header in frame
# "map". It is random, and so outside all that is compared between flights.
RUN_BYTES = slice(20, 24)
RUN_MESSAGES = frozenset(
    f"dtsa_msgs/msg/{name}"
    for name in (
        "Slot",
        "Transmission",
        "Frame",
        "Report",
        "Reception",
        "Decision",
        "Configuration",
        "RunStatus",
        "SlotRecord",
    )
)


def without_run(data: bytes | memoryview) -> bytes:
    """A message of :data:`RUN_MESSAGES` with the run's id blanked.

    :param data: the message as CDR.
    """
    return b"".join((data[: RUN_BYTES.start], bytes(4), data[RUN_BYTES.stop :]))


def pack_received(mask: NDArray[np.bool_]) -> bytes:
    """The field ``received``: one bit an agent and frame.

    :param mask: (F, N): the agent with id column + 1 received the frame.
    """
    return np.packbits(mask, axis=1, bitorder="little").tobytes()


def unpack_received(data: bytes | memoryview, frames: int, agents: int) -> NDArray[np.uint8]:
    """The mask (F, N), 0 or 1, that :func:`pack_received` packed.

    :param data: the field.
    :param frames: number of frames F.
    :param agents: number of agents N.
    :raises ValueError: if the field's length does not fit.
    """
    rows = np.frombuffer(data, dtype=np.uint8).reshape(frames, (agents + 7) // 8)
    return np.unpackbits(rows, axis=1, count=agents, bitorder="little")


def split_frames(data: bytes | memoryview, lengths: Sequence[int]) -> list[bytes]:
    """The frames that lie one after the other in ``data``.

    :param lengths: bytes, length of each; 0 gives an empty one.
    :raises ValueError: if the lengths do not add up to the data.
    """
    frames, at, whole = [], 0, bytes(data)
    for length in lengths:
        frames.append(whole[at : at + length])
        at += length
    if at != len(whole):
        raise ValueError(f"{len(whole)} bytes of frames, {at} in their lengths")
    return frames
