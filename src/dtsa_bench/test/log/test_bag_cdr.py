"""The fast serialisers against rosbags' and rclpy's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from bag_helpers import SECOND, cdr, stamp, typestore
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_bench.drawing import palette
from dtsa_bench.log.bag.cdr import (
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
    types = typestore().types
    g = "geometry_msgs/msg/"
    zero = types[g + "Vector3"](0.0, 0.0, 0.0)
    pose = types[g + "Pose"](types[g + "Point"](*position), types[g + "Quaternion"](0.0, 0.0, 0.0, 1.0))
    twist = types[g + "Twist"](types[g + "Vector3"](*velocity), zero)
    return cdr(
        "nav_msgs/msg/Odometry", header=types["std_msgs/msg/Header"](stamp(time_ns), frame), child_frame_id=child,
        pose=types[g + "PoseWithCovariance"](pose, COVARIANCE),
        twist=types[g + "TwistWithCovariance"](twist, COVARIANCE),
    )  # fmt: skip


@settings(max_examples=60, deadline=None)
@given(FRAMES, st.dictionaries(FRAMES, st.lists(st.tuples(VECTORS, VECTORS), min_size=2, max_size=2), min_size=1))
def test_odometry_is_what_rosbags_writes_and_a_packer_can_be_used_again(frame: str, bodies: Any) -> None:
    packer = OdometryPacker(list(bodies), frame)
    for turn, time_ns in enumerate((2**31 * SECOND - 1, SECOND + 5)):
        states = [each[turn] for each in bodies.values()]
        place, speed = np.array(states, dtype=np.float64).transpose(1, 2, 0)
        expected = [odometry(time_ns, child, *state, frame) for child, state in zip(bodies, states, strict=True)]
        assert packer.pack(time_ns, place, speed) == expected


def test_a_packer_refuses_the_wrong_number_of_bodies() -> None:
    with pytest.raises(ValueError, match="argument"):
        OdometryPacker(["a", "b"]).pack(0, np.zeros((3, 1)), np.zeros((3, 1)))


@pytest.mark.parametrize("ids", [[1], [1, 22, 333], range(1, 71)])
def test_markers_decode_to_spheres_names_and_targets(ids: Sequence[int]) -> None:
    random = np.random.default_rng(2)
    n = len(ids)
    position, target = random.normal(size=(2, 3, n))
    state = random.integers(0, 4, n).astype(np.uint8)
    packer = MarkerPacker(ids)
    packer.pack(0, target, 3 - state, position)  # what was there before must not shine through
    data = packer.pack(3 * SECOND + 5, position, state, target)
    array = typestore().deserialize_cdr(data, "visualization_msgs/msg/MarkerArray")
    assert cdr("visualization_msgs/msg/MarkerArray", markers=array.markers) == data
    markers = array.markers
    assert len(markers) == 3 * n
    assert {(m.header.stamp.sec, m.header.stamp.nanosec, m.header.frame_id) for m in markers} == {(3, 5, "map")}
    assert len({(m.ns, m.id) for m in markers}) == len(markers)
    for k, (ball, name) in enumerate(zip(markers[:n], markers[n : 2 * n], strict=True)):
        where = ball.pose.position
        assert (ball.type, name.type) == (SPHERE, TEXT)
        assert [where.x, where.y, where.z] == position[:, k].tolist()
        assert math.isclose(name.pose.position.z, position[2, k] + 0.15)
        colour = ball.color
        assert [colour.r, colour.g, colour.b] == pytest.approx(palette.rgb(palette.agent_colour(ids[k])), abs=1e-6)
        assert colour.a == pytest.approx(0.45 if state[k] == QUIET else 1.0)
        sends = state[k] in (SENDING, COLLIDED)
        assert (ball.scale.x, ball.scale.y, ball.scale.z) == pytest.approx((0.32 if sends else 0.2,) * 3)
        assert [name.color.r, name.color.g, name.color.b, name.color.a] == NAMES[state[k]].tolist()
        assert name.scale.z == pytest.approx(0.12)
        assert name.text == f"cf{ids[k]}"
    for k, disc in enumerate(markers[2 * n :]):
        where = disc.pose.position
        assert disc.type == CYLINDER
        assert [where.x, where.y, where.z] == target[:, k].tolist()
