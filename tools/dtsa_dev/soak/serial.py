"""Agents over simulated modems: cold starts, losses, modems that come and go, lines that keep bytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.recordings.merge.merge import verified
from dtsa_bench.recordings.verify import verify_bag
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig
from dtsa_dev.network.fake_modems import FakeModemSettings
from dtsa_dev.network.serial_flight import SerialFlight, SerialTrial, fly
from dtsa_dev.network.trial import WHOLE, NotFlown

from .checks import met
from .item import Item, NotMet, Soak

AGE_MARGIN = 0.10  # mean age may differ from the simulator's by this share
_FAULT_S = 6.0
_SLOW = {"v_max": 0.25, "a_max": 1.0, "radius": 0.35}  # m/s, m/s^2, m: slots are long
#: What goes wrong in a flight, and what it does to it.
FAULTS = {
    "kill": "an agent's process is killed, and started again after 2 s",
    "partition": "the air is cut in two for 6 s",
    "unplug": "a modem is unplugged for 6 s, and is another device then",
    "garbage": "other bytes come out of modems before a fifth of the packets",
    "latency": "USB adapters keep bytes for 16 to 32 ms",
    "echo": "modems give back what they are given",
}
_MODEMS: dict[str, dict[str, Any]] = {
    "garbage": {"garbage": 0.2}, "latency": {"latency_ms": 16.0, "jitter_ms": 16.0}, "echo": {"echo": True},
}  # fmt: skip


def _items() -> Iterator[Item]:
    seed = 0
    for modem, agents, slot_ms in (("sik-64k", 12, 100.0), ("sik-64k", 12, 90.0), ("e22-19k", 6, 150.0)):
        for loss in (0.0, 0.1):
            seed += 1
            settings = {"modem": modem, "agents": agents, "slot_ms": slot_ms, "loss": loss}
            yield Item(f"{agents} over {modem}, {slot_ms:g} ms, {loss:.0%} lost", settings, seed, 100.0)
    for fault in FAULTS:
        seed += 1
        settings = {"modem": "sik-64k", "agents": 6, "slot_ms": 70.0, "loss": 0.05, "fault": fault}
        yield Item(fault, settings, seed, 60.0, sample=fault == "kill")


def _disturbed(flight: SerialFlight, fault: str) -> None:
    agents = flight.trial.swarm.agents
    if fault == "kill":
        flight.kill(2)
        flight.carry(2.0)
        flight.start(2)
        flight.await_frames([2])
    elif fault == "partition":
        flight.modems.set(partition=[list(range(1, agents // 2 + 1)), list(range(agents // 2 + 1, agents + 1))])
        flight.carry(_FAULT_S)
        flight.modems.set(partition="")
    elif fault == "unplug":
        flight.modems.unplug(2)
        flight.carry(_FAULT_S)
        flight.modems.plug(2)
        flight.await_frames([2])


def _run(item: Item, directory: Path) -> dict[str, Any]:
    given = item.settings
    fault, agents, slot_ms, loss = given.get("fault", ""), given["agents"], given["slot_ms"], given["loss"]
    swarm = SwarmConfig(
        agents=agents, policy="lease", slot_ms=slot_ms, scenario="waypoints", stops=8, pause_slots=0, auth=True,
        auth_session=item.seed, seed=item.seed, open_every=0, adoption=False, options=_SLOW,
    )  # fmt: skip
    modems = FakeModemSettings(modem=given["modem"], count=agents, **_MODEMS.get(fault, {}))
    trial = SerialTrial(swarm, modems, {"loss": loss}, seconds=item.seconds * 0.7, seed=item.seed)
    try:
        found = fly(trial, directory, (lambda flight: _disturbed(flight, fault)) if fault else None)
    except NotFlown as error:
        raise NotMet(str(error)) from error
    met(verified(found), f"the bags do not verify: {found['decisions_again']}, {found['turns']['which']}, "
        f"{found['frames_heard_not_as_sent']} frames heard not as sent")  # fmt: skip
    flown = found["flight"]
    if flown is None:
        raise NotMet("they never counted alike")
    checked = verify_bag(directory / WHOLE)
    met(checked.ok, f"the merged bag does not verify: {checked.difference}")
    met(found["slots_with_two_senders"] == 0, f"{found['slots_with_two_senders']} slots with two senders")
    again = _simulated(swarm, loss, flown["flight_time_s"])
    ages = [flown["age_mean_slots"], again["age_mean_slots"]]
    if not fault:
        met(abs(ages[0] / ages[1] - 1.0) <= AGE_MARGIN, f"mean age {ages[0]:.4g}, {ages[1]:.4g} in the simulator")
    return {
        "fault": fault, "modem": given["modem"], "agents": agents, "slot_ms": slot_ms, "loss": loss,
        "common_after_last_start_s": found["common_after_last_start_s"],
        "clock_spread_ms": found["clock_spread_ms"],
        "residual_us": found["time_line"]["residual_us"],
        "flight_time_us": found["time_line"]["flight_time_us"],
        "frames": [found["frames_sent"], found["frames_unsent"]],
        "slots": flown["slots"], "slots_with_two_senders": found["slots_with_two_senders"],
        "decisions_again": found["decisions_again"]["equal"],
        "collided": [flown["collided"], again["collided"]],
        "min_distance_m": [flown["min_distance_m"], again["min_distance_m"]],
        "age_mean_slots": ages,
        "pairs_known_share": flown["pairs_known_share"],
        "heard_age_max_slots": flown["heard_age_max_slots"],
        "modems": found["modems"], "said": found["said"],
    }  # fmt: skip


def _simulated(swarm: SwarmConfig, loss: float, seconds: float) -> dict[str, Any]:
    """The same flight in the simulator."""
    limits = RunLimits(timeout_s=max(1.0, seconds), tail_s=3600.0, stop_on_crash=False)
    config = SwarmConfig.from_dict({**swarm.to_dict(), "auth": False, "auth_session": 0})
    return simulate(RunConfig(config, ChannelConfig(loss=loss, **from_swarm(config)), limits)).summary()


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    return {row["item"]: row["summary"] for row in rows}


SOAK = Soak(
    "serial",
    "Twelve agents over simulated SiK modems at 64 kbit/s and six over LoRa, started in any order, up to a tenth of "
    "all frames lost: their bags verify, no slot has two senders, and ages are the simulator's to "
    f"{AGE_MARGIN:.0%}. Six agents come through a kill, a partition, an unplugged modem, garbage, slow adapters and "
    "echoes: bags verify, no slot has two senders.",
    tuple(_items()),
    _run,
    _figures,
)
