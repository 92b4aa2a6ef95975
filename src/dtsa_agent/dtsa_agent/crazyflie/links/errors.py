"""Errors of the bridge."""

from __future__ import annotations


class LinkError(Exception):
    """A connection could not be made; the text says why."""
