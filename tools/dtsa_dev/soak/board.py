"""The protocol on board for an hour of virtual time, with faults: twelve apps in the peer-to-peer laboratory."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_bench.crazyflies.peer_lab.app import LabSettings, read_app
from dtsa_bench.crazyflies.peer_lab.compiling import sanitizer_environment
from dtsa_bench.crazyflies.peer_lab.onboard import APP, OnBoard
from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.recordings.merge.agent_bag import read
from dtsa_bench.recordings.merge.merge import Merge

from .item import Item, NotMet, Soak

_AGENTS, _SECONDS, _SANITIZED_S, _ENABLED_S = 12, 300.0, 100.0, 8.0
_EACH_S = 12.0  # from one change of goals to the next
_NEAREST_M = 0.2
_LOOK_S, _HOVER = 0.2, 2  # how often an app is asked for its mode; one of these
_ONE = 5  # agent of the faults that befall one
_RESET_S, _BACK_S = 60.0, 15.0
_LAST_S = 30.0  # before the end: where one is without power the others land
_FOREIGN_HZ = 20.0
_SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
_ALL = "all but a brown-out, with sanitizers"
#: Faults by name: settings of the laboratory.
_FAULTS: dict[str, dict[str, float]] = {
    "clocks off by 50 ppm": {},
    "30 % lost": {"loss": 0.3},
    "polls, 10 a second each": {"polls": 10.0},
    "polls, 50 a second each": {"polls": 50.0},
    "an app that is reset": {},
    "a brown-out in flight": {},
    "a foreign sender": {},
    _ALL: {"loss": 0.1, "polls": 10.0},
}


def _items() -> tuple[Item, ...]:
    whole = (
        Item(f"{fault}, {part}", {"fault": fault, "seconds": _SANITIZED_S if fault == _ALL else _SECONDS}, part, 150.0)
        for fault in _FAULTS
        for part in (1, 2)
    )
    return (*whole, Item("sample", {"fault": "a foreign sender", "seconds": 14.0}, 7, 10.0, sample=True))


def _fly_to_and_fro(flight: OnBoard, seconds: float) -> None:
    """Agents fly between start and target; nobody is told where the others fly to."""
    places = (np.array(flight.scenario.start), np.array(flight.scenario.target))
    for turn in range(1, int((seconds - _ENABLED_S) / _EACH_S)):
        for agent in range(1, flight.swarm.agents + 1):
            goal = places[(turn + 1) % 2][:, agent - 1]
            flight.lab.at(_ENABLED_S + turn * _EACH_S, lambda a=agent, g=goal: flight.send_goal(a, g))  # type: ignore[misc]


def _befall(flight: OnBoard, fault: str, seconds: float, seed: int) -> None:
    lab = flight.lab
    if fault == "a brown-out in flight":
        lab.at(seconds - _LAST_S, lambda: lab.switch_off(_ONE))
    if fault in ("an app that is reset", _ALL):  # on the floor: a reset takes the motors with it
        for at in np.arange(_RESET_S, seconds - 2 * _BACK_S, _RESET_S).tolist():
            lab.at(at - 12.0, lambda: lab.send(_ONE, b"L") and None)
            lab.at(at, lambda: lab.switch_off(_ONE))
            lab.at(at + 1.0, lambda: flight.come_back(_ONE, _BACK_S))
    if fault in ("a foreign sender", _ALL):
        random = np.random.default_rng(seed)
        for at in np.cumsum(random.exponential(1.0 / _FOREIGN_HZ, int(seconds * _FOREIGN_HZ))):
            data, port = random.bytes(int(random.integers(1, 61))), int(random.integers(0, 16))
            lab.at(float(at), lambda data=data, port=port: lab.transmit(data, port))  # type: ignore[misc]


def fly(fault: str, seconds: float, seed: int, directory: Path, flags: Sequence[str] = ()) -> dict[str, Any]:
    """One flight with a fault; returns what the laboratory says of it.

    :param fault: its name.
    :param seconds: s, of virtual time.
    :param seed: of laboratory and swarm.
    :param directory: for the bags.
    :param flags: more of the compiler's.
    """
    settings = LabSettings(seed=seed, drift_ppm=50.0, **_FAULTS[fault])  # type: ignore[arg-type]
    swarm = SwarmConfig(agents=_AGENTS, policy="lease", seed=seed, targets_known=False)
    with OnBoard(swarm, settings, directory, enable_s=_ENABLED_S, flags=flags) as flight:
        _fly_to_and_fro(flight, seconds)
        _befall(flight, fault, seconds, seed)
        modes: list[int] = []
        for at in np.arange(_ENABLED_S + 2.0, seconds, _LOOK_S).tolist():
            flight.lab.at(at, lambda: modes.extend(_modes(flight)))
        flight.lab.run(seconds)
        return {**flight.finish(), "hover_share": modes.count(_HOVER) / len(modes)}


def _modes(flight: OnBoard) -> list[int]:
    lab = flight.lab
    return [round(lab.log(agent, "dtsa.mode")) for agent in range(1, _AGENTS + 1) if lab.is_on(agent)]


def _fly_with_sanitizers(fault: str, seconds: float, seed: int, directory: Path) -> dict[str, Any]:
    """The same in a process of its own: the sanitizers have to be there before Python is."""
    app = read_app(APP)
    environment = sanitizer_environment(dataclasses.replace(app, flags=(*app.flags, *_SANITIZERS)))
    words = [fault, str(seconds), str(seed), str(directory), *_SANITIZERS]
    done = subprocess.run(
        [sys.executable, "-m", __name__, *words], env={**os.environ, **environment}, capture_output=True, text=True
    )
    if done.returncode:
        raise NotMet(f"{fault}: {(done.stderr.strip().splitlines() or ['no word'])[-1]}")
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def _run(item: Item, directory: Path) -> dict[str, Any]:
    fault, seconds = str(item.settings["fault"]), float(item.settings["seconds"])
    flown = _fly_with_sanitizers if fault == _ALL else fly
    summary = flown(fault, seconds, item.seed, directory)
    found = Merge([read(path) for path in sorted(directory.glob("cf*.mcap"))]).judge()
    again, turns = found["decisions_again"], found["turns"]
    figures = {
        "fault": fault, "seconds": seconds, "crashed": [int(agent) for agent in summary["crashed"]],
        "min_distance_m": summary["min_distance_m"], "decisions_again": again["equal"],
        "differences": len(again["differences"]), "slots_with_two_senders": turns["slots_with_two_senders"],
        "sent": found["frames_sent"], "heard_share": found["frames_heard"] / found["frames_sent"] / (_AGENTS - 1),
        "mean_age_ms": summary["mean_age_ms"], "hover_share": summary["hover_share"],
    }  # fmt: skip
    expected = [_ONE] if fault == "a brown-out in flight" else []
    if figures["crashed"] != expected:
        raise NotMet(f"{item.name}: crashed {figures['crashed']}, expected {expected}", figures)
    if figures["differences"]:
        raise NotMet(f"{item.name}: {again['differences'][0]}", figures)
    if figures["min_distance_m"] < _NEAREST_M:
        raise NotMet(f"{item.name}: two came as near as {figures['min_distance_m']:.3f} m", figures)
    return figures


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for fault in _FAULTS:
        parts = [row["summary"] for row in rows if row["summary"].get("fault") == fault]
        if parts:
            seconds = sum(part["seconds"] for part in parts)
            found[fault] = {
                "seconds": seconds,
                "crashed": sum(len(part["crashed"]) for part in parts),
                "min_distance_m": min(part["min_distance_m"] for part in parts),
                "decisions_again": sum(part["decisions_again"] for part in parts),
                "slots_with_two_senders": sum(part["slots_with_two_senders"] for part in parts),
                "heard_share": sum(part["heard_share"] for part in parts) / len(parts),
                "mean_age_ms": sum(part["mean_age_ms"] for part in parts) / len(parts),
                "hover_share": sum(part["hover_share"] * part["seconds"] for part in parts) / seconds,
            }
    return found


SOAK = Soak(
    "board",
    "Twelve apps on board fly to and fro, with clocks that drift, losses, polls of the ground, resets, a brown-out "
    "and a foreign sender: nobody falls but the one without power, nobody comes nearer than 0.2 m to another, and all "
    "decisions made again are equal.",
    _items(),
    _run,
    _figures,
)


if __name__ == "__main__":
    _fault, _seconds, _seed, _directory, *_flags = sys.argv[1:]
    print(json.dumps(fly(_fault, float(_seconds), int(_seed), Path(_directory), _flags)))
