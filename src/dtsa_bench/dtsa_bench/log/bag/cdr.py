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

from dtsa_agent.ros.common.cdr import REPRESENTATION, SECOND
from dtsa_agent.ros.common.cdr import POSE_COVARIANCE, TWIST_COVARIANCE
from dtsa_bench.drawing import palette

STAMP = struct.Struct("<iI")
_VECTOR = struct.Struct("<3d")

# visualization_msgs/Marker
SPHERE, CYLINDER, TEXT = 2, 3, 9
DELETE_ALL = 3
SIZE = 7  # numbers of a pose, which stand before the scale
# What an agent's radio does in a slot.
QUIET, WAITING, SENDING, COLLIDED = 0, 1, 2, 3
# A sphere has its agent's colour; who sends is larger, and its name has the colour of what became of the frame.
OPACITY = np.array([0.45, 1.0, 1.0, 1.0], dtype="<f4")
SWELLING = np.array([1.0, 1.0, 1.6, 1.6])
NAMES = np.array(
    [(*palette.rgb(colour), 1.0) for colour in ("#737f94", "#737f94", palette.SENT, palette.COLLIDED)], dtype="<f4"
)


class CdrBuilder:
    """Lays one message out as CDR; alignment counts from the end of the 4-byte header."""

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

    def __init__(self, child_frames: Sequence[str], frame: str = "map") -> None:
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
        """One message a body.

        :param position: m, (3, n), in the frame.
        :param velocity: m/s, (3, n), in the frame.
        """
        seconds, nanoseconds = divmod(stamp_ns, SECOND)
        messages = []
        for (data, place, twist), where, speed in zip(
            self._templates, position.T.tolist(), velocity.T.tolist(), strict=True
        ):
            STAMP.pack_into(data, 4, seconds, nanoseconds)
            _VECTOR.pack_into(data, place, *where)
            _VECTOR.pack_into(data, twist, *speed)
            messages.append(bytes(data))
        return messages


class MarkerPacker:
    """CDR of a `visualization_msgs/MarkerArray` of a swarm: sphere, name and target of each agent.

    :param diameter: m, of the spheres.
    :param targets: whether each agent's target is drawn too, as a flat disc.
    :param ids: the agents' ids; None: 1, 2, ...
    """

    def __init__(
        self,
        names: Sequence[str],
        diameter: float = 0.2,
        frame: str = "map",
        targets: bool = True,
        ids: Sequence[int] | None = None,
    ) -> None:
        self._n = len(names)
        message = CdrBuilder()
        kinds = 3 if targets else 2
        message.number("I", kinds * self._n)
        stamps, places, colours = [], [], []
        for kind in range(kinds):
            for number, name in zip(ids or range(1, self._n + 1), names, strict=True):
                stamp, place, colour = self._add(message, kind, number, name, diameter, frame)
                stamps.append(stamp)
                places.append(place)
                colours.append(colour)
        self._data = bytearray(REPRESENTATION + message.data)
        body = memoryview(self._data)[4:]
        whole = len(body) // 8 * 8
        self._f8 = np.frombuffer(body[:whole], "<f8")
        self._f4 = np.frombuffer(body[: len(body) // 4 * 4], "<f4")
        self._i4 = self._f4.view("<i4")
        self._stamps = np.array(stamps) // 4
        self._places = (np.array(places).reshape(kinds, self._n)[:, :, None] // 8) + np.arange(3)
        tints = np.array(colours).reshape(kinds, self._n)[:, :, None] // 4 + np.arange(4)
        self._opacity, self._name_tints = tints[0][:, 3], tints[1]
        self._sizes = self._places[0][:, :1] + SIZE + np.arange(3)
        self._diameter, self._lift = diameter, 0.75 * diameter

    def pack(
        self,
        stamp_ns: int,
        position: NDArray[np.float64],
        state: NDArray[np.uint8],
        target: NDArray[np.float64] | None = None,
    ) -> bytes:
        """The whole array as one message.

        :param position: m, (3, n), in the frame.
        :param state: (n,), QUIET (pale), WAITING, SENDING or COLLIDED.
        :param target: m, (3, n); needed if the targets are drawn.
        """
        seconds, nanoseconds = divmod(stamp_ns, SECOND)
        self._i4[self._stamps] = seconds
        self._i4[self._stamps + 1] = nanoseconds
        self._f8[self._places[0]] = position.T
        self._f8[self._places[1]] = position.T
        self._f8[self._places[1][:, 2]] += self._lift
        if len(self._places) > 2 and target is not None:
            self._f8[self._places[2]] = target.T
        self._f8[self._sizes] = (self._diameter * SWELLING[state])[:, None]
        self._f4[self._opacity] = OPACITY[state]
        self._f4[self._name_tints] = NAMES[state]
        return bytes(self._data)

    @classmethod
    def nothing(cls, frame: str = "map") -> bytes:
        """A message that takes all markers away."""
        message = CdrBuilder()
        message.number("I", 1)
        cls._add(message, 0, 0, "", 1.0, frame, DELETE_ALL)
        return REPRESENTATION + bytes(message.data)

    @staticmethod
    def _add(
        message: CdrBuilder, kind: int, number: int, name: str, diameter: float, frame: str, action: int = 0
    ) -> tuple[int, int, int]:
        shape = (SPHERE, TEXT, CYLINDER)[kind]
        scale = ((diameter,) * 3, (0.0, 0.0, 0.6 * diameter), (diameter, diameter, 0.02))[kind]
        own = palette.rgb(palette.agent_colour(number))
        colour = ((*own, 1.0), (0.45, 0.50, 0.58, 1.0), (*own, 0.35))[kind]
        stamp = message.stamp(frame)
        message.text(("agent", "name", "target")[kind])
        message.number("i", number, shape, action)
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
