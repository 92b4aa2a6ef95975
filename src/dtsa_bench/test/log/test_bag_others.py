"""Integration: bags as rosbag2's options and other tools leave them are read, recovered and verified."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
import zstandard
from bag_helpers import RUN, SECOND, SyntheticRun, definition, rewrite, synthetic_bag
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import Writer
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode

from dtsa_bench.commands import cli
from dtsa_bench.log.bag import metadata
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.recover import recover
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import load_log
from dtsa_bench.runs.config import RunConfig

Row = tuple[str, int, int, int, bytes]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> SyntheticRun:
    directory = tmp_path_factory.mktemp("bags") / "flight"
    return synthetic_bag(directory, slots=40, chunk_size=20_000, custom_data={metadata.RUN_ID: f"{RUN:08x}"})


def rows(path: Path) -> list[Row]:
    with Bag(path) as bag:
        return [(m.topic, m.log_time_ns, m.publish_time_ns, m.sequence, m.data) for m in bag.messages()]


def within(begin_ns: int, end_ns: int) -> Callable[[list[BagMessage]], list[BagMessage]]:
    """The messages of a part of a bag's time."""
    return lambda messages: [message for message in messages if begin_ns <= message.log_time_ns < end_ns]


def check(run: SyntheticRun, path: Path, target: Path) -> None:
    """A bag has all that the run has, for every reader of it; and so has what is recovered."""
    for bag in (path, target):
        if bag == target:
            recover(path, target)
        assert rows(bag) == rows(run.writer.directory)
        with Bag(bag) as opened:
            assert opened.config == RunConfig(run.config).to_dict()
            assert {name: topic.count for name, topic in opened.topics.items()} == run.writer.counts
            assert opened.start_ns == SECOND
        assert len(load_log(bag).outcome) == 39  # the last one is not answered


def test_a_summary_without_channels_and_schemas(run: SyntheticRun, tmp_path: Path) -> None:
    """As rosbag2's storage settings `noRepeatedChannels` and `noRepeatedSchemas` leave it."""
    path = tmp_path / "bag" / "bag_0.mcap"
    rewrite(run.writer.path, path, repeat_channels=False, repeat_schemas=False)
    with path.open("rb") as stream:
        assert not make_reader(stream).get_summary().channels
    check(run, path.parent, tmp_path / "new")


def test_what_mcap_filter_drops_is_in_metadata_yaml(run: SyntheticRun, tmp_path: Path) -> None:
    path = tmp_path / "bag" / run.writer.path.name
    rewrite(run.writer.path, path, records=False)
    shutil.copy(run.writer.directory / "metadata.yaml", path.parent)
    check(run, path.parent, tmp_path / "new")
    with Bag(path) as alone:
        assert alone.config == RunConfig(run.config).to_dict()
    other = path.with_name("other.mcap")
    shutil.copy(path, other)
    with Bag(other) as alone, pytest.raises(UnusableBag, match="no configuration"):  # metadata.yaml is not of this file
        _ = alone.config


def add_strange_topics(writer: Writer) -> None:
    """Topics of a bag that was recorded with `--include-hidden-topics`, and what other recorders put beside."""
    texts = [
        ("std_srvs/srv/SetBool_Event", "ros2msg", b"std_srvs/SetBool_Request[<=1] request\n!!"),
        ("a_msgs/msg/Odd", "ros2msg", b"\xff\xfe no definition"),
        ("a_msgs/msg/Idl", "ros2idl", b"module a_msgs {};"),
    ]
    for name, encoding, text in texts:
        schema = writer.register_schema(name, encoding, text)
        channel = writer.register_channel(f"/{name.rpartition('/')[2].lower()}", "cdr", schema)
        writer.add_message(channel, 2 * SECOND, b"\0\1\0\0\0\0\0\0", 2 * SECOND)
    channel = writer.register_channel("/notes", "json", writer.register_schema("Note", "jsonschema", b"{}"))
    writer.add_message(channel, 2 * SECOND, b"{}", 2 * SECOND)
    writer.add_message(writer.register_channel("/raw", "raw", 0), 2 * SECOND, b"\1\2", 2 * SECOND)


def test_a_bag_is_read_by_its_own_definitions_whatever_was_read_before(run: SyntheticRun, tmp_path: Path) -> None:
    path = tmp_path / "json.mcap"
    rewrite(run.writer.path, path, encodings={"/cf1/odom": "json", "/cf2/odom": "json", "/cf3/odom": "json"})
    for _ in range(2):
        with Bag(run.writer.path) as bag:
            assert len(list(bag.typed(["/cf1/odom"]))) == 40
        with Bag(path) as bag, pytest.raises(UnusableBag, match=r"/cf1/odom.*recorded as json/ros2msg"):
            next(bag.typed(["/cf1/odom"]))


def test_topics_that_cannot_be_decoded_spoil_no_others(run: SyntheticRun, tmp_path: Path) -> None:
    path = tmp_path / "bag" / "bag_0.mcap"
    rewrite(run.writer.path, path, more=add_strange_topics)
    for bag in (path, tmp_path / "new"):
        if bag != path:
            recover(path, bag)
        with Bag(bag) as opened:
            assert len(list(opened.typed(["/cf1/odom", "/cf2/odom"]))) == 80
            for topic, reason in (
                ("/setbool_event", "definition cannot be used"),
                ("/odd", "definition cannot be used"),
                ("/idl", "recorded as cdr/ros2idl"),
                ("/notes", "recorded as json/jsonschema"),
                ("/raw", "recorded as raw/no schema"),
            ):
                with pytest.raises(UnusableBag, match=f"topic {topic}.*{reason}") as caught:
                    next(opened.typed([topic]))
                assert "\n" not in str(caught.value)
        assert cli.main(["export", str(bag), "--out", str(tmp_path / f"{bag.name}_tables")]) == 0
    old, new = (channels_of(file) for file in (path, tmp_path / "new" / "new_0.mcap"))
    assert old == new


def channels_of(path: Path) -> dict[str, tuple[str, str, str, bytes]]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()

    def about(channel: Channel) -> tuple[str, str, str, bytes]:
        schema = summary.schemas.get(channel.schema_id, Schema(0, b"", "", ""))
        return channel.message_encoding, schema.name, schema.encoding, schema.data

    return {channel.topic: about(channel) for channel in summary.channels.values()}


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "compressed"])
@pytest.mark.parametrize("listed", [True, False], ids=["with metadata.yaml", "without"])
def test_split_bags_are_one(run: SyntheticRun, tmp_path: Path, listed: bool, packed: bool) -> None:
    """As `ros2 bag record --max-bag-duration` leaves them; eleven, so that 10 comes after 9."""
    bag, names = tmp_path / "bag", [f"bag_{number}.mcap" for number in range(11)]
    for number, name in enumerate(names):
        begin, end = (SECOND + 37_000_000 * (number + k) for k in (0, 1))
        end = end if number < 10 else 1 << 62
        rewrite(run.writer.path, bag / name, edit=within(begin, end))
    if packed:
        for name in names:
            (bag / f"{name}.zstd").write_bytes(zstandard.compress((bag / name).read_bytes()))
            (bag / name).unlink()
    if listed:
        content = yaml.safe_load((run.writer.directory / "metadata.yaml").read_text())
        content["rosbag2_bagfile_information"]["relative_file_paths"] = [name + ".zstd" * packed for name in names]
        (bag / "metadata.yaml").write_text(yaml.safe_dump(content))
    check(run, bag, tmp_path / "new")
    next(bag.glob("bag_4.*")).unlink()
    for use in (Bag, recover):
        with pytest.raises(UnusableBag, match=r"bag_4.mcap.* is missing" if listed else "not the parts of one bag"):
            use(bag)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE], ids=["file", "message"])
def test_bags_that_are_compressed_by_file_or_message(run: SyntheticRun, tmp_path: Path, mode: CompressionMode) -> None:
    """As an independent writer of rosbag2's format makes them. It keeps times of reception only."""
    bag = tmp_path / "bag"
    writer = RosbagsWriter(bag, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer, Bag(run.writer.directory) as source:
        for key, value in source.custom_data.items():
            writer.set_custom_data(key, value)
        connections = {
            name: writer.add_connection(name, t.type, msgdef=t.definition.text, rihs01=t.definition.type_hash)
            for name, t in source.topics.items()
        }
        for message in source.messages():
            writer.write(connections[message.topic], message.log_time_ns, message.data)
    if mode is CompressionMode.FILE:
        assert [path.suffix for path in bag.glob("bag*")] == [".zstd"]
    wanted = [(topic, log_ns, data) for topic, log_ns, _, _, data in rows(run.writer.directory)]
    recover(bag, tmp_path / "new")
    for path in (bag, tmp_path / "new"):
        assert sorted((topic, log_ns, data) for topic, log_ns, _, _, data in rows(path)) == sorted(wanted)
        with Bag(path) as opened:
            assert opened.config == RunConfig(run.config).to_dict()
    with Reader(tmp_path / "new") as reader:  # plain now
        assert sorted((c.topic, at, bytes(data)) for c, at, data in reader.messages()) == sorted(wanted)


def test_damaged_compressed_files_are_recovered_up_to_there(run: SyntheticRun, tmp_path: Path) -> None:
    data, compressor = run.writer.path.read_bytes(), zstandard.ZstdCompressor().compressobj()
    whole = b""
    for start in range(0, len(data), 5000):
        whole += compressor.compress(data[start : start + 5000])
        whole += compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    packed = tmp_path / "bag" / "bag_0.mcap.zstd"
    packed.parent.mkdir()
    packed.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UnusableBag, match=r"not closed.*recover"):
        Bag(packed)
    recover(packed, tmp_path / "new")
    saved = rows(tmp_path / "new")
    assert 0 < len(saved) < sum(run.writer.counts.values())
    assert saved == rows(run.writer.directory)[: len(saved)]
    packed.write_bytes(b"\x28\xb5\x2f\xfd")
    for use in (Bag, recover):
        with pytest.raises(UnusableBag, match="not an MCAP file"):
            use(packed.parent)


def test_a_split_bag_whose_recorder_was_killed_is_recovered(run: SyntheticRun, tmp_path: Path) -> None:
    bag, middle = tmp_path / "bag", SECOND + SECOND // 5
    rewrite(run.writer.path, bag / "bag_0.mcap", edit=within(0, middle))
    rewrite(run.writer.path, bag / "bag_1.mcap", edit=within(middle, 1 << 62))
    last = (bag / "bag_1.mcap").read_bytes()
    (bag / "bag_1.mcap").write_bytes(last[: len(last) // 2])
    with pytest.raises(UnusableBag, match=r"not closed.*recover"):
        Bag(bag)
    result = recover(bag, tmp_path / "new")
    assert not result.closed
    assert "bag_1.mcap was not closed, or its index is damaged" in result.damaged
    saved = rows(tmp_path / "new")
    assert saved == rows(run.writer.directory)[: len(saved)]
    assert saved[-1][1] > middle


def test_qos_written_as_numbers_is_written_by_name_where_recovered(tmp_path: Path) -> None:
    """As rosbag2 wrote it before Jazzy: a reader of version 9 expects names."""
    forever = {"sec": 2147483647, "nsec": 4294967295}
    numbers = {
        "history": 3, "depth": 0, "reliability": 1, "durability": 1, "deadline": forever, "lifespan": forever,
        "liveliness": 1, "liveliness_lease_duration": forever, "avoid_ros_namespace_conventions": False,
    }  # fmt: skip
    path, kind = tmp_path / "old.mcap", definition("nav_msgs/msg/Odometry")
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        schema = writer.register_schema(kind.name, "ros2msg", kind.text.encode())
        about = {"offered_qos_profiles": yaml.safe_dump([numbers, {**numbers, "history": 9, "durability": 2}])}
        writer.add_message(writer.register_channel("/odom", "cdr", schema, about), SECOND, b"\0\1\0\0", SECOND)
        writer.finish()
    recover(path, tmp_path / "new")
    names = {
        "history": "unknown",
        "reliability": "reliable",
        "durability": "transient_local",
        "liveliness": "automatic",
    }
    for bag in (path, tmp_path / "new"):
        with Bag(bag) as opened:
            first, second = opened.topics["/odom"].profiles
        assert first == {**numbers, **names}
        assert (second["history"], second["durability"]) == ("unknown", "volatile")
    content = yaml.safe_load((tmp_path / "new" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert content["topics_with_message_count"][0]["topic_metadata"]["offered_qos_profiles"][0] == {**numbers, **names}


def test_json_stays_json_with_its_own_records_of_metadata(tmp_path: Path) -> None:
    path = tmp_path / "notes.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=100)
        writer.start("")
        writer.add_metadata("mine", {"a": "1"})
        schema = json.dumps({"title": "Note", "type": "object"}).encode()
        channel = writer.register_channel("notes", "json", writer.register_schema("Note", "jsonschema", schema))
        for number in range(20):
            writer.add_message(channel, number, json.dumps({"n": number}).encode(), number)
        writer.add_metadata("mine", {"b": "2"})
        writer.finish()
    assert recover(path, tmp_path / "new").damaged == []
    with (tmp_path / "new" / "new_0.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == ""
        assert [json.loads(m.data)["n"] for _, _, m in reader.iter_messages()] == list(range(20))
        assert [r.metadata for r in reader.iter_metadata() if r.name == "mine"] == [{"a": "1"}, {"b": "2"}]
    assert channels_of(path) == channels_of(tmp_path / "new" / "new_0.mcap")
    content = yaml.safe_load((tmp_path / "new" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert content["topics_with_message_count"][0]["topic_metadata"]["serialization_format"] == "json"


def test_two_types_on_one_topic_are_not_mixed(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        for name, text in (("a_msgs/msg/A", b"uint8 a"), ("a_msgs/msg/B", b"uint16 b")):
            channel = writer.register_channel("/x", "cdr", writer.register_schema(name, "ros2msg", text))
            writer.add_message(channel, SECOND, b"\0\1\0\0\1\0", SECOND)
        writer.finish()
    result = recover(path, tmp_path / "new")
    assert (result.count, result.closed) == (1, False)
    assert any("topics that are not defined" in note for note in result.damaged)
    assert {topic.type for topic in Bag(tmp_path / "new").topics.values()} == {"a_msgs/msg/A"}


def test_sqlite_bags_are_refused_with_a_command_that_is_installed(tmp_path: Path) -> None:
    bag = tmp_path / "old"
    with RosbagsWriter(bag, version=9) as writer, BagWriter(tmp_path / "new", None) as new:
        kind = definition("nav_msgs/msg/Odometry")
        new.add_topic("/odom", kind.name, "reliable", kind)
        writer.add_connection("/odom", kind.name, msgdef=kind.text, rihs01=kind.type_hash)
    for path in (bag, next(bag.glob("*.db3"))):
        with pytest.raises(UnusableBag, match=rf"sqlite3.*`rosbags-convert --src {bag} --dst NEW --dst-storage mcap`"):
            Bag(path)
