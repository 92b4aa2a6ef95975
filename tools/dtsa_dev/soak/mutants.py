"""Mutation testing: a random sample of small changes of the source, each of which the tests should find.

A change is made in a copy of the sources, in a directory that is removed with the item; the sources are only read. One
that no test finds is a failure of the soak, unless a note says why nobody could tell the difference.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from dtsa_bench.experiments.batch.task import Row

from .changes import Change, changes_of
from .item import Item, NotMet, Soak

_ROOT = Path(__file__).resolve().parents[3]
_PACKAGES = ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench")
_COPIED = ("src", "docs", "tools", "examples", "layouts", "pyproject.toml", "conftest.py", "README.md")
_NOTES = Path("tools/test/mutants.json")  # what is known of changes that have survived
_SAMPLE = 20  # changes of each module
_LIMIT_S = 240.0  # of wall time: a change after which tests go on for ever is found, too
_SURVIVED, _FOUND = 0, (1, 2)  # exit codes of pytest


@dataclass(frozen=True, slots=True)
class Module:
    """Sources that are changed, and the tests that should find it, the quick ones first."""

    sources: tuple[str, ...]  # below src, patterns
    tests: tuple[str, ...]  # below src


_CORE, _AGENT, _CHANNEL, _BENCH = (
    "dtsa_agent/dtsa_agent/core", "dtsa_agent/test", "dtsa_channel_sim/test", "dtsa_bench/test"
)  # fmt: skip
_CORE_TESTS, _BAG_TESTS = f"{_AGENT}/core", f"{_BENCH}/recordings"
MODULES = {
    "medium": Module(
        ("dtsa_channel_sim/dtsa_channel_sim/model/medium.py",),
        (f"{_CHANNEL}/test_channel_air.py", f"{_CHANNEL}/test_channel.py", f"{_CHANNEL}/test_channel_losses.py"),
    ),
    "policies": Module(
        tuple(f"{_CORE}/reference/{name}.py" for name in ("policies", "selection", "rules", "lease/*")),
        (
            f"{_CORE_TESTS}/test_lease.py",
            f"{_CORE_TESTS}/test_lease_rules.py",
            f"{_CORE_TESTS}/test_reference.py",
            "../tools/test/test_oracle.py",
        ),
    ),
    "codec": Module(
        tuple(f"{_CORE}/{name}.py" for name in ("frame*", "reference/frame*")),
        (f"{_CORE_TESTS}/test_frame.py", f"{_CORE_TESTS}/test_frame_extended.py", f"{_CORE_TESTS}/test_reference.py"),
    ),
    "authentication": Module(
        (f"{_CORE}/agents/authentication.py", f"{_CORE}/reference/tag.py"),
        (
            f"{_CORE_TESTS}/test_authentication.py",
            f"{_CORE_TESTS}/test_wrappers.py",
            f"{_CORE_TESTS}/test_reference.py",
        ),
    ),
    "verify": Module(
        tuple(
            f"dtsa_bench/dtsa_bench/recordings/verify/{name}.py"
            for name in ("check", "decisions", "explain", "frames", "intake", "l*", "re*", "stream")
        ),
        (
            f"{_BAG_TESTS}/test_sent_frames.py",
            f"{_BAG_TESTS}/test_verify.py",
            f"{_BAG_TESTS}/test_verify_realtime.py",
        ),
    ),
    "safety": Module(
        tuple(f"dtsa_agent/dtsa_agent/crazyflie/{name}.py" for name in ("safety/rules", "motion/limits")),
        (
            f"{_AGENT}/crazyflie/test_bridge_rules.py",
            f"{_BENCH}/integration/test_settings.py",
        ),
    ),
    "replay": Module(("dtsa_bench/dtsa_bench/recordings/bag/replay.py",), (f"{_BAG_TESTS}/test_bag_replay.py",)),
}


def _items() -> Iterator[Item]:
    for name in MODULES:
        sample = name == "authentication"
        yield Item(f"{name}, unchanged", {"module": name}, 0, 30.0, sample=sample)
        for number in range(1, _SAMPLE + 1):
            yield Item(f"{name} {number}", {"module": name}, number, 15.0, sample=sample and number <= 2)


@cache
def drawn(name: str) -> list[tuple[Path, Change]]:
    """The changes of a module that are tried: always the same for the same sources.

    :param name: a key of MODULES.
    :returns: files, relative to the checkout, and changes.
    """
    files = sorted(path for pattern in MODULES[name].sources for path in (_ROOT / "src").glob(pattern))
    every = [(path.relative_to(_ROOT), change) for path in files for change in changes_of(path.read_text("utf-8"))]
    return random.Random(f"mutants of {name}").sample(every, _SAMPLE)


def _run(item: Item, directory: Path) -> dict[str, Any]:
    name = str(item.settings["module"])
    tree = _copy(directory)
    if not item.seed:
        code, said = _test(tree, name)
        if code != _SURVIVED:
            raise NotMet(f"tests fail without a change: {said}")
        return {"module": name, "found": "unchanged"}
    path, change = drawn(name)[item.seed - 1]
    (tree / path).write_text(change.applied((tree / path).read_text("utf-8")), "utf-8")
    code, said = _test(tree, name)
    there = {"module": name, "file": str(path), "line": change.line, "where": change.where, "change": str(change)}
    note = {key: text for key, text in _note(there).items() if key in ("equivalent", "test")}
    if code is None or code in _FOUND or code < 0:
        if "equivalent" in note:
            raise NotMet(f"found, although a note says that it cannot be: {path}:{change.line}: {change}: {said}")
        return {**there, "found": "time" if code is None else "test", **note}
    if code != _SURVIVED:
        raise NotMet(f"pytest ended with code {code}: {said}")
    if "equivalent" in note:
        return {**there, "found": "no", **note}
    raise NotMet(f"survived: {path}:{change.line}: {change.where}: {change}")


def _copy(directory: Path) -> Path:
    """A copy of what tests need; compiled modules come along, with the times by which Python knows that they fit."""
    for name in _COPIED:
        if (_ROOT / name).is_dir():
            shutil.copytree(_ROOT / name, directory / name)
        else:
            shutil.copy2(_ROOT / name, directory / name)
    return directory


def _test(tree: Path, name: str) -> tuple[int | None, str]:
    """Runs a module's tests; its exit code, None when time is up, and the last line that says something."""
    tests = [f"src/{test}" for test in MODULES[name].tests]
    paths = [*(str(tree / "src" / package) for package in _PACKAGES), os.environ.get("PYTHONPATH", "")]
    # With CI, hypothesis looks at the same examples each time.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "CI": "1"}
    words = ["nice", "-n", "10", sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    with (tree / "said.txt").open("w+", encoding="utf-8") as said:
        process = subprocess.Popen(
            words, cwd=tree, env=environment, stdout=said, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code: int | None = process.wait(_LIMIT_S)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        said.seek(0)
        lines = [line for line in said.read().splitlines() if line.startswith(("FAILED", "ERROR"))]
    return code, lines[-1][:300] if lines else ""


@cache
def _notes() -> list[dict[str, str]]:
    path = _ROOT / _NOTES
    return json.loads(path.read_text("utf-8")) if path.is_file() else []


def _note(there: dict[str, Any]) -> dict[str, str]:
    keys = ("file", "where", "change")
    return next((note for note in _notes() if all(note[key] == there[key] for key in keys)), {})


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["summary"] for row in rows]
    figures: dict[str, Any] = {}
    for name in MODULES:
        how = [row["found"] for row in found if row["module"] == name and row["found"] != "unchanged"]
        figures[name] = {"found": len(how) - how.count("no"), "of them by time": how.count("time"),
                         "equivalent": how.count("no")}  # fmt: skip
    return {**figures, "survivors": [row for row in found if {"equivalent", "test"} & set(row)]}


SOAK = Soak(
    "mutants",
    "Tests find every small change, of a random sample, of the sources of medium, policies, codec, authentication, "
    "verify, safety and replay, but for those that change nothing.",
    tuple(_items()),
    _run,
    _figures,
)
