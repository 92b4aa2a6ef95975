"""Integration: the documentation becomes a site: whole, without a network, no dead links, no page that nobody finds."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest

pytest.importorskip("mkdocs")

from browser_helpers import CHROMIUM, MISSING, browsing
from dtsa_dev.registry import add_commands

from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_bench.commands.cli import main

add_commands()
ROOT = Path(__file__).resolve().parents[2]
_LINK = re.compile(r'<a [^>]*?href="([^"#]*)')
_LOADED = re.compile(r'<(?:script|img|iframe)[^>]*? src="([^"]+)"|<link [^>]*?href="([^"]+)"')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("docs") / "site"
    # A process of its own: MkDocs and its plug-ins keep settings in modules.
    built = subprocess.run(
        [sys.executable, "-m", "dtsa_dev", "docs", "--out", str(out)], capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stdout + built.stderr
    assert built.stdout.strip().endswith("index.html")
    return out


def pages(site: Path) -> list[Path]:
    return [path for path in sorted(site.rglob("*.html")) if path.name != "404.html"]


def test_a_page_is_found_in_two_clicks_and_needs_no_network(site: Path) -> None:
    def linked(path: Path) -> set[Path]:
        targets = (unquote(url) for url in _LINK.findall(path.read_text(encoding="utf-8")) if "://" not in url)
        return {Path(os.path.normpath(path.parent / target)) for target in targets if target.endswith(".html")}

    first = linked(site / "index.html")
    second = set().union(*map(linked, first))
    assert {*pages(site)} <= first | second | {site / "index.html"}
    for path in pages(site):
        text = path.read_text(encoding="utf-8")
        loaded = [url for found in _LOADED.findall(text) for url in found if "://" in url]
        assert not loaded, f"{path.relative_to(site)} loads {loaded}"
        # For this class the theme fetches a script from elsewhere.
        assert 'class="mermaid"' not in text, path.relative_to(site)


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_page_that_is_opened_from_the_disk_is_searched(site: Path) -> None:
    with browsing() as browser:
        browser.open((site / "how-to" / "fly.html").as_uri())
        field = "document.querySelector('input[name=query]')"
        browser.wait_for(field)
        browser.run(f"{field}.focus(), {field}.value = 'genie', {field}.dispatchEvent(new KeyboardEvent('keyup'))")
        browser.wait_for(
            "[...document.querySelectorAll('.md-search-result__item')].some(x => /genie/i.test(x.innerText))"
        )
        assert not browser.complaints()


def test_pages_and_tables_are_made_from_the_code(site: Path) -> None:
    rows = json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))["docs"]
    found = {row["location"]: row["text"] for row in rows}
    assert "flies every combination" in found["reference/commands.html#sweep"].lower()
    assert "reference/messages.html#report" in found
    assert any(place.startswith("reference/library.html#") and place.endswith(".Table") for place in found)
    settings = (site / "reference" / "settings.html").read_text(encoding="utf-8")
    assert all(f"<code>{spec.name}</code>" in settings for spec in settings_of(SwarmConfig))
    assert "<code>/swarm/slot</code>" in (site / "reference" / "nodes.html").read_text(encoding="utf-8")
    broken = ("<!-- table:", "<p>|", "&lt;" * 7)  # a table not made, a table without a head, a merge not resolved
    texts = {path.name: path.read_text(encoding="utf-8") for path in pages(site)}
    assert not [(name, mark) for name, text in texts.items() for mark in broken if mark in text]


def test_types_of_settings_are_those_of_the_settings() -> None:
    from dtsa_dev.documents.pages import run_settings

    assert (ROOT / "src" / "dtsa_bench" / "dtsa" / "_settings.pyi").read_text(encoding="utf-8") == run_settings()


def test_dead_links_and_pages_that_nobody_finds_end_the_build(tmp_path: Path) -> None:
    for name in ("src", "tools", "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "REPRODUCTION.md", "LICENSE"):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    with (tmp_path / "docs" / "index.md").open("a", encoding="utf-8") as page:
        page.write("\n[a](how-to/nowhere.md) [b](how-to/fly.md#no-such-heading)\n")
    (tmp_path / "docs" / "alone.md").write_text("# Alone\n", encoding="utf-8")
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 1
    for what in ("how-to/nowhere.md", "#no-such-heading", "alone.md"):
        assert what in built.stderr, built.stderr


def test_a_directory_with_other_files_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.tex").touch()
    assert main(["docs", "--out", str(tmp_path)]) == 2
    assert "out: got" in capsys.readouterr().err
    assert (tmp_path / "thesis.tex").exists()
