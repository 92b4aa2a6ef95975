"""Integration: names are plain engineering words, each class name stands once, files are neither tiny nor too many."""

from __future__ import annotations

import ast
import re
import subprocess
from collections import Counter, defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Rooms that are not checked yet, below the root.
NOT_YET = ("src/dtsa_bench/launch/",)
#: Words that no name may have: why not, and what to write instead.
BANNED = {
    "say": ("a radio does not speak", "send, announce; to a user: print, log, report"),
    "tell": ("a radio does not speak", "send, announce; to a user: print, log, report"),
    "speak": ("a radio does not speak", "send, transmit"),
    "look": ("does it read, compare or check?", "check, inspect, load"),
    "lay": ("says neither where from nor where to", "write, copy, schedule"),
    "settle": ("says not what is decided", "resolve, arbitrate"),
    "judge": ("says not what is decided", "resolve, check"),
    "news": ("says not of what", "state update, latest frame"),
    "there": ("an adverb names nothing", "the thing that is there"),
    "way": ("way of doing, or path?", "path, method"),
    "piece": ("a piece of what?", "chunk, part"),
    "thing": ("names nothing", "the thing's name"),
    "stray": ("a metaphor", "unmatched, unrecorded"),
    "strange": ("a metaphor", "foreign, unmatched"),
    "stranger": ("a metaphor", "foreign"),
    "somebody": ("a pronoun", "the agent, the sender"),
    "nobody": ("a pronoun", "no agent"),
    "who": ("a pronoun", "the agent, the owner, the receiver"),
    "those": ("a pronoun", "the agents"),
    "alive": ("a metaphor", "connected"),
    "dead": ("a metaphor", "lost, absent"),
    "life": ("a metaphor", "process, session"),
    "lives": ("a metaphor", "processes, sessions"),
    **dict.fromkeys(
        ("told", "said", "taken", "seen", "flown", "begun", "led", "unheard", "asked"),
        ("a participle leaves out what it is said of", "a noun of the field with its role"),
    ),
}
#: Words that no class may end with: its last word is the noun.
BANNED_AS_NOUNS = {
    **dict.fromkeys(
        ("heard", "sent", "given", "made", "found", "known", "kept", "gone"),
        ("a participle leaves out what it is said of", "a noun of the field with its role"),
    ),
    **dict.fromkeys(
        ("other", "until", "again", "work", "world", "take", "hold", "one"), ("names nothing", "a noun of the field")
    ),
}
#: Classes of one interface: the specification in `core/reference` has the names of what it specifies.
INTERFACES = {"Agent", "Station"}
SMALL = 60  # lines; a smaller file joins its only user
MAY_BE_SMALL = {
    "__init__.py", "__main__.py", "setup.py",
    "kernel.py",  # the binding alone: everything in the core imports it
    "delays.py",  # four rooms count delays
    "env.py",  # a public module of its own
    "keys.py",  # the one place that reads the secret
    "verdict.py",  # what channel, nodes and bench share
    "event_tdma.py", "sense.py", "threshold_aoii.py",  # a scheme a file
    "interfaces.py",  # the types of Crazyswarm2, where they are installed
    "palette.py", "card.py",  # colours that layouts share; what notebooks show
    "errors.py", "processes.py", "program.py",  # each has users in several rooms
}  # fmt: skip
MOST_FILES = 12  # of a package


def modules() -> list[Path]:
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = [path for path in listed.split() if path.startswith(("src/", "tools/")) and not path.startswith(NOT_YET)]
    return [Path(path) for path in paths if not {"test", "golden"} & set(path.split("/"))]


def tokens(name: str) -> list[str]:
    return [word.lower() for word in re.findall(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z0-9]+|[A-Z]+", name)]


def wrong(name: str, banned: dict[str, tuple[str, str]]) -> list[str]:
    return [f"{word}: {banned[word][0]}; better: {banned[word][1]}" for word in tokens(name) if word in banned]


@pytest.fixture(scope="module", autouse=True)
def checkout() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("names are checked in a checkout")


def test_names_are_plain() -> None:
    faults = []
    for path in modules():
        faults += [f"{path}: {fault}" for fault in wrong(path.stem, BANNED)]
        for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                faults += [f"{path}: {node.name}: {fault}" for fault in wrong(node.name, BANNED)]
                noun = tokens(node.name)[-1]
                faults += [f"{path}: {node.name}: {fault}" for fault in wrong(noun, BANNED_AS_NOUNS)]
            elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                faults += [f"{path}: {node.name}: {fault}" for fault in wrong(node.name, BANNED)]
    assert not faults, "\n".join(faults)


def test_a_class_name_stands_once() -> None:
    places = defaultdict(list)
    for path in modules():
        for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and "core/reference" not in str(path):
                places[node.name].append(str(path))
    assert not {name: where for name, where in places.items() if len(where) > 1 and name not in INTERFACES}


def test_files_are_not_tiny_and_packages_not_crowded() -> None:
    paths = [path for path in modules() if path.name not in MAY_BE_SMALL]
    sizes = {str(path): len((ROOT / path).read_text(encoding="utf-8").splitlines()) for path in paths}
    assert not {path: size for path, size in sizes.items() if size < SMALL}
    assert not {
        place: count for place, count in Counter(map(str, (p.parent for p in paths))).items() if count > MOST_FILES
    }
