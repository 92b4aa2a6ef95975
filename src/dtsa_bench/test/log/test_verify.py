"""Verification of bags of real nodes: what is right passes, and no tampering gets through."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_helpers import rewrite

from dtsa_bench.commands.cli import main
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import SLOT_RECORD, load_log
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.log.verify.result import Result
from dtsa_bench.pages.report.data import run_data

pytest.importorskip("rclpy")
pytest.importorskip("dtsa_msgs")
pytestmark = pytest.mark.ros

KEY = "7c1f0a93e4d25b6880b13f96c2de470a"
KINDS = ["byte", "drop", "swap times", "swap data"]
LEASE = ("--agents", "4", "--moving", "2", "--policy", "lease", "--processes", "1", "--timeout-s", "0.5")
FIELDS = (
    "data", "length", "received", "lost", "chosen", "reason", "digest", "score", "track", "velocity", "command", "goal",
)  # fmt: skip
Edit = Callable[[list[BagMessage]], list[BagMessage]]


def dtsa(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dtsa_bench", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def fly(directory: Path, *arguments: str) -> Path:
    done = dtsa("fly", "--out", str(directory), "--avoider", "orca", "--timeout-s", "1.5", "--no-picture", *arguments)
    assert done.returncode == 0, done.stderr
    return directory


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six agents in two processes on a channel that loses frames: DTSA diverges, and every view is different."""
    arguments = ("--agents", "6", "--policy", "dtsa", "--processes", "2", "--loss", "0.1", "--seed", "5")
    return fly(tmp_path_factory.mktemp("verify") / "flight", *arguments)


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DTSA_AUTH_KEY", KEY)
        return fly(tmp_path_factory.mktemp("sealed") / "flight", *LEASE, "--auth")


def test_a_flight_of_real_nodes_is_what_the_protocol_gives(flight: Path, tmp_path: Path) -> None:
    assert verify_bag(rewrite(flight, tmp_path / "same.mcap")).ok
    result = verify_bag(flight)
    assert result.ok, result.difference
    slots = json.loads((flight / "summary.json").read_text())["slots"]["total"]
    assert result.slots == slots == result.checked["slot records"] == result.checked["decisions"] / 6
    assert result.checked["odometry"] == 6 * -(-slots // 5)  # 20 times a second
    assert result.checked["digest of all messages"] == 1
    assert result.checked["summary.json"] > 20
    assert not result.safety["all_agents_chose_alike"]
    assert set(result.skipped) == {"/swarm/markers", "/swarm/configuration", "/swarm/status"}
    done = dtsa("verify", str(flight))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "everything is what the protocol gives" in done.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ("--agents", "5", "--policy", "tdma", "--estimator", "hold", "--slot-ms", "20"),
        ("--agents", "4", "--policy", "aloha", "--estimator", "intent", "--processes", "1"),
        ("--agents", "6", "--moving", "2", "--policy", "age", "--processes", "3"),
        ("--agents", "6", "--policy", "lease", "--processes", "2", "--loss", "0.2", "--burst-length", "5"),
    ],
    ids=lambda a: a[a.index("--policy") + 1],
)
def test_every_policy_verifies(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    result = verify_bag(fly(tmp_path / "flight", "--timeout-s", "0.8", *arguments))
    assert result.ok, result.difference
    if {"tdma", "age"} & set(arguments):  # with equal tables; dtsa is in test_fly.py
        assert result.safety["all_agents_chose_alike"]
        assert result.safety["slots_with_two_senders"] == 0


def test_a_sealed_flight_verifies_with_its_key_only(sealed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", KEY)
    assert verify_bag(sealed).ok
    monkeypatch.setenv("DTSA_AUTH_KEY", "ff" + KEY[2:])
    difference = verify_bag(sealed).difference
    assert difference.what == "frame"
    for path in sealed.rglob("*"):
        assert not path.is_file() or KEY[-6:].encode() not in path.read_bytes()  # the key is nowhere


def frame_places(messages: list[BagMessage], bag: Bag) -> list[tuple[int, int]]:
    places = []
    for index, message in enumerate(messages):
        if message.topic == SLOT_RECORD:
            record = bag.decode(message)
            for data in (getattr(record, name).tobytes() for name in FIELDS):
                start = message.data.find(data) if data else -1
                places += [(index, start + i) for i in range(len(data)) if start >= 0]
    return places


def altered(message: BagMessage, at: int, bit: int) -> BagMessage:
    data = bytearray(message.data)
    data[at] ^= 1 << bit
    return message._replace(data=bytes(data))


def tampering(random: np.random.Generator, kind: str, places: list[tuple[int, int]]) -> Edit:
    def edit(messages: list[BagMessage]) -> list[BagMessage]:
        if kind == "byte":
            index, at = places[random.integers(len(places))]
            messages[index] = altered(messages[index], at, int(random.integers(8)))
        elif kind == "drop":
            del messages[random.integers(len(messages))]
        else:
            a, b = (int(i) for i in random.choice(len(messages), 2, replace=False))
            x, y = messages[a], messages[b]
            if x.data == y.data:
                return edit(messages)
            if kind == "swap data" and x.topic == y.topic:
                messages[a], messages[b] = x._replace(data=y.data), y._replace(data=x.data)
            else:
                times = ("log_time_ns", "publish_time_ns")
                if x.log_time_ns == y.log_time_ns:
                    return edit(messages)
                messages[a] = x._replace(**{name: getattr(y, name) for name in times})
                messages[b] = y._replace(**{name: getattr(x, name) for name in times})
                messages.sort(key=lambda m: m.log_time_ns)
        return messages

    return edit


@pytest.mark.parametrize("kind", KINDS)
def test_a_hundred_tamperings_are_found(flight: Path, tmp_path: Path, kind: str) -> None:
    """25 of each kind; the forger keeps the digest that the recorder wrote."""
    random = np.random.default_rng(KINDS.index(kind))
    with Bag(flight / "bag") as bag:
        places = frame_places(list(bag.messages()), bag)
    missed = []
    for number in range(25):
        forged = rewrite(flight, tmp_path / f"{number}.mcap", tampering(random, kind, places))
        if verify_bag(forged).ok:
            missed.append(number)
        forged.unlink()
    assert not missed


@pytest.mark.parametrize("tagged", [False, True])
def test_a_changed_frame_is_named_and_shown_in_words_without_any_digest(flight, sealed, tmp_path, monkeypatch, tagged):
    """One bit of the position in one frame: slot, agent, both values and the reason are shown."""
    monkeypatch.setenv("DTSA_AUTH_KEY", KEY)
    original = sealed if tagged else flight
    with Bag(original / "bag") as bag:
        messages = list(bag.messages())
        later = [i for i, m in enumerate(messages) if m.topic == SLOT_RECORD and i > len(messages) / 2]
        index, sent = next((i, m) for i in later if (m := bag.decode(messages[i])).data.size)
    at = messages[index].data.find(sent.data.tobytes()) + 8

    def edit(messages: list[BagMessage]) -> list[BagMessage]:
        messages[index] = altered(messages[index], at, 0)
        return messages

    result = result_of(original, tmp_path, edit)
    found = result.difference
    assert result.slots == found.slot > 0  # those before it are right
    assert found.what == "frame"
    assert found.slot == int(sent.slot)
    assert found.agent == int(sent.sender[0])
    assert f"sender={found.agent}" in found.expected
    assert found.expected != found.recorded
    assert "codec" in found.reason
    for text in (found.expected, found.recorded):
        assert "no frame" not in text
        assert "Gossip(" in text or not tagged
        assert ("sealed" in text) == tagged


def result_of(flight: Path, tmp_path: Path, edit: Edit) -> Result:
    return verify_bag(rewrite(flight, tmp_path / "edited.mcap", edit, without="digest:"))


@pytest.mark.parametrize("topic", [SLOT_RECORD, "/swarm/markers", "/cf3/odom"])
def test_a_missing_message_and_a_wrong_sequence_number_are_found_without_any_digest(flight, tmp_path, topic):
    def middle(messages: list[BagMessage]) -> int:
        of_topic = [i for i, m in enumerate(messages) if m.topic == topic]
        return of_topic[len(of_topic) // 2]

    def drop(messages: list[BagMessage]) -> list[BagMessage]:
        del messages[middle(messages)]
        return messages

    def renumber(messages: list[BagMessage]) -> list[BagMessage]:
        at = middle(messages)
        messages[at] = messages[at]._replace(sequence=messages[at].sequence + 1)
        return messages

    difference = result_of(flight, tmp_path, drop).difference
    assert difference.slot is not None
    difference = result_of(flight, tmp_path, renumber).difference
    assert difference.what == f"{topic}, sequence number"
    assert int(difference.recorded) == int(difference.expected) + 1


@pytest.mark.parametrize("text", ["{", "[]", '{"slots": 3}', "[" * 100_000])
def test_a_damaged_summary_beside_a_bag_is_a_difference(flight: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "bag").mkdir()
    rewrite(flight, tmp_path / "bag" / "bag_0.mcap")
    (tmp_path / "summary.json").write_text(text)
    assert verify_bag(tmp_path).difference.what == "summary.json"


@pytest.mark.parametrize(("name", "is_right"), [("/cf\u00b2/odom", True), ("/parameter_events", False)])
def test_a_topic_of_another_kind_than_its_name_says_ends_in_words(flight, tmp_path, name, is_right):
    with Bag(flight) as bag, BagWriter(tmp_path / "more.mcap", None, custom_data=bag.custom_data) as copy:
        channels = {topic.name: copy.add_topic(topic.name, topic.type) for topic in bag.topics.values()}
        channels[name] = copy.add_topic(name, "nav_msgs/msg/Odometry")
        messages = list(bag.messages())
        messages.append(next(m for m in messages if m.topic == "/cf1/odom")._replace(topic=name))
        for one in messages:
            copy.write(channels[one.topic], one.data, one.log_time_ns, one.publish_time_ns)
    assert verify_bag(tmp_path / "more.mcap").ok == is_right


def test_an_account_that_is_missing_is_named(flight: Path, tmp_path: Path) -> None:
    def without_ids(messages: list[BagMessage]) -> list[BagMessage]:
        records = [i for i, m in enumerate(messages) if m.topic == SLOT_RECORD]
        at = records[len(records) // 2]
        with Bag(flight / "bag") as bag:
            record = bag.decode(messages[at])
            for name in ("agent", "chosen", "reason", "digest", "score", "track", "velocity", "command", "goal"):
                setattr(record, name, getattr(record, name)[:0])
            data = bytes(bag.typestore(SLOT_RECORD).serialize_cdr(record, messages[at].type))
            messages[at] = messages[at]._replace(data=data)
        return messages

    difference = result_of(flight, tmp_path, without_ids).difference
    assert (difference.what, difference.agent, difference.recorded) == ("agent", 1, "none")


@pytest.mark.parametrize("name", [*FIELDS, "outcome"])
def test_a_changed_field_is_named_with_slot_and_agent(flight: Path, tmp_path: Path, name: str) -> None:
    changed = []

    def edit(messages: list[BagMessage]) -> list[BagMessage]:
        with Bag(flight / "bag") as bag:
            for i in range(len(messages) // 2, len(messages)):
                if messages[i].topic != SLOT_RECORD:
                    continue
                record = bag.decode(messages[i])
                value: Any = getattr(record, name)
                if name == "outcome":
                    record.outcome ^= 1
                elif not value.size:
                    continue
                elif name == "length":
                    record.length, record.data = value - 1, record.data[:-1]
                else:
                    raw = bytearray(value.tobytes())
                    raw[0] ^= 1
                    setattr(record, name, np.frombuffer(bytes(raw), value.dtype))
                changed.append(int(record.slot))
                data = bytes(bag.typestore(SLOT_RECORD).serialize_cdr(record, messages[i].type))
                messages[i] = messages[i]._replace(data=data)
                return messages
        raise AssertionError("nothing to change")

    difference = result_of(flight, tmp_path, edit).difference
    assert {"data": "frame", "length": "length"}.get(name, name) in difference.what
    # The end of a slot is at the start of the next.
    assert difference.slot == changed[0]
    assert difference.agent is not None or name == "outcome"
    assert difference.expected != difference.recorded


def test_of_a_bag_with_a_hole_it_is_said_what_is_missing(holed, tmp_path, capsys):
    begin, end = 1_505_000_000, 1_595_000_000  # ns, where slots have 10 ms from 1 s on
    saved = rewrite(
        holed, tmp_path / "saved.mcap", lambda messages: [m for m in messages if not begin < m.log_time_ns < end]
    )
    run = load_log(saved)
    gap = np.flatnonzero(~run.recorded)
    first, last = int(gap[0]), int(gap[-1])
    missing = f"slots {first} to {last}"
    assert run.missing == missing
    result = verify_bag(saved)
    assert result.difference is not None
    assert main(["export", str(saved), "--to", "csv", "--out", str(tmp_path / "tables")]) == 0
    why = f"Ages, estimates and results are left out: {missing} are missing in the bag."
    assert capsys.readouterr().err == f"dtsa: {why}\n"
    decisions = (tmp_path / "tables" / "decisions.csv").read_text().count("\n") - 1
    assert decisions == int(run.known.sum()) > 0
    assert why in run_data(saved)["notes"]


@pytest.fixture(params=["lockstep", "realtime"])
def holed(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    shape = ("--agents", "4", "--policy", "lease", "--processes", "1", "--timeout-s", "3")
    fly(tmp_path / "flown", *shape, "--mode", request.param, "--slot-ms", "10")
    return tmp_path / "flown"
