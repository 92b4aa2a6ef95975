"""Changes of the source that tests should find: which there are, and that they are made in a copy only."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from dtsa_dev.soak import mutants
from dtsa_dev.soak.changes import changes_of
from dtsa_dev.soak.item import NotMet

ROOT = Path(__file__).resolve().parents[2]
SOURCE = '''
"""Text that says 1 < 2."""
LIMIT: int = 3

@cache
def late(a: int | None, é: float) -> bool:
    if a is None or not é:
        raise ValueError(f"{a + 1} is too much")
    self.seen = max(a, 2)
    return a < é
'''


def test_changes_are_small_valid_and_leave_texts_and_annotations_alone() -> None:
    changes = changes_of(SOURCE)
    for change in changes:
        changed = change.applied(SOURCE)
        compile(changed, "changed", "exec")
        assert changed != SOURCE
        before, after = SOURCE.splitlines(), changed.splitlines()
        pairs = enumerate(zip(before, after, strict=False), 1)
        assert next(line for line, (old, new) in pairs if old != new) == change.line
    assert {(change.where, str(change)) for change in changes} == {
        ("", "3 -> 4"),
        ("late", "a is None or not é -> not (a is None or not é)"),
        ("late", "a is None or not é -> a is None and (not é)"),
        ("late", "a is None -> a is not None"),
        ("late", "not é -> é"),
        ("late", "raise ValueError(f'{a + 1} is too much') -> pass"),
        ("late", "self.seen = max(a, 2) -> pass"),
        ("late", "max(a, 2) -> min(a, 2)"),
        ("late", "2 -> 3"),
        ("late", "return a < é -> return None"),
        ("late", "a < é -> a <= é"),
        ("late", "a < é -> a >= é"),
    }


def test_a_change_is_made_in_a_copy_and_found_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    item = next(item for item in mutants.SOAK.items if item.name == "authentication 1")
    path, change = mutants.drawn("authentication")[0]
    before = (ROOT / path).read_text("utf-8")
    (tmp_path / "found").mkdir()
    found = mutants.SOAK.run(item, tmp_path / "found")
    assert (found["found"], found["file"], found["change"]) == ("test", str(path), str(change))
    assert (tmp_path / "found" / path).read_text("utf-8") == change.applied(before)
    # The same change beside tests of something else.
    module = mutants.MODULES["authentication"]
    other = mutants.Module(module.sources, ("dtsa_agent/test/crazyflie/test_conversions.py",))
    monkeypatch.setitem(mutants.MODULES, "authentication", other)
    (tmp_path / "lost").mkdir()
    with pytest.raises(NotMet, match="survived: src/dtsa_agent"):
        mutants.SOAK.run(item, tmp_path / "lost")
    assert (ROOT / path).read_text("utf-8") == before


def test_notes_are_about_changes_that_there_are() -> None:
    for note in json.loads((ROOT / "tools/test/mutants.json").read_text("utf-8")):
        there = {(change.where, str(change)) for change in changes_of((ROOT / note["file"]).read_text("utf-8"))}
        assert (note["where"], note["change"]) in there
        assert len({"equivalent", "test"} & set(note)) == 1
        if "test" in note:
            path, name = note["test"].split("::")
            assert f"def {name}(" in (ROOT / path).read_text("utf-8")
