"""Integration: a short flight of `soak serial`: agents' processes over simulated modems, one killed and back."""

from __future__ import annotations

from pathlib import Path

from dtsa_dev.network.fake_modems import FakeModemSettings
from dtsa_dev.network.serial_flight import SerialFlight, SerialTrial, fly
from dtsa_dev.network.trial import WHOLE

from dtsa_agent.core import SwarmConfig
from dtsa_bench.recordings.merge.merge import verified
from dtsa_bench.recordings.verify import verify_bag


def test_a_killed_agent_comes_back_and_no_slot_has_two_senders(tmp_path: Path) -> None:
    swarm = SwarmConfig(
        agents=3, policy="lease", slot_ms=50.0, scenario="waypoints", stops=8, auth=True, auth_session=4,
        open_every=0, adoption=False,
    )  # fmt: skip

    def disturb(flight: SerialFlight) -> None:
        flight.kill(2)
        flight.carry(1.0)
        flight.start(2)
        flight.await_frames([2])

    modems = FakeModemSettings(modem="esp-now", count=3)
    found = fly(SerialTrial(swarm, modems, {"loss": 0.05}, seconds=8.0, seed=2), tmp_path, disturb)
    assert verified(found), found["decisions_again"]
    assert found["bags"] == 4
    assert found["slots_with_two_senders"] == 0
    assert found["modems"]["overflowed_bytes"] == 0
    checked = verify_bag(tmp_path / WHOLE)
    assert checked.ok, checked.difference
