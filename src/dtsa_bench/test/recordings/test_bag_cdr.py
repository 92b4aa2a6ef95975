"""The fast serialisers against rosbags' and rclpy's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from bag_helpers import SECOND, cdr, stamp, typestore
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_bench.drawing import palette
from dtsa_bench.recordings.bag.cdr import (
    COLLIDED,
    CYLINDER,
    NAMES,
    QUIET,
    SENDING,
    SPHERE,
    TEXT,
    MarkerPacker,
    OdometryPacker,
)

COORDINATES = st.floats(-1e6, 1e6, allow_nan=False)
# A millimetre where the simulation is exact; nothing is claimed about attitude and body rates, which are not modelled.
COVARIANCE = np.diag([1e-6] * 3 + [1e6] * 3).ravel()
VECTORS = st.tuples(COORDINATES, COORDINATES, COORDINATES)
FRAMES = st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=24)


def odometry(time_ns: int, child: str, position: Any, velocity: Any, frame: str) -> bytes:
    """The same message by rosbags."""
    types = typestore().types
    g = "geometry_msgs/msg/"
    zero = types[g + "Vector3"](0.0, 0.0, 0.0)
    pose = types[g + "Pose"](types[g + "Point"](*position), types[g + "Quaternion"](0.0, 0.0, 0.0, 1.0))
    twist = types[g + "Twist"](types[g + "Vector3"](*velocity), zero)
    return cdr(
        "nav_msgs/msg/Odometry",
        header=types["std_msgs/msg/Header"](stamp(time_ns), frame),
        child_frame_id=child,
        pose=types[g + "PoseWithCovariance"](pose, COVARIANCE),
        twist=types[g + "TwistWithCovariance"](twist, COVARIANCE),
    )


def odometry_cdr(time_ns: int, child: str, place: Any, speed: Any, frame: str = "map") -> bytes:
    """One message of the packer."""
    columns = np.array([place, speed], dtype=np.float64)[:, :, None]
    return OdometryPacker([child], frame).pack(time_ns, columns[0], columns[1])[0]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31 * SECOND - 1), FRAMES, FRAMES, VECTORS, VECTORS)
def test_odometry_is_what_rosbags_writes(time_ns: int, child: str, frame: str, place: Any, speed: Any) -> None:
    assert odometry_cdr(time_ns, child, place, speed, frame) == odometry(time_ns, child, place, speed, frame)


def test_a_packer_writes_one_message_a_body_and_can_be_used_again() -> None:
    frames = [f"cf{number}/base_link" for number in range(1, 13)]
    packer = OdometryPacker(frames)
    random = np.random.default_rng(1)
    for turn in range(3):
        position, velocity = random.normal(size=(2, 3, 12))
        found = packer.pack(SECOND + turn, position, velocity)
        for k, data in enumerate(found):
            assert data == odometry(SECOND + turn, frames[k], position[:, k], velocity[:, k], "map")


def test_a_packer_refuses_the_wrong_number_of_bodies() -> None:
    with pytest.raises(ValueError, match="argument"):
        OdometryPacker(["a", "b"]).pack(0, np.zeros((3, 1)), np.zeros((3, 1)))


@pytest.mark.parametrize("targets", [True, False])
@pytest.mark.parametrize("names", [["1"], ["1", "22", "cf333"], [f"cf{k}" for k in range(70)]])
def test_markers_decode_to_spheres_names_and_targets(names: list[str], targets: bool) -> None:
    random = np.random.default_rng(2)
    n = len(names)
    position, target = random.normal(size=(2, 3, n))
    state = random.integers(0, 4, n).astype(np.uint8)
    packer = MarkerPacker(names, diameter=0.2, targets=targets)
    packer.pack(0, target, 3 - state, position)  # what was there before must not shine through
    data = packer.pack(3 * SECOND + 5, position, state, target)
    array = typestore().deserialize_cdr(data, "visualization_msgs/msg/MarkerArray")
    assert cdr("visualization_msgs/msg/MarkerArray", markers=array.markers) == data
    markers = array.markers
    assert len(markers) == (3 if targets else 2) * n
    assert {(m.header.stamp.sec, m.header.stamp.nanosec, m.header.frame_id) for m in markers} == {(3, 5, "map")}
    assert len({(m.ns, m.id) for m in markers}) == len(markers)
    for k, (ball, name) in enumerate(zip(markers[:n], markers[n : 2 * n], strict=True)):
        where = ball.pose.position
        assert (ball.type, name.type) == (SPHERE, TEXT)
        assert [where.x, where.y, where.z] == position[:, k].tolist()
        assert math.isclose(name.pose.position.z, position[2, k] + 0.15)
        colour = ball.color
        assert [colour.r, colour.g, colour.b] == pytest.approx(palette.rgb(palette.agent_colour(k + 1)), abs=1e-6)
        assert colour.a == pytest.approx(0.45 if state[k] == QUIET else 1.0)
        sends = state[k] in (SENDING, COLLIDED)
        assert (ball.scale.x, ball.scale.y, ball.scale.z) == pytest.approx((0.32 if sends else 0.2,) * 3)
        assert [name.color.r, name.color.g, name.color.b, name.color.a] == NAMES[state[k]].tolist()
        assert name.scale.z == pytest.approx(0.12)
        assert name.text == names[k]
    for k, disc in enumerate(markers[2 * n :]):
        where = disc.pose.position
        assert disc.type == CYLINDER
        assert [where.x, where.y, where.z] == target[:, k].tolist()


def test_rclpy_reads_both_and_writes_the_same_length() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    from nav_msgs.msg import Odometry
    from rclpy.serialization import deserialize_message, serialize_message
    from visualization_msgs.msg import MarkerArray

    place, speed = (1.5, -2.25, 1e-3), (0.1, 0.2, -0.3)
    for child in ("cf1/base_link", "cf10/base_link", "a", "ab", "abc", "abcd"):
        data = odometry_cdr(7 * SECOND + 9, child, place, speed)
        message = deserialize_message(data, Odometry)
        where, linear = message.pose.pose.position, message.twist.twist.linear
        assert (where.x, where.y, where.z) == place
        assert (linear.x, linear.y, linear.z) == speed
        assert (message.child_frame_id, message.header.frame_id) == (child, "map")
        assert message.pose.pose.orientation.w == 1.0
        again = serialize_message(message)
        # Bytes between fields are whatever the middleware finds there, and zero here: compare all others.
        assert len(again) == len(data)
        assert deserialize_message(again, Odometry) == message
        fields = [i for i in range(len(data)) if data[i]]
        assert all(again[i] == data[i] for i in fields)
    data = MarkerPacker(["1", "22"]).pack(SECOND, np.ones((3, 2)), np.zeros(2, np.uint8), np.ones((3, 2)))
    array = deserialize_message(data, MarkerArray)
    assert len(serialize_message(array)) == len(data)
    assert [marker.text for marker in array.markers] == ["", "", "1", "22", "", ""]
