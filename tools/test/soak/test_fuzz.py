"""Integration: no input makes libdtsa touch foreign memory or hang."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from dtsa_dev.proofs.programs import TARGETS, NotHere, build, fuzz

pytestmark = [pytest.mark.soak, pytest.mark.timeout(900)]
SECONDS = {"frames": 120.0, "agents": 420.0, "station": 60.0}  # of one share: an hour in all
CORPUS = Path("runs") / "fuzz"  # kept: the next soak begins where this one ended


@pytest.mark.parametrize("share", range(1, 7))
@pytest.mark.parametrize("target", TARGETS)
def test_nothing_is_found(target: str, share: int, tmp_path: Path, record: list[dict[str, Any]]) -> None:
    try:
        program = build(target, tmp_path)
    except NotHere as error:
        pytest.skip(str(error))
    done = fuzz(program, SECONDS[target], (CORPUS / target).resolve(), share)
    record.append({"target": target, "inputs": done.runs, "edges": done.covered})


def summarise(found: list[dict[str, Any]]) -> tuple[list[str], list[list[object]]]:
    rows: list[list[object]] = []
    for target in TARGETS:
        mine = [row for row in found if row["target"] == target]
        rows.append([target, f"{sum(row['inputs'] for row in mine):,}", max(row["edges"] for row in mine)])
    return ["target", "inputs", "edges reached"], rows
