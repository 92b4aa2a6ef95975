"""Provenance of a measurement: a digest of the code that flew, and the commit, cores, Python and date."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core.settings.config import REGISTRIES

PROJECT = ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench")
_HERE = Path(__file__).resolve().parent


@cache
def code_digest(plug_ins: frozenset[tuple[str, str]] = frozenset()) -> str:
    """Return a digest of this project's sources and compiled kernels, of plug-ins, and of Python and NumPy.

    A process computes it once, because it keeps the code that it has imported. Packages that a plug-in imports from
    other distributions are left out. Plug-ins are kind and name.
    """
    digest = hashlib.sha256(f"Python {platform.python_version()} NumPy {np.__version__}".encode())
    for module in (*PROJECT, *sorted({module for kind, name in plug_ins for module in _modules_of(kind, name)})):
        for path in sorted(_files_of(module)):
            if module not in PROJECT or path.suffix in (".py", ".c", ".h", ".so"):
                digest.update(f"\0{module}\0{path.name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def _modules_of(kind: str, name: str) -> set[str]:
    """Top-level modules of a plug-in's distribution; builders other than setuptools list its files alone."""
    registry = REGISTRIES[kind]
    modules = {registry.factory(name).__module__}
    installed = None if name in registry.registered else registry.plug_ins()[name].dist
    if installed is not None:
        modules.update((installed.read_text("top_level.txt") or "").split())
        modules.update(p.parts[0].removesuffix(".py") for p in installed.files or () if p.suffix == ".py")
    return {module.partition(".")[0] for module in modules} - {*PROJECT, "dtsa", "__main__", ""}


def _files_of(module: str) -> Iterator[Path]:
    """Files of a package, data included, or the one of a module; caches and hidden files are left out."""
    spec = importlib.util.find_spec(module)
    if spec is None:
        return
    for root in spec.submodule_search_locations or ():
        for path in Path(root).rglob("*"):
            hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
            if path.is_file() and path.suffix != ".pyc" and not hidden:
                yield path
    if not spec.submodule_search_locations and spec.origin and Path(spec.origin).is_file():
        yield Path(spec.origin)


def read_provenance() -> dict[str, Any]:
    """Return the commit of the checkout and whether the tree differs from it; date, cores and Python."""
    ours = _git("ls-files", "--error-unmatch", Path(__file__).name)  # an installation may lie in another repository
    commit = _git("rev-parse", "HEAD") if ours else ""
    return {
        "commit": commit or "unknown",
        "tree_changed": bool(_git("status", "--porcelain", "--untracked-files=no")) if commit else None,
        "date": time.strftime("%Y-%m-%dT%H:%MZ", time.gmtime()),
        "cores": len(os.sched_getaffinity(0)),
        "python": ".".join(map(str, sys.version_info[:3])),
    }


def _git(*words: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(_HERE), *words], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
