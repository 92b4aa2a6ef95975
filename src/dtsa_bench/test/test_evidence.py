"""What pages quote of measurements is what their records say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.evidence_tables import QUOTED, main, rewritten, speed

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGE = "Before.\n<!-- evidence: fuzz -->\nold\n<!-- end -->\nAfter.\n"


@pytest.mark.parametrize("path", sorted(DOCS.glob("*.md")), ids=lambda path: path.name)
def test_quotations_are_those_of_the_records(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert rewritten(text, DOCS / "evidence") == text, "run: python -m dtsa_bench.evidence_tables docs/*.md"


def test_every_quotation_is_on_a_page() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("*.md"))
    assert all(f"<!-- evidence: {name} -->" in text for name in QUOTED)


def test_a_page_follows_its_record(tmp_path: Path) -> None:
    (tmp_path / "page.md").write_text(PAGE)
    assert main([str(tmp_path / "page.md")]) == 0
    assert (tmp_path / "page.md").read_text() == PAGE  # no record yet
    (tmp_path / "evidence").mkdir()
    figures = {"frames: inputs": 1_000_000, "agents: inputs": 2000}
    failures = [{"item": "frames 1", "reason": "stands still"}]
    for found, word in (([], "no findings"), (failures, "1 findings")):
        record = {"wall_s": 3600.0, "figures": figures, "failures": found}
        (tmp_path / "evidence" / "fuzz.json").write_text(json.dumps(record))
        assert main([str(tmp_path / "page.md")]) == 0
        text = (tmp_path / "page.md").read_text()
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
