"""The digest of all code that flies: every journal has it, so that rows of different code are never mixed."""

from __future__ import annotations

import hashlib
import importlib.util
import marshal
import platform
from collections.abc import Iterator
from functools import cache
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core.registry import ESTIMATORS, POLICIES, Registry
from dtsa_agent.core.settings.flight_models import AVOIDERS

PROJECT = ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench")
_SOURCES = (".py", ".c", ".h", ".so")  # compiled kernels, too
_REGISTRIES: dict[str, Registry[Any]] = {registry.kind: registry for registry in (POLICIES, ESTIMATORS, AVOIDERS)}

_HERE = "__main__"

PlugIn = tuple[str, str]  # kind and name


def code_digest(plug_ins: frozenset[PlugIn] = frozenset(), own: tuple[Path, ...] = ()) -> str:
    """A digest of the code that flies: this project, its compiled kernels, plug-ins, Python and NumPy.

    What a plug-in imports from packages of others is not in it. A process reads each package once, because it keeps the
    code that it has imported.

    :param plug_ins: kind and name of each plug-in that flies.
    :param own: further files.
    """
    digest = hashlib.sha256(f"Python {platform.python_version()} NumPy {np.__version__}".encode())
    for package in PROJECT:
        digest.update(_content_of(package, _SOURCES))
    for package in sorted({name for kind, plug_in in plug_ins for name in _packages_of(kind, plug_in)}):
        digest.update(_content_of(package, None))
    for kind, plug_in in sorted(plug_ins):
        digest.update(_written_here(_REGISTRIES[kind].factory(plug_in)))
    for path in own:
        digest.update(_entry(path.name, path))
    return digest.hexdigest()[:16]


def package_digest(kind: str, name: str) -> str:
    """A digest of the packages that a part comes from; of one that is built in, of this project's package with it.

    :param kind: of the part, as a setting names it.
    :param name: its name.
    """
    registry = _REGISTRIES[kind]
    built_in = "dtsa_agent" if name in registry.rows else registry.factory(name).__module__.partition(".")[0]
    digest = hashlib.sha256()
    if built_in in PROJECT:
        digest.update(_content_of(built_in, _SOURCES))
    else:
        for package in sorted(set(_packages_of(kind, name))):
            digest.update(_content_of(package, None))
        digest.update(_written_here(registry.factory(name)))
    return digest.hexdigest()


def _packages_of(kind: str, name: str) -> Iterator[str]:
    """Top-level modules and packages of a plug-in: all that its distribution announces; none of this project's."""
    registry = _REGISTRIES[kind]
    found = {registry.factory(name).__module__}
    if name not in registry.registered:
        point = registry.plug_ins()[name]
        found |= {point.module, *_announced(point.dist)}
    yield from {module.partition(".")[0] for module in found} - {*PROJECT, "dtsa", _HERE}


def _announced(installed: Distribution | None) -> set[str]:
    """Top-level modules and packages of a distribution; builders other than setuptools list its files alone."""
    if installed is None:
        return set()
    listed = installed.read_text("top_level.txt")
    if listed is not None:
        return set(listed.split())
    sources = [path for path in installed.files or () if path.suffix == ".py" and path.parts[0] != ".."]
    return {path.parts[0].removesuffix(".py") for path in sources}


def _written_here(factory: Any) -> bytes:
    """The compiled code of a plug-in that a notebook or a script has registered itself; empty: it has a module."""
    if factory.__module__ != _HERE:
        return b""
    parts = vars(factory) if isinstance(factory, type) else {factory.__name__: factory}
    codes = {name: part.__code__ for name, part in parts.items() if hasattr(part, "__code__")}
    values = {name: repr(part) for name, part in parts.items() if isinstance(part, (int, float, str, bytes, tuple))}
    written = [(name, marshal.dumps(code.replace(co_filename=""))) for name, code in sorted(codes.items())]
    return repr((factory.__name__, written, sorted(values.items()))).encode()


@cache
def _content_of(module: str, endings: tuple[str, ...] | None) -> bytes:
    """A digest of the files of a package, or of the one of a module.

    :param module: its name.
    :param endings: of the files that count; None: all do.
    """
    digest = hashlib.sha256(f"\0{module}\0".encode())
    spec = importlib.util.find_spec(module)
    origin = "" if spec is None else spec.origin or ""
    roots = [] if spec is None else sorted(spec.submodule_search_locations or ())
    if not roots and Path(origin).is_file():
        digest.update(_entry(Path(origin).name, Path(origin)))
    for root in roots:
        for path in sorted(Path(root).rglob("*")):
            place = path.relative_to(root)
            hidden = path.suffix == ".pyc" or any(part.startswith(".") for part in place.parts)
            if not hidden and (endings is None or path.suffix in endings) and path.is_file():
                digest.update(_entry(place.as_posix(), path))
    return digest.digest()


def _entry(name: str, path: Path) -> bytes:
    return name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest()
