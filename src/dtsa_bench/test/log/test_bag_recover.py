"""What a killed recorder, a cut or a flipped bit leaves is saved: all that is readable, nothing that is not."""

from __future__ import annotations

import contextlib
import itertools
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from bag_helpers import SyntheticRun, definition, synthetic_bag
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.commands import cli
from dtsa_bench.log.bag import writer
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.file import MAGIC, PREFIX
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.recover import recover
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_channel_sim import ChannelConfig

Row = tuple[str, int, int, int, bytes]
COMPRESSIONS = tuple(CompressionType)


def rows_of(path: Path) -> list[Row]:
    with path.open("rb") as stream:
        messages = make_reader(stream).iter_messages(log_time_order=False)
        return [(c.topic, m.log_time, m.publish_time, m.sequence, bytes(m.data)) for _, c, m in messages]


def chunks_of(path: Path) -> list[tuple[int, int, int]]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    found = []
    with path.open("rb") as stream:
        for index in sorted(summary.chunk_indexes, key=lambda one: one.chunk_start_offset):
            count = 0
            for offset in index.message_index_offsets.values():
                stream.seek(offset + 9 + 2)
                count += int.from_bytes(stream.read(4), "little") // 16
            found.append((index.chunk_start_offset, index.chunk_start_offset + index.chunk_length, count))
    return found


@pytest.fixture(scope="module", params=COMPRESSIONS, ids=lambda one: one.name)
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> SyntheticRun:
    directory = tmp_path_factory.mktemp("bags") / "flight"
    return synthetic_bag(directory, slots=30, agents=3, chunk_size=9000, compression=request.param)


def recovered(path: Path, directory: Path) -> tuple[list[Row], list[str]]:
    """Messages of the recovered bag, and what was said; none if there was nothing to save."""
    before, said = path.read_bytes(), ""
    try:
        result = recover(path, directory)
    except UnusableBag as error:
        said = str(error)
    assert path.read_bytes() == before
    if said:
        assert "\n" not in said
        assert not directory.exists()
        return [], [said]
    (file,) = directory.glob("*.mcap")
    rows = rows_of(file)
    assert len(rows) == result.count
    assert (directory / "metadata.yaml").exists()
    with Bag(directory) as bag:
        assert sum(1 for _ in bag.messages()) == result.count
        assert {name: topic.count for name, topic in bag.topics.items()} == result.saved
    shutil.rmtree(directory)
    return rows, result.damaged


def test_100_truncations_give_back_all_whole_chunks(run: SyntheticRun, tmp_path: Path) -> None:
    whole, rows, chunks = run.writer.path.read_bytes(), rows_of(run.writer.path), chunks_of(run.writer.path)
    assert sum(count for _, _, count in chunks) == len(rows)
    pick = random.Random(11)
    path = tmp_path / "cut.mcap"
    for size in [0, 7, 8, 9, *(pick.randrange(len(whole)) for _ in range(30)), len(whole) - 1]:
        path.write_bytes(whole[:size])
        found, said = recovered(path, tmp_path / "new")
        assert found == rows[: sum(count for _, end, count in chunks if end <= size)], size
        assert said


def whole_rows(run: SyntheticRun, damaged: Callable[[int, int], bool]) -> list[Row]:
    """The messages of all chunks but the damaged ones, by where a chunk begins and ends in the file."""
    rows, saved = rows_of(run.writer.path), []
    for start, end, count in chunks_of(run.writer.path):
        saved += [] if damaged(start, end) else rows[:count]
        rows = rows[count:]
    return saved


def check_flipped(run: SyntheticRun, directory: Path, flips: list[tuple[int, int]]) -> None:
    """Damaged bits, by place and number: all other chunks are saved, nothing wrong, and no loss is silent."""
    whole, rows, path = run.writer.path.read_bytes(), rows_of(run.writer.path), directory / "flipped.mcap"
    for place, bit in flips:
        data = bytearray(whole)
        data[place] ^= 1 << bit
        path.write_bytes(data)
        found, said = recovered(path, directory / "new")
        if place >= len(MAGIC):  # else it is taken for something else
            # What messages belong to stands before them and at the end: all are saved but those of a damaged chunk,
            # and even those where only its times are damaged.
            left = whole_rows(run, lambda start, end, place=place: start <= place < end)
            assert found in (left, rows), (place, bit)
        assert found == rows or said, (place, bit)


def test_flipped_bits_lose_only_the_chunk_that_they_stand_in(run: SyntheticRun, tmp_path: Path) -> None:
    pick, size = random.Random(13), run.writer.path.stat().st_size
    check_flipped(run, tmp_path, [(pick.randrange(size), pick.randrange(8)) for _ in range(34)])


def test_a_flipped_bit_in_what_a_record_is_brings_nothing_wrong(run, tmp_path, request):
    whole = run.writer.path.read_bytes()
    places, position = [], len(MAGIC)
    while position < len(whole) - len(MAGIC):
        places.append(position)
        position += PREFIX.size + PREFIX.unpack_from(whole, position)[1]
    last = max(place for place in places if whole[place] == Opcode.CHUNK)
    # One compression for each bit: what tells of a record is not compressed.
    first = COMPRESSIONS.index(request.node.callspec.params["run"])
    chosen = enumerate([*places[:16], last, *places[-12:]])
    check_flipped(run, tmp_path, [(place, bit) for k, place in chosen for bit in range((first + k) % 3, 8, 3)])


def test_what_follows_a_hole_in_the_middle_is_saved_too(run: SyntheticRun, tmp_path: Path) -> None:
    """Whether there is an index or not; channels that were defined in the hole are those of the index."""
    rows, chunks, whole = rows_of(run.writer.path), chunks_of(run.writer.path), run.writer.path.read_bytes()
    (start, _, _), (_, end, _) = chunks[1], chunks[2]
    left = whole_rows(run, lambda begin, _: start <= begin < end)
    last_s = max(row[1] for row in rows[: chunks[0][2]]) / 1e9
    data = whole[:start] + bytes(end - start) + whole[end:]
    for size in (len(data), chunks[-1][1]):
        (tmp_path / "hole.mcap").write_bytes(data[:size])
        found, said = recovered(tmp_path / "hole.mcap", tmp_path / "new")
        assert found == left
        # What stands between two chunks, an index of messages, is of no use without the chunk before it.
        assert re.match(rf"bytes {start} to {chunks[3][0]}, after {last_s:.3f} s, cannot be read", said[0])
        assert said[1:] == (
            [f"{len(rows) - len(left)} of the {len(rows)} messages that the bag had are lost"]
            if size == len(data)
            else ["hole.mcap was not closed, or its index is damaged"]
        )


def test_messages_whose_channels_are_lost_are_nothing_to_save(run: SyntheticRun, tmp_path: Path) -> None:
    (start, end, _), *_, (_, last, _) = chunks_of(run.writer.path)
    data = run.writer.path.read_bytes()
    (tmp_path / "bad.mcap").write_bytes(data[:start] + bytes(end - start) + data[end:last])
    with pytest.raises(UnusableBag, match="nothing to save"):
        recover(tmp_path / "bad.mcap", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_new_bag_knows_its_run(run: SyntheticRun, tmp_path: Path) -> None:
    source = tmp_path / "flight"
    source.mkdir()
    data = run.writer.path.read_bytes()
    (source / "flight_0.mcap").write_bytes(data[: len(data) * 3 // 4])
    result = recover(source)
    assert result.directory == tmp_path / "flight_recovered"
    assert not result.closed
    with Bag(result.directory) as bag, Bag(run.writer.directory) as original:
        assert bag.config == original.config
        assert bag.custom_data["recovered_from"] == "flight_0.mcap"
        for name, topic in bag.topics.items():
            before = original.topics[name]
            assert (topic.definition, topic.profiles) == (before.definition, before.profiles)


def test_a_whole_bag_is_copied_what_is_missing_is_counted_and_what_is_there_stays(run, tmp_path):
    result = recover(run.writer.directory, tmp_path / "new")
    assert result.closed
    assert result.damaged == []
    assert result.saved == result.expected == run.writer.counts
    chunks = chunks_of(run.writer.path)
    data = bytearray(run.writer.path.read_bytes())
    data[chunks[1][1] - 5] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    result = recover(tmp_path / "bad.mcap", tmp_path / "less")
    assert sum(result.expected.values()) - result.count == chunks[1][2]
    assert not result.closed
    (tmp_path / "note").write_text("mine")
    with pytest.raises(ConfigError, match="empty or does not exist"):
        recover(run.writer.directory, tmp_path)
    with pytest.raises(ConfigError, match="empty or does not exist"):
        recover(run.writer.directory, run.writer.directory)
    assert {path.name for path in tmp_path.iterdir()} == {"note", "new", "bad.mcap", "less"}


@pytest.mark.parametrize("name", ["new", "new.mcap"])
def test_what_was_interrupted_leaves_nothing_that_passes_for_all(run, tmp_path, monkeypatch, name):
    write, count = writer.BagWriter.write, itertools.count()

    def interrupted(*arguments: object) -> None:
        write(*arguments)
        if next(count) == 50:
            raise KeyboardInterrupt

    monkeypatch.setattr(writer.BagWriter, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        recover(run.writer.directory, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_topic_of_which_nothing_is_left_is_named(tmp_path: Path) -> None:
    with writer.BagWriter(tmp_path / "bag.mcap", None, chunk_size=1) as bag:  # a chunk a message
        for time_ns, topic in enumerate(("/a", "/b"), 1):
            channel = bag.add_topic(topic, "nav_msgs/msg/Odometry", "reliable", definition("nav_msgs/msg/Odometry"))
            bag.write(channel, b"\0\1\0\0", time_ns, time_ns)
    (_, end, _), _ = chunks_of(tmp_path / "bag.mcap")
    data = bytearray((tmp_path / "bag.mcap").read_bytes())
    data[end - 1] ^= 1
    (tmp_path / "bag.mcap").write_bytes(data)
    result = recover(tmp_path / "bag.mcap")
    assert (result.saved, result.expected) == ({"/a": 0, "/b": 1}, {"/a": 1, "/b": 1})


CUTS = 40


def flown(directory: Path, mode: str, patch: pytest.MonkeyPatch) -> Path:
    """A whole flight of real nodes whose bag has a chunk for every slot."""
    pytest.importorskip("dtsa_msgs.msg")
    from dtsa_bench.flights.flight import FlightOptions, fly

    patch.setattr(writer, "FLUSH_S", 0.0)
    swarm = SwarmConfig(agents=5, moving=2, policy="lease", slot_ms=20.0, seed=3)
    run = RunConfig(
        swarm, ChannelConfig(loss=0.2, **from_swarm(swarm)), RunLimits(timeout_s=1.5, tail_s=1.5), mode=mode
    )
    fly(run, directory, FlightOptions(processes=2))
    return directory / "bag" / "bag_0.mcap"


@pytest.mark.ros
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_cut_anywhere_it_verifies_up_to_its_end(mode, tmp_path, monkeypatch, capsys):
    whole = flown(tmp_path / "whole", mode, monkeypatch)
    complete = verify_bag(whole)
    assert complete.ok, complete.difference
    assert not complete.broken_off
    data, pick = whole.read_bytes(), random.Random(mode)
    cut, found = tmp_path / "cut" / "bag", []
    cut.mkdir(parents=True)
    # A summary beside the bag tells of the whole flight, of which the cut bag holds a part.
    shutil.copy(tmp_path / "whole" / "summary.json", cut.parent / "summary.json")
    for size in sorted({*(pick.randrange(len(data)) for _ in range(CUTS)), len(data) - 1, len(data) - 8}):
        (cut / "bag_0.mcap").write_bytes(data[:size])
        target = tmp_path / "cut" / "recovered"
        if not found:  # the first slot may be incomplete
            with contextlib.suppress(UnusableBag):
                recover(cut, target)
            if not target.exists():
                continue
            shutil.rmtree(target)
        result = recover(cut, target)
        verified = verify_bag(target)
        assert verified.ok, (size, verified.difference)
        assert verified.broken_off
        assert not result.closed
        assert verified.slots >= (found[-1] if found else 0), size  # who cuts later loses less
        found.append(verified.slots)
        shutil.rmtree(target)
    assert found[-1] == complete.slots
    assert len(set(found)) > CUTS // 4  # slot for slot, not half seconds
    (cut / "bag_0.mcap").write_bytes(data[: len(data) // 2])
    assert cli.main(["recover", str(cut)]) == 0
    assert "breaks off at" in capsys.readouterr().out
    check_holes(whole, cut, complete.slots, pick)


def check_holes(whole: Path, directory: Path, slots: int, pick: random.Random) -> None:
    """Of a bag with a hole in its middle what stands before the hole is right, and what follows is not called wrong."""
    data, chunks, found = whole.read_bytes(), chunks_of(whole), set()
    for k in range(10):
        first = pick.randrange(2, len(chunks) - 3)
        start, end = chunks[first][0], chunks[pick.randrange(first, min(first + 9, len(chunks) - 2))][1]
        (directory / "bag_0.mcap").write_bytes(data[:start] + bytes(end - start) + data[end:])
        result = recover(directory, directory.parent / f"hole{k}")
        assert not result.closed
        verified = verify_bag(result.directory)
        assert verified.ok, (first, verified.difference)
        assert verified.broken_off
        assert 0 < verified.slots < slots
        found.add(verified.slots)
    assert len(found) > 3
