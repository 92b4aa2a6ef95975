"""Where a bag is, and its metadata: `metadata.yaml`, version 9, as Jazzy writes it, and profiles of QoS."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml
import zstandard
from lz4.frame import LZ4FrameDecompressor
from mcap.records import Metadata
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from .errors import UnusableBag

VERSION = 9
ROOT = "rosbag2_bagfile_information"
FILE_NAME = "metadata.yaml"
RECORD_NAME = "rosbag2"  # name of the metadata record inside the .mcap
RECORD_KEY = "serialized_metadata"
RUN_ID = "run"  # name of the run's id in custom data, 8 hexadecimal digits
MERGED_FROM = "merged_from"  # custom data of a bag that was made from the bags of agents on a network, as JSON
RECOVERED_FROM = "recovered_from"  # custom data of a bag that `recover` has made: name of the damaged file
MAX_UNPACKED_BYTES = 1 << 28  # of a chunk, or of a message that is compressed by itself

Profile = dict[str, Any]  # quality of service of a publisher, with the fields of rosbag2


# -- files ------------------------------------------------------------------------------------------------------------
def bag_of(path: str | Path) -> Path:
    """The bag of what was given as a recorded run: that in a run's directory; anything else as it is."""
    given = Path(path)
    inner = given / "bag"
    return inner if inner.is_dir() and not any(given.glob("*.mcap*")) else given


def find_files(path: str | Path) -> list[Path]:
    """The files of what was given as a recorded run, in their order: .mcap, or .mcap.zstd where compressed as a whole.

    Those of a bag that was split are those of metadata.yaml, else X_0.mcap, X_1.mcap, ...

    :raises UnusableBag: if there is none, or several that are not the parts of one bag.
    """
    bag = bag_of(path)
    if not bag.exists():
        raise UnusableBag(bag, "there is no such file or directory")
    found = {file.name.removesuffix(".zstd"): file for packed in (".zstd", "") for file in bag.glob(f"*.mcap{packed}")}
    if bag.suffix == ".db3" or (not found and any(bag.glob("*.db3"))):
        source = bag if bag.is_dir() else bag.parent
        convert = f"`rosbags-convert --src {source} --dst NEW --dst-storage mcap` makes an mcap bag of it"
        raise UnusableBag(bag, f"an sqlite3 bag; {convert}")
    if not bag.is_dir():
        return [bag]
    if not found:
        below = sorted(entry.parent.name for entry in bag.glob("*/*.mcap"))
        hint = f"; did you mean one of {', '.join(below[:5])} in it?" if below else ""
        raise UnusableBag(bag, f"the directory holds no .mcap file{hint}")
    names = [name.removesuffix(".zstd") for name in _file_names(read(bag))] if len(found) > 1 else list(found)
    if names:
        if missing := [name for name in names if name not in found]:
            raise UnusableBag(bag, f"{', '.join(missing[:5])}, which {FILE_NAME} names, is missing: name a file")
    else:
        stem = next(iter(found)).rpartition("_")[0]
        names = [f"{stem}_{number}.mcap" for number in range(len(found))]
        if set(names) != set(found):
            raise UnusableBag(
                bag, f"holds {len(found)} .mcap files that are not the parts of one bag: name one of them"
            )
    return [found[name] for name in names]


# -- metadata ---------------------------------------------------------------------------------------------------------
_TEXTS, _VALUES = "BaseLoader", "SafeLoader"  # of yaml; texts: every value as it is written, 1.10 and 007 too
_MOST_OPENED = 10_000  # collections in a text
_OPENED = re.compile(r"[\[{]|[-?](?=\s)")


def _parse(text: str, loader: str) -> Any:
    """What a text says as YAML. The parser in C ends the process in collections that are nested some 20,000 deep."""
    is_safe = sum(1 for _ in _OPENED.finditer(text)) <= _MOST_OPENED
    return yaml.load(text, Loader=getattr(yaml, f"C{loader}" if is_safe else loader, getattr(yaml, loader)))


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Writes every value out: rosbag2's YAML reader must not meet anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def dump(content: Mapping[str, Any]) -> str:
    """YAML text of a metadata map."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1 << 30))


def load(text: str) -> dict[str, Any]:
    """A metadata map from its YAML text, all values as texts; empty if the text is none."""
    try:
        loaded = _parse(text, _TEXTS)
    except (yaml.YAMLError, RecursionError):
        return {}
    return loaded if isinstance(loaded, dict) else {}


def load_record(record: Metadata) -> dict[str, Any]:
    """What rosbag2's metadata record inside a file says, without what it leaves empty."""
    return {key: value for key, value in load(record.metadata.get(RECORD_KEY, "")).items() if value}


def read(directory: Path) -> dict[str, Any]:
    """What `metadata.yaml` in a directory says, all values as texts; empty if there is none."""
    try:
        content = load((directory / FILE_NAME).read_text(encoding="utf-8")).get(ROOT)
    except (OSError, UnicodeError):
        return {}
    return content if isinstance(content, dict) else {}


def read_beside(file: Path, given: str | Path) -> dict[str, Any]:
    """What `metadata.yaml` beside a file says, if it is of the bag that was given."""
    content = read(file.parent)
    return content if file.name in _file_names(content) or Path(given).is_dir() else {}


# Values that are no texts are left out, never made texts: aliases of YAML make terabytes of a few lines.
def _file_names(content: Mapping[str, Any]) -> list[str]:
    """Names of the files that metadata lists."""
    listed = content.get("relative_file_paths")
    return [Path(name).name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []


def has_packed_messages(content: Mapping[str, Any]) -> bool:
    """Whether rosbag2 compressed each message by itself."""
    mode = content.get("compression_mode")
    return isinstance(mode, str) and mode.lower() == "message"


def unpack(data: bytes, compression: str = "zstd", size: int = 0) -> bytes:
    """A chunk, or a message that rosbag2 compressed by itself.

    :param compression: of it, by MCAP's name.
    :param size: bytes at most when it is unpacked, as its chunk says; 0: not known.
    :raises ValueError: if it is damaged, or larger than `MAX_UNPACKED_BYTES`.
    """
    try:
        stated = max(size, zstandard.frame_content_size(data) if compression == "zstd" else 0)
        if stated > MAX_UNPACKED_BYTES:
            raise ValueError(f"{stated} bytes when unpacked, more than {MAX_UNPACKED_BYTES >> 20} MiB")
        if compression == "zstd":
            return zstandard.ZstdDecompressor().decompress(data, max_output_size=stated or MAX_UNPACKED_BYTES)
        if compression != "lz4":
            raise ValueError(f"its compression {compression!r} is not known")
        reader = LZ4FrameDecompressor()
        unpacked: bytes = reader.decompress(data, max_length=stated)
    except (zstandard.ZstdError, RuntimeError) as error:  # of lz4
        raise ValueError(str(error)) from None
    if not reader.eof:
        raise ValueError("it is cut off, or larger than it says")
    return unpacked


def load_json(text: str) -> Any:
    """What a text from outside says as JSON; ValueError: it is none."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("JSON that is nested too deep") from None


def custom_data(content: Mapping[str, Any]) -> dict[str, str]:
    """The recorder's own texts in a metadata map."""
    custom = content.get("custom_data")
    return {key: value for key, value in custom.items() if isinstance(value, str)} if isinstance(custom, dict) else {}


def write(directory: Path, content: Mapping[str, Any]) -> None:
    """Write `metadata.yaml` so that it is either whole or absent: temporary file, then rename."""
    temporary = directory / f".{FILE_NAME}.part"
    with temporary.open("w", encoding="utf-8") as stream:
        stream.write(dump({ROOT: content}))
        stream.flush()
        os.fsync(stream.fileno())
    temporary.replace(directory / FILE_NAME)


# -- quality of service -----------------------------------------------------------------------------------------------
INFINITE = {"sec": 9223372036, "nsec": 854775807}  # the middleware's "for ever", as rosbag2 splits it
_PROFILE: Profile = {
    "history": "keep_last", "depth": 10, "reliability": "reliable", "durability": "volatile", "deadline": INFINITE,
    "lifespan": INFINITE, "liveliness": "automatic", "liveliness_lease_duration": INFINITE,
    "avoid_ros_namespace_conventions": False,
}  # fmt: skip
PROFILES: Mapping[str, Profile] = {
    "reliable": _PROFILE,
    "best_effort": _PROFILE | {"reliability": "best_effort"},
    "sensor_data": _PROFILE | {"reliability": "best_effort", "depth": 5},
    "latched": _PROFILE | {"durability": "transient_local", "depth": 1},
}


def dump_profiles(profiles: Sequence[Profile]) -> str:
    """The YAML sequence that a channel carries as `offered_qos_profiles`."""
    return dump(list(profiles)).rstrip("\n") if profiles else ""  # type: ignore[arg-type]


@lru_cache(maxsize=64)  # the topics of a bag share a few texts, and YAML is slow
def load_profiles(text: str) -> tuple[Profile, ...]:
    """Profiles from a channel's `offered_qos_profiles`, with names of policies; an unreadable text gives none.

    Before Jazzy rosbag2 wrote policies as numbers.
    """
    try:
        return tuple(dict(entry) for entry in dump_qos_v9(parse_qos(_parse(text, _VALUES))))
    except Exception:  # the library meets texts from outside with many kinds of errors
        return ()
