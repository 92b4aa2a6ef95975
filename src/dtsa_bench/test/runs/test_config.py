"""One run's settings: what does not go together is refused in one line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_bench.runs.config import RunConfig, from_swarm
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.airtime import RADIOS


def run(radio: str, loss: float = 0.0, **swarm: Any) -> RunConfig:
    config = SwarmConfig(**{"agents": 4, **swarm})
    return RunConfig(config, ChannelConfig(radio=radio, loss=loss, **from_swarm(config)))


@pytest.mark.parametrize(
    ("policy", "shortest_ms"), [("tdma", 0.5205), ("lease", 1.0385), ("dtsa", 0.7805), ("age", 0.7805)]
)
def test_slots_that_no_clock_and_no_processor_could_keep_are_refused(policy: str, shortest_ms: float) -> None:
    """Turn-round, frame, and the line: to the receiver, and back for those that need the frame."""
    run("crazyflie", policy=policy, slot_ms=shortest_ms)
    run("plain", policy=policy, slot_ms=0.3)
    with pytest.raises(ConfigError, match=f"slot_ms: got 0.5; allowed: at least {shortest_ms} with radio crazyflie"):
        run("crazyflie", policy=policy, slot_ms=0.5)


def test_frames_that_the_radio_does_not_take_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    row = RADIOS["crazyflie"]
    monkeypatch.setitem(RADIOS, "crazyflie", replace(row, airtime=replace(row.airtime, longest=32)))
    run("crazyflie", policy="tdma")
    allowed = "channel.radio: got 'crazyflie'; allowed: a radio that takes frames of 56 bytes, not 32 at most"
    with pytest.raises(ConfigError, match=allowed):
        run("crazyflie", policy="lease")


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("policy", ["tdma", "lease", "dtsa"])
def test_in_slots_that_are_long_enough_the_radio_changes_no_flight(policy: str, loss: float) -> None:
    flown = []
    for radio in ("plain", "crazyflie"):
        flight = simulate(run(radio, loss, policy=policy, slot_ms=2, seed=3, agents=6), trace=True)
        assert flight.trace is not None
        flown.append((flight.trace.senders, flight.trace.outcomes, [track.tobytes() for track in flight.trace.tracks]))
    assert flown[0] == flown[1]
