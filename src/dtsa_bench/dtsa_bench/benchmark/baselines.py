"""The independent implementations in `benchmarks/` at the repository's root, loaded as modules."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

from dtsa_agent.core.errors import DtsaError


class NotHere(DtsaError):
    """A baseline cannot be used on this machine; the message says why."""


def directory() -> Path:
    """The directory `benchmarks` of the repository that this package, or the working directory, belongs to.

    :raises NotHere: if there is none, as in an installation without sources.
    """
    for start in (Path(__file__).resolve(), Path.cwd().resolve() / "here"):
        for parent in start.parents:
            if (parent / "benchmarks" / "numpy_swarm.py").is_file():
                return parent / "benchmarks"
    raise NotHere("no directory benchmarks: not run in the project's sources")


@cache
def baseline(name: str) -> ModuleType:
    """One baseline.

    :param name: its file without suffix, e.g. ``pyrvo_step``.
    :raises NotHere: if it, or the package it wraps, is missing.
    """
    path = directory() / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"dtsa_benchmarks_{name}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise NotHere(f"{path} is missing")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except ImportError as error:
        raise NotHere(f"{error} (requirements/benchmark.txt)") from error
    return module
