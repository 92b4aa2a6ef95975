"""The soaks by name. Each is imported when it is wanted."""

from __future__ import annotations

from importlib import import_module

from .item import Soak

SOAKS = {
    "recorder": "the recorder killed at random moments of flights in both modes; its bags recovered and verified",
}


def soak_named(name: str) -> Soak:
    """A soak.

    :param name: a key of SOAKS.
    """
    found: Soak = import_module(f"dtsa_bench.soak.{name}").SOAK
    return found
