"""`metadata.yaml` of a bag directory, version 9, as Jazzy writes it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from dtsa_agent.core.errors import ConfigError

VERSION = 9
ROOT = "rosbag2_bagfile_information"
FILE_NAME = "metadata.yaml"
RECORD_NAME = "rosbag2"  # name of the metadata record inside the .mcap
RECORD_KEY = "serialized_metadata"
RUN_ID = "run"  # name of the run's id in custom data, 8 hexadecimal digits
MERGED_FROM = "merged_from"  # custom data of a bag that was made from the bags of agents on a network, as JSON
RECOVERED_FROM = "recovered_from"  # custom data of a bag that `recover` has made: name of the damaged file


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic of a bag, for its metadata."""

    name: str
    type: str
    profiles: Sequence[Profile]
    type_hash: str
    count: int  # messages


def build(
    file_name: str,
    topics: Sequence[TopicSummary],
    start_ns: int,
    end_ns: int,
    custom_data: Mapping[str, str],
    ros_distro: str = "jazzy",
) -> dict[str, Any]:
    """The whole map below the root key.

    :param start_ns: log time of the first message, ns; 0 in an empty bag.
    """
    count = sum(topic.count for topic in topics)
    starting_time = {"nanoseconds_since_epoch": start_ns}
    duration = {"nanoseconds": max(0, end_ns - start_ns)}
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": starting_time,
        "message_count": count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [dict(entry) for entry in topic.profiles],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.count,
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [
            {
                "path": file_name,
                "starting_time": dict(starting_time),
                "duration": dict(duration),
                "message_count": count,
            }
        ],
        "custom_data": {str(key): str(value) for key, value in custom_data.items()},
        "ros_distro": ros_distro,
    }


_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_TextLoader = getattr(yaml, "CBaseLoader", yaml.BaseLoader)  # every value as it is written


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Writes every value out: rosbag2's YAML reader must not meet anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def dump(content: Mapping[str, Any]) -> str:
    """YAML text of a metadata map."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1 << 30))


def load(text: str) -> dict[str, Any]:
    """A metadata map from its YAML text; empty if the text is none."""
    try:
        loaded = yaml.load(text, Loader=_Loader)
        if not isinstance(loaded, dict):
            return {}
        custom = loaded.get("custom_data")
        if isinstance(custom, dict) and not all(isinstance(entry, str) for pair in custom.items() for entry in pair):
            # rosbag2 writes these texts without quotes: 1.10 and 007 stay what they are, not 1.1 and 7.
            loaded["custom_data"] = yaml.load(text, Loader=_TextLoader)["custom_data"]
    except yaml.YAMLError:
        return {}
    return loaded


def custom_data(content: Mapping[str, Any]) -> dict[str, str]:
    """The recorder's own texts in a metadata map."""
    custom = content.get("custom_data")
    return {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}


def has_packed_messages(content: Mapping[str, Any]) -> bool:
    """Whether a bag's metadata says that rosbag2 compressed each message by itself."""
    return str(content.get("compression_mode", "")).lower() == "message"


def write(directory: Path, content: Mapping[str, Any]) -> Path:
    """Write `metadata.yaml` so that it is either whole or absent: temporary file, then rename."""
    path = directory / FILE_NAME
    temporary = directory / f".{FILE_NAME}.part"
    with temporary.open("w", encoding="utf-8") as stream:
        stream.write(dump({ROOT: content}))
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(path)
    return path


# The middleware's "for ever" (RMW_DURATION_INFINITE), split as rosbag2 splits it.
INFINITE = {"sec": 9223372036, "nsec": 854775807}
Profile = dict[str, Any]


def profile(reliability: str = "reliable", durability: str = "volatile", depth: int = 10) -> Profile:
    """One QoS profile with all the fields that rosbag2 stores."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": reliability,
        "durability": durability,
        "deadline": dict(INFINITE),
        "lifespan": dict(INFINITE),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(INFINITE),
        "avoid_ros_namespace_conventions": False,
    }


PROFILES: Mapping[str, Profile] = {
    "reliable": profile(),
    "best_effort": profile("best_effort"),
    "sensor_data": profile("best_effort", depth=5),
    "latched": profile("reliable", "transient_local", 1),
}


def resolve_profiles(qos: str | Profile | Sequence[Profile]) -> list[Profile]:
    """List of profiles from a name of `PROFILES`, one profile or several.

    :raises ConfigError: if the name is unknown.
    """
    if isinstance(qos, str):
        if qos not in PROFILES:
            raise ConfigError("qos", qos, ", ".join(PROFILES))
        return [dict(PROFILES[qos])]
    if isinstance(qos, Mapping):
        return [dict(qos)]
    return [dict(entry) for entry in qos]


def dump_profiles(profiles: Sequence[Profile]) -> str:
    """The YAML sequence that a channel carries as `offered_qos_profiles`."""
    return str(yaml.safe_dump(list(profiles), sort_keys=False)).rstrip("\n") if profiles else ""


def load_profiles(text: str) -> list[Profile]:
    """Profiles from a channel's `offered_qos_profiles`; an unreadable text gives none."""
    return [dict(entry) for entry in _parse(text)]


@lru_cache(maxsize=64)  # the topics of a bag share a few texts, and YAML is slow
def _parse(text: str) -> tuple[Profile, ...]:
    try:
        loaded = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)) if text else []
    except yaml.YAMLError:
        return ()
    return tuple(entry for entry in loaded if isinstance(entry, dict)) if isinstance(loaded, list) else ()
