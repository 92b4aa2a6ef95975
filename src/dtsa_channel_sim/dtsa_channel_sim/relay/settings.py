"""The relay's YAML file: robots, their topics, where they are, and the channel between them."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting, named, names_with_values
from dtsa_channel_sim.model.config import ChannelConfig

from .transport import AccessSettings, Transport, read_settings

_NAME = re.compile(r"(?!.*__)/?[A-Za-z]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_TYPE = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", re.ASCII)
PLACES = {
    "place": Setting("place", "vector", None, "where it stands", unit="m"),
    "odometry": Setting("odometry", "text", None, "topic, nav_msgs/msg/Odometry"),
    "tf": Setting("tf", "text", None, "frame of /tf"),
}
_BYTES = Setting("bytes", "int", None, "size on the air", unit="bytes", minimum=1, optional=True)


@dataclass(frozen=True, slots=True)
class RelayedTopic:
    """A topic of a robot that others hear."""

    robot: int  # id
    name: str  # as in the file
    source: str  # full name
    message_type: str  # package/msg/Name; empty: that of its publisher
    length: int | None  # bytes on the air; None: those of the serialised message
    receivers: tuple[int, ...]  # ids


@dataclass(frozen=True, slots=True)
class RelaySettings:
    """All that a relay does; made from the content of its file."""

    access: AccessSettings
    channel: ChannelConfig
    robots: tuple[str, ...]  # namespaces without the slash in front; ids are 1, 2, ...
    places: tuple[tuple[str, Any], ...]  # by robot: a name of PLACES or "", and its value
    topics: tuple[RelayedTopic, ...]
    map_frame: str  # in which positions are

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> RelaySettings:
        """Return settings as the file has them.

        :raises ConfigError: naming what cannot be used.
        """
        _check_keys(content, ("robots", "channel", "map_frame"))
        entries = names_with_values(content.get("robots"), "robots")
        robots = tuple(full_name("", name, "robots")[1:] for name in entries)
        with named("channel"):
            access, channel = read_settings(names_with_values(content.get("channel") or {}, "settings"), len(robots))
        topics: list[RelayedTopic] = []
        places: list[tuple[str, Any]] = []
        for robot, given in entries.items():
            with named(f"robots.{robot}"):
                entry = names_with_values(given or {}, "settings")
                _check_keys(entry, ("topics", *PLACES))
                chosen = [name for name in PLACES if name in entry]
                if len(chosen) != 1 and (chosen or channel.needs_positions or access.access == "error"):
                    raise ConfigError("place", chosen or None, "one of place, odometry, tf, which the channel needs")
                places.append((chosen[0], PLACES[chosen[0]].check(entry[chosen[0]])) if chosen else ("", None))
                for name, of_topic in names_with_values(entry.get("topics") or {}, "topics").items():
                    topic = _topic(len(places), robots, name, of_topic or {})
                    if any(other.source == topic.source for other in topics):
                        raise ConfigError(f"topics.{name}", topic.source, "a topic of one robot only")
                    topics.append(topic)
        if not topics:
            raise ConfigError("robots", list(robots), "at least one robot with topics")
        transport = Transport(access, channel)
        for topic in topics:
            if topic.length and (fault := transport.fault_of(topic.length)):
                raise ConfigError(f"{topic.source}: bytes", topic.length, f"what can be sent: {fault}")
        frame = Setting("map_frame", "text", None, "frame of positions").check(content.get("map_frame", "map"))
        return cls(access, channel, robots, tuple(places), tuple(topics), frame.strip("/"))


def full_name(robot: str, name: object, field: str) -> str:
    """Return the full name of a topic: without a leading slash it is in the robot's namespace."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(field, name, "a name of ROS, as robot1 or sensors/pose")
    return name if name.startswith("/") else f"/{robot}/{name}".replace("//", "/")


def _check_keys(content: Mapping[str, Any], allowed: Collection[str]) -> None:
    for key in content:
        if key not in allowed:
            raise ConfigError(str(key), content[key], f"one of the settings {', '.join(allowed)}")


def _topic(robot: int, robots: tuple[str, ...], name: str, given: object) -> RelayedTopic:
    own, source = robots[robot - 1], full_name(robots[robot - 1], name, "topics")
    with named(f"topics.{name}"):
        entry = names_with_values(given, "settings")
        _check_keys(entry, ("type", "bytes", "to"))
        message_type, to = entry.get("type", ""), entry.get("to", robots)
        if message_type and not (isinstance(message_type, str) and _TYPE.fullmatch(message_type)):
            raise ConfigError("type", message_type, "package/msg/Name")
        if not isinstance(to, list | tuple) or not to or any(other not in robots for other in to):
            raise ConfigError("to", to, f"a list of robots: {', '.join(robots)}")
        receivers = tuple(sorted({robots.index(other) + 1 for other in to if other != own}))
        return RelayedTopic(robot, name, source, message_type, _BYTES.check(entry.get("bytes")), receivers)
