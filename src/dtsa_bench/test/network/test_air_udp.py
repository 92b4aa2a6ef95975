"""Integration: agents over UDP: real sockets on the loopback interface, bags of their own, merged and judged."""

from __future__ import annotations

import base64
import dataclasses
import json
import resource
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import air_helpers as helpers
import numpy as np
import pytest
from bag_helpers import rewrite
from rosbags.rosbag2 import Reader
from waiting import wait_for

import dtsa
from dtsa_agent.air.port import link_of
from dtsa_agent.air.settings import AgentSettings, UdpSettings
from dtsa_agent.air.udp_port import UdpPort
from dtsa_agent.core import ConfigError, Frame, SwarmConfig, encode_frame
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.station import StationSettings
from dtsa_agent.stop import Stop
from dtsa_bench.commands.cli import main
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.arrays import ReceivedFrames
from dtsa_bench.log.bag.metadata import MERGED_FROM
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.bag.recover import recover
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.merge.merge import Merge, is_verified
from dtsa_bench.log.merge.timeline import Crossings, fit
from dtsa_bench.log.merged_bag import write_merged
from dtsa_bench.log.record import SLOT_RECORD, load_log
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.network.sniffer import Sniffer
from dtsa_bench.pages.report.data import run_data

KEY = "8f3c1d5e7a9b2460c1e3f5a7b9d8c6e4"
# Nothing but an owner or its one lessee may send: no two in a slot, whatever is lost.
CONFIG = SwarmConfig(agents=4, policy="lease", slot_ms=20.0, open_every=0, adoption=False, auth=True, auth_session=7)
OFFSET_NS = 700_000_000


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Agents start one after the other, with clocks that differ; a stranger talks in between; one leaves early."""
    helpers.need_multicast()
    directory, group = tmp_path_factory.mktemp("udp"), helpers.own_group()
    udp = UdpSettings(interface="lo", group=group)
    paths = [directory / f"cf{agent}.mcap" for agent in (1, 2, 3)]
    stranger = UdpPort(udp)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DTSA_AUTH_KEY", KEY)
        sniffing = helpers.Sniffing(CONFIG, udp, directory / "sniffed.mcap")
        try:
            with helpers.listening(CONFIG, udp) as told, helpers.flying(CONFIG, [udp] * 3, directory, own) as flying:
                helpers.hear_each_other(flying, 10)
                sniffing.start()
                _disturb(stranger, flying)
                helpers.go_on(flying, 60)
                for one in flying:
                    one.end()
                wait_for(lambda: told()[-1]["absent"] == [1, 2, 3, 4])
        finally:
            stranger.close()
            sniffed = sniffing.end()
    run, merged = helpers.merge_bags(reversed(paths), directory / "whole")
    summaries = {one.agent.own.id: one.agent.summary() for one in flying}
    return SimpleNamespace(
        bags=paths, summaries=summaries, merged=merged, run=run, whole=directory / "whole", sniffed=sniffed, told=told()
    )


def own(agent: int) -> dict[str, int]:
    return {"clock_offset_ns": OFFSET_NS * agent, "clock_drift_ppb": 40_000 * (agent - 2)}


def _disturb(stranger: UdpPort, flying: list[helpers.Flying]) -> None:
    """Noise, frames of another swarm, changed frames, the same ones again at once and much later."""

    def repeats() -> bool:
        stranger.send(helpers.hear(stranger, 1)[-1])
        return all(one.agent.reports.not_taken_in["repeated"] for one in flying)

    wait_for(repeats)
    kept = helpers.hear(stranger, 6)  # of two at least: to its sender an old datagram is a repeated one
    first = kept[0]
    for data in (b"", b"noise" * 50, b"x" * 2000, first[:30], first[:4] + b"abcd" + first[8:], first[:26] + bytes(60)):
        stranger.send(data)
    stranger.send(first[:20] + bytes([first[20] ^ 1]) + first[21:])
    time.sleep(3 * CONFIG.slot_s)
    for data in kept:
        stranger.send(data)


def test_groups_become_one_flight_on_one_time_line_in_which_all_keep_the_rules(flight: SimpleNamespace) -> None:
    helpers.check_merged(flight.merged, flight.whole, 150)
    assert flight.merged["clock_spread_ms"]["end"] < CONFIG.slot_ms / 2
    for agent, summary in flight.summaries.items():
        assert (summary["state"], summary["heard_of"]) == ("joined", [k for k in (1, 2, 3) if k != agent])
    found = flight.merged["flight"]
    assert found["slots"]["success"] > 20
    assert found["slots"]["collision"] == 0
    assert found["min_distance_m"] > 0.2
    assert 0 < found["age_mean_slots"] < 4 * CONFIG.agents * CONFIG.turn_every
    found = flight.sniffed
    assert found["heard"].keys() == {"cf1", "cf2", "cf3"}
    assert found["frames_judged"] > 10
    assert (found["rules_broken"], found["slots_with_two_senders"]) == (0, 0), found["which"]
    assert {"not ours", "other settings", "rejected", "repeated"} <= found["not_taken_in"].keys()
    heard = load_log(flight.bags[0].with_name("sniffed.mcap"))
    assert int(heard.sent.sum()) == sum(found["heard"].values())
    assert not heard.known.any()
    assert verify_bag(flight.bags[0].with_name("sniffed.mcap")).ok
    for summary in flight.summaries.values():
        found = summary["not_taken_in"]
        assert found["not ours"] >= 2
        assert {"length", "other settings", "no frame", "rejected", "repeated", "other time"} <= found.keys()
    line = flight.merged["time_line"]
    assert flight.merged["not_on_the_time_line"] == []
    assert flight.merged["missing"] == [4]
    for agent in (2, 3):
        assert line["clocks"][f"cf{agent}"]["offset_ms"] == pytest.approx(OFFSET_NS / 1e6 * (agent - 1), abs=2.0)
    assert line["residual_us"]["p50"] < 1000


def test_a_page_is_told_what_a_listener_heard(flight: SimpleNamespace) -> None:
    """Who sends in which slot, where the frames say that all are, who comes and who leaves; and nothing more."""

    def numbers(text: str, kind: str) -> Any:
        return np.frombuffer(base64.b64decode(text), kind)

    records = {agent: read(path).log for agent, path in enumerate(flight.bags, 1)}
    heard = [
        pair
        for moment in flight.told
        for pair in zip(
            numbers(moment["frames"]["slot"], "<u4").tolist(),
            numbers(moment["frames"]["sender"], "<u2").tolist(),
            strict=True,
        )
    ]
    assert len(heard) > 60
    sent = {
        (log.first_slot + row, agent) for agent, log in records.items() for row in np.flatnonzero(log.sent).tolist()
    }
    assert set(heard) <= sent
    assert len(set(heard)) == len(heard)
    first = heard[0][0]
    assert len(heard) > 0.9 * len([slot for slot, _ in sent if slot >= first])
    middle = flight.told[len(flight.told) // 2]
    slot = numbers(middle["at"], "<u4")[-1]
    place = numbers(middle["place"], "<f4").reshape(-1, 3, CONFIG.agents)[-1]
    for agent in (1, 2, 3):
        track = records[agent].track[slot - records[agent].first_slot, -1, :, 0]
        assert np.linalg.norm(place[:, agent - 1] - track) < 0.1
    words = "\n".join(event[2] for moment in flight.told for event in moment["events"])
    assert all(f"cf{agent} is heard" in words and f"cf{agent} leaves" in words for agent in (1, 2, 3))
    assert "cf4" not in words
    last = flight.told[-1]
    assert last["refused"] >= 8  # what the stranger said
    assert (last["tables"], last["agree"]) == (0, [0, 0])


def test_bags_of_agents_and_merged_ones_that_lie_are_found(flight: SimpleNamespace, tmp_path: Path) -> None:
    bags = [read(path) for path in flight.bags]
    log = bags[0].log
    row = int(np.flatnonzero(log.known)[-20])
    log.chosen[row] = 4 if log.chosen[row, 0] != 4 else 1
    found = Merge(bags).summary()
    assert not is_verified(found)
    assert [(one["agent"], one["slot"], one["field"]) for one in found["decisions_again"]["differences"]] == [
        (1, log.first_slot + row, "chosen")
    ]
    bags = [read(path) for path in flight.bags]
    frames = bags[1].log.sent_frames
    at = np.flatnonzero(frames.row > len(bags[1].log) - 60)[0]
    frames.data[at] = frames.data[at][:-5] + bytes([frames.data[at][-5] ^ 1]) + frames.data[at][-4:]
    assert Merge(bags).summary()["frames_heard_not_as_sent"] > 0
    for number, name in enumerate(("chosen", "digest", "lost", "received", "data", "odom")):
        with Bag(flight.whole) as bag, BagWriter(tmp_path / f"{number}", None, custom_data=bag.custom_data) as copy:
            channels = {name: copy.add_topic(name, info.type, info.profiles) for name, info in bag.topics.items()}
            late = [m.log_time_ns for m in bag.messages([SLOT_RECORD]) if len(bag.decode(m).sender)][-60]
            changed = False
            for message in bag.messages():
                data = message.data
                if message.topic == SLOT_RECORD and message.log_time_ns == late and name != "odom":
                    record = bag.decode(message)
                    raw = bytearray(getattr(record, name).tobytes())
                    raw[8 if name == "data" else 0] ^= 1
                    setattr(record, name, np.frombuffer(bytes(raw), getattr(record, name).dtype))
                    data, changed = bytes(bag.typestore(SLOT_RECORD).serialize_cdr(record, message.type)), True
                elif message.topic == "/cf2/odom" and name == "odom" and not changed:
                    data, changed = data[:60] + bytes([data[60] ^ 1]) + data[61:], True
                copy.write(channels[message.topic], data, message.log_time_ns, message.publish_time_ns)
        assert changed
        assert verify_bag(tmp_path / f"{number}").difference is not None, name
    log = Merge([read(path) for path in flight.bags]).log
    row = int(np.flatnonzero(log.known[:, 1])[-20])
    log.chosen[row, 1] = 4 if log.chosen[row, 1] != 4 else 1
    write_merged(tmp_path / "lie", log, {})
    difference = verify_bag(tmp_path / "lie").difference
    assert difference is not None
    assert (difference.what, difference.slot, difference.agent) == ("chosen", log.first_slot + row, 2)


def _copied(whole: Path, target: Path, custom: dict[str, str]) -> str:
    """A bag that says other things of itself, finished by the real writer."""
    with Bag(whole) as bag, BagWriter(target, None, custom_data={**bag.custom_data, **custom}) as copy:
        channels = {name: copy.add_topic(name, info.type, info.profiles) for name, info in bag.topics.items()}
        for one in bag.messages():
            copy.write(channels[one.topic], one.data, one.log_time_ns, one.publish_time_ns)
    return str(target)


def test_a_merged_bag_with_other_control_instants_than_its_settings_is_refused(flight, tmp_path, capsys):
    with Bag(flight.whole) as bag:
        settings = {**bag.config, "swarm": {**bag.config["swarm"], "control_ms": 20.0}}
    lie = _copied(flight.whole, tmp_path / "lie.mcap", {"configuration": json.dumps(settings)})
    assert main(["verify", lie]) == 1
    assert main(["export", lie, "--to", "csv", "--out", str(tmp_path / "tables")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("change", [
    {"agents_that_gave_up_a_time": None}, {"not_determined": [3]}, {"processes": []}, {"processes": [{"agent": 1e999}]},
    {"residual_us": None}, {"common_slot": 1 << 70},
])  # fmt: skip
def test_a_merged_bag_that_lies_of_its_origin_is_found(flight, tmp_path, capsys, change):
    with Bag(flight.whole) as bag:
        about = json.loads(bag.custom_data[MERGED_FROM]) | change
    assert main(["verify", _copied(flight.whole, tmp_path / "lie.mcap", {MERGED_FROM: json.dumps(about)})]) == 1
    assert capsys.readouterr().err == ""


def test_a_damaged_bag_without_room_for_a_copy_is_one_line_and_no_difference(flight, tmp_path):
    (tmp_path / "cf1.mcap").write_bytes(flight.bags[0].read_bytes()[:-100])
    for command in ("merge", "verify"):
        words = [sys.executable, "-m", "dtsa_bench", command, str(tmp_path)]
        limit = (1 << 12, 1 << 12)  # bytes of a file that it writes
        done = subprocess.run(
            words, capture_output=True, text=True, check=False,
            preexec_fn=lambda limit=limit: resource.setrlimit(resource.RLIMIT_FSIZE, limit),
        )  # fmt: skip
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1), done
        assert str(tmp_path / "cf1.mcap") in done.stderr


def test_a_bag_cut_off_is_read_up_to_there(flight: SimpleNamespace, tmp_path: Path) -> None:
    whole = flight.bags[0].read_bytes()
    cut = tmp_path / "cf1.mcap"
    cut.write_bytes(whole[: len(whole) * 2 // 3])
    bag = read(cut)
    assert bag.broken_off
    assert 0 < len(bag.log) < len(read(flight.bags[0]).log)
    found = Merge([bag, *(read(path) for path in flight.bags[1:])]).summary()
    assert found["broken_off"] == ["cf1"]
    assert is_verified(found)
    saved = read(recover(cut).directory)
    assert saved.log.known.tolist() == bag.log.known.tolist()
    assert saved.log.first_slot == bag.log.first_slot
    again = Merge([saved, *(read(path) for path in flight.bags[1:])]).summary()
    assert {**again, "broken_off": []} == {**found, "broken_off": []}, again
    assert again["broken_off"] == ["cf1"]
    middle = len(whole) // 2
    cut.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    bag = read(cut)
    assert bag.damage
    assert 0 < len(bag.log) <= len(read(flight.bags[0]).log)
    assert not verify_bag(cut).ok
    rewrite(flight.bags[0], cut, use_chunking=False)  # all messages, not as the recorder writes them
    assert read(cut).damage
    assert not verify_bag(cut.parent).ok
    for bad in (whole[:20], b"no bag", whole[:200] + b"\xff" * 40 + whole[240:]):
        cut.write_bytes(bad)
        with pytest.raises(DtsaError):
            Merge([read(cut)]).summary()


def test_a_merged_flight_is_kept_as_a_bag_in_which_nothing_is_known_of_who_has_none(flight: SimpleNamespace) -> None:
    found, run = flight.merged["flight"], dtsa.open(flight.whole)
    assert json.loads((flight.whole / "summary.json").read_text())["flight"] == found
    assert "channel_load" not in found  # nobody knows how long this network's frames are on the air
    assert run.summary == found
    seen = run.ages_by_observer[run.ages_by_observer.counted]
    assert seen.age_slots.mean() == pytest.approx(found["age_mean_slots"], rel=1e-12)
    assert seen.error_m.max() == found["estimate_error_max_m"]
    page = run_data(flight.whole)
    assert page["summary"]["age_mean_slots"] == found["age_mean_slots"]
    assert page["slots"]["count"] == len(run.slots)
    assert page["distances"]["time"]
    with Reader(flight.whole / "bag") as foreign:  # rosbag2's metadata, and every message, by an independent reader
        assert foreign.message_count == sum(1 for _ in foreign.messages())
        assert {SLOT_RECORD, "/swarm/configuration", "/cf1/odom"} <= foreign.topics.keys()
    with Bag(flight.whole) as bag:
        said: dict[str, list[Any]] = {}
        for message, decoded in bag.typed():
            said.setdefault(message.topic, []).append(decoded)
    pictures = [[(one.action, one.id) for one in picture.markers] for picture in said["/swarm/markers"]]
    assert pictures[0] == [(3, 0)]  # DELETEALL: who vanishes is not left standing
    assert {agent for picture in pictures for action, agent in picture if action == 0} == {1, 2, 3}
    run = dtsa.open(flight.whole)
    assert set(run.states.agent) == set(run.decisions.agent) == {1, 2, 3}
    assert run.receptions.received[run.receptions.receiver == 4].isna().all()
    whole = run.receptions[(run.receptions.receiver < 4) & (run.receptions.slot < run.slots.slot.max() // 2)]
    assert whole.received.notna().all()
    assert (run.slots.outcome.isna() == run.slots.sender.isna()).all()
    assert set(run.slots.outcome.dropna()) == {"success"}  # whether cf4 has sent in the others nobody knows
    assert run.frames.collided.isna().all()
    page = run_data(flight.whole)
    assert any("no bag of cf4" in note for note in page["notes"])
    assert page["slots"]["unknown"] == run.slots.slot[run.slots.outcome.isna()].tolist()
    assert page["summary"]["slots"]["idle"] == 0
    assert page["table"][3].keys() & {"path", "heard"} == {"heard"}
    assert page["table"][3]["heard"] is None


def test_a_report_counts_receptions_of_agents_with_a_bag_alone(flight: SimpleNamespace, tmp_path: Path) -> None:
    """A frame of another one is known because it was heard: of such ones too many were received."""
    bags, draw = [read(path) for path in flight.bags[:2]], np.random.default_rng(1)
    for bag in bags:
        row, *others, data = bag.log.heard
        kept = np.flatnonzero(draw.random(len(row)) < 0.5)
        columns = (values[kept] for values in (row, *others))
        bag.log.heard = ReceivedFrames(*columns, [data[k] for k in kept.tolist()])
    write_merged(tmp_path / "two", Merge(bags).log, {})
    page, known = run_data(tmp_path / "two"), dtsa.open(tmp_path / "two").receptions.dropna().astype(int)
    assert set(known.sender) == {1, 2, 3}
    known = known[known.sender < 3]
    assert page["summary"]["lost_fraction"] == pytest.approx(1 - known.received.mean(), abs=1e-12)
    received = known.groupby("sender").received.mean()
    assert [row["heard"] for row in page["table"]] == [*(pytest.approx(one, abs=1e-4) for one in received), None, None]
    lost = page["channel"]["lost"]
    for place, share in known.groupby(known.slot * len(lost) // page["slots"]["count"]).received.mean().items():
        assert lost[place] == pytest.approx(1 - share, abs=1e-4)


def test_of_one_bag_nothing_is_said_that_only_others_could_say(flight: SimpleNamespace, tmp_path: Path) -> None:
    alone = Merge([read(flight.bags[0])]).log
    write_merged(tmp_path / "one", alone, {})
    page, slots = run_data(tmp_path / "one"), dtsa.open(tmp_path / "one").frames.query("sender == 1").slot
    assert alone.distances.distance_m.isna().all()
    assert alone.merged["not_on_the_time_line"] == []
    columns = zip(*(np.frombuffer(base64.b64decode(page["slots"][name]), kind) for name, kind in
                    (("slot", "<u4"), ("sender", "<u2"), ("received", "u1"))), strict=True)  # fmt: skip
    levels = {int(slot): int(level) for slot, sender, level in columns if sender == 1}
    assert levels == dict.fromkeys(slots.tolist(), 255)  # who received its frames is not known


def test_merge_keeps_the_whole_flight_or_nothing(flight, tmp_path, monkeypatch, capsys):
    """Of a bag that breaks off what is whole is kept, and nothing is made up for the rest."""
    cut = tmp_path / "cf1.mcap"
    cut.write_bytes(flight.bags[0].read_bytes()[: flight.bags[0].stat().st_size * 2 // 3])
    out, words = tmp_path / "out", ["merge", str(cut), *map(str, flight.bags[1:]), "--out", str(tmp_path / "out")]

    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dtsa_bench.log.merged_bag._Viewer.show", interrupted)
        assert main(words) == 130
        assert not out.exists()
    assert main([*words, "--json"]) == 0
    states = dtsa.open(out).states
    ends = states.groupby("agent").time_s.max()
    assert ends[1] < ends[2] - 0.1
    assert verify_bag(out).ok
    assert any("cf1 break off" in note for note in run_data(out)["notes"])
    capsys.readouterr()
    assert main(words) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("which", ["one agent's", "all in a directory"])
def test_commands_join_the_bags_of_agents_by_themselves(flight, which, tmp_path, capsys):
    given = tmp_path / "flown"
    given.mkdir()
    for path in flight.bags[: 1 if which == "one agent's" else 3]:
        (given / path.name).write_bytes(path.read_bytes())
    for words in (["verify"], ["export", "--out", str(tmp_path / "t")], ["report", "--out", str(tmp_path / "r.html")]):
        assert main([words[0], str(given), *words[1:]]) == 0, capsys.readouterr().out
    log = dtsa.open(given)
    told = [1] if which == "one agent's" else [1, 2, 3]
    assert sorted(set(log.decisions.agent)) == told
    if len(told) > 1:
        assert log.summary == flight.merged["flight"]


def test_bags_that_do_not_belong_together_are_refused(flight: SimpleNamespace) -> None:
    one = read(flight.bags[0])
    with pytest.raises(ConfigError, match="one process of cf1 at a time"):
        Merge([one, read(flight.bags[0])]).summary()
    other = read(flight.bags[1])
    other.swarm = dataclasses.replace(CONFIG, auth_session=8)
    with pytest.raises(ConfigError, match="auth_session 8, there 7"):
        Merge([one, other]).summary()
    with pytest.raises(ConfigError, match="bags"):
        Merge([]).summary()
    deaf = read(flight.bags[1])
    for bag in (one, deaf):
        bag.log.heard = bag.log.heard.part(0, 0)
    apart = Merge([one, deaf])
    with pytest.raises(ConfigError, match=r"hear each other|do not go both ways"):
        _ = apart.log


def test_offsets_and_drifts_are_found_among_frames_that_were_held_up() -> None:
    draw = np.random.default_rng(3)
    offset, drift = {1: 0, 2: 5 * 10**15, 3: -3_000_000}, {1: 0.0, 2: 60e-6, 3: -40e-6}

    def shown(agent: int, at_ns: float) -> int:
        return round(offset[agent] + at_ns * (1 + drift[agent]))

    rows = []
    for at in range(0, 20_000_000_000, 10_000_000):
        sender = int(draw.integers(1, 4))
        for receiver in {1, 2, 3} - {sender}:
            under_way = 250_000 + draw.normal(0, 5_000) + (draw.random() < 0.1) * 4_000_000
            rows.append((sender, receiver, shown(sender, at + 10**9), shown(receiver, at + 10**9 + under_way)))
    line = fit([(agent, 0) for agent in range(4)], Crossings(*np.array(rows).T), 30_000)
    found = line.summary()
    assert found["clocks"]["cf2"]["drift_ppm"] - found["clocks"]["cf1"]["drift_ppm"] == pytest.approx(60, abs=0.2)
    assert found["clocks"]["cf3"]["drift_ppm"] == pytest.approx(-40, abs=0.2)
    assert found["flight_time_us"] == pytest.approx(250, abs=2)
    assert found["frames_left_out"] == pytest.approx(len(rows) / 10, rel=0.2)
    at = 10**10
    here = [line.clocks[(agent, 0)].common_ns(shown(agent, at)) for agent in (1, 2, 3)]
    assert max(here) - min(here) < 3_000


def test_a_second_agent_of_the_same_id_hovers_and_is_silent(tmp_path: Path) -> None:
    helpers.need_multicast()
    config, udp = SwarmConfig(agents=2, policy="tdma"), UdpSettings(interface="lo", group=helpers.own_group())

    def start(id: int, name: str) -> helpers.Flying:
        agent = helpers.Flying(AgentSettings(id=id), config, udp, tmp_path / name)
        stack.callback(agent.end)
        return agent

    with ExitStack() as stack:
        first, other = start(1, "cf1.mcap"), start(2, "cf2.mcap")
        wait_for(lambda: len(first.slots) > 5 and len(other.slots) > 5)
        other.end()
        again = start(2, "again.mcap")
        wait_for(lambda: len(again.slots) > 5)  # who comes back is welcome
        wait_for(lambda: again.heard[1] > 5 and first.speed > 0.05)  # in one time, and not new
        second = start(1, "second.mcap")
        wait_for(lambda: "hovers: another agent sends as 1" in second.said)
    found = second.agent.summary()
    assert found["sent"] <= 1  # its first turn may come before it hears the other one
    assert found["never_flew"]


def test_an_agent_needs_no_ros(tmp_path: Path) -> None:
    helpers.need_multicast()
    words = ["agent", "--id", "1", "--interface", "lo", "--group", helpers.own_group(), "--no-seal"]
    words += ["--duration-s", "0.1", "--json", "--out", str(tmp_path / "cf1")]
    known = "sorted({name.partition('.')[0] for name in sys.modules} & {'rclpy', 'dtsa_msgs', 'matplotlib', 'pandas'})"
    program = (
        f"import sys; from dtsa_bench.commands import cli; code = cli.main({words!r}); print({known}); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    said, _, last = done.stdout.rstrip().rpartition("\n")
    assert (done.returncode, last) == (0, "[]"), done.stderr
    assert json.loads(said) == (summary := json.loads((tmp_path / "cf1" / "summary.json").read_text()))
    assert (summary["sealed"], summary["heard_of"]) == (False, [])


def test_a_swarm_that_is_started_again_is_judged_and_recorded_anew(tmp_path: Path) -> None:
    helpers.need_multicast()
    config, udp = SwarmConfig(agents=2, policy="tdma"), UdpSettings(interface="lo", group=helpers.own_group())
    datagrams = StationSettings(config, link_of(config, udp.properties))
    with closing(Sniffer(config, udp, tmp_path / "sniffed.mcap")) as sniffer, Stop() as stop:
        begins = time.monotonic_ns()
        for starts_ns in (begins, begins + 60_000_000_000):
            for slot in range(5, 25):
                frame = encode_frame(Frame(slot % 2 + 1, slot, 1, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
                sniffer._receive(datagrams.write(frame, slot), starts_ns + slot * config.slot_ns)
        stop.signal = 1
        sniffer.run(stop)
    found = sniffer.summary()
    assert (found["heard"], found["not_taken_in"]) == ({"cf1": 20, "cf2": 20}, {})
    assert (found["frames_judged"], found["rules_broken"]) == (40, 0)
    for name in ("sniffed.mcap", "sniffed_2.mcap"):
        assert load_log(tmp_path / name).sent.sum() == 20
        assert verify_bag(tmp_path / name).ok
