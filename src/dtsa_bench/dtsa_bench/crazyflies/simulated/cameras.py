"""What motion capture sees of a fleet, 100 times a second, as one UDP datagram to a process that publishes it."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

HEAD = struct.Struct("<d")  # s, Unix time
BODY = struct.Struct("<H4f")  # id, place in m (world), heading in rad
DATAGRAM = 65000
NOISE_M = 0.0003  # of a calibrated system


class Cameras:
    """Tells where everybody is.

    :param port: UDP port on this machine.
    :param count: number of Crazyflies in the fleet.
    """

    def __init__(self, port: int, count: int) -> None:
        self.unseen: set[int] = set()  # indices of those that are hidden
        self._count = count
        self._noise = np.random.default_rng(count)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.connect(("127.0.0.1", port))

    def look(self, position: NDArray[np.float64], yaw: Sequence[float]) -> None:
        """One picture.

        :param position: (3, N) m, world. :param yaw: N, rad.
        """
        measured = position + NOISE_M * self._noise.standard_normal(position.shape)
        bodies = zip(range(self._count), measured.T.tolist(), yaw, strict=True)
        seen = b"".join(BODY.pack(k + 1, *place, angle) for k, place, angle in bodies if k not in self.unseen)
        with contextlib.suppress(OSError):  # nobody listens yet, or any more
            self._socket.send(HEAD.pack(time.time()) + seen)

    def close(self) -> None:
        """No more pictures."""
        self._socket.close()


def read_picture(datagram: bytes) -> tuple[float, list[tuple[int, float, float, float, float]]]:
    """Time (s) and who was seen (id, place, heading)."""
    (stamp,) = HEAD.unpack_from(datagram)
    bodies = [(int(k), x, y, z, yaw) for k, x, y, z, yaw in BODY.iter_unpack(datagram[HEAD.size :])]
    return stamp, bodies


def half_turn(yaw: float) -> tuple[float, float]:
    """The z and w of the quaternion of a heading (rad).

    :param yaw: rad, the heading.
    """
    return math.sin(yaw / 2), math.cos(yaw / 2)
