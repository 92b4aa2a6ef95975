"""Integration: twelve agents on hosts of their own, started in any order, with clocks of their own, up to a fifth of
all frames lost: their bags verify, nobody crashes, frames overlap in at most 0.1 % of slots, in none without shortcuts,
and ages are the simulator's to 3 %. After kills, stand-stills, partitions, jamming, and among forged frames, all take
part again.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import pytest
from dtsa_dev.network.hosts import why_not
from dtsa_dev.network.switch import Intruder, Links
from trials import WHOLE, Trial, apart, fly

from dtsa_agent.air.port import NETWORK
from dtsa_agent.core import SwarmConfig
from dtsa_bench.log.record import load_log

pytestmark = [pytest.mark.soak, pytest.mark.skipif(bool(why_not()), reason=why_not() or "hosts can be made")]
AGENTS = 12
OVERLAP = 0.001  # of slots
AGE_MARGIN, ERROR_MARGIN = 0.03, 0.15  # mean age and mean error may differ from the simulator's by this share
# Slots of each: agents that begin later are there at once, and name it within three cycles of their lists at most.
HELD_SLOTS = 3 * AGENTS * -(-(AGENTS - 1) // (NETWORK.peers - 1))
FLIGHT_S, FAULT_S = 12.0, 3.0
ON_THE_AIR: dict[str, dict[str, Any]] = {"jam": {"jam": True}, "partition": {"partition": apart(AGENTS)}}
LINKS = Links(delay_ns=200_000, jitter_ns=500_000, double=0.1)
#: Faults of a flight, and their settings.
FAULTS = {
    "kill": "an agent's process is killed, and started again after 1 s",
    "freeze": "an agent's process stands still for 3 s", "partition": "the air is cut in two for 3 s",
    "jam": "no agent hears any other for 3 s", "stall": "the switch stands still for 1 s",
    "groups": "the air is cut in two from the start: two groups that count differently meet",
    "intruder": "a stranger without the key answers each frame: played again, changed, made up, floods of twenty",
    "links": "frames are 0.2 to 0.7 ms longer under way, and every tenth arrives twice",
}  # fmt: skip


def _disturb(flight: Any, fault: str) -> None:
    if fault == "kill":
        flight.kill_and_restart(2, 1.0)
        flight.carry(FAULT_S)
    elif fault == "freeze":
        flight.signal(2, signal.SIGSTOP)
        flight.carry(FAULT_S)
        flight.signal(2, signal.SIGCONT)
    elif fault == "stall":
        time.sleep(1.0)
    elif fault == "groups":
        flight.switch.set(partition="")
    elif fault == "intruder":
        Intruder(flight.switch, flight.trial.seed)
    elif fault in ON_THE_AIR:
        flight.switch.set(**ON_THE_AIR[fault])
        flight.carry(FAULT_S)
        flight.switch.set(jam=False, partition="")


def _fly(directory: Path, seed: int, slot_ms: float, loss: float, fault: str = "", **shortcuts: Any) -> dict[str, Any]:
    """A flight whose bags verify, and in which all are heard at the end; its figures, the simulator's beside them."""
    swarm = SwarmConfig(
        agents=AGENTS, policy="lease", slot_ms=slot_ms, scenario="waypoints", stops=8, pause_slots=0,
        auth=True, auth_session=seed, seed=seed, **shortcuts,
    )  # fmt: skip
    medium = {"loss": loss, **({"partition": apart(AGENTS)} if fault == "groups" else {})}
    trial = Trial(swarm, medium, LINKS if fault == "links" else Links(), seconds=FLIGHT_S, seed=seed)
    begins, lasts = (round(time_s / swarm.slot_s) for time_s in (FLIGHT_S / 3, FAULT_S))
    schedule = [{"slot": begins, "until": begins + lasts, **ON_THE_AIR[fault]}] if fault in ON_THE_AIR else []
    found = fly(trial, directory, lambda flight: _disturb(flight, fault), schedule=tuple(schedule))
    assert load_log(directory / WHOLE).summary == found["flight"]
    assert len(found["medium"]["heard_at_the_end"]) == AGENTS
    return found


def _row(name: str, found: dict[str, Any]) -> list[object]:
    flown, again, medium = found["flight"], found["simulated"], found["medium"]
    spread = found["clock_spread_ms"]
    return [
        name, f"{spread['mean']:.2f} / {spread['max']:.1f}", f"{medium['overlap_slots']} of {medium['slots']}",
        f"{found['frames_sent']}, {found['frames_unsent']}", f"{found['decisions_again']['equal']:,}",
        f"{flown['age_mean_slots']:.2f}, {again['age_mean_slots']:.2f}",
        f"{flown['min_distance_m']:.2f}, {again['min_distance_m']:.2f}",
    ]  # fmt: skip


STARTS = [(slot_ms, loss, strict) for slot_ms in (10.0, 5.0) for loss in (0.0, 0.05, 0.2) for strict in (True, False)]


@pytest.mark.parametrize(("slot_ms", "loss", "strict"), STARTS)
def test_cold_start(slot_ms: float, loss: float, strict: bool, tmp_path: Path, record: list[list[object]]) -> None:
    seed = 1 + STARTS.index((slot_ms, loss, strict))
    shortcuts = {"open_every": 0, "adoption": False} if strict else {}
    found = _fly(tmp_path, seed, slot_ms, loss, **shortcuts)
    flown, medium = found["flight"], found["medium"]
    assert found["common_after_last_start_s"] > 0, "one began in the past"
    assert not flown["collided"]
    assert max(found["held_slots"].values(), default=0) <= HELD_SLOTS
    assert medium["overlap_slots"] <= (0.0 if strict else OVERLAP) * medium["slots"]
    for name, margin in (("age_mean_slots", AGE_MARGIN), ("estimate_error_mean_m", ERROR_MARGIN)):
        assert flown[name] == pytest.approx(found["simulated"][name], rel=margin), name
    record.append(_row(f"{slot_ms:g} ms, {loss:.0%} lost{', no shortcuts' * strict}", found))


@pytest.mark.parametrize("fault", FAULTS)
def test_fault(fault: str, tmp_path: Path, record: list[list[object]]) -> None:
    found = _fly(tmp_path, 13 + list(FAULTS).index(fault), 10.0, 0.05, fault)
    refused = {reason: count for counts in found["not_taken_in"].values() for reason, count in counts.items()}
    if fault == "intruder":
        assert {"not ours", "other settings", "rejected", "repeated", "other time"} <= refused.keys()
    if fault == "links":
        assert refused["repeated"] > 0
    record.append(_row(FAULTS[fault], found))


def summarise(found: list[list[object]]) -> tuple[list[str], list[list[object]]]:
    heads = [
        "flight", "slots apart, ms: mean / largest", "slots with frames that overlapped", "frames sent, not sent",
        "decisions made again, all equal", "mean age, slots; in the simulator", "closest pair, m; in the simulator",
    ]  # fmt: skip
    return heads, found
