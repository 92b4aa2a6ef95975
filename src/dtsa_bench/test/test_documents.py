"""What the documents say about commands and files is true."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from dtsa_bench.registry import COMMANDS, available

ROOT = Path(__file__).resolve().parents[3]
NAMES = ("README.md", "CONTRIBUTING.md", "REPRODUCTION.md")
DOCUMENTS = [*(ROOT / name for name in NAMES), *sorted((ROOT / "docs").glob("*.md"))]
OF_THE_TOOL = {"setup", "shell", "test", "ros2", "clean"}

pytestmark = pytest.mark.skipif(not (ROOT / "tools" / "dtsa").exists(), reason="not in the source tree")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", document.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.name} links to {target}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_commands_exist(document: Path) -> None:
    known = OF_THE_TOOL | {name for name, _ in available()}
    for command in re.findall(r"tools/dtsa ([a-z][a-z0-9-]*)", document.read_text(encoding="utf-8")):
        assert command in known, f"{document.name} names tools/dtsa {command}"


def test_options_exist() -> None:
    """Every option in a command line of a document is one of that command."""
    helps: dict[str, str] = {}
    for document in DOCUMENTS:
        for line in re.findall(r"tools/dtsa [^`\n|#]*", document.read_text(encoding="utf-8")):
            command, *words = line.split()[1:] or [""]
            if command not in COMMANDS:
                continue
            if command not in helps:
                helps[command] = subprocess.run(
                    [sys.executable, "-m", "dtsa_bench", command, "--help"], capture_output=True, text=True, check=True
                ).stdout
            for word in words:
                option = word.split("=")[0].rstrip(".,:;)")
                if option.startswith("--"):
                    assert option in helps[command], f"{document.name}: {line.strip()}: {option}"


def test_every_command_is_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert not [name for name, _ in available() if f"tools/dtsa {name}" not in text]
