"""The benchmark: what it reports is complete, and does without what is not installed."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dtsa_dev.benchmark import baselines, crazyflie, environments, parts
from dtsa_dev.registry import main


def test_kernels_are_timed_by_number_of_agents(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "--parts", "kernels", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    rows = [row for row in content["kernels"] if row["what"] == "priorities of all"]
    assert [row["agents"] for row in rows] == [18, 70, 200]
    for row in rows:
        assert row["ours_us"] > 0
    assert {"frame encoded", "frame decoded"} <= {row["what"] for row in content["kernels"]}
    assert content["machine"]["cores"] >= 1
    assert content["targets"] == []


def test_without_baselines_only_the_comparison_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise baselines.NotHere(f"{name} is not here")

    monkeypatch.setattr(parts, "baseline", missing)
    monkeypatch.setattr(parts, "SIZES", (4,))
    assert all("not here" in row["left_out"] for row in parts.avoidance())
    beside = list(parts.slots([{"agents": 4, "pyrvo_ten_us": 30.0, "pyrvo_customary_us": 40.0}]))
    assert all(row["share_of_pyrvo"] == row["core_us"] / 30.0 for row in beside)
    assert [target["limit"] for target in parts.targets(beside)] == [0.5, 0.5, 0.5]
    slots = list(parts.slots([]))
    assert [row["policy"] for row in slots] == ["tdma", "age", "dtsa"]
    assert all(row["core_us"] > 0 for row in slots)


def test_the_figure_of_the_cost_of_a_slot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parts, "COST_SIZES", (4, 10))
    assert main(["benchmark", "--parts", "cost", "--out", str(tmp_path / "out")]) == 0
    content = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert len(content["cost"]) == 6
    assert (tmp_path / "out" / "cost.png").stat().st_size > 5000
    assert "dtsa" in (tmp_path / "out" / "cost.svg").read_text()


def test_targets_are_met_or_not() -> None:
    rows: list[dict[str, Any]] = [
        {"what": "flight", "agents": 18, "policy": "tdma", "best_ms": 9.0, "limit_ms": 8.0},
        {"what": "whole slot", "agents": 18, "policy": "dtsa", "share_of_pyrvo": 0.25},
        {"what": "whole slot", "agents": 200, "policy": "dtsa", "share_of_pyrvo": 0.9},
        {"what": "whole slot", "agents": 200, "policy": "dtsa", "share_of_pyrvo": 1.5},
        {"what": "whole slot", "agents": 200, "policy": "tdma", "share_of_pyrvo": 0.9},
        {"what": "whole slot", "agents": 70, "policy": "age", "core_us": 5.0},
    ]
    bridge = {"what": "crazyflie bridge", "crazyflies": 12, "commands_hz": 47.0, "logs_hz": 50.0, "connect_s": 1.0}
    bridge |= {"close_s": 3.5, "latency_p99_ms": 9.0, "bridge_cpu_percent": 61.0}
    rows += [bridge, {"what": "crazyflie bridge", "left_out": "no cflib"}]
    node = {"what": "nodes in lockstep", "agents": 12, "processes": 12}
    rows += [node | {"slots_per_s": 199.0, "limit_per_s": 200.0}, node | {"slots_per_s": 201.0, "limit_per_s": 200.0}]
    rows += [node | {"slots_per_s": 1.0, "limit_per_s": None}, {"what": "nodes in lockstep", "left_out": "no rclpy"}]
    met = [target["met"] for target in parts.targets(rows)]
    assert met == [False, True, True, False, False, False, True, True, False, True, False, False, True]


def test_the_environment_is_timed_beside_simulate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environments, "AGENTS", 3)
    rows = list(environments.environments(flights=1, repeats=1))
    assert [row["loss"] for row in rows] == [0.0, 0.1]
    assert all(row["over_simulate"] > 0 for row in rows if "left_out" not in row)
    one = {"what": "environment", "form": "dictionaries", "agents": 12, "loss": 0.1, "limit_per_s": 20_000}
    found = parts.targets([one | {"agent_steps_per_s": 19_000.0}, one | {"left_out": "no PettingZoo"}])
    assert [target["met"] for target in found] == [False]


@pytest.mark.ros
def test_nodes_and_the_bare_round_beside_them(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("dtsa_msgs", reason="the workspace is not built")
    monkeypatch.setattr(parts, "NODE_TARGETS", ((2, 2, 1.0), (3, 1, None)))
    monkeypatch.setattr(parts, "NODE_SLOTS", 20)
    monkeypatch.setattr(parts, "NODE_REPEATS", 2)
    assert main(["benchmark", "--parts", "nodes", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    first, second = content["nodes"]
    assert first["slots"] == second["slots"] == 20
    assert first["slots_per_s"] >= first["median_per_s"] > 0
    assert len(first["ratios"]) == 2
    assert first["ratio"] == pytest.approx(sum(first["ratios"]) / 2)
    assert "ratio" not in second
    assert [target["target"] for target in content["targets"]] == [
        "nodes in lockstep, 2 agents, processes: 2 [slots/s]", "bare rounds over slots, 2 processes"
    ]  # fmt: skip
    assert content["targets"][0]["met"]


def test_unknown_parts_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "--parts", "kernels,moon"]) == 2
    assert "moon" in capsys.readouterr().err


def test_without_cflib_the_bridge_is_left_out(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "cflib" else True)
    assert main(["benchmark", "--parts", "crazyflie", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    (row,) = content["crazyflie"]
    assert row["left_out"] == "cflib is not installed: tools/dtsa setup --extra cflib"
    assert content["targets"] == []


def test_rate_and_latency_of_commands() -> None:
    published = 100.0 + 0.02 * np.arange(50) + np.array([[0.0], [0.001]])  # 50 Hz for one second, to two
    rows = [(k, i, published[k, i] + 0.002) for k in range(2) for i in range(50)]
    rows[7] = (0, 7, published[0, 7] + 0.050)
    others = [(0, -3, 99.9), (1, 50, 101.1)]  # before and after the measurement
    row = crazyflie.commands(published, np.array(rows + others), 2)
    assert row["commands_hz"] == pytest.approx(50.0)
    assert row["latency_median_ms"] == pytest.approx(2.0, abs=1e-3)
    assert 2.0 < row["latency_p99_ms"] < 50.0
    half = crazyflie.commands(published, np.array(rows[::2]), 2)
    assert half["commands_hz"] == pytest.approx(25.0)
    with pytest.raises(crazyflie.BenchmarkError, match="no command"):
        crazyflie.commands(published, np.empty((0, 3)), 2)


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.realtime
def test_the_bridge_is_measured_in_flight() -> None:
    pytest.importorskip("cflib")
    pytest.importorskip("dtsa_msgs.srv")
    row = crazyflie.measure(2, 1.0, {"link_age_s": 3.0, "command_age_s": 0.45})
    assert row["crazyflies"] == 2
    for name in ("connect_s", "close_s", "commands_hz", "logs_hz", "bridge_cpu_percent", "fleet_cpu_percent"):
        assert row[name] > 0.0, name
    assert 0.0 < row["latency_median_ms"] <= row["latency_p99_ms"]
    assert row["commands_hz"] < 60.0
