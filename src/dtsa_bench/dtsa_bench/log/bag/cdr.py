"""Fast CDR for what a recorder writes often: `nav_msgs/Odometry` and `visualization_msgs/MarkerArray`.

Each message is laid out once as a byte template; afterwards only the numbers that change are written into
it. The result equals, byte for byte, what rclpy gives for the same message.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import repeat

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.ros.common.cdr import POSE_COVARIANCE, REPRESENTATION, SECOND, TWIST_COVARIANCE
from dtsa_agent.ros.common.names import FRAME
from dtsa_bench.drawing import palette

_STAMP, _VECTOR = struct.Struct("<iI"), struct.Struct("<3d")

# visualization_msgs/Marker
SPHERE, CYLINDER, TEXT = 2, 3, 9
DELETE_ALL = 3
_POSE = 7  # numbers, which stand before the scale
_DIAMETER_M = 0.2  # of spheres; the name stands above
# What an agent's radio does in a slot.
QUIET, WAITING, SENDING, COLLIDED = 0, 1, 2, 3
# A sphere has its agent's colour; who sends is larger, and its name has the colour of what became of the frame.
OPACITY = np.array([0.45, 1.0, 1.0, 1.0], dtype="<f4")
SWELLING = np.array([1.0, 1.0, 1.6, 1.6])
NAMES = np.array(
    [(*palette.rgb(colour), 1.0) for colour in ("#737f94", "#737f94", palette.SENT, palette.COLLIDED)], dtype="<f4"
)


class CdrBuilder:
    """Writes one message as CDR; alignment counts from the end of the 4-byte header."""

    def __init__(self) -> None:
        self.data = bytearray()

    def number(self, code: str, *values: float) -> int:
        """Append numbers of one struct code; gives the offset of the first in the body."""
        size = struct.calcsize(f"<{code}")
        self.data += bytes(-len(self.data) % size)
        offset = len(self.data)
        self.data += struct.pack(f"<{len(values)}{code}", *values)
        return offset

    def text(self, value: str) -> None:
        """Append a string: length with its closing zero, bytes, zero."""
        encoded = value.encode() + b"\0"
        self.number("I", len(encoded))
        self.data += encoded

    def stamp(self, frame_id: str) -> int:
        """Append a `std_msgs/Header`; gives the offset of its stamp."""
        offset = self.number("i", 0)
        self.number("I", 0)
        self.text(frame_id)
        return offset


class OdometryPacker:
    """CDR of `nav_msgs/Odometry` for a number of bodies whose attitude is not modelled.

    The orientation is the identity, so that the axes of the child frame are those of the frame: the
    twist, which Odometry gives in the child frame (REP-103, REP-147), holds the velocity in the frame as
    it is. Covariances do not claim certainty: see dtsa_agent.ros.common.cdr.
    """

    def __init__(self, child_frames: Sequence[str], frame: str = FRAME) -> None:
        self._templates: list[tuple[bytearray, int, int]] = []
        for child in child_frames:
            message = CdrBuilder()
            message.stamp(frame)
            message.text(child)
            position = message.number("d", *repeat(0.0, 3))
            message.number("d", 0.0, 0.0, 0.0, 1.0, *POSE_COVARIANCE)
            twist = message.number("d", *repeat(0.0, 6), *TWIST_COVARIANCE)
            self._templates.append((bytearray(REPRESENTATION + message.data), position + 4, twist + 4))

    def pack(self, stamp_ns: int, position: NDArray[np.float64], velocity: NDArray[np.float64]) -> list[bytes]:
        """One message a body, of position and velocity, (3, n), m and m/s, in the frame."""
        stamp, messages = divmod(stamp_ns, SECOND), []
        states = zip(self._templates, position.T.tolist(), velocity.T.tolist(), strict=True)
        for (data, position_at, twist_at), point, speed in states:
            _STAMP.pack_into(data, 4, *stamp)
            _VECTOR.pack_into(data, position_at, *point)
            _VECTOR.pack_into(data, twist_at, *speed)
            messages.append(bytes(data))
        return messages


class MarkerPacker:
    """CDR of a `visualization_msgs/MarkerArray` of agents: a sphere, the name and the target of each, a flat disc."""

    def __init__(self, ids: Sequence[int]) -> None:
        message, shape = CdrBuilder(), (3, len(ids))
        message.number("I", 3 * len(ids))
        offsets = [self._add(message, kind, agent, f"cf{agent}") for kind in range(3) for agent in ids]
        stamps, places, colours = np.array(offsets, np.intp).reshape(-1, 3).T
        self._data = bytearray(REPRESENTATION + message.data)
        body = memoryview(self._data)[4:]
        self._f8 = np.frombuffer(body[: len(body) // 8 * 8], "<f8")
        self._f4 = np.frombuffer(body[: len(body) // 4 * 4], "<f4")
        self._i4 = self._f4.view("<i4")
        self._stamps = stamps // 4
        self._places = places.reshape(shape)[:, :, None] // 8 + np.arange(3)
        tints = colours.reshape(shape)[:, :, None] // 4 + np.arange(4)
        self._opacity, self._name_tints = tints[0][:, 3], tints[1]
        self._sizes = self._places[0][:, :1] + _POSE + np.arange(3)

    def pack(
        self, stamp_ns: int, position: NDArray[np.float64], state: NDArray[np.uint8], target: NDArray[np.float64]
    ) -> bytes:
        """The whole array as one message; position and target: (3, n), m.

        :param state: (n,), QUIET (pale), WAITING, SENDING or COLLIDED.
        """
        self._i4[self._stamps], self._i4[self._stamps + 1] = divmod(stamp_ns, SECOND)
        for places, points in zip(self._places, (position, position, target), strict=True):
            self._f8[places] = points.T
        self._f8[self._places[1][:, 2]] += 0.75 * _DIAMETER_M
        self._f8[self._sizes] = (_DIAMETER_M * SWELLING[state])[:, None]
        self._f4[self._opacity] = OPACITY[state]
        self._f4[self._name_tints] = NAMES[state]
        return bytes(self._data)

    @classmethod
    def nothing(cls) -> bytes:
        """A message that takes all markers away."""
        message = CdrBuilder()
        message.number("I", 1)
        cls._add(message, 0, 0, "", DELETE_ALL)
        return REPRESENTATION + bytes(message.data)

    @staticmethod
    def _add(message: CdrBuilder, kind: int, agent: int, name: str, action: int = 0) -> tuple[int, int, int]:
        """Append a marker: sphere, name or target; return where its stamp, its position and its colour are."""
        shape = (SPHERE, TEXT, CYLINDER)[kind]
        size = 1.0 if action else _DIAMETER_M
        scale = ((size,) * 3, (0.0, 0.0, 0.6 * size), (size, size, 0.02))[kind]
        own = palette.rgb(palette.agent_colour(agent))
        colour = ((*own, 1.0), (0.45, 0.50, 0.58, 1.0), (*own, 0.35))[kind]
        stamp = message.stamp(FRAME)
        message.text(("agent", "name", "target")[kind])
        message.number("i", agent, shape, action)
        place = message.number("d", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *scale)
        tint = message.number("f", *colour)
        message.number("i", 0, 0)  # lifetime: for ever
        message.number("B", 0)  # frame_locked
        message.number("I", 0, 0)  # points, colors
        message.text("")  # texture_resource
        message.stamp("")  # texture
        message.text("")
        message.number("I", 0, 0)  # its data, uv_coordinates
        message.text(name if shape == TEXT else "")
        message.text("")  # mesh_resource
        message.text("")  # mesh_file
        message.number("I", 0)
        message.number("B", 0)  # mesh_use_embedded_materials
        return stamp, place, tint
