"""Reading back: order, selection, decoding, and bags that are none."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from bag_helpers import SECOND, SyntheticRun, definition, synthetic_bag
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log.bag import metadata
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.recover import recover
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import SLOT_RECORD, load_log
from dtsa_bench.runs.config import RunConfig


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> SyntheticRun:
    return synthetic_bag(tmp_path_factory.mktemp("bags") / "flight", slots=60, chunk_size=20_000)


def test_messages_are_exactly_those_recorded_in_order_of_time_and_can_be_chosen(run: SyntheticRun) -> None:
    with Bag(run.writer.directory) as whole, Bag(run.writer.path) as alone:
        assert list(whole.messages()) == list(alone.messages())
        assert whole.config == alone.config == RunConfig(run.config).to_dict()
    with Bag(run.writer.directory) as bag:
        found: dict[str, list[tuple[int, int, bytes]]] = {}
        times = []
        for message in bag.messages():
            times.append(message.log_time_ns)
            assert message.sequence == len(found.setdefault(message.topic, []))
            found[message.topic].append((message.log_time_ns, message.publish_time_ns, message.data))
        assert times == sorted(times)
        assert found == run.written
        assert (bag.start_ns, bag.end_ns) == (min(times), max(times))
        assert {name: topic.count for name, topic in bag.topics.items()} == run.writer.counts
    begin = SECOND + 100_000_000
    with Bag(run.writer.directory) as bag:
        found = [(m.topic, m.log_time_ns) for m in bag.messages(["/cf1/odom", SLOT_RECORD], begin)]
        expected = [(topic, row[0]) for topic in ("/cf1/odom", SLOT_RECORD) for row in run.written[topic]]
        assert sorted(found) == [entry for entry in expected if begin <= entry[1]]
        with pytest.raises(UnusableBag, match="no topic '/nothing'"):
            list(bag.messages(["/nothing"]))


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 40), max_size=120), st.integers(1, 30))
def test_order_holds_whatever_the_order_of_writing(tmp_path_factory, times, per_chunk):
    directory = tmp_path_factory.mktemp("order") / "bag"
    kind = "dtsa_msgs/msg/Transmission"
    with BagWriter(directory, {}) as writer:
        channels = [writer.add_topic(name, kind, "reliable", definition(kind)) for name in ("/a", "/b")]
        for number, time in enumerate(times):
            writer.write(channels[number % 2], number.to_bytes(4, "little"), SECOND + time, SECOND)
            if number % per_chunk == 0:
                writer.flush()  # closes the chunk: chunks overlap in time
    with Bag(directory) as bag:
        found = [(m.log_time_ns - SECOND, int.from_bytes(m.data, "little")) for m in bag.messages()]
    assert found == sorted((time, number) for number, time in enumerate(times))


def _zeros(kind: str, size: int, says_size: bool) -> bytes:
    if kind == "lz4":
        packer, block = lz4.frame.LZ4FrameCompressor(), bytes(1 << 20)
        return bytes(packer.begin() + b"".join(packer.compress(block) for _ in range(size >> 20)) + packer.flush())
    packer = zstandard.ZstdCompressor().compressobj(size=size if says_size else -1)
    return b"".join(packer.compress(bytes(1 << 20)) for _ in range(size >> 20)) + packer.flush()


@pytest.mark.parametrize(("kind", "says_size"), [("lz4", False), ("zstd", True), ("zstd", False)])
def test_a_chunk_that_unpacks_to_far_more_than_it_says_costs_no_memory(kind, says_size, tmp_path, monkeypatch):
    bomb, compression = _zeros(kind, 1 << 30, says_size), CompressionType[kind.upper()]
    name = "mcap.writer.lz4.frame.compress" if kind == "lz4" else "mcap.writer.zstandard.compress"
    monkeypatch.setattr(name, lambda data: bomb)
    run = synthetic_bag(tmp_path / "bomb", slots=5, compression=compression)
    tracemalloc.start()
    for read in (lambda: load_log(run.writer.directory), lambda: recover(run.writer.directory)):
        with pytest.raises(UnusableBag) as error:
            read()
        assert len(str(error.value).splitlines()) == 1
    assert tracemalloc.get_traced_memory()[1] < 1 << 28
    tracemalloc.stop()


def test_damaged_message_bytes_are_an_error_that_names_the_message(run: SyntheticRun) -> None:
    with Bag(run.writer.directory) as bag:
        whole = next(bag.messages([SLOT_RECORD]))
        for size in range(len(whole.data) - 4):
            with pytest.raises(BagError, match="/swarm/slot_record at 1"):
                bag.decode(whole._replace(data=whole.data[:size]))
        huge = bytearray(whole.data)
        huge[16:20] = b"\xff\xff\xff\x7f"  # the length of the first sequence
        with pytest.raises(BagError, match="/swarm/slot_record"):
            bag.decode(whole._replace(data=bytes(huge)))


def test_what_is_no_bag_is_said_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("hello, I am no bag at all, but long enough to be taken for one")
    for name in ("nothing.mcap", "old/old_0.db3", "two/a.mcap", "two/b.mcap", "above/inner/inner_0.mcap"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    for name, text in [
        ("missing", "no such file"),
        ("empty", "no .mcap file"),
        ("text.mcap", "not an MCAP file"),
        ("nothing.mcap", "not an MCAP file"),
        ("old", "sqlite3"),
        ("two", "2 .mcap files"),
        ("above", "did you mean one of inner"),
    ]:
        for use in (Bag, recover):
            with pytest.raises(UnusableBag, match=text) as caught:
                use(tmp_path / name)
            assert "\n" not in str(caught.value)
            assert str(tmp_path / name) in str(caught.value)
            assert isinstance(caught.value, ConfigError)


def test_bags_unfinished_damaged_or_of_others_are_refused_by_what_they_lack(run: SyntheticRun, tmp_path: Path) -> None:
    whole = run.writer.path.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UnusableBag, match=r"not closed.*tools/dtsa recover"):
        Bag(cut)
    data = bytearray(run.writer.path.read_bytes())
    with run.writer.path.open("rb") as stream:
        place = make_reader(stream).get_summary().chunk_indexes[1].chunk_start_offset + 200
    data[place] ^= 0x10
    (tmp_path / "bad.mcap").write_bytes(data)
    with Bag(tmp_path / "bad.mcap") as bag, pytest.raises(UnusableBag, match=r"damaged chunk.*recover"):
        list(bag.messages())
    data = bytearray(whole)
    data[whole.rindex(b"/swarm/markers") + 3] ^= 1  # in the index
    (tmp_path / "index.mcap").write_bytes(data)
    with pytest.raises(UnusableBag, match=r"index does not fit its checksum.*recover"):
        Bag(tmp_path / "index.mcap")
    assert recover(tmp_path / "index.mcap", tmp_path / "whole").saved == run.writer.counts
    path = tmp_path / "json.mcap"
    writer = Writer(str(path))
    writer.start(profile="")
    schema = writer.register_schema("Thing", "jsonschema", b"{}")
    channel = writer.register_channel("/thing", "json", schema)
    writer.add_message(channel, SECOND, b"{}", SECOND)
    writer.finish()
    with pytest.raises(UnusableBag, match=r"/thing is recorded as json/jsonschema"):
        Bag(path)
    kind = "nav_msgs/msg/Odometry"
    with BagWriter(tmp_path / "bag", None) as writer:
        writer.add_topic("/odom", kind, "reliable", definition(kind))
    with Bag(tmp_path / "bag") as bag, pytest.raises(UnusableBag, match="no configuration"):
        _ = bag.config


def test_texts_of_the_recorder_stay_texts_without_quotes() -> None:
    text = 'version: 9\ncustom_data:\n  version: 1.10\n  seed: 007\n  yes: no\n  empty: ""\n'
    loaded = metadata.load(text)
    assert loaded["version"] == "9"
    assert metadata.custom_data(loaded) == {"version": "1.10", "seed": "007", "yes": "no", "empty": ""}
    many = "".join(f"  a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 30))  # 10^30 texts
    bomb = f"custom_data:\n  a0: &a0 [x, x]\n  a: b\n{many}relative_file_paths: [*a29]\ncompression_mode: *a29\n"
    loaded = metadata.load(bomb)
    assert metadata.custom_data(loaded) == {"a": "b"}
    assert not metadata.has_packed_messages(loaded)
    for deep in ("[" * 100_000, "- " * 100_000, "? " * 100_000):  # in C: the end of the process
        assert metadata.load(deep) == {}
        assert metadata.load_profiles(deep) == ()
