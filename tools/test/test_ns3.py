"""Integration: the simulated channel's side of the soak `ns3`, and the figures of both. None of it needs ns-3."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from dtsa_dev.registry import main
from dtsa_dev.soak.ns3 import contention, load_of
from dtsa_dev.soak.ns3.carry import Traffic, traffic
from dtsa_dev.soak.ns3.compare import carried, non_persistent_csma, pure_aloha, slotted_aloha
from dtsa_dev.soak.ns3.contend import BACKOFF_NS, LISTEN_NS
from dtsa_dev.soak.ns3.other_python import PYTHON

RECORD = Path(__file__).resolve().parents[2] / "docs" / "evidence" / "ns3.json"


def heard(run: Traffic) -> list[list[int]]:
    """What ns-3 would report that agrees."""
    return [
        [frame, int(receiver), run.frames[frame][1] + run.on_air_ns]
        for frame, mask in enumerate(run.received)
        for receiver in np.flatnonzero(mask)
    ]


@pytest.mark.parametrize("scheme", ["pure ALOHA", "pure ALOHA, hidden senders", "slotted ALOHA", "TDMA", "CSMA"])
def test_a_reception_that_only_one_side_has_is_found(scheme: str) -> None:
    load = 1.0 if scheme == "TDMA" else 0.5
    swarm, channel, slots = load_of(scheme, load, 1)
    run = traffic(swarm, channel, max(40, slots // 20))
    same = carried(run, heard(run))
    assert (same["differ"], same["arrivals_apart_ns"]) == (0, 0)
    assert same["frames"] > 10
    assert same["received"][0] == same["received"][1] > 0
    assert same["age_ms"][0] == same["age_ms"][1]
    value, half = same["throughput"][0]
    formula = {"pure ALOHA": pure_aloha(0.5, 20), "slotted ALOHA": slotted_aloha(0.5, 20), "TDMA": 0.95}
    if scheme in formula:
        assert value == pytest.approx(formula[scheme], abs=2.0 * half + 1e-9)
    differs = carried(run, heard(run)[1:])
    assert differs["differ"] == 1
    assert differs["received"] == [same["received"][0], same["received"][0] - 1]


def test_mean_age_of_two_frames_that_one_agent_hears() -> None:
    """Made at 0 and 30 ms, heard 10 ms later; the run ends at 50 + 10 ms."""
    ms = 1_000_000
    run = Traffic([[0.0] * 3] * 2, 10 * ms, 10 * ms, 50 * ms, [(0, 0), (0, 30 * ms)], [np.array([False, True])] * 2)
    # From 10 to 40 ms the age grows from 10 to 40 ms, from 40 to 60 ms from 10 to 30 ms.
    assert carried(run, heard(run))["age_ms"] == [pytest.approx((30 * 25 + 20 * 20) / 50)] * 2


def test_formulas() -> None:
    assert pure_aloha(0.5, 10**9) == pytest.approx(0.5 / np.e)
    assert slotted_aloha(1.0, 10**6) == pytest.approx(1.0 / np.e, rel=1e-5)
    assert non_persistent_csma(1e-6, 0.01) == pytest.approx(1e-6, rel=1e-3)
    assert non_persistent_csma(1.0, 0.0) == pytest.approx(0.5)


def test_contenders_wait_for_whole_back_offs_and_the_waits_are_those_of_the_question() -> None:
    figures, question = contention("CSMA/CA", 0.25, 1, frames=400)
    assert 300 < figures["sent"] < 500
    assert 0.9 < figures["received_share"][0] <= 1.0
    assert len(question["waits_ns"]) == 20
    turn_ms = 0.192
    assert figures["wait_ms"]["mean"] > 3.5 * BACKOFF_NS / 1e6 + LISTEN_NS / 1e6 + turn_ms
    again, _ = contention("CSMA/CA", 0.25, 1, frames=400)
    assert again == figures
    own, _ = contention("CSMA beside CSMA/CA", 0.25, 1, frames=400)
    assert own["wait_ms"]["mean"] < figures["wait_ms"]["mean"]  # it sends at once if the air is free
    assert own["throughput"] == pytest.approx(own["formula"], rel=0.2)


def test_without_ns3_one_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.delenv(PYTHON, raising=False)
    assert main(["soak", "ns3", "--sample"]) == 2
    said = capsys.readouterr().err.strip()
    assert said.count("\n") == 0
    assert "DTSA_NS3_PYTHON: got ''; allowed: a Python that has ns-3" in said
    assert "pip install ns3==" in said


def test_the_record_holds_what_it_promises() -> None:
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    assert record["finished"] == record["items"]
    assert not record["failures"]
    assert all(row["differ"] == row["arrivals_apart_ns"] == 0 for row in record["figures"]["carried"])
