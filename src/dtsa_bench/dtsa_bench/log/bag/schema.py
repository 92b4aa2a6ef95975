"""Topics of a bag, with the definitions and type hashes of their messages.

The texts are the original `.msg` files from the ament index: the Python messages of Jazzy do not carry them, and a
regenerated text would lose comments and defaults. Where there is no ROS, the project's own `.msg` files are those that
the distribution `dtsa` brings along (`messages`), and rosbags makes the texts of those of ROS. The hashes are the same.
"""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

from mcap.records import Channel, Schema
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from . import metadata
from .errors import BagError

_BROUGHT = Path(__file__).resolve().parent / "messages"  # those of dtsa_msgs, where there is no ROS
READABLE = "cdr/ros2msg"  # encodings of messages and of their definition
SEPARATOR = "=" * 80
_PRIMITIVE = re.compile(r"bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string")
_FIELD = re.compile(r"\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]")  # or a constant, of a primitive type
_MESSAGE_TYPE = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*")


@dataclass(frozen=True, slots=True)
class Definition:
    """What a bag stores about a type of messages."""

    name: str  # "package/msg/Type"
    text: str  # root definition and, after a separator each, all definitions that it needs
    type_hash: str  # "RIHS01_...", or empty
    encoding: str = "ros2msg"  # of the definition; empty: there is none
    message_encoding: str = "cdr"

    @property
    def encodings(self) -> str:
        """Of messages and definition; READABLE alone can be decoded."""
        return f"{self.message_encoding}/{self.encoding or 'no schema'}"


@dataclass(slots=True)
class Topic:
    """A topic of a bag that is read or written."""

    name: str
    definition: Definition
    profiles: Sequence[metadata.Profile]  # offered QoS
    count: int = 0  # messages

    @property
    def type(self) -> str:
        """ "package/msg/Type"."""
        return self.definition.name

    @classmethod
    def of_channel(cls, channel: Channel, schema: Schema | None) -> Topic:
        """What a file says of a channel."""
        text = "" if schema is None else schema.data.decode("utf-8", "surrogateescape")
        name, encoding = ("", "") if schema is None else (schema.name, schema.encoding)
        type_hash = channel.metadata.get("topic_type_hash", "")
        definition = Definition(name, text, type_hash, encoding, channel.message_encoding)
        return cls(channel.topic, definition, metadata.load_profiles(channel.metadata.get("offered_qos_profiles", "")))


@lru_cache(maxsize=128)  # compiling a type takes longer than reading most bags
def typestore_of(definition: Definition) -> Typestore:
    """The type of a definition, with all that it needs and nothing else: what is wrong with one says nothing of others.

    :raises ValueError: if the definition cannot be used.
    """
    if definition.encodings != READABLE:
        raise ValueError(f"it is recorded as {definition.encodings}, not as {READABLE}")
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition.text, definition.name))
        if definition.name not in store.fielddefs:
            raise ValueError("it is not of the form package/msg/Type")
    except Exception as error:  # the parser meets texts from outside with many kinds of errors
        raise ValueError(f"its definition cannot be used: {error}".partition("\n")[0]) from None
    return store


def concatenate(name: str, text_of: Callable[[str], str]) -> str:
    """Definition of a type with all that it needs, as rosbag2 stores it in a schema.

    :param text_of: gives the text of one `.msg` file by its type's full name.
    """
    texts: dict[str, str] = {}
    waiting = [name]
    while waiting:
        kind = waiting.pop(0)
        if kind in texts:
            continue
        texts[kind], package = text_of(kind), kind.partition("/")[0]
        named = (match[1] for line in texts[kind].splitlines() if (match := _FIELD.match(line)))
        needed = (field.rpartition("/") for field in named if not _PRIMITIVE.fullmatch(field))
        waiting += [f"{owner.partition('/')[0] or package}/msg/{short}" for owner, _, short in needed]
    root = texts.pop(name)
    return "\n".join([root, *(f"{SEPARATOR}\nMSG: {kind.replace('/msg', '')}\n{text}" for kind, text in texts.items())])


@cache
def installed(name: str) -> Definition:
    """Definition and RIHS01 hash of an installed type of messages.

    :raises BagError: if it is not installed, or is no type of messages.
    """
    if not _MESSAGE_TYPE.fullmatch(name):
        raise BagError(f"message type {name!r}: not of the form package/msg/Type")
    if importlib.util.find_spec("ament_index_python") is None and _BROUGHT.is_dir():
        return brought(name, _BROUGHT)
    hashes = json.loads(_text(name, ".json"))["type_hashes"]
    type_hash = next(entry["hash_string"] for entry in hashes if entry["type_name"] == name)
    return Definition(name, concatenate(name, lambda kind: _text(kind, ".msg")), type_hash)


def brought(name: str, folder: Path) -> Definition:
    """Definition and RIHS01 hash of a type of messages where there is no ROS; `folder`: the project's own files."""
    store, (package, _, short), own = get_typestore(Stores.ROS2_JAZZY), name.split("/"), ""
    if package == "dtsa_msgs" and (file := folder / f"{short}.msg").is_file():
        own = file.read_text(encoding="utf-8")
        store.register(get_types_from_msg(own, name))
    if name not in store.fielddefs:
        raise BagError(f"message type {name}: not installed")
    root, *needed = store.generate_msgdef(name, ros_version=2)[0].partition(SEPARATOR)
    return Definition(name, "\n".join([own or root, "".join(needed)]), store.hash_rihs01(name))


def _text(name: str, suffix: str) -> str:
    """An installed file of a type of messages."""
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    package, _, short = name.split("/")
    try:
        folder = Path(get_package_share_directory(package)) / "msg"
        return (folder / f"{short}{suffix}").read_text(encoding="utf-8")
    except PackageNotFoundError:
        raise BagError(f"message type {name}: package {package} is not installed") from None
    except OSError as error:
        raise BagError(f"message type {name}: {error}") from None
