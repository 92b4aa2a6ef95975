"""What the documents say about commands and files is true."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("dtsa_msgs.msg")

from dtsa_dev.registry import COMMANDS as DEVELOPERS

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.agents import authentication
from dtsa_agent.ros import realtime
from dtsa_agent.ros.common.wire import intake
from dtsa_bench.commands.registry import COMMANDS as BENCH
from dtsa_bench.flights import clock_statistics
from dtsa_bench.runs import hearing
from dtsa_bench.runs.config import RunLimits
from dtsa_channel_sim.ros import live_air, pace, realtime_channel, roster

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


def test_every_command_is_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
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


def seconds(value_ns: float) -> str:
    return f"{value_ns / 1e9:g}"


def ms(value_ns: float) -> str:
    return f"{value_ns / 1e6:g} ms"


WORDS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
SPANS = {1_000_000_000: "a second", 500_000_000: "half a second"}
# What documents say with numbers that code has; a number that changes there changes here.
FIGURES: dict[str, list[str]] = {
    "explanation/real-time.md": [
        f"more than {SPANS[pace._BEHIND_NS]} behind for {seconds(pace._TOO_LONG_NS)} seconds, the flight is ended",
        f"takes in {realtime_channel._FRAMES} frames and {WORDS[realtime_channel._REPORTS]} reports",
        f"for {WORDS[pace._STALL_SLOTS]} slots and {ms(pace._STALL_NS)} at least",
        f"{SPANS[realtime_channel._PATIENCE_NS]} ({WORDS[realtime_channel._PATIENCE_SLOTS]} slots, if that is more)",
        f"an agent that hangs after {realtime_channel.LOST_AFTER_S:g} s",
        f"A frame is settled {live_air._GRACE:g} slots after it has left the air",
        f"until {realtime._LATEST:g} slots, at most {ms(realtime._LATEST_NS)}, after it",
        f"If that is more than {realtime_channel._TIGHT:g}",
        "after (K M + 1) N slots at the latest",  # RealtimeNode._ended; test_nodes leaves a flight so
    ],
    "how-to/security.md": [
        f"ends with a {authentication.TAG_LENGTH}-byte code",
        f"{authentication.MIN_KEY} to {authentication.MAX_KEY} bytes",
        f"processes of another run that stay for {roster._LEFT_OVER_S:g} s",
        f"(a line every {intake._LOG_S:g} s at most)",
    ],
    "how-to/fly.md": [f"once {hearing._ROUNDS} N slots have passed"],
    "reference/metrics.md": [
        f"closer than `collision_m` ({RunLimits().collision_m:g} m)",
        f"within `r_min` ({SwarmConfig().r_min:g} m)",
        f"frames that left within {ms(clock_statistics.ON_TIME_NS)} of the swarm's common time",
        f"largest of the last {clock_statistics._END} slots",
    ],
}


@pytest.mark.parametrize("name", FIGURES)
def test_numbers_in_documents_are_those_of_the_code(name: str) -> None:
    text = " ".join((ROOT / "docs" / name).read_text(encoding="utf-8").split())
    assert not [figure for figure in FIGURES[name] if figure not in text]
