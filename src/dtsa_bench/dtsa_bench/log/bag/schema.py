"""Message definitions and type hashes for the schemas of a bag.

The texts are the original `.msg` files from the ament index: the Python messages of Jazzy do not carry
them, and a regenerated text would lose comments and defaults. Where there is no ROS, the project's own
`.msg` files are those that the distribution `dtsa` brings along (`messages`), and rosbags makes the texts of
those of ROS. The hashes are the same.
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
PRIMITIVES = frozenset(
    [
        "bool",
        "byte",
        "char",
        "float32",
        "float64",
        "int8",
        "uint8",
        "int16",
        "uint16",
        "int32",
        "uint32",
        "int64",
        "uint64",
        "string",
        "wstring",
    ]
)
_FIELD = re.compile(r"^\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*\s*(?!\s*=)")
_CONSTANT = re.compile(r"^\s*[A-Za-z][\w/]*(?:<=\d+)?\s+[A-Z]\w*\s*=")


@dataclass(frozen=True, slots=True)
class Definition:
    """What a bag stores about a message type."""

    name: str  # "package/msg/Type"
    text: str  # root definition and, after a separator each, all definitions that it needs
    type_hash: str  # "RIHS01_..."


def dependencies(text: str, package: str) -> list[str]:
    """Message types that a definition names, in order of appearance, once each."""
    found: dict[str, None] = {}
    for line in text.splitlines():
        line = line.split("#", 1)[0]
        match = _FIELD.match(line)
        if not match or _CONSTANT.match(line) or match[1] in PRIMITIVES:
            continue
        parts = match[1].split("/")
        owner = parts[0] if len(parts) > 1 else package
        found[f"{owner}/msg/{parts[-1]}"] = None
    return list(found)


def concatenate(name: str, text_of: Callable[[str], str]) -> str:
    """Definition of a type with all that it needs, as rosbag2 stores it in a schema.

    :param text_of: gives the text of one `.msg` file by its type's full name.
    """
    root = text_of(name)
    parts = [root]
    seen = {name}
    waiting = dependencies(root, name.split("/")[0])
    while waiting:
        dependency = waiting.pop(0)
        if dependency in seen:
            continue
        seen.add(dependency)
        text = text_of(dependency)
        package, _, short = dependency.split("/")
        parts.append(f"{SEPARATOR}\nMSG: {package}/{short}\n{text}")
        waiting.extend(dependencies(text, package))
    return "\n".join(parts)


@cache
def installed(name: str) -> Definition:
    """Definition and RIHS01 hash of an installed message type.

    :raises BagError: if the package or its type description is not installed.
    """
    if importlib.util.find_spec("ament_index_python") is None and _BROUGHT.is_dir():
        return brought(name, _BROUGHT)
    description = _file(name, ".json")
    hashes = json.loads(description.read_text(encoding="utf-8"))["type_hashes"]
    type_hash = next((entry["hash_string"] for entry in hashes if entry["type_name"] == name), None)
    if type_hash is None:
        raise BagError(f"message type {name}: {description} holds no hash of it")
    text = concatenate(name, lambda kind: _file(kind, ".msg").read_text(encoding="utf-8"))
    return Definition(name, text, type_hash)


def brought(name: str, folder: Path) -> Definition:
    """Definition and RIHS01 hash of a message type where there is no ROS."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    own = {f"dtsa_msgs/msg/{path.stem}": path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.msg"))}
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind, text in own.items():
        store.register(get_types_from_msg(text, kind))

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
