"""The independent implementations beside which ours are timed, where what they wrap is installed."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from dtsa_agent.core.errors import DtsaError


class NotHere(DtsaError):
    """A baseline cannot be used on this machine; the message says why."""


def baseline(name: str) -> ModuleType:
    """One baseline.

    :param name: ``pyrvo_step`` or ``rotorpy_step``.
    :raises NotHere: if the package that it wraps is missing.
    """
    try:
        return import_module(f"dtsa_dev.benchmark.{name}")
    except ImportError as error:
        raise NotHere(f"{error} (tools/dtsa setup --extra dev)") from error
