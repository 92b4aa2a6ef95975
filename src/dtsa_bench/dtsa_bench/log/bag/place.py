"""Where a recorded run is: what all commands that read bags take."""

from __future__ import annotations

from pathlib import Path

from .errors import UnusableBag

SQLITE = "an sqlite3 bag; `ros2 bag convert` makes an mcap bag of it"
PACKED = "its file is compressed as a whole; `ros2 bag convert` makes a plain bag of it"


def bag_of(path: str | Path) -> Path:
    """The bag of what was given as a recorded run.

    :returns: the bag in a run's directory; anything else as it is.
    """
    given = Path(path)
    inner = given / "bag"
    return inner if inner.is_dir() and not any(given.glob("*.mcap")) else given


def find_file(path: str | Path) -> Path:
    """The .mcap file of what was given as a recorded run.

    :raises UnusableBag: if there is none, or several.
    """
    path = bag_of(path)
    if not path.exists():
        raise UnusableBag(path, "there is no such file or directory")
    if not path.is_dir():
        if path.suffix == ".db3":
            raise UnusableBag(path, SQLITE)
        if path.suffix == ".zstd":
            raise UnusableBag(path, PACKED)
        return path
    found = sorted(path.glob("*.mcap"))
    if len(found) == 1:
        return found[0]
    if found:
        raise UnusableBag(
            path, f"holds {len(found)} .mcap files: name one of them, or join them with `ros2 bag convert`"
        )
    if any(path.glob("*.db3")):
        raise UnusableBag(path, SQLITE)
    if any(path.glob("*.mcap.zstd")):
        raise UnusableBag(path, PACKED)
    below = sorted(entry.parent.name for entry in path.glob("*/*.mcap"))
    hint = f"; did you mean one of {', '.join(below[:5])} in it?" if below else ""
    raise UnusableBag(path, f"the directory holds no .mcap file{hint}")
