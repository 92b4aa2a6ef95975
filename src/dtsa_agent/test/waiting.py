"""How tests wait: for what they need, never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")


def wait_for(condition: Callable[[], T], patience_s: float = 120.0, what: str = "waited in vain") -> T:
    """What a condition gives once it holds; after so many s of wall time the test fails with some words."""
    end = time.monotonic() + patience_s
    while not (found := condition()):
        assert time.monotonic() < end, what
        time.sleep(0.01)
    return found
