"""The log of a flight: simulated and recorded it is the same, and what is no log of this format is refused."""

from __future__ import annotations

import dataclasses
import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from bag_helpers import SECOND, definition, flight_bag

import dtsa
from dtsa_agent.core import SwarmConfig
from dtsa_bench.commands.cli import main
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import AGENT, SLOT_RECORD, TYPE, load_log, pack_record
from dtsa_bench.log.tables import COLUMNS, table
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.runs import options
from dtsa_bench.runs.config import RunConfig

ARRAYS = ("outcome", "length", "lost", "collided", "chosen", "reason", "digest", "score", "velocity", "command", "goal")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without losses: the simulator flies the same."""
    path = tmp_path_factory.mktemp("log") / "bag"
    flight_bag(path, slots=150, agents=5, moving=3, policy="lease", seed=4)
    return path


def test_a_recorded_flight_has_the_arrays_of_the_simulated_one(bag: Path) -> None:
    recorded = load_log(bag)
    simulated = dtsa.simulate(RunConfig.from_dict(recorded.settings))
    assert len(recorded) == 150 <= len(simulated)
    for name in ARRAYS:
        assert np.array_equal(getattr(recorded, name), getattr(simulated, name)[:150]), name
    assert np.array_equal(recorded.track, simulated.track[:151])
    frames = recorded.sent_frames
    assert frames.data == simulated.sent_frames.data[: len(frames.data)]
    assert np.array_equal(frames.received, simulated.received[: len(frames.data)])
    assert recorded.known.all()
    assert np.array_equal(recorded.position[3, -1], recorded.track[4, -1])
    for row, sender, data in zip(frames.row.tolist(), frames.sender.tolist(), frames.data, strict=True):
        assert recorded.frame(row, sender) == data


def test_a_log_is_pickled_and_written_as_parquet(bag: Path, tmp_path: Path) -> None:
    log = load_log(bag)
    again = pickle.loads(pickle.dumps(log))
    for name in COLUMNS:
        assert table(log, name).equals(table(again, name)), name
    assert again.summary == log.summary
    files = log.to_parquet(tmp_path / "tables", ["slots", "distances"])
    assert [path.name for path in files] == ["slots.parquet", "distances.parquet"]
    assert pd.read_parquet(files[1])["distance_m"].min() == pytest.approx(log.summary["min_distance_m"])
    assert log.errors["error_m"].equals(log.ages["error_m"])


def test_bags_of_format_1_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "old", {"swarm": {"agents": 3}}) as writer:
        for topic in ("/swarm/reception", "/swarm/transmission"):
            writer.add_topic(topic, kind := "dtsa_msgs/msg/Transmission", "reliable", definition(kind))
    with pytest.raises(UnusableBag, match="bag format 1, and this version reads format 2"):
        load_log(tmp_path / "old")
    with pytest.raises(UnusableBag, match="bag format 1"):
        verify_bag(tmp_path / "old")
    for command in ("verify", "report", "export"):
        assert main([command, str(tmp_path / "old")]) == 2
        said = capsys.readouterr().err
        assert "bag format 1" in said
        assert said.count("\n") == 1


def rewritten(bag: Path, target: Path, change: Callable[[Any], dict[str, Any]]) -> Path:
    """A bag with the slot records of another one, in which some fields are others."""
    with Bag(bag) as source, BagWriter(target, source.config) as copy:
        channel = copy.add_topic(SLOT_RECORD, TYPE, "reliable", definition(TYPE))
        for message, record in source.typed([SLOT_RECORD]):
            for name, value in change(record).items():
                old = getattr(record, name)
                setattr(record, name, np.ascontiguousarray(value, old.dtype) if isinstance(old, np.ndarray) else value)
            data = bytes(source.typestore(SLOT_RECORD).serialize_cdr(record, TYPE))
            copy.write(channel, data, message.log_time_ns, message.publish_time_ns)
    return target


def heard(count: int, **more: Any) -> dict[str, Any]:
    """The fields of frames of agent 1 that agent 2 heard."""
    entries = {"sender": [1] * count, "slot": [0] * count, "ns": [0] * count, "by": [2] * count}
    return {f"heard_{name}": values for name, values in (entries | more).items()}


CHANGES: dict[str, dict[int, Callable[[Any], dict[str, Any]]]] = {
    "a number": {70: lambda _: {"slot": 2**31}},
    "the order of agents": {70: lambda record: {"agent": record.agent[::-1]}},
    "too few entries": {70: lambda record: {"score": record.score[1:]}},
    "no receivers": {70: lambda _: heard(1, by=[])},
    # Together they have as many lengths as frames.
    "lengths of frames": {
        70: lambda _: heard(1, length=[1, 1], data=[7, 7]), 71: lambda _: heard(2, length=[1], data=[7]),
    },
}  # fmt: skip


@pytest.mark.parametrize("what", CHANGES)
def test_records_that_do_not_fit_together_are_one_line(bag: Path, tmp_path: Path, what: str) -> None:
    changes = CHANGES[what]
    changed = rewritten(bag, tmp_path / "bag", lambda r: changes[r.slot](r) if r.slot in changes else {})
    with pytest.raises(UnusableBag, match="do not fit together") as caught:
        load_log(changed)
    assert "\n" not in str(caught.value)


def test_what_has_no_room_in_memory_is_refused_by_name_before_it_is_asked_for(bag, tmp_path, monkeypatch, capsys):
    memory = tmp_path / "meminfo"
    memory.write_text("MemTotal:       24576000 kB\nMemAvailable:         10 kB\n")
    monkeypatch.setattr(options, "_MEMORY", memory)
    for words in (
        ["simulate", "--picture", tmp_path / "a.png"],
        ["export", bag, "--to", "csv", "--out", tmp_path / "a"],
    ):
        assert main(list(map(str, words))) == 2
        said = capsys.readouterr().err
        assert "agents: got" in said
        assert said.count("\n") == 1


def test_control_instants_are_those_of_the_configuration(bag: Path, tmp_path: Path) -> None:
    def twice(record: Any) -> dict[str, Any]:
        return {
            "steps": 2 * record.steps,
            "track": np.repeat(record.track.reshape(record.steps, -1), 2, axis=0).ravel(),
        }

    assert verify_bag(rewritten(bag, tmp_path / "same", lambda _: {})).ok
    difference = verify_bag(rewritten(bag, tmp_path / "twice", twice)).difference
    assert difference is not None
    assert (difference.what, difference.slot) == ("slot record, steps", 0)


@pytest.mark.parametrize(("kind", "old", "new"), [
    ("std_msgs/msg/String", "", ""), (TYPE, "uint8 outcome", "uint8 result"), (TYPE, "string frame_id", "string frame"),
    (TYPE, "float64[] score", "float32[] score"), (TYPE, "uint16[] agent", "uint16[] who"),
])  # fmt: skip
def test_records_of_another_type_are_refused_in_one_line(tmp_path, capsys, kind, old, new):
    theirs, settings = definition(kind), RunConfig(SwarmConfig(agents=3)).to_dict()
    for name, custom in (("bag", {}), ("cf1.mcap", {AGENT: json.dumps({"id": 1})})):
        with BagWriter(tmp_path / name, settings, custom_data=custom) as writer:
            changed = dataclasses.replace(theirs, text=theirs.text.replace(old, new))
            channel = writer.add_topic(SLOT_RECORD, kind, "reliable", changed)
            writer.write(channel, pack_record(1, 0, SECOND, 1), SECOND, SECOND)
    for command in ("verify", "report", "export"):
        assert main([command, str(tmp_path / "bag")]) == 2
        said = capsys.readouterr().err
        assert f"{SLOT_RECORD} is {kind}, without fields" in said
        assert said.count("\n") == 1
    assert main(["merge", str(tmp_path / "cf1.mcap")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
