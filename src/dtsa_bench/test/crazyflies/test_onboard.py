"""The protocol on board: twelve apps in the laboratory decide, bit for bit, what agents on computers decide."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.commands.cli import main
from dtsa_bench.crazyflies.peer_lab.app import LabSettings, read_app
from dtsa_bench.crazyflies.peer_lab.compiling import FIRMWARE, compiler
from dtsa_bench.crazyflies.peer_lab.onboard import APP, OnboardSwarm
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.merge.merge import Merge, is_verified

pytestmark = pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler")

OFF, FLY, HOVER, LAND = range(4)
DISABLED, GROUND, ORDERED, UNHEARD, OLD_NEWS = 1, 2, 4, 7, 8
LEASE = SwarmConfig(agents=5, policy="lease")


def merged(folder: Path) -> dict[str, Any]:
    return Merge([read(path) for path in sorted(folder.glob("cf*.mcap"))]).summary()


@pytest.mark.parametrize(("swarm", "lab"), [
    (LEASE, LabSettings(drift_ppm=50.0)), (LEASE, LabSettings(loss=0.1, seed=2)),
    (SwarmConfig(agents=5, policy="tdma", slot_ms=5.0, estimator="hold"), LabSettings(loss=0.1)),
    (SwarmConfig(agents=5, policy="lease", auth=True, auth_session=3), LabSettings()),
])  # fmt: skip
def test_apps_decide_what_agents_on_computers_decide(swarm: SwarmConfig, lab: LabSettings, tmp_path: Path) -> None:
    with OnboardSwarm(swarm, lab, tmp_path, key=bytes(range(16)) if swarm.auth else b"", enable_s=6.0) as flight:
        assert flight.lab.warnings == ""
        flight.lab.run(11.5)
        summary = flight.summary()
    found = merged(tmp_path)
    assert is_verified(found)
    assert found["decisions_again"]["differences"] == []
    assert found["decisions_again"]["equal"] > 600 * swarm.agents
    assert found["turns"]["slots_with_two_senders"] == 0
    assert summary["crashed"] == []
    assert max(summary["away_m"]) < 0.3
    assert summary["min_distance_m"] > 0.2
    assert summary["pairs_known"] == 1.0


@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_a_policy_that_nobody_can_join_begins_with_all_together(loss: float, tmp_path: Path) -> None:
    """DTSA: with losses tables come apart, several send at once, and agents that hear too little hover."""
    flown, whole = tmp_path / "flown", tmp_path / "merged"
    flown.mkdir()
    with OnboardSwarm(SwarmConfig(agents=6, policy="dtsa"), LabSettings(loss=loss), flown, enable_s=6.0) as flight:
        flight.lab.run(11.5)
        summary = flight.summary()
    assert summary["crashed"] == []
    assert main(["merge", *map(str, sorted(flown.glob("cf*.mcap"))), "--out", str(whole)]) == 0
    assert main(["verify", str(whole)]) == 0  # nobody has broken a rule
    found = merged(flown)
    assert 0 < found["common_after_last_start_s"] < 11.5  # by the vehicles' clocks, not by this machine's
    assert found["decisions_again"]["differences"] == []
    assert found["decisions_again"]["equal"] > 600 * 6
    assert (found["turns"]["slots_with_two_senders"] > 0) == (loss > 0)
    assert loss or max(summary["away_m"]) < 0.3


def test_the_same_seed_gives_the_same_bits() -> None:
    digests = []
    for seed in (1, 1, 2):
        lab = LabSettings(seed=seed, loss=0.2, drift_ppm=50.0, polls=20.0)
        with OnboardSwarm(SwarmConfig(agents=3, policy="lease"), lab) as flight:
            flight.lab.run(9.0)
            digests.append(flight.summary()["digest"])
    assert digests[0] == digests[1] != digests[2]


def test_one_is_switched_off_and_on_again_and_the_others_fly_on(tmp_path: Path) -> None:
    with OnboardSwarm(LEASE, LabSettings(), tmp_path) as flight:
        lab = flight.lab
        lab.at(10.0, lambda: lab.switch_off(4))
        lab.at(10.5, lambda: lab.switch_on(4))
        lab.at(10.6, lambda: flight.prepare(4))
        lab.run(16.0)
        assert lab.log(4, "dtsa.heard") > 50  # from the floor, it takes part
        assert [lab.log(k, "dtsa.mode") for k in (1, 2, 3, 5)] == [FLY] * 4
    assert merged(tmp_path)["decisions_again"]["differences"] == []


@pytest.mark.parametrize("known", [False, True])
def test_an_agent_with_a_new_goal_is_soon_heard(known: bool, tmp_path: Path) -> None:
    """Agents whose goal is their last give nearly all of their turns away, for good: such an agent may get no other."""
    with OnboardSwarm(replace(LEASE, targets_known=known), LabSettings(), tmp_path, enable_s=6.0) as flight:
        lab = flight.lab
        lab.run(13.0)
        before = [lab.log(k, "dtsa.sent") for k in range(1, 6)]
        for agent in range(1, 6):
            flight.send_goal(agent, flight.scenario.start[:, agent - 1])
        lab.run(13.3)
        new = [lab.log(k, "dtsa.sent") - old for k, old in enumerate(before, 1)]
        lab.run(13.3 if known else 15.0)
    assert all((data == b"T\0goals known") == known for _, _, data in lab.from_apps[-5:])
    assert known or min(new) >= 3  # of 30 slots each has six
    assert merged(tmp_path)["decisions_again"]["differences"] == []


def in_flight(flight: OnboardSwarm) -> None:
    flight.lab.run(9.5)
    agents = flight.swarm.agents
    assert [flight.lab.log(k, "dtsa.mode") for k in range(1, agents + 1)] == [FLY] * agents


def test_the_ground_takes_a_vehicle_back_in_four_ways() -> None:
    with OnboardSwarm(SwarmConfig(agents=4, policy="lease"), LabSettings()) as flight:
        in_flight(flight)
        lab = flight.lab
        lab.set_parameter(1, "dtsa.enable", 0)
        lab.go_to(2, 0.0, 0.0, 2.5, 2.0)  # a command of the ground's, without a word to the app
        lab.send(3, b"L")
        lab.land(4, 0.0, 2.0)
        lab.set_parameter(4, "dtsa.enable", 0)  # before the app looks again: it lands all the same
        lab.run(10.0)
        assert [lab.log(k, "dtsa.mode") for k in range(1, 4)] == [OFF, OFF, LAND]
        assert [lab.log(k, "dtsa.why") for k in range(1, 4)] == [DISABLED, GROUND, ORDERED]
        lab.run(12.5)
        height = lab.motion.vehicles.position[2]
        assert height[3] < 0.05
        lab.run(16.0)
        assert height[0] == pytest.approx(1.2, abs=0.15)  # it holds its place
        assert height[1] == pytest.approx(2.5, abs=0.15)
        assert height[2] < 0.05
        assert lab.record.crashed == {}


def test_who_hears_nobody_hovers_and_then_lands() -> None:
    with OnboardSwarm(SwarmConfig(agents=3, policy="lease"), LabSettings()) as flight:
        in_flight(flight)
        lab = flight.lab
        for agent in (2, 3):
            lab.set_parameter(agent, "dtsa.enable", 0)
            lab.send(agent, b"Z")  # an order that there is not
        lab.run(9.6)
        assert lab.from_apps[-1][2] == b"Z\0order"
        for agent in (2, 3):  # their radios only: they hang in the air by the high-level commander
            lab.set_parameter(agent, "dtsa.mute", 1)
        lab.run(11.0)
        assert (lab.log(1, "dtsa.mode"), lab.log(1, "dtsa.why")) == (HOVER, UNHEARD)
        lab.run(18.0)
        assert (lab.log(1, "dtsa.mode"), lab.log(1, "dtsa.why")) in [(LAND, UNHEARD), (OFF, UNHEARD)]
        assert lab.motion.vehicles.position[2, 0] < 0.05
        assert lab.record.crashed == {}


def test_an_agent_that_stays_for_old_news_gives_way_to_those_that_it_hears() -> None:
    """To agent 1 all news is too old, where six meet; one that held its place would be passed at 0.22 m."""
    swarm = SwarmConfig(agents=6, policy="lease", axis_x_m=0.8, axis_y_m=0.8, jitter_m=0.0, targets_known=False)
    nearest = []
    with OnboardSwarm(swarm, LabSettings(), enable_s=6.0) as flight:
        lab, place = flight.lab, flight.lab.motion.vehicles.position
        lab.run(6.9)
        for name in ("dtsa.newsS", "dtsa.restsS"):
            lab.set_parameter(1, name, -1.0)
        for at in np.arange(7.0, 10.5, 0.05).tolist():
            lab.at(at, lambda: nearest.append(np.linalg.norm(place[:, 1:] - place[:, :1], axis=0).min()))
        lab.run(10.5)
        assert (lab.log(1, "dtsa.mode"), lab.log(1, "dtsa.why")) == (HOVER, OLD_NEWS)
        assert all(lab.log(k, "dtsa.mode") == FLY for k in range(2, 7))
    assert min(nearest) > 0.3


@pytest.mark.parametrize(("swarm", "said"), [
    (SwarmConfig(agents=21, policy="lease"), "agents: got 21; allowed: 1 to 20"),
    (SwarmConfig(agents=4, policy="lease", auth=True, auth_session=1), "key: got 'none'"),
    (SwarmConfig(agents=4, policy="tdma", estimator="intent"), "estimator: got 'intent'; allowed: hold, linear"),
])  # fmt: skip
def test_a_swarm_that_cannot_fly_on_board_is_refused(swarm: SwarmConfig, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        OnboardSwarm(swarm, LabSettings())


def test_the_app_compiles_for_its_microcontroller_without_a_warning(tmp_path: Path) -> None:
    found = shutil.which("arm-none-eabi-gcc")
    if found is None:
        pytest.skip("no arm-none-eabi-gcc on this machine")
    board = ["-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os", "-std=gnu11"]
    words = [found, *board, "-Wall", "-Wextra", "-Wdouble-promotion", "-Werror", "-c"]
    app = read_app(str(APP))
    places = [f"-I{path}" for path in (*app.include, FIRMWARE)]
    for path in app.sources:
        if path.parent == APP.resolve():
            subprocess.run([*words, *places, "-o", tmp_path / f"{path.stem}.o", path], check=True, timeout=60)
    sizes = subprocess.run(
        ["arm-none-eabi-size", *map(str, tmp_path.glob("*.o"))], check=True, capture_output=True, text=True
    ).stdout
    ram = sum(int(line.split()[1]) + int(line.split()[2]) for line in sizes.splitlines()[1:])
    assert ram < 20_000, sizes


def test_the_command_flies_the_protocol_and_says_what_cannot_be(tmp_path, capsys):
    short = ["peer-lab", "protocol", "--agents", "3", "--seconds", "7", "--out", str(tmp_path / "flight")]
    assert main([*short, "--policy", "tdma"]) == 0
    assert "digest" in capsys.readouterr().out
    assert len(list((tmp_path / "flight").glob("cf*.mcap"))) == 3
    for words, said in (
        (["protocol", "--policy", "csma"], "policy: got 'csma'"),
        (["protocol", "--agents", "21"], "agents: got 21"),
        (["beacons", "--slot-ms", "5"], "slot_ms: got '5'; allowed: only with protocol"),
        (["protocol", "--auth-session", "7"], "DTSA_AUTH_KEY: got ''"),
        (["protocol", "--auth-session", "0"], "auth_session: got 0"),
        (["beacons", "--set", "a.b=1,a.c=2"], "set: got 'a.b=1,a.c=2'; allowed: GROUP.NAME=NUMBER"),
        (["beacons", "--set", "a.b=1", "--set", ""], "set: got ''; allowed: GROUP.NAME=NUMBER"),
    ):
        assert main(["peer-lab", *words]) == 2
        assert said in capsys.readouterr().err
