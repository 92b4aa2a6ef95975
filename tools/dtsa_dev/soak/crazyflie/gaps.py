"""Gaps of the link in flight: six vehicles over three dongles or UDP, a gap of its own each, all at one time."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dtsa_bench.crazyflies.simulated.truth import read_truth
from dtsa_bench.experiments.batch.task import Row
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.item import Item

from .fleets import RunningFleet, running, station_priority

COUNT = 6
FLIGHTS = 5  # for each phase: 30 gaps, 0.1 to 3 s
PHASES = ("take-off", "commands", "landing")
KINDS = {"gaps": 0.01, "closed ports": None}  # on the air, with that share of packets lost; of UDP
SURVIVED_S = 0.75
STEP_S = 0.02
LOW_M = 0.1  # m: it stands, or nearly so
_HEIGHT_M, _CLIMB_S = 0.95, 2.5
_FLEW_ON, _LANDED, _OFF = "flew on", "landed", "motors off"


def items() -> Iterator[Item]:
    """All lengths in all phases."""
    for kind, phase, flight in itertools.product(KINDS, PHASES, range(1, FLIGHTS + 1)):
        lengths = [round(0.1 * (flight + FLIGHTS * k), 1) for k in range(COUNT)]
        settings = {"part": "gap", "kind": kind, "phase": phase, "gaps": lengths}
        sample = (kind, phase, flight) == ("gaps", "commands", 1)
        yield Item(f"{kind} in {phase}, {flight}", settings, flight, 25.0, sample=sample)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Fly.

    :raises NotMet: somebody falls after a gap that the firmware survives, or stays lost.
    """
    from dtsa_agent.crazyflie.links.link import SIMULATED_RADIO

    station = {"toc_cache": str(directory / "cache"), "safety": {"geofence": False}}
    options = ["--radio-seed", str(item.seed), "--seed", str(item.seed)]
    loss = KINDS[str(item.settings["kind"])]
    with running(directory, COUNT, loss, options, station) as fleet, station_priority():
        before = os.environ.get(SIMULATED_RADIO)
        os.environ[SIMULATED_RADIO] = str(fleet.radio or "")
        try:
            begun, lost = _fly(fleet, str(item.settings["phase"]), list(item.settings["gaps"]))
        finally:
            os.environ.pop(SIMULATED_RADIO)
            if before is not None:
                os.environ[SIMULATED_RADIO] = before
        did = [_outcome(fleet, cf, begun) for cf in range(1, COUNT + 1)]
    table = [[seconds, outcome] for seconds, outcome in zip(item.settings["gaps"], did, strict=True)]
    fallen = [seconds for seconds, outcome in table if seconds < SURVIVED_S and outcome.startswith(_OFF)]
    met(not fallen, f"motors off after gaps of {fallen} s: {table}")
    met(not lost, f"still lost at the end: {', '.join(lost)}")
    return {**item.settings, "table": table}


def _fly(fleet: RunningFleet, phase: str, gaps: list[float]) -> tuple[float, list[str]]:
    """Fly with gaps; the fleet's time at which they began, and who is lost at the end."""
    from dtsa_agent.crazyflie.node.bridge import Bridge
    from dtsa_agent.crazyflie.settings.config import load_swarm
    from dtsa_agent.crazyflie.state.state_machine import State

    bridge = Bridge(load_swarm(fleet.config), lambda level, line: None)
    names, over = list(bridge.vehicles), threading.Event()
    try:
        met(not bridge.connect(), "not everybody connects")
        bridge.each(names, lambda v: v.arm(True))
        _until(lambda: all(v.state == State.ARMED for v in bridge.vehicles.values()), "all are armed")
        met(bridge.each(names, lambda v: v.takeoff(_HEIGHT_M, _CLIMB_S))[0], "the take-off is refused")
        time.sleep(0.7 if phase == "take-off" else _CLIMB_S + 0.3)
        if phase != "take-off":
            threading.Thread(target=_stream, args=(bridge, over), daemon=True).start()
            time.sleep(0.5)
        if phase == "landing":
            over.set()
            bridge.land_all("the landing that is disturbed")
            time.sleep(0.4)
        for cf, seconds in enumerate(gaps, 1):
            begun = fleet.fault("close", cf, seconds=seconds)  # on the air nothing is heard, in both directions
        time.sleep(max(gaps) + (_CLIMB_S if phase == "take-off" else 0.0) + 1.0)
        over.set()
        _until(lambda: all(v.state != State.LOST for v in bridge.vehicles.values()), "all are heard again", 8.0, False)
        lost = [name for name, vehicle in bridge.vehicles.items() if vehicle.state == State.LOST]
        fleet.fault("heal")  # a mark in the record: what comes now was ordered
        bridge.land_all("the flight is over")
        bridge.wait_landed(lambda: False)
    finally:
        over.set()
        bridge.close()
    return begun, lost


def _stream(bridge: Any, over: threading.Event) -> None:
    from dtsa_agent.crazyflie.state.conversions import velocity_world

    while not over.wait(STEP_S):
        for vehicle in bridge.vehicles.values():
            vehicle.command(velocity_world((0.0, 0.0, 0.0), 0.0, time.monotonic()))


def _until(condition: Callable[[], object], what: str, patience_s: float = 20.0, needed: bool = True) -> None:
    end = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > end:
            met(not needed, f"{what}: not within {patience_s:g} s")
            return
        time.sleep(STEP_S)


def _outcome(fleet: RunningFleet, cf: int, begun: float) -> str:
    """What a vehicle did from the gap to the end."""
    times, positions, events = read_truth(fleet.truth)
    mine = [e for e in events if e["cf"] == cf and e["t"] >= begun - 0.02]
    marks = [k for k, event in enumerate(mine) if event["event"] == "fault: heal"]
    for event in mine[: marks[-1]] if marks else mine:
        if event["event"] == "state" and event["state"] in ("locked", "crashed"):
            height = positions[min(int(times.searchsorted(event["t"])), len(times) - 1), 2, cf - 1]
            if height > LOW_M:
                return f"{_OFF}: {event.get('reason', '')}"
        if event["event"] == "state" and event["state"] == "landed":
            return _LANDED
    low = positions[times.searchsorted(mine[marks[-1]]["t"]) - 1, 2, cf - 1] < LOW_M if marks else False
    return _LANDED if low else _FLEW_ON


def figures(rows: Sequence[Row]) -> dict[str, Any]:
    """By kind and phase: lengths of gaps (s) by what the vehicle did."""
    found: dict[str, Any] = {}
    for kind, phase in itertools.product(KINDS, PHASES):
        by: dict[str, list[float]] = {}
        for row in rows:
            if (row["kind"], row["phase"]) == (kind, phase):
                for seconds, outcome in row["table"]:
                    by.setdefault(outcome, []).append(seconds)
        if by:
            found[f"{kind} in {phase}, s"] = {outcome: sorted(seconds) for outcome, seconds in sorted(by.items())}
    return found
