"""Agents over UDP that fly RotorPy's multirotors by odometry and velocities; all twelve: `tools/dtsa soak air`."""

from __future__ import annotations

from pathlib import Path

import pytest
from dtsa_dev.soak.air.multirotor_flight import fly, missing

from dtsa_bench.runs.config import RunLimits


@pytest.mark.ros
@pytest.mark.skipif(bool(missing()), reason=missing() or "RotorPy is there")
@pytest.mark.realtime
def test_agents_fly_multirotors_of_somebody_else_to_their_goals(tmp_path: Path) -> None:
    pytest.importorskip("dtsa_msgs.msg")
    found = fly(3, tmp_path)
    assert found["arrived"] == 3, found
    assert found["min_distance_m"] > RunLimits().collision_m
    assert min(found["commands"]) > 20
