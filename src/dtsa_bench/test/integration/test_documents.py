"""What the documents say about commands and files is true."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("dtsa_msgs.msg")

from dtsa_dev.registry import COMMANDS as DEVELOPERS

from dtsa_bench.commands.registry import COMMANDS as BENCH

ROOT = Path(__file__).resolve().parents[4]
NAMES = ("README.md", "CONTRIBUTING.md", "REPRODUCTION.md")
DOCUMENTS = [*(ROOT / name for name in NAMES), *sorted((ROOT / "docs").rglob("*.md"))]
SOURCES = [
    path for path in (ROOT / "src").rglob("*") if path.suffix in (".py", ".c", ".h") and "build" not in path.parts
]
COMMANDS = BENCH | DEVELOPERS
OF_THE_TOOL = {"setup", "shell", "test", "ros2", "clean"}

pytestmark = pytest.mark.skipif(not (ROOT / "tools" / "dtsa").exists(), reason="not in the source tree")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", document.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.relative_to(ROOT)} links to {target}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_exist(document: Path) -> None:
    known = OF_THE_TOOL | {*COMMANDS}
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
                    [sys.executable, "-m", "dtsa_dev", command, "--help"], capture_output=True, text=True, check=True
                ).stdout
            for word in words:
                option = word.split("=")[0].rstrip(".,:;)")
                if option.startswith("--"):
                    assert option in helps[command], f"{document.name}: {line.strip()}: {option}"


def test_every_command_is_in_the_table_of_tasks() -> None:
    text = (ROOT / "docs" / "how-to" / "index.md").read_text(encoding="utf-8")
    assert not [name for name in COMMANDS if f"tools/dtsa {name}" not in text]


def test_files_have_the_names_that_documents_give_them() -> None:
    """As in `ros/lockstep.py` (`_run`): the file is there, and so is what it is said to hold."""
    looked = 0
    for document in DOCUMENTS:
        for place, names in re.findall(
            r"`([\w/.]+\.(?:py|c|h))` \(((?:`\w+`(?:, )?)+)\)", document.read_text(encoding="utf-8")
        ):
            texts = [path.read_text(encoding="utf-8") for path in SOURCES if f"/{path}".endswith(f"/{place}")]
            assert texts, f"{document.name}: there is no {place}"
            for name in re.findall(r"\w+", names):
                defined = re.compile(rf"\b(?:def|class|struct) {name}\b|^[\w \*]*\b{name}\(", re.MULTILINE)
                assert any(defined.search(text) for text in texts), f"{document.name}: {place} has no {name}"
                looked += 1
    assert looked >= 4
