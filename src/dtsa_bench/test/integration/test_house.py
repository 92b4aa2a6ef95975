"""Rules of the house that a look at the files can hold."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[4]
PLACES = ("src/dtsa_agent", "src/dtsa_channel_sim", "src/dtsa_bench", "tools")
WORKAROUNDS = (  # of defects in other packages
    "src/dtsa_agent/dtsa_agent/ros/common/_endless.c",
    "src/dtsa_agent/dtsa_agent/ros/common/loop.py",
    "src/dtsa_agent/dtsa_agent/ros/common/node_process.py",
    "src/dtsa_agent/dtsa_agent/crazyflie/drivers.py",
)

pytestmark = pytest.mark.skipif(not (ROOT / "conftest.py").exists(), reason="not in the source tree")


def modules(place: Path) -> Iterator[str]:
    """Names of modules below a directory, and of the directories that hold them; `a/_b.c` is b, and a_b."""
    for path in place.rglob("*"):
        parts = path.relative_to(place).parts
        if path.suffix in (".py", ".c", ".js") and "test" not in parts and not {"build", "install"} & set(parts):
            names = [*parts[:-1], path.stem.strip("_")]
            yield from names
            yield from map("_".join, pairwise(names))


def room(test: Path, place: Path) -> Path:
    """The room whose tests stand beside a test; the whole place where it has no room of that name."""
    name = test.relative_to(place / "test").parts[0]
    return next((path for path in sorted(place.rglob(name)) if path.is_dir() and "test" not in path.parts), place)


@pytest.mark.parametrize("place", PLACES)
def test_a_test_file_stands_beside_a_module_or_says_that_it_is_an_integration_test(place: str) -> None:
    everywhere, silent = set(modules(ROOT / place)), []
    tests = [path for path in (ROOT / place / "test").rglob("test_*.py") if path.parent.name != "integration"]
    assert tests
    for path in tests:
        name = path.stem.removeprefix("test_")
        tail = name.partition("_")[2]  # test_bridge_limits.py: limits.py of the bridge's room
        beside = name in everywhere or tail in set(modules(room(path, ROOT / place)))
        if not beside and not path.read_text(encoding="utf-8").startswith('"""Integration: '):
            silent.append(path.name)
    assert silent == []


def test_what_works_around_others_says_which_defect_and_when_it_can_go() -> None:
    for name in WORKAROUNDS:
        text = (ROOT / name).read_text(encoding="utf-8")
        assert re.search(r"Upstream: .*\n(.*\n)*?.*Delete when: .*\n", text), name
