"""The relay's YAML file: robots, their topics, where they are, and the channel between them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, named, names_with_values, setting

from .transport import MessageChannel, Transport

_NAME = re.compile(r"(?!.*__)/?[A-Za-z]\w*(/[A-Za-z_]\w*)*", re.ASCII)


@dataclass(frozen=True, slots=True, eq=False)
class RelayedTopic(Settings):
    """A topic of a robot that others receive."""

    type: str = setting("", "package/msg/Name; empty: that of its publisher")
    bytes: int | None = setting(None, "size on the air; None: that of the serialised message", unit="bytes", minimum=1)
    to: Any = setting(None, "robots that receive it; None: all", kind="structure")
    robot: int = 0  # id
    name: str = ""  # as in the file
    source: str = ""  # full name
    receivers: Any = None  # (N,) bool


@dataclass(frozen=True, slots=True)
class RelayedRobot(Settings):
    """A robot, and where it is: one of three, or none where it does not matter."""

    place: tuple[float, ...] | None = setting(None, "where it stands", kind="vector", unit="m")
    odometry: str | None = setting(None, "topic, nav_msgs/msg/Odometry")
    tf: str | None = setting(None, "frame of /tf")
    topics: Any = setting(None, "topics by name", kind="structure")


@dataclass(frozen=True, slots=True)
class RelaySettings(Settings):
    """All that a relay does, as its file has it."""

    robots: Mapping[str, Any] = setting(REQUIRED, "robots by namespace", kind="structure")
    channel: Any = setting(None, "settings of the channel", kind="structure")
    map_frame: str = setting("map", "frame of positions")

    def read(self) -> tuple[Transport, dict[str, RelayedRobot], list[RelayedTopic]]:
        """Return the medium, the robots by namespace without the slash in front, in the order of ids, and all topics.

        :raises ConfigError: naming what cannot be used.
        """
        robots, topics = dict[str, RelayedRobot](), dict[str, RelayedTopic]()
        names = [full_name("", name, "robots")[1:] for name in names_with_values(self.robots, "robots")]
        with named("channel"):
            channel = MessageChannel.of(names_with_values(self.channel or {}, "settings"), len(names))
        if len(set(names)) < len(names):
            raise ConfigError("robots", names, "each robot once")
        transport = Transport(channel)
        for robot, (name, content) in enumerate(zip(names, self.robots.values(), strict=True), 1):
            with named(f"robots.{name}"):
                entry = robots[name] = RelayedRobot.from_dict(content or {})
                given = sorted(entry.not_default().keys() - {"topics"})
                if len(given) > 1 or (not given and (channel.needs_positions or channel.access == "error")):
                    raise ConfigError("place", given or None, "one of place, odometry, tf, which the channel needs")
                for topic, options in names_with_values(entry.topics or {}, "topics").items():
                    source = full_name(name, topic, "topics")
                    if source in topics:
                        raise ConfigError(f"topics.{topic}", source, "a topic of one robot only")
                    if topic.strip("/") in [other.name.strip("/") for other in topics.values() if other.robot == robot]:
                        raise ConfigError(f"topics.{topic}", source, "a topic that comes out under a name of its own")
                    with named(f"topics.{topic}"):
                        relayed = RelayedTopic.from_dict(options or {})
                        to = names if relayed.to is None else relayed.to
                        if not isinstance(to, list) or not to or any(other not in names for other in to):
                            raise ConfigError("to", to, f"a list of robots: {', '.join(names)}")
                        if relayed.bytes:
                            transport.check_length(relayed.bytes)
                    receivers = np.array([other in to and other != name for other in names])
                    topics[source] = replace(relayed, robot=robot, name=topic, source=source, receivers=receivers)
        if not topics:
            raise ConfigError("robots", names, "at least one robot with topics")
        return transport, robots, list(topics.values())


def full_name(robot: str, name: object, field: str) -> str:
    """Return the full name of a topic: without a leading slash it is in the robot's namespace."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ConfigError(field, name, "a name of ROS, as robot1 or sensors/pose")
    return name if name.startswith("/") else f"/{robot}/{name}".replace("//", "/")
