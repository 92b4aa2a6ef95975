"""docs/reference/equations.md leads to code that exists and has every equation of the paper that is computed."""

from __future__ import annotations

import importlib
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[4]
SPECIFICATION = "dtsa_agent.core.reference"
LABELS = {
    "eq:remaining_t_slots", "eq:update_time_tdma", "eq:update_time_NA", "eq:permission_alpha",
    "eq:permission_d_p_ang", "eq:pfs", "eq:secondary", "eq:estimate",
}  # fmt: skip


def rows() -> list[list[str]]:
    text = (ROOT / "docs" / "reference" / "equations.md").read_text(encoding="utf-8")
    lines = [line.replace("\\|", "!") for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if not row[0].startswith(("equation or rule", "rule", "---"))]


def names(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def found(name: str) -> Any:
    """What a dotted name below the specification is; fails with the part that is missing."""
    parts = name.split(".")
    for count in range(len(parts) - 1, 0, -1):
        try:
            thing: Any = importlib.import_module(".".join([SPECIFICATION, *parts[:count]]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            assert hasattr(thing, part), f"docs/reference/equations.md: {name}: there is no {part!r} in {thing!r}"
            thing = getattr(thing, part)
        return thing
    pytest.fail(f"docs/reference/equations.md: {name}: no such module below {SPECIFICATION}")


@cache
def compiled() -> set[str]:
    """Names of all functions that the C sources define."""
    sources = [*(ROOT / "src" / "dtsa_agent").rglob("*.c"), *(ROOT / "src" / "dtsa_agent").rglob("*.h")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in sources)
    return set(re.findall(r"^[A-Za-z_][\w \t*]*?[ *](\w+)\([^;{]*\)\s*\{", text, flags=re.MULTILINE))


@pytest.mark.parametrize("row", rows(), ids=lambda row: row[0].replace("`", ""))
def test_every_name_exists(row: list[str]) -> None:
    rule, _, python, c = row
    assert names(python)
    things = [found(name) for name in names(python)]
    for label in re.findall(r"eq:\w+", rule):
        assert any(label in (thing.__doc__ or "") for thing in things), f"no docstring of {python} names {label}"
    missing = [name for name in names(c) if name not in compiled()]
    assert not missing, f"docs/reference/equations.md: {rule}: the C sources define no {', '.join(missing)}"


def test_every_equation_that_is_computed_is_there() -> None:
    assert {label for row in rows() for label in re.findall(r"eq:\w+", row[0])} == LABELS
    for path in (ROOT / "src/dtsa_agent/dtsa_agent/core/reference").rglob("*.py"):
        for label in re.findall(r"eq:\w+", path.read_text(encoding="utf-8")):
            assert label in LABELS, f"{path.name}: {label} is no label of the paper"


def test_a_name_that_is_gone_is_found() -> None:
    with pytest.raises(AssertionError, match="no 'chose'"):
        found("policies.chose")
    assert "swarm_flies" not in compiled()
    assert {"priority_values", "eta_row"} <= compiled()
