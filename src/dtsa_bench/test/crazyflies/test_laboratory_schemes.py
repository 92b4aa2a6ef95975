"""Integration: the laboratory's own apps have the ages of the league's schemes, but for what their air times explain."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest
from dtsa_agent.core import SwarmConfig
from dtsa_bench.crazyflies.peer_lab.compiling import compiler
from dtsa_bench.crazyflies.peer_lab.process import fly
from dtsa_bench.crazyflies.peer_lab.settings import LabSettings
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim.model.airtime import Airtime
from dtsa_channel_sim.model.radio_table import CRAZYFLIE_LINE

pytestmark = pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler")

# A scheme's ages are counted at the ends of slots of 10 ms, from the start of the slot in which a frame was sent. So they
# are half a slot smaller than those from the call that sends to the callback that hears, on the average.
HALF_SLOT_MS = 5.0


def scheme_ms(policy: str, options: dict[str, float]) -> float:
    """Mean age of a flight of twelve."""
    run = RunConfig(swarm=SwarmConfig(agents=12, policy=policy, options=options, seed=1))
    return float(simulate(run).summary()["age_mean_ms"]) + HALF_SLOT_MS


def lab_ms(app: str) -> float:
    """Mean age of the same in the laboratory."""
    return float(fly(app, 12.0, LabSettings(agents=12, seed=1))["mean_age_ms"])


def lab_way_ms(length: int) -> float:
    """From a call to the callback."""
    times = Airtime(line=CRAZYFLIE_LINE)
    return (times.to_radio_ns(length) + times.total_ns(length) + times.from_radio_ns(length)) / 1e6


def test_beacons_have_the_ages_of_the_scheme() -> None:
    scheme = scheme_ms("beacons", {"beacons.period_ms": 120.0, "beacons.jitter_ms": 10.0})
    assert lab_ms("beacons") == pytest.approx(scheme + lab_way_ms(24), abs=3.0)


def test_a_token_ring_has_the_ages_that_its_packets_take() -> None:
    def age_ms(way_ms: Callable[[int], float]) -> float:
        """Half a round: each of twelve tells eleven others, who answer, and hands the token on in three packets."""
        return 12 * (11 * (way_ms(29) + way_ms(5)) + 3 * way_ms(5)) / 2 + way_ms(29)

    def scheme_way_ms(length: int) -> float:
        return 0.3 + Airtime().total_ns(length) / 1e6 + 0.3  # `dtr.react_ms`, `link_delay_ns`

    assert scheme_ms("dtr", {}) == pytest.approx(age_ms(scheme_way_ms), rel=0.05)
    assert lab_ms("dtr") == pytest.approx(age_ms(lab_way_ms), rel=0.05)
