"""Integration: the benchmark times what it says, and its rows become a record."""

from __future__ import annotations

import json

import pytest
from dtsa_dev.benchmark import core
from dtsa_dev.registry import add_commands

from dtsa_bench.commands.cli import main

add_commands()


def test_kernels_slots_and_flights_are_rows_of_a_record(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(core, "SIZES", (4,))
    monkeypatch.setattr(core, "FLIGHTS", tuple(({"agents": 4, "policy": "tdma"}, limit) for limit in (1e9, 0, 0, 1e9)))
    assert main(["benchmark", "--parts", "kernels,slots,flights", "--out", str(tmp_path / "speed.json")]) == 0
    record = json.loads((tmp_path / "speed.json").read_text())
    rows = {row[0]: dict(zip(record["heads"], row, strict=True)) for row in record["rows"]}
    assert record["command"] == "benchmark --parts kernels,slots,flights --out FILE"
    assert 0 < float(rows["priorities of all, N = 4"]["ratio"]) < 1
    assert rows["whole slot, dtsa, N = 4"]["here"].endswith(" us")
    assert 0 < float(rows["set-up and one slot of a flight of 4"]["ratio"]) < 1
    assert [row[-1] for row in record["rows"] if row[0].startswith("flight")] == [
        "<= 1e+12 ms", "<= 0 ms, NOT MET", "<= 0 ms, NOT MET", "<= 1e+12 ms"
    ]  # fmt: skip
    assert len(capsys.readouterr().out.splitlines()) == len(record["rows"])


@pytest.mark.ros
def test_nodes_and_the_bare_round_beside_them(monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = pytest.importorskip("dtsa_dev.benchmark.nodes")
    monkeypatch.setattr(nodes, "TARGETS", ((2, 2, 1.0), (3, 1, None)))
    monkeypatch.setattr(nodes, "SLOTS", 20)
    monkeypatch.setattr(nodes, "REPEATS", 1)
    first, second = nodes.nodes()
    assert first.ratio > 0
    assert first.target == "<= 2.5, >= 1 slots/s"
    assert (second.ratio, second.target) == (None, "")
