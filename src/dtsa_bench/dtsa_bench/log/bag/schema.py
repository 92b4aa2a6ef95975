"""Message definitions and type hashes for the schemas of a bag.

The texts are the original `.msg` files from the ament index: the Python messages of Jazzy do not carry them, and a
regenerated text would lose comments and defaults. Where there is no ROS, the project's own `.msg` files are those that
the distribution `dtsa` brings along (`messages`), and rosbags makes the texts of those of ROS. The hashes are the same.
"""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from .errors import BagError

_BROUGHT = Path(__file__).resolve().parent / "messages"  # those of dtsa_msgs, where there is no ROS
SEPARATOR = "=" * 80
_PRIMITIVE = re.compile(r"bool|byte|char|float(32|64)|u?int(8|16|32|64)|w?string")
_FIELD = re.compile(r"\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]")  # or a constant, of a primitive type
_MESSAGE_TYPE = re.compile(r"[A-Za-z]\w*/msg/[A-Za-z]\w*")


@dataclass(frozen=True, slots=True)
class Definition:
    """What a bag stores about a type of messages."""

    name: str  # "package/msg/Type"
    text: str  # root definition and, after a separator each, all definitions that it needs
    type_hash: str  # "RIHS01_..."
    encoding: str = "ros2msg"  # of the definition
    message_encoding: str = "cdr"


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
    hashes = json.loads(_file(name, ".json").read_text(encoding="utf-8"))["type_hashes"]
    type_hash = next(entry["hash_string"] for entry in hashes if entry["type_name"] == name)
    return Definition(name, concatenate(name, lambda kind: _file(kind, ".msg").read_text(encoding="utf-8")), type_hash)


def brought(name: str, folder: Path) -> Definition:
    """Definition and RIHS01 hash of a type of messages where there is no ROS; `folder`: the project's own files."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    own = {f"dtsa_msgs/msg/{path.stem}": path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.msg"))}
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind, text in own.items():
        store.register(get_types_from_msg(text, kind))
    if name not in store.fielddefs:
        raise BagError(f"message type {name}: not installed")

    def text_of(kind: str) -> str:
        return own[kind] if kind in own else store.generate_msgdef(kind, ros_version=2)[0].partition(SEPARATOR)[0]

    return Definition(name, concatenate(name, text_of), store.hash_rihs01(name))


def _file(name: str, suffix: str) -> Path:
    from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

    package, _, short = name.split("/")
    try:
        path = Path(get_package_share_directory(package)) / "msg" / f"{short}{suffix}"
    except PackageNotFoundError:
        raise BagError(f"message type {name}: package {package} is not installed") from None
    except OSError as error:
        raise BagError(f"message type {name}: {error}") from None
    if not path.is_file():
        raise BagError(f"message type {name}: {path} is missing")
    return path
