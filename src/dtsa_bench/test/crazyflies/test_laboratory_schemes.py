"""Integration: the laboratory's own apps have the ages of the league's schemes with the same radio."""

from __future__ import annotations

import shutil

import pytest

from dtsa_agent.core import SwarmConfig
from dtsa_bench.crazyflies.peer_lab.app import LabSettings, read_app
from dtsa_bench.crazyflies.peer_lab.compiling import compiler
from dtsa_bench.crazyflies.peer_lab.process import fly
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.airtime import CRAZYFLIE_LINE, Airtime

pytestmark = pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler")

# A scheme's ages are counted at the ends of slots of 10 ms, from the start of the slot in which a frame was sent: half
# a slot less, on the average, than from its start to its arrival.
HALF_SLOT_MS = 5.0


def scheme_ms(policy: str, **options: float) -> float:
    channel = ChannelConfig(agents=12, radio="crazyflie")
    swarm = SwarmConfig(agents=12, policy=policy, options=options, seed=1)
    return float(simulate(RunConfig(swarm=swarm, channel=channel)).summary()["age_mean_ms"]) + HALF_SLOT_MS


def lab_ms(app: str) -> float:
    return float(fly(read_app(app), 12.0, LabSettings(agents=12, seed=1))["mean_age_ms"])


def test_beacons_have_the_ages_of_the_scheme() -> None:
    scheme = scheme_ms("beacons", **{"beacons.period_ms": 120.0, "beacons.jitter_ms": 10.0})
    assert lab_ms("beacons") == pytest.approx(scheme, rel=0.05)


def test_a_token_ring_has_the_ages_of_the_scheme_and_those_that_its_packets_take() -> None:
    def way_ms(length: int) -> float:
        times = Airtime(line=CRAZYFLIE_LINE)
        return (times.to_radio_ns(length) + times.total_ns(length) + times.from_radio_ns(length)) / 1e6

    # Half a round: each of twelve tells eleven others, who answer, and hands the token on in three packets.
    half_round = 12 * (11 * (way_ms(29) + way_ms(5)) + 3 * way_ms(5)) / 2
    lab = lab_ms("dtr")
    assert lab == pytest.approx(half_round + way_ms(29), rel=0.05)
    # A scheme's flight is short, and its ages begin at 0: the first of some twenty rounds has smaller ones.
    assert lab == pytest.approx(scheme_ms("dtr", **{"dtr.react_ms": 0.01}), rel=0.1)
