"""Integration: twelve apps on board fly to and fro, an hour of virtual time in all, with clocks that drift, losses,
polls of the ground, resets, a brown-out and a foreign sender: none falls but the one without power, none comes nearer
than 0.2 m to another, and all decisions made again are equal.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtsa_agent.core import SwarmConfig
from dtsa_bench.crazyflies.peer_lab.app import LabSettings, read_app
from dtsa_bench.crazyflies.peer_lab.compiling import sanitizer_environment
from dtsa_bench.crazyflies.peer_lab.onboard import APP, OnboardSwarm
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.merge.merge import Merge

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]
AGENTS, ENABLED_S = 12, 8.0
CHANGE_S = 12.0  # from one change of goals to the next
NEAREST_M = 0.2
LOOK_S, HOVER = 0.2, 2  # how often an app is asked for its mode; one of these
VICTIM = 5  # agent of the faults that befall one
RESET_S, BACK_S = 60.0, 15.0
LAST_S = 30.0  # before the end: where one is without power the others land
FOREIGN_HZ = 20.0
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
ALL = "all but a brown-out, with sanitizers"
#: Faults by name: settings of the laboratory.
FAULTS: dict[str, dict[str, float]] = {
    "clocks off by 50 ppm": {}, "30 % lost": {"loss": 0.3}, "polls, 10 a second each": {"polls": 10.0},
    "polls, 50 a second each": {"polls": 50.0}, "an app that is reset": {}, "a brown-out in flight": {},
    "a foreign sender": {}, ALL: {"loss": 0.1, "polls": 10.0},
}  # fmt: skip
ITEMS = [(fault, part, 100.0 if fault == ALL else 300.0) for fault in FAULTS for part in (1, 2)]


def _change_goals(flight: OnboardSwarm, seconds: float) -> None:
    """Agents fly between start and target; none knows where the others fly to."""
    places = (np.array(flight.scenario.start), np.array(flight.scenario.target))
    for turn in range(1, int((seconds - ENABLED_S) / CHANGE_S)):
        for agent in range(1, flight.swarm.agents + 1):
            goal = places[(turn + 1) % 2][:, agent - 1]
            flight.lab.at(ENABLED_S + turn * CHANGE_S, lambda a=agent, g=goal: flight.send_goal(a, g))  # type: ignore[misc]


def _schedule_fault(flight: OnboardSwarm, fault: str, seconds: float, seed: int) -> None:
    lab = flight.lab
    if fault == "a brown-out in flight":
        lab.at(seconds - LAST_S, lambda: lab.switch_off(VICTIM))
    if fault in ("an app that is reset", ALL):  # on the floor: a reset takes the motors with it
        for at in np.arange(RESET_S, seconds - 2 * BACK_S, RESET_S).tolist():
            lab.at(at - 12.0, lambda: lab.send(VICTIM, b"L") and None)
            lab.at(at, lambda: lab.switch_off(VICTIM))
            lab.at(at + 1.0, lambda: flight.come_back(VICTIM, BACK_S))
    if fault in ("a foreign sender", ALL):
        pick = np.random.default_rng(seed)
        for at in np.cumsum(pick.exponential(1.0 / FOREIGN_HZ, int(seconds * FOREIGN_HZ))):
            data, port = pick.bytes(int(pick.integers(1, 61))), int(pick.integers(0, 16))
            lab.at(float(at), lambda data=data, port=port: lab.transmit(data, port))  # type: ignore[misc]


def fly(fault: str, seconds: float, seed: int, directory: Path, flags: Sequence[str] = ()) -> dict[str, Any]:
    """One flight of virtual time with a fault; what the laboratory says of it."""
    settings = LabSettings(seed=seed, drift_ppm=50.0, **FAULTS[fault])  # type: ignore[arg-type]
    swarm = SwarmConfig(agents=AGENTS, policy="lease", seed=seed, targets_known=False)
    app = read_app(APP, flags=tuple(flags))
    with OnboardSwarm(swarm, settings, directory, enable_s=ENABLED_S, app=app) as flight:
        _change_goals(flight, seconds)
        _schedule_fault(flight, fault, seconds, seed)
        modes: list[int] = []

        def look() -> None:
            agents = [agent for agent in range(1, AGENTS + 1) if flight.lab.is_on(agent)]
            modes.extend(round(flight.lab.log(agent, "dtsa.mode")) for agent in agents)

        for at in np.arange(ENABLED_S + 2.0, seconds, LOOK_S).tolist():
            flight.lab.at(at, look)
        flight.lab.run(seconds)
        return {**flight.summary(), "hover_share": modes.count(HOVER) / len(modes)}


def _fly_with_sanitizers(fault: str, seconds: float, seed: int, directory: Path) -> dict[str, Any]:
    """The same in a process of its own: the sanitizers have to be there before Python is."""
    environment = sanitizer_environment(read_app(APP, flags=SANITIZERS))
    words = [fault, str(seconds), str(seed), str(directory), *SANITIZERS]
    done = subprocess.run(
        [sys.executable, __file__, *words], env={**os.environ, **environment}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-500:]
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


@pytest.mark.parametrize(("fault", "seed", "seconds"), ITEMS)
def test_fault(fault: str, seed: int, seconds: float, tmp_path: Path, record: list[dict[str, Any]]) -> None:
    summary = (_fly_with_sanitizers if fault == ALL else fly)(fault, seconds, seed, tmp_path)
    merged = Merge([read(path) for path in sorted(tmp_path.glob("cf*.mcap"))]).summary()
    again = merged["decisions_again"]
    assert [int(agent) for agent in summary["crashed"]] == [VICTIM] * (fault == "a brown-out in flight")
    assert again["differences"] == []
    assert summary["min_distance_m"] >= NEAREST_M
    record.append({
        "fault": fault, "seconds": seconds, "fell": len(summary["crashed"]), "nearest_m": summary["min_distance_m"],
        "heard": merged["frames_heard"] / merged["frames_sent"] / (AGENTS - 1), "age_ms": summary["mean_age_ms"],
        "hovered": summary["hover_share"], "two_senders": merged["turns"]["slots_with_two_senders"],
        "equal": again["equal"],
    })  # fmt: skip


def summarise(found: list[dict[str, Any]]) -> tuple[list[str], list[list[object]]]:
    rows: list[list[object]] = []
    for fault in dict.fromkeys(row["fault"] for row in found):  # not all, if it was interrupted
        mine = [row for row in found if row["fault"] == fault]
        total = {name: sum(row[name] for row in mine) for name in ("seconds", "fell", "two_senders", "equal")}
        mean = {
            name: sum(row[name] * row["seconds"] for row in mine) / total["seconds"]
            for name in ("heard", "age_ms", "hovered")
        }
        rows.append([
            fault, f"{total['seconds']:.0f} s", total["fell"], f"{min(row['nearest_m'] for row in mine):.2f} m",
            f"{mean['heard']:.0%}", f"{mean['age_ms']:.0f} ms", f"{mean['hovered']:.1%}", total["two_senders"],
            f"{total['equal']:,}",
        ])  # fmt: skip
    heads = [
        "fault", "flown", "fell", "closest pair", "frames heard", "mean age", "time hovered", "slots with two senders",
        "decisions made again, all equal",
    ]  # fmt: skip
    return heads, rows


if __name__ == "__main__":
    _fault, _seconds, _seed, _directory, *_flags = sys.argv[1:]
    print(json.dumps(fly(_fault, float(_seconds), int(_seed), Path(_directory), _flags)))
