"""Integration: each row of the table of faults has the reaction that stands beside it."""

from __future__ import annotations

from pathlib import Path

import pytest
from faults import FAULTS, Fault

pytestmark = [pytest.mark.ros, pytest.mark.soak]
ROWS = [pytest.param(fault, id=fault.name, marks=[pytest.mark.sample] * fault.sample) for fault in FAULTS]


@pytest.mark.parametrize("fault", ROWS)
def test_reaction(fault: Fault, tmp_path: Path, record: list[tuple[object, ...]]) -> None:
    pytest.importorskip("dtsa_msgs.msg")
    fault.run(tmp_path)
    record.append((fault.name,))
