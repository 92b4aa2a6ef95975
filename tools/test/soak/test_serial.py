"""Integration: twelve agents over simulated SiK modems at 64 kbit/s and six over LoRa, started in any order, up to a
tenth of all frames lost: their bags verify, no slot has two senders, and ages are the simulator's to 10 %. Six agents
come through a kill, a partition, an unplugged modem, garbage, slow adapters and echoes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from dtsa_dev.network.fake_modems import FakeModemSettings
from trials import Trial, apart, fly

from dtsa_agent.core import SwarmConfig

soak = pytest.mark.soak
AGE_MARGIN = 0.10  # mean age may differ from the simulator's by this share
FAULT_S = 6.0
SLOW = {"v_max": 0.25, "a_max": 1.0, "radius": 0.35}  # m/s, m/s^2, m: slots are long
#: Faults of a flight, and their settings.
FAULTS = {
    "kill": "an agent's process is killed, and started again after 2 s", "partition": "the air is cut in two for 6 s",
    "unplug": "a modem is unplugged for 6 s, and is another device then",
    "garbage": "other bytes come out of modems before a fifth of the packets",
    "latency": "USB adapters keep bytes for 16 to 32 ms", "echo": "modems give back what they are given",
}  # fmt: skip
MODEMS: dict[str, dict[str, Any]] = {
    "garbage": {"garbage": 0.2}, "latency": {"latency_ms": 16.0, "jitter_ms": 16.0}, "echo": {"echo": True},
}  # fmt: skip


def _disturb(flight: Any, fault: str) -> None:
    if fault == "kill":
        flight.kill_and_restart(2, 2.0)
    elif fault == "partition":
        flight.modems.set(partition=apart(flight.trial.swarm.agents))
        flight.carry(FAULT_S)
        flight.modems.set(partition="")
    elif fault == "unplug":
        flight.modems.unplug(2)
        flight.carry(FAULT_S)
        flight.modems.plug(2)
        flight.wait_for_frames([2])


def _fly(
    directory: Path, modem: str, agents: int, slot_ms: float, loss: float, seconds: float, seed: int, fault: str = ""
) -> dict[str, Any]:
    """A flight whose bags verify, and in which no slot has two senders; the simulator's beside it."""
    swarm = SwarmConfig(
        agents=agents, policy="lease", slot_ms=slot_ms, scenario="waypoints", stops=8, pause_slots=0, auth=True,
        auth_session=seed, seed=seed, open_every=0, adoption=False, options=SLOW,
    )  # fmt: skip
    modems = FakeModemSettings(modem=modem, count=agents, **MODEMS.get(fault, {}))
    trial = Trial(swarm, {"loss": loss}, modems=modems, seconds=seconds, spread_s=2.0, seed=seed)
    found = fly(trial, directory, lambda flight: _disturb(flight, fault))
    assert found["slots_with_two_senders"] == 0
    return found


def _row(name: str, found: dict[str, Any]) -> list[object]:
    flown, spread = found["flight"], found["clock_spread_ms"]
    return [
        name, f"{found['frames_sent']}, {found['frames_unsent']}", flown["slots"]["total"],
        f"{found['decisions_again']['equal']:,}", f"{spread['mean']:.1f} / {spread['max']:.1f}",
        f"{flown['age_mean_slots']:.2f}, {found['simulated']['age_mean_slots']:.2f}", f"{flown['min_distance_m']:.2f}",
    ]  # fmt: skip


def test_a_killed_agent_comes_back(tmp_path: Path) -> None:
    """The part that the suite runs."""
    found = _fly(tmp_path, "esp-now", 3, 50.0, 0.05, 8.0, 2, "kill")
    assert found["bags"] == 4
    assert found["medium"]["overflowed_bytes"] == 0


STARTS = [(*radio, loss) for radio in (("sik-64k", 12, 100.0), ("sik-64k", 12, 90.0), ("e22-19k", 6, 150.0))
          for loss in (0.0, 0.1)]  # fmt: skip


@soak
@pytest.mark.parametrize(("modem", "agents", "slot_ms", "loss"), STARTS)
def test_cold_start(modem, agents, slot_ms, loss, tmp_path, record):
    seed = 1 + STARTS.index((modem, agents, slot_ms, loss))
    found = _fly(tmp_path, modem, agents, slot_ms, loss, 70.0, seed)
    assert found["flight"]["age_mean_slots"] == pytest.approx(found["simulated"]["age_mean_slots"], rel=AGE_MARGIN)
    record.append(_row(f"{agents} over {modem}, {slot_ms:g} ms, {loss:.0%} lost", found))


@soak
@pytest.mark.parametrize("fault", FAULTS)
def test_fault(fault: str, tmp_path: Path, record: list[list[object]]) -> None:
    found = _fly(tmp_path, "sik-64k", 6, 70.0, 0.05, 42.0, 7 + list(FAULTS).index(fault), fault)
    record.append(_row(FAULTS[fault], found))


def summarise(found: list[list[object]]) -> tuple[list[str], list[list[object]]]:
    heads = [
        "flight", "frames sent, not sent", "slots, none with two senders", "decisions made again, all equal",
        "slots apart, ms: mean / largest", "mean age, slots; in the simulator", "closest pair, m",
    ]  # fmt: skip
    return heads, found
