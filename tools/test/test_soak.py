"""Soaks: resumed where they stopped, with a record of what they found; and the part that tests have time for."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from dtsa_dev.registry import main
from dtsa_dev.soak.faults import FAULTS, rewritten
from dtsa_dev.soak.faults.fault import Fault
from dtsa_dev.soak.item import Item, NotMet, Soak
from dtsa_dev.soak.registry import SOAKS, soak_named
from dtsa_dev.soak.runner import run_soak, write_record
from waiting import wait_for

from dtsa_bench.experiments.batch.task import Row


def soak_of(run: Any) -> Soak:
    items = tuple(Item(f"item {k}", {"k": k}, seed=k, sample=k == 2) for k in range(4))
    return Soak("trial", "All is well.", items, run, lambda rows: {"k": [row["summary"]["k"] for row in rows]})


def test_an_interrupted_soak_goes_on_where_it_stopped(tmp_path: Path) -> None:
    done: list[int] = []
    interrupts = [2]

    def run(item: Item, directory: Path) -> Row:
        assert list(directory.iterdir()) == []
        if item.seed in interrupts:
            interrupts.clear()
            raise KeyboardInterrupt
        done.append(item.seed)
        return {"k": item.seed}

    with pytest.raises(KeyboardInterrupt):
        run_soak(soak_of(run), tmp_path / "journal", 1.0)
    assert done == [0, 1]
    record = run_soak(soak_of(run), tmp_path / "journal", 1.0)
    assert done == [0, 1, 2, 3]
    assert record["finished"] == record["items"] == 4
    assert record["figures"] == {"k": [0, 1, 2, 3]}
    assert record["failures"] == []


@pytest.mark.parametrize("figures", [False, True])
def test_a_failed_item_is_in_the_record_and_is_tried_again(figures: bool, tmp_path: Path) -> None:
    broken = [3]

    def run(item: Item, directory: Path) -> Row:
        if item.seed in broken:
            raise NotMet("it fell\n over", {"k": -1} if figures else None)
        return {"k": item.seed}

    record = run_soak(soak_of(run), tmp_path / "journal", 1.0)
    assert record["failures"] == [{"item": "item 3", "reason": "NotMet: it fell over"}]
    assert record["figures"] == {"k": [0, 1, 2, -1] if figures else [0, 1, 2]}
    assert "failed_before_they_passed" not in record
    unfinished = run_soak(soak_of(run), tmp_path / "journal", 1e-9)
    assert (unfinished["failures"], unfinished["finished"]) == (record["failures"], record["finished"])
    broken.clear()
    repeated = run_soak(soak_of(run), tmp_path / "journal", 1.0)
    assert (repeated["failures"], repeated["failed_before_they_passed"]) == ([], record["failures"])


def test_nothing_begins_after_the_limit_and_a_sample_is_a_part(tmp_path: Path) -> None:
    soak = soak_of(lambda item, directory: {"k": item.seed})
    assert run_soak(soak, tmp_path / "late", 1e-9)["finished"] == 0
    record = run_soak(soak, tmp_path / "sample", 1.0, sample=True)
    assert (record["soak"], record["seeds"], record["items"]) == ("trial-sample", [2], 1)


def test_the_record_says_what_it_was_made_with(tmp_path: Path) -> None:
    record = run_soak(soak_of(lambda item, directory: {"k": 1}), tmp_path / "journal", 1.0)
    write_record(tmp_path / "docs" / "trial.json", record)
    kept = json.loads((tmp_path / "docs" / "trial.json").read_text())
    assert kept == record
    assert set(kept["load"]) == {"before", "after"}
    assert {"commit", "tree_changed", "cores", "python", "date", "promise"} <= set(kept)
    assert kept["seeds"] == [0, 1, 2, 3]


def test_soaks_are_listed_and_others_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["soak", "--list"]) == 0
    listed = capsys.readouterr().out
    for name in SOAKS:
        assert name in listed
    for words in (["nothing"], [], ["recorder", "--minutes", "91"], ["recorder", "--minutes", "soon"]):
        assert main(["soak", *words]) == 2
        said = capsys.readouterr().err
        assert "allowed" in said
        assert "Traceback" not in said


@pytest.mark.parametrize("name", sorted(SOAKS))
def test_items_of_a_soak_have_names_of_their_own_and_settings_for_the_journal(name: str) -> None:
    soak = soak_named(name)
    names = [item.name for item in soak.items]
    assert soak.name == name
    assert len(set(names)) == len(names)
    assert any(item.sample for item in soak.items)
    assert json.loads(json.dumps([dict(item.settings) for item in soak.items]))
    assert sum(item.seconds for item in soak.items) <= 90 * 60
    assert all(item.seconds > 0 for item in soak.items)


def test_the_table_of_faults_in_the_docs_is_the_one_that_is_run() -> None:
    text = (Path(__file__).resolve().parents[2] / "docs" / "evidence" / "faults.md").read_text(encoding="utf-8")
    assert rewritten(text) == text, "run: python -m dtsa_dev.soak.faults docs/evidence/faults.md"
    assert len(FAULTS) >= 30
    assert 3 * sum(fault.sample for fault in FAULTS) >= len(FAULTS)


@pytest.mark.ros
@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault.sample], ids=lambda fault: fault.name)
def test_a_fault_has_the_reaction_that_the_table_says(fault: Fault, tmp_path: Path) -> None:
    pytest.importorskip("dtsa_msgs.msg")
    fault.run(tmp_path)


@pytest.mark.ros
@pytest.mark.parametrize("item", [i for i in soak_named("recorder").items if i.sample], ids=lambda item: item.name)
def test_a_killed_recorder_loses_a_second_at_most(item: Item, tmp_path: Path) -> None:
    pytest.importorskip("dtsa_msgs.msg")
    assert soak_named("recorder").run(item, tmp_path)["slots"] > 0


def test_ctrl_c_in_a_soak_with_crazyflies_leaves_no_process_and_no_traceback(tmp_path: Path) -> None:
    pytest.importorskip("cflib")
    words = [
        "soak",
        "crazyflie",
        "--minutes",
        "2",
        "--out",
        str(tmp_path / "out"),
        "--evidence",
        str(tmp_path / "e.json"),
    ]
    mark = f"SOAK_OF_A_TEST={tmp_path}"
    with subprocess.Popen(
        [sys.executable, "-m", "dtsa_dev", *words],
        env={**os.environ, "SOAK_OF_A_TEST": str(tmp_path)},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    ) as process:
        wait_for(lambda: process.poll() is not None or len(marked(mark)) >= 4)  # fleet, load, `fly` and its recorder
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        _, said = process.communicate(timeout=60)
        assert process.returncode == 130
        assert "Traceback" not in said, said
        assert said.strip().splitlines()[-1].startswith("dtsa: interrupted; ")
    assert not marked(mark)  # none outlives it


def marked(mark: str) -> list[int]:
    """Processes with a variable in their environment."""
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            if entry.name.isdigit() and mark.encode() in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
    return found
