"""Soaks: too long for the suite, `tools/dtsa soak NAME`; with `--evidence` each leaves a record in docs/evidence."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import pytest
from dtsa_dev.records import EVIDENCE, load, write_record


@pytest.fixture(scope="module")
def record(request: pytest.FixtureRequest) -> Iterator[list[Any]]:
    """Results of the items of a soak. With `--evidence` its module's `summarise` makes the rows of a record of it."""
    begun, loads = time.monotonic(), [load()]
    found: list[Any] = []
    yield found
    if os.environ.get("DTSA_EVIDENCE"):
        name = request.path.stem.removeprefix("test_")
        items = sum(item.path == request.path for item in request.session.items)
        heads, rows = getattr(request.module, "summarise", lambda found: ([], []))(found)
        figures = {
            "promise": " ".join(request.module.__doc__.removeprefix("Integration: ").split()),
            "passed": f"{len(found)} of {items}",
            "minutes": round((time.monotonic() - begun) / 60, 1),
            "load": [*loads, load()],
        }
        chosen = request.config.option.keyword
        part = f" -k '{chosen}'" if chosen else ""
        command = f"soak {name}{part} --evidence"
        write_record(EVIDENCE / f"{name}.json", command, heads, rows, figures)
