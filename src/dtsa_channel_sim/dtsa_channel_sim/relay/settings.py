"""The relay's YAML file: robots, their topics, where they are, and the channel between them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, named, names_with_values, setting
from dtsa_channel_sim.model.config import ChannelConfig

from .transport import AccessSettings, Transport, read_settings

_NAME = re.compile(r"(?!.*__)/?[A-Za-z]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TYPE = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)


@dataclass(frozen=True, slots=True)
class _File(Settings):
    robots: Mapping[str, Any] = setting(REQUIRED, "robots by namespace", kind="structure")
    channel: Any = setting(None, "settings of access and channel", kind="structure")
    map_frame: str = setting("map", "frame of positions")


@dataclass(frozen=True, slots=True)
class _Robot(Settings):
    place: tuple[float, ...] | None = setting(None, "where it stands", kind="vector", unit="m")
    odometry: str | None = setting(None, "topic, nav_msgs/msg/Odometry")
    tf: str | None = setting(None, "frame of /tf")
    topics: Any = setting(None, "topics by name", kind="structure")


@dataclass(frozen=True, slots=True)
class RelayedTopic(Settings):
    """A topic of a robot that others receive."""

    type: str = setting("", "package/msg/Name; empty: that of its publisher")
    bytes: int | None = setting(None, "size on the air; None: that of the serialised message", unit="bytes", minimum=1)
    to: Any = setting(None, "robots that receive it; None: all", kind="structure")
    robot: int = 0  # id
    name: str = ""  # as in the file
    source: str = ""  # full name
    receivers: tuple[int, ...] = ()  # ids


@dataclass(frozen=True, slots=True)
class RelaySettings:
    """All that a relay does; made from the content of its file."""

    access: AccessSettings
    channel: ChannelConfig
    robots: tuple[str, ...]  # namespaces without the slash in front; ids are 1, 2, ...
    places: tuple[tuple[str, Any], ...]  # by robot: place, odometry, tf or "", and its value
    topics: tuple[RelayedTopic, ...]
    map_frame: str  # in which positions are

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> RelaySettings:
        """Return settings as the file has them.

        :raises ConfigError: naming what cannot be used.
        """
        file = _File.from_dict(content)
        entries = names_with_values(file.robots, "robots")
        robots = tuple(full_name("", name, "robots")[1:] for name in entries)
        with named("channel"):
            access, channel = read_settings(names_with_values(file.channel or {}, "settings"), len(robots))
        topics, places = dict[str, RelayedTopic](), list[tuple[str, Any]]()
        for robot, given in entries.items():
            with named(f"robots.{robot}"):
                entry = _Robot.from_dict(given or {})
                place = [(name, value) for name, value in entry.not_default().items() if name != "topics"]
                if len(place) != 1 and (place or channel.needs_positions or access.access == "error"):
                    allowed = "one of place, odometry, tf, which the channel needs"
                    raise ConfigError("place", [name for name, _ in place] or None, allowed)
                places += place or [("", None)]
                for name, options in names_with_values(entry.topics or {}, "topics").items():
                    topic = _topic(len(places), robots, name, options or {})
                    if topic.source in topics:
                        raise ConfigError(f"topics.{name}", topic.source, "a topic of one robot only")
                    topics[topic.source] = topic
        if not topics:
            raise ConfigError("robots", list(robots), "at least one robot with topics")
        transport = Transport(access, channel)
        for source, topic in topics.items():
            if topic.bytes and (fault := transport.fault_of(topic.bytes)):
                raise ConfigError(f"{source}: bytes", topic.bytes, f"what can be sent: {fault}")
        return cls(access, channel, robots, tuple(places), tuple(topics.values()), file.map_frame.strip("/"))


def full_name(robot: str, name: object, field: str) -> str:
    """Return the full name of a topic: without a leading slash it is in the robot's namespace."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(field, name, "a name of ROS, as robot1 or sensors/pose")
    return name if name.startswith("/") else f"/{robot}/{name}".replace("//", "/")


def _topic(robot: int, robots: tuple[str, ...], name: str, options: Mapping[str, Any]) -> RelayedTopic:
    source = full_name(robots[robot - 1], name, "topics")
    with named(f"topics.{name}"):
        topic = RelayedTopic.from_dict(options)
        if topic.type and not _TYPE.fullmatch(topic.type):
            raise ConfigError("type", topic.type, "package/msg/Name")
        to = robots if topic.to is None else topic.to
        if not isinstance(to, list | tuple) or not to or any(other not in robots for other in to):
            raise ConfigError("to", to, f"a list of robots: {', '.join(robots)}")
        receivers = tuple(sorted({robots.index(other) + 1 for other in to} - {robot}))
        return replace(topic, robot=robot, name=name, source=source, receivers=receivers)
