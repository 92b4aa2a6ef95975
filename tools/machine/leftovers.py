"""What an interrupted pip leaves in the virtual environment, and how it is removed.

While pip swaps a package, the old one has another name (`~etuptools-65.5.0.dist-info`), and the new one has no list of
its files (`RECORD`) until it is whole. pip can uninstall neither, and takes the half one for installed.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from machine import layout

MOVED = "~"  # begins the names of what pip has moved away


def canonical(name: str) -> str:
    """A package's name as requirements and package indices compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def found(names: set[str]) -> bool:
    """Whether an interruption of pip left its marks.

    :param names: the packages that count, canonical.
    """
    if next(layout.site_packages().glob(f"{MOVED}*"), None):
        return True
    return any(name_of(info) in names and not (info / "RECORD").exists() for info in infos())


def remove(pins: list[str]) -> None:
    """Remove packages that are not whole, without their help, and all that pip had moved away.

    A package is whole where its pinned version has a list of files: pip writes it last. May be interrupted itself.

    :param pins: requirements `name==version`. pip then installs those that are missing.
    """
    pinned = {canonical(name): version for name, _, version in (pin.partition("==") for pin in pins)}
    whole = {name_of(info) for info in infos() if is_whole(info, pinned)}
    for info in infos():
        if name_of(info) in pinned.keys() - whole:
            for path in files_of(info):
                path.unlink(missing_ok=True)
            shutil.rmtree(info)
    for directory, directories, files in os.walk(layout.VENV):
        for name in [name for name in directories if name.startswith(MOVED)]:
            directories.remove(name)
            shutil.rmtree(Path(directory, name))
        for name in files:
            if name.startswith(MOVED):
                Path(directory, name).unlink()


def is_whole(info: Path, pinned: Mapping[str, str]) -> bool:
    """Whether a directory describes the pinned version of a package, with a list of its files."""
    version = info.name.removesuffix(".dist-info").partition("-")[2]
    moved = info.name.startswith(MOVED)
    return not moved and pinned.get(name_of(info)) == version and (info / "RECORD").exists()


def infos() -> Iterator[Path]:
    """Directories in which packages describe themselves, those that pip has moved away among them."""
    return (info for info in sorted(layout.site_packages().glob("*.dist-info")) if info.is_dir())


def name_of(info: Path) -> str:
    """Canonical name of the package that a directory describes; empty where it does not say any more."""
    if not info.name.startswith(MOVED):
        return canonical(info.name.partition("-")[0])
    stated = re.search(r"(?m)^Name: *(\S+)", layout.read(info / "METADATA"))
    return canonical(stated[1]) if stated else ""


def files_of(info: Path) -> Iterator[Path]:
    """Files of a package as far as it lists them, without those that describe it."""
    place = info.parent
    for row in csv.reader(layout.read(info / "RECORD").splitlines()):
        path = Path(os.path.normpath(place / row[0])) if row else info
        if path.is_relative_to(layout.VENV) and not path.is_relative_to(info) and not path.is_dir():
            yield path
