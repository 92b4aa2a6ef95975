"""What is written, field by field, read back by two independent libraries."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from bag_helpers import MESSAGES, SECOND, SyntheticRun, definition, synthetic_bag, typestore
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log import record
from dtsa_bench.log.bag import schema
from dtsa_bench.log.bag.errors import BagError
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.writer import BagWriter

INFINITE = {"sec": 9223372036, "nsec": 854775807}
HERE = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> SyntheticRun:
    return synthetic_bag(tmp_path_factory.mktemp("bags") / "flight", slots=40, chunk_size=20_000)


def content(run: SyntheticRun) -> dict:
    text = (run.writer.directory / "metadata.yaml").read_text(encoding="utf-8")
    assert "&id" not in text  # anchors, which rosbag2 does not read
    loaded = yaml.safe_load(text)
    assert list(loaded) == ["rosbag2_bagfile_information"]
    return loaded["rosbag2_bagfile_information"]


def test_metadata_has_every_mandatory_field_and_describes_each_topic(run: SyntheticRun) -> None:
    assert sorted(path.name for path in run.writer.directory.iterdir()) == ["flight_0.mcap", "metadata.yaml"]
    found = content(run)
    times = [log_ns for rows in run.written.values() for log_ns, _, _ in rows]
    shared = {
        "duration": {"nanoseconds": max(times) - min(times)},
        "starting_time": {"nanoseconds_since_epoch": min(times)},
        "message_count": sum(map(len, run.written.values())),
    }
    fixed = {"version": 9, "storage_identifier": "mcap", "compression_format": "", "compression_mode": ""}
    names = {"relative_file_paths": ["flight_0.mcap"], "files": [{"path": "flight_0.mcap", **shared}]}
    wanted = {**shared, **fixed, **names, "ros_distro": "jazzy"}
    assert {key: found[key] for key in wanted} == wanted
    assert all(isinstance(value, str) for value in found["custom_data"].values())
    assert found["custom_data"]["seed"] == "7"
    assert json.loads(found["custom_data"]["configuration"])["swarm"]["agents"] == 4
    assert found["custom_data"]["version"]
    topics = {
        entry["topic_metadata"]["name"]: (entry["topic_metadata"], entry["message_count"])
        for entry in content(run)["topics_with_message_count"]
    }
    assert topics.keys() == run.written.keys()
    for name, (topic, count) in topics.items():
        assert count == len(run.written[name])
        assert topic["serialization_format"] == "cdr"
        assert topic["type_description_hash"] == definition(topic["type"]).type_hash
        (profile,) = topic["offered_qos_profiles"]
        assert profile == {
            "history": "keep_last", "depth": 5 if name.endswith("odom") else 10,
            "reliability": "best_effort" if name.endswith("odom") else "reliable", "durability": "volatile",
            "deadline": INFINITE, "lifespan": INFINITE, "liveliness": "automatic",
            "liveliness_lease_duration": INFINITE, "avoid_ros_namespace_conventions": False,
        }  # fmt: skip


def test_two_other_libraries_read_headers_schemas_indexes_metadata_and_every_message(run: SyntheticRun) -> None:
    with run.writer.path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert summary.statistics.message_count == sum(map(len, run.written.values()))
        assert len(summary.chunk_indexes) > 1
        assert all(index.compression == "zstd" for index in summary.chunk_indexes)
        assert all(index.message_index_length > 0 for index in summary.chunk_indexes)
        for channel in summary.channels.values():
            kind = summary.schemas[channel.schema_id]
            assert channel.message_encoding == "cdr"
            assert kind.encoding == "ros2msg"
            assert kind.data.decode() == definition(kind.name).text
            assert channel.metadata["topic_type_hash"] == definition(kind.name).type_hash
            (profile,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
            assert profile["history"] == "keep_last"
            assert channel.metadata["offered_qos_profiles"].startswith("- history: keep_last\n")
        found: dict[str, list[tuple[int, int, bytes]]] = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            found.setdefault(channel.topic, []).append((message.log_time, message.publish_time, message.data))
        assert found == run.written
    with run.writer.path.open("rb") as stream:
        records = list(make_reader(stream).iter_metadata())
    assert [record.name for record in records] == ["rosbag2", "rosbag2"]
    first, last = (yaml.safe_load(record.metadata["serialized_metadata"]) for record in records)
    assert first["message_count"] == 0
    assert first["custom_data"]["configuration"] == last["custom_data"]["configuration"]
    assert last == content(run)
    store = typestore()
    found: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(run.writer.directory) as reader:
        assert {c.topic for c in reader.connections} == run.written.keys()
        for connection in reader.connections:
            assert connection.digest == definition(connection.msgtype).type_hash
        for connection, time_ns, data in reader.messages():
            store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((time_ns, bytes(data)))
    assert found == {topic: [(row[0], row[2]) for row in rows] for topic, rows in run.written.items()}


@pytest.mark.parametrize("name", ["dtsa_msgs/msg/Slot", "dtsa_msgs/msg/Transmission", "nav_msgs/msg/Odometry"])
def test_definitions_have_the_hash_of_an_independent_computation_and_the_projects_own_text(name: str) -> None:
    brought = schema.brought(name, MESSAGES)
    assert brought.type_hash == definition(name).type_hash == typestore().hash_rihs01(name)
    own, _, rest = brought.text.partition(schema.SEPARATOR)
    assert "MSG: builtin_interfaces/Time" in rest
    if name == "dtsa_msgs/msg/Slot":
        assert own.rstrip("\n") == (MESSAGES / "Slot.msg").read_text(encoding="utf-8").rstrip("\n")


def test_definition_lists_each_dependency_once_and_keeps_comments() -> None:
    texts = {
        "a/msg/Root": "# about\nb/Leaf one\nb/Leaf[] many\nOwn[] own  # note\nuint8 LEAF=1\nstring<=5 s",
        "a/msg/Own": "builtin_interfaces/Time stamp\nb/Leaf leaf",
        "b/msg/Leaf": "float64 x 1.5  # default",
        "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    }
    parts = [f"{'=' * 80}\nMSG: {name.replace('/msg', '')}\n{texts[name]}" for name in
             ("b/msg/Leaf", "a/msg/Own", "builtin_interfaces/msg/Time")]  # fmt: skip
    assert schema.concatenate("a/msg/Root", texts.__getitem__) == "\n".join([texts["a/msg/Root"], *parts])


def test_directories_in_use_closed_bags_and_wrong_messages_are_refused(tmp_path: Path) -> None:
    (tmp_path / "something").write_text("precious")
    for path in (tmp_path, tmp_path / "something"):
        with pytest.raises(ConfigError, match="empty or does not exist"):
            BagWriter(path, {})
    assert [path.read_text() for path in tmp_path.iterdir()] == ["precious"]
    run = synthetic_bag(tmp_path / "closed", slots=1)
    run.writer.close()
    for action in (lambda: run.slot(1), run.writer.flush, lambda: run.writer.add_topic("/x", "a/msg/B")):
        with pytest.raises(BagError, match="closed"):
            action()
    with BagWriter(tmp_path / "bag", {}) as writer:
        kind = "nav_msgs/msg/Odometry"
        channel = writer.add_topic("/odom", kind, "reliable", definition(kind))
        with pytest.raises(BagError, match="never added"):
            writer.write(channel + 1, b"\0\1\0\0", SECOND, SECOND)
        with pytest.raises(ConfigError, match="not in the bag yet"):
            writer.add_topic("/odom", kind, "reliable", definition(kind))
    with Bag(tmp_path / "bag") as bag:
        assert bag.topics["/odom"].count == 0


def test_no_definition_is_read_once_a_flight_has_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Types of messages take 20 ms to make: an agent with slots of 5 ms would lose four of them."""
    record._store.cache_clear()
    with BagWriter(tmp_path / "bag", {"mode": "realtime"}) as bag:
        topic = record.add_records(bag)
        monkeypatch.setattr(schema, "typestore_of", None)
        bag.write(topic, record.pack_record(1, 2, 3, 1, agent=[1], track=[0.0, 1.0, 2.0]), SECOND, SECOND)
