"""The relay's file: what it means, and one line for what cannot be used."""

from __future__ import annotations

from typing import Any

import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim.relay.settings import RelaySettings


def content(channel: dict[str, Any] | None = None, topics: Any = None, **robot1: Any) -> dict[str, Any]:
    own = {"topics": {"pose": {"bytes": 24}} if topics is None else topics, **robot1}
    return {"channel": channel or {}, "robots": {"robot1": own, "robot2": {"place": [1, 2, 3]}, "robot3": None}}


def test_a_file_says_all() -> None:
    transport, robots, topics = RelaySettings.from_dict(
        content(
            {"access": "lease", "slot_ms": 5, "loss": 0.2},
            {"pose": {"type": "geometry_msgs/msg/PoseStamped", "bytes": 24, "to": ["robot3"]}, "/map": None},
            odometry="odom",
        )
    ).read()
    channel = transport.config
    assert list(robots) == ["robot1", "robot2", "robot3"]
    assert [(robot.odometry, robot.place) for robot in robots.values()] == [
        ("odom", None), (None, (1.0, 2.0, 3.0)), (None, None),
    ]  # fmt: skip
    assert (channel.access, channel.loss, channel.slot_ns) == ("lease", 0.2, 5_000_000)
    pose, room = topics
    assert (pose.source, pose.bytes, pose.receivers.tolist()) == ("/robot1/pose", 24, [False, False, True])
    assert (room.source, room.bytes, room.receivers.tolist()) == ("/map", None, [False, True, True])


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({}, "robots"),
        ({"robots": {"a": {}, "b": {}}}, "robots"),
        ({"robots": {"a b": {}, "b": {}}}, "robots"),
        ({"robots": {"a": {}, "/a": {}}}, "robots"),
        ({"robots": {"a": {"topics": {"x": {}}}}}, "channel.robots"),
        ({"robots": {"a": {"topics": {"/x": {}}}, "b": {"topics": {"/x": {}}}}}, "robots.b.topics./x"),
        (content(topics={"map": {}, "/map": {}}), "robots.robot1.topics./map"),
        (content() | {"robot": 1}, "robot"),
        (content() | {"map_frame": 3}, "map_frame"),
        (content({"los": 0.1}), "channel.los"),
        (content({"loss": "much"}), "channel.loss"),
        (content({"range_m": 5}), "robots.robot1.place"),
        (content({"access": "error"}), "robots.robot1.place"),
        (content({"access": "tdma", "slot_ms": 0.3}, {"pose": {"bytes": 200}}), "robots.robot1.topics.pose.bytes"),
        (content({"access": "lease", "slot_ms": 0.4}), "robots.robot1.topics.pose.bytes"),
        (content(topics={"pose": {"bytes": 0}}), "robots.robot1.topics.pose.bytes"),
        (content(topics={"pose": {"typ": "x"}}), "robots.robot1.topics.pose.typ"),
        (content(topics={"pose": {"type": 3}}), "robots.robot1.topics.pose.type"),
        (content(topics={"pose": {"to": ["robot9"]}}), "robots.robot1.topics.pose.to"),
        (content(topics={"po se": {}}), "topics"),
        (content(topics={"po__se": {}}), "topics"),
        (content(place=[1, 2]), "robots.robot1.place"),
        (content(place=[1, 2, 3], tf="base"), "robots.robot1.place"),
        (content(speed=3), "robots.robot1.speed"),
    ],
)
def test_what_cannot_be_used_is_named(wrong: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        RelaySettings.from_dict(wrong).read()
    assert caught.value.field.endswith(field)
    assert "\n" not in str(caught.value)
