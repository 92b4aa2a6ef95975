"""The benchmark: what it reports is complete, and does without what is not installed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dtsa_bench.benchmark import baselines, parts
from dtsa_bench.cli import main


def test_kernels_agree_with_plain_numpy_and_are_compared_with_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "--parts", "kernels", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    rows = [row for row in content["kernels"] if row["what"] == "priorities of all"]
    assert [row["agents"] for row in rows] == [18, 70, 200]
    for row in rows:
        assert row["largest_difference"] < 1e-12
        assert row["ratio"] == pytest.approx(row["numpy_us"] / row["ours_us"])
    assert {"frame encoded", "frame decoded"} <= {row["what"] for row in content["kernels"]}
    assert content["machine"]["cores"] >= 1
    assert content["targets"] == []


def test_without_baselines_only_the_comparison_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise baselines.NotHere(f"{name} is not here")

    monkeypatch.setattr(parts, "baseline", missing)
    monkeypatch.setattr(parts, "SIZES", (4,))
    rows = [*parts.avoidance(), *parts.slots([])]
    assert all("not here" in row["left_out"] for row in rows)
    slots = [row for row in rows if row["what"] == "whole slot"]
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
        {"what": "whole slot", "agents": 18, "policy": "dtsa", "core_us": 5.0, "pyrvo_ten_us": 20.0},
        {"what": "whole slot", "agents": 200, "policy": "dtsa", "core_us": 300.0, "pyrvo_ten_us": 200.0},
        {"what": "whole slot", "agents": 70, "policy": "age", "core_us": 5.0},
    ]
    assert [target["met"] for target in parts.targets(rows)] == [False, True]


def test_unknown_parts_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["benchmark", "--parts", "kernels,moon"]) == 2
    assert "moon" in capsys.readouterr().err
