"""Integration: what pages quote of measurements is what their records say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from dtsa_dev.documents import twelve_picture
from dtsa_dev.documents.evidence_tables import LEAGUES, LIST, QUOTED, main, rewritten, speed

from dtsa_agent.core.errors import ConfigError

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = "Before.\n<!-- evidence: fuzz -->\nold\n<!-- end -->\nAfter.\n"


@pytest.mark.parametrize("path", sorted(DOCS.rglob("*.md")), ids=lambda path: str(path.relative_to(DOCS)))
def test_quotations_are_those_of_the_records(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert rewritten(text, DOCS / "evidence") == text, "run: python -m dtsa_dev.documents.evidence_tables docs/*/*.md"


def test_every_quotation_is_on_a_page() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in DOCS.rglob("*.md"))
    assert all(f"<!-- evidence: {name} -->" in text for name in (*QUOTED, *LEAGUES, LIST))


def test_a_page_follows_its_record(tmp_path: Path) -> None:
    page = tmp_path / "how-to" / "page.md"
    page.parent.mkdir()
    page.write_text(PAGE)
    assert main([str(page)]) == 0
    assert page.read_text() == PAGE  # no record yet
    (tmp_path / "evidence").mkdir()
    figures = {"frames: inputs": 1_000_000, "agents: inputs": 2000}
    failures = [{"item": "frames 1", "reason": "stands still"}]
    for found, word in (([], "no findings"), (failures, "1 findings")):
        record = {"wall_s": 3600.0, "figures": figures, "failures": found}
        (tmp_path / "evidence" / "fuzz.json").write_text(json.dumps(record))
        assert main([str(page)]) == 0
        text = page.read_text()
        assert "60 minutes" in text
        assert "1,000,000" in text
        assert word in text
        assert "old" not in text
        assert text.startswith("Before.\n")
        assert text.endswith("<!-- end -->\nAfter.\n")
    with pytest.raises(ConfigError, match="fuzz"):
        rewritten(PAGE.replace("fuzz", "moon"), tmp_path)
    with pytest.raises(ConfigError, match="nodes"):
        speed({"kernels": [], "machine": {}})


def test_speeds_and_missed_targets_are_quoted() -> None:
    sizes, policies = (18, 70, 200), ("tdma", "age", "dtsa")
    record = {
        "date": "2026-01-02T03:04Z",
        "machine": {"cores": 2, "load": 0.1, "python": "3.11.7"},
        "kernels": [{"what": "priorities of all", "agents": n, "ours_us": n / 12} for n in sizes],
        "avoidance": [{"what": "avoidance of all", "agents": n, "pyrvo_ten_us": n / 2} for n in sizes],
        "slots": [
            {"what": "whole slot", "agents": n, "policy": p, "core_us": n / 4, "share_of_pyrvo": 0.5}
            for n in sizes
            for p in policies
        ],
        "flights": [
            {"what": "flight", "agents": n, "policy": p, "best_ms": n / 4 + 100 * bool(loss), **loss}
            for n in sizes[:2]
            for p in policies
            for loss in ({}, {"loss": 0.1})
        ],
        "nodes": [{"what": "nodes in lockstep", "agents": 4, "processes": 4, "slots_per_s": 99.6, "limit_per_s": None}],
        "targets": [
            {"target": "one", "value": 1.234, "limit": 1.0, "met": False},
            {"target": "two", "value": 0.3, "limit": 0.5, "met": True},
        ],
    }
    said = speed(record)
    for line in (
        "| all priorities g, one thread | 1.5 µs | 5.8 µs | 17 µs |",
        "| whole slot, dtsa | 4.5 µs | 18 µs | 50 µs |",
        "| whole slot over that step, dtsa | 0.50 | 0.50 | 0.50 |",
        "| whole flight, tdma | 4.5 ms | 18 ms |  |",
        "| 4 | 4 | 100 |  |  |",
        "1 of 2 targets are met; not: one: 1.23, not 1.",
    ):
        assert line in said.split("\n")


def test_the_picture_of_twelve_on_board_is_drawn_from_its_record(tmp_path: Path) -> None:
    record = Path(__file__).parents[2] / "docs/evidence/twelve.json"
    assert twelve_picture.main(str(record), str(tmp_path / "twelve.svg")) == 0
    drawn = (tmp_path / "twelve.svg").read_text(encoding="utf-8")
    assert "on board, laboratory" in drawn
    assert json.loads(record.read_text(encoding="utf-8"))["commit"] in drawn
