"""Integration: bags of agents over UDP between which frames go one way only, or nothing was written."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import air_helpers as helpers
import numpy as np
import pytest
from waiting import wait_for

from dtsa_agent.air.record import SlotRecord
from dtsa_agent.air.settings import AgentSettings, UdpSettings
from dtsa_agent.core import SwarmConfig
from dtsa_bench.commands.cli import main
from dtsa_bench.log.agent_bag import AgentBag, AgentRecorder, read
from dtsa_bench.log.arrays import split_log
from dtsa_bench.log.bag.errors import NothingWritten, UnusableBag
from dtsa_bench.log.merge.merge import Merge
from dtsa_bench.log.merge.timeline import Crossings, both_ways, fit
from dtsa_bench.log.merged_flight import MergedReplay, slots_until_all_known
from dtsa_bench.log.record import AGENT
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.pages.report.data import run_data

CONFIG = SwarmConfig(agents=3, policy="lease", slot_ms=20.0, open_every=0, adoption=False)
DELAY_S = 0.1
MS = 1_000_000


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """cf1 and cf2 hear each other; cf3 hears them after 100 ms, and nobody hears cf3."""
    helpers.need_multicast()
    directory = tmp_path_factory.mktemp("one_way")
    near, far = helpers.own_group(), helpers.own_group()
    ports = [UdpSettings(interface="lo", group=group) for group in (near, near, far)]
    carrier = helpers.Carrier(near, far, DELAY_S, back=False)
    try:
        with helpers.flying(CONFIG, ports, directory) as (first, second, third):
            heard = (first.heard, 2), (second.heard, 1), (third.heard, 1), (third.heard, 2)
            wait_for(lambda: all(frames[sender] > 20 for frames, sender in heard), 60.0)
            helpers.go_on([third], 100)
    finally:
        carrier.end()
    return [directory / f"cf{agent}.mcap" for agent in (1, 2, 3)]


def _merged(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, dict[str, Any], str]:
    code = main(["merge", *map(str, words), "--json"])
    said = capsys.readouterr()
    return code, json.loads(said.out) if said.out else {}, said.err


def test_between_groups_that_hear_one_way_no_offset_is_made_up(bags, tmp_path, capsys):
    code, found, said = _merged(capsys, *bags, "--out", tmp_path / "whole")
    assert code == 1
    assert found["not_determined"] == [["cf1", "cf2"], ["cf3"]]
    assert found["not_on_the_time_line"] == ["cf3"]
    assert said.count("\n") == 1
    assert "not determined: frames do not go both ways between cf1, cf2 | cf3" in said
    assert found["time_line"]["clocks"].keys() == {"cf1", "cf2"}  # all clocks are one here
    assert abs(found["time_line"]["clocks"]["cf2"]["offset_ms"]) < 2.0
    verified = verify_bag(tmp_path / "whole")
    assert not verified.ok
    assert "cf1, cf2 | cf3" in str(verified.difference)
    assert any("the others: cf3." in note for note in run_data(tmp_path / "whole")["notes"])


def test_two_agents_of_which_one_is_deaf_have_no_time_line(bags, tmp_path, capsys):
    code, found, said = _merged(capsys, bags[0], bags[2])
    assert code == 1
    assert found["not_determined"] == [["cf1"], ["cf3"]]
    assert "cf1 | cf3" in said
    assert (found["time_line"]["clocks"], found["time_line"]["flight_time_us"]) == ({}, None)
    assert (found["common_slot"], found["flight"]) == (None, None)
    assert found["clock_spread_ms"] == {"mean": None, "max": None, "end": None}
    code, _, said = _merged(capsys, bags[0], bags[2], "--out", tmp_path / "whole")
    assert code == 2
    assert (said.count("\n"), "cf1 | cf3" in said) == (1, True)
    assert not (tmp_path / "whole").exists()


def test_an_agent_that_wrote_nothing_is_named_and_the_others_are_merged(bags, tmp_path, capsys):
    empty, killed, begun = (tmp_path / name for name in ("cf3", "killed", "begun"))
    for directory in (empty, killed, begun):
        directory.mkdir()
    (killed / "cf3.mcap").touch()
    with AgentRecorder(tmp_path / "begun.mcap", AgentSettings(id=3), CONFIG, UdpSettings(interface="lo")):
        (begun / "cf3.mcap").write_bytes((tmp_path / "begun.mcap").read_bytes())  # killed before its first slot
    whole = tmp_path / "whole"
    code, found, said = _merged(capsys, bags[0], empty, bags[1], killed, begun, "--out", whole)
    assert code == 0, said
    assert found["nothing_written"] == [str(empty), str(killed), str(begun)]
    assert (found["bags"], found["missing"], found["not_determined"]) == (2, [3], [])
    lines = zip(said.splitlines(), found["nothing_written"], strict=True)
    assert all(path in line for line, path in lines)
    assert found["flight"]["pairs_known_share"] is not None
    assert verify_bag(whole).ok
    assert any(str(empty) in note for note in run_data(whole)["notes"])
    with pytest.raises(NothingWritten, match=r"holds no \.mcap file"):
        read(empty)
    for words in ([empty], [begun], [empty, killed], [bags[0], tmp_path / "never"]):
        code, _, said = _merged(capsys, *words)
        assert (code, said.count("\n")) == (2, 1)


def test_frames_of_a_process_that_wrote_nothing_are_no_lies(bags, tmp_path, capsys):
    """cf2 was killed before it wrote, and its frames were heard; then it came back, and was heard, too."""
    later = read(bags[1])
    later.log = split_log(later.log, later.log.first_slot + len(later.log) // 2)
    assert Merge([read(bags[0]), later]).summary()["frames_heard_not_as_sent"] > 0
    assert Merge([read(bags[0]), later], ["runs/cf2"]).summary()["frames_heard_not_as_sent"] == 0


def test_frames_of_a_time_that_was_given_up_are_no_lies_in_the_merged_bag(bags: list[Path]) -> None:
    """It holds only the time of all: what cf2 sent before it took that over is heard, and not known as sent."""
    later = read(bags[1])
    later.log = split_log(later.log, later.log.first_slot + len(later.log) // 2)
    log = Merge([read(bags[0]), later]).log
    assert MergedReplay(log).count_unmatched_frames() > 0
    for agents, is_right in (([2], True), ([1], False)):
        log.merged["agents_that_gave_up_a_time"] = agents
        assert (MergedReplay(log).count_unmatched_frames() == 0) == is_right
    log.merged["count"] = 9  # of a bag from elsewhere
    assert "Merged from 2 agents' bags." in MergedReplay(log).run().notes[0]


def test_an_outage_is_seen_beside_the_mean_age(bags: list[Path]) -> None:
    ones = [read(path) for path in bags[:2]]
    together = Merge(ones)
    before, near = together.summary()["flight"], together.log.distances.set_index("time_s").distance_m
    until_s = before["min_distance_time_s"] + 1e-6  # the end of a slot, as in the tables counted from slot 0
    assert near[until_s - CONFIG.slot_s : until_s].min() == pytest.approx(before["min_distance_m"])
    log = ones[1].log
    first, last = log.first_slot, log.first_slot + len(log) - 1
    since = first + (last - first) // 2
    assert last - since > 2 * slots_until_all_known(CONFIG)
    log.heard = log.heard.part(0, since - first)  # cf2 heard nothing in the second half
    after = Merge(ones).summary()["flight"]
    assert before["heard_age_max_slots"] < after["heard_age_max_slots"] <= last - since + before["heard_age_max_slots"]
    assert after["heard_age_max_slots"] > (last - since) * 0.8
    assert after["heard_age_max_pair"] == [2, 1]
    assert after["heard_age_max_ms"] == after["heard_age_max_slots"] * CONFIG.slot_ms
    assert before["pairs_known_share"] > 0.95  # one that has heard nobody yet leaves out half of its frames
    assert 0.5 < after["pairs_known_share"] < 1.0


PROCESSES = [(agent, 0) for agent in range(6)]


def _crossings(delays_ns: dict[tuple[int, int], int], frames: int = 400) -> Crossings:
    """Frames among agents whose clocks are one and the same."""
    draw = np.random.default_rng(5)
    rows = [
        (sender, receiver, at * 10 * MS, at * 10 * MS + under_way + int(draw.normal(0, 5_000)))
        for at in range(frames)
        for (sender, receiver), under_way in delays_ns.items()
    ]
    return Crossings(*np.array(rows, np.int64).reshape(-1, 4).T)


def test_clocks_are_fit_within_groups_connected_both_ways() -> None:
    """Frames from cf1 and cf2 to cf3 and cf4 take 100 ms; back there are none."""
    slow = {(sender, receiver): 100 * MS for sender in (1, 2) for receiver in (3, 4)}
    near = dict.fromkeys([(1, 2), (2, 1), (3, 4), (4, 3)], 184_000)
    line = fit(PROCESSES, _crossings(near | slow), 30_000)
    assert list(line.groups) == [((1, 0), (2, 0)), ((3, 0), (4, 0))]
    assert line.clocks.keys() == {(1, 0), (2, 0)}
    assert line.flight_ns == pytest.approx(184_000, abs=2_000)
    lone = fit(PROCESSES, _crossings({(1, 2): 100 * MS}), 30_000)
    assert (dict(lone.clocks), lone.summary()["flight_time_us"]) == ({}, None)
    ring = {(1, 2): MS, (2, 3): MS, (3, 1): MS}
    assert both_ways(6, _crossings(ring, 3)) == [(1, 2, 3)]
    line = fit(PROCESSES, _crossings(ring), 30_000)
    assert line.flight_ns == pytest.approx(MS, abs=5_000)
    assert all(abs(clock.offset_ns + clock.coarse_ns - line.clocks[(1, 0)].coarse_ns) < 5_000
               for clock in line.clocks.values())  # fmt: skip
    assert both_ways(6, _crossings(ring | {(4, 1): MS, (4, 5): MS, (5, 4): MS}, 3)) == [(1, 2, 3), (4, 5)]
    assert both_ways(6, _crossings({})) == []
    many = _crossings({(1, 2): MS}, 90_001)
    back = np.array([2, 1, 5 * MS, 6 * MS])
    line = fit(PROCESSES, Crossings(*np.insert(np.array(many), 7, back, axis=1)), 30_000)
    assert line.clocks.keys() == {(1, 0), (2, 0)}
    assert line.flight_ns == pytest.approx(MS, abs=50_000)


def _recorded(
    path: Path, slots: list[int], steps: int = CONFIG.steps, about: dict[str, Any] | None = None,
    again: int = 1 << 62, off: int = 0,
) -> AgentBag:  # fmt: skip
    """The bag of an agent that took over another time wherever its slots count back; `about`: other values of it.

    With slot `again` it restarts, too, in a time whose slots start so many slots earlier than they would have.
    """
    zero, track = np.zeros(3), np.zeros((steps, 3))
    with AgentRecorder(path, AgentSettings(id=1), CONFIG, UdpSettings(interface="lo")) as recorder:
        for at, slot in enumerate(slots):
            is_first = at == 0 or slot < slots[at - 1] or slot == again
            start_ns = (slot - off * (slot >= again)) * CONFIG.slot_ns
            recorder.slot(SlotRecord(slot, start_ns, is_first, 1, 0, 0, 0, 0.0, track, zero, zero, zero))
        custom = recorder._bag.custom_data
        custom[AGENT] = json.dumps(json.loads(custom[AGENT]) | (about or {}))
    return read(path)


def test_slots_of_times_that_were_given_up_are_kept_apart(tmp_path: Path) -> None:
    """Two processes of an agent, each of which took over a time with smaller slot numbers."""
    slots_of = {"a.mcap": [70, 71, 3, 4], "b.mcap": [90, 91, 80, 5, 6]}
    bags = [_recorded(tmp_path / name, slots) for name, slots in slots_of.items()]
    slots = {key: np.flatnonzero(bag.log.known) + bag.log.first_slot for key, bag in Merge(bags).processes.items()}
    assert {key: values.tolist() for key, values in slots.items()} == {
        (1, 0): [3, 4], (1, 1): [5, 6], (1, -1): [70, 71], (1, -2): [80], (1, -3): [90, 91],
    }  # fmt: skip


def test_a_time_that_was_given_up_is_kept_apart_whatever_its_numbers(tmp_path: Path) -> None:
    """An agent that was alone, and came to hear a swarm that had flown for months; or that only stood still."""
    last = 1 << 30
    bag = _recorded(tmp_path / "cf1.mcap", [3, 4, 5, last, last + 1], again=last, off=last - 6)
    assert bag.slots.tolist() == [last, last + 1]
    assert [(len(log), log.first_slot) for log in bag.earlier] == [(3, 3)]
    assert Merge([bag]).summary()["slots_of_times_given_up"] == 3
    bag = _recorded(tmp_path / "cf2.mcap", [3, 4, 5, 9000], again=9000)
    assert (bag.slots.tolist(), bag.earlier) == ([3, 4, 5, 9000], [])


def test_frames_of_times_that_were_given_up_are_sent_and_share_no_slot_with_others(bags: list[Path]) -> None:
    ones = [read(path) for path in bags[:2]]
    before = Merge(ones).summary()
    for one in ones:
        one.earlier.append(ones[1].log)  # frames with the slot numbers of those of cf2
    after = Merge(ones).summary()
    assert after["frames_sent"] == before["frames_sent"] + 2 * len(ones[1].log.sent_frames.row)
    shared = ("slots_with_two_senders", "slots_with_two_senders_before")
    assert [after[name] for name in shared] == [before[name] for name in shared]


@pytest.mark.parametrize(("last", "is_read"), [(100_000, True), (1 << 30, False)])
def test_an_agent_may_stand_still_for_longer_than_it_flew(tmp_path: Path, last: int, is_read: bool) -> None:
    slots = [3, 4, 5, last]
    with nullcontext() if is_read else pytest.raises(UnusableBag):
        bag = _recorded(tmp_path / "cf1.mcap", slots)
        assert bag.slots.tolist() == slots
        assert Merge([bag]).log.known.sum() == len(slots)


@pytest.mark.parametrize("about", [
    {"zero_ns": 1 << 70}, {"zero_ns": 1 << 62}, {"zero_ns": float("inf")}, {"started_ns": -(1 << 70)},
    {"started_ns": 1 << 62}, {"port": {"name": "udp", "byte_time_ns": None}},
    {"port": {"name": "udp", "turn_ns": 1 << 70}},
])  # fmt: skip
def test_times_that_no_clock_or_port_has_are_refused(tmp_path: Path, about: dict[str, Any]) -> None:
    with pytest.raises(UnusableBag, match="what it says of its agent cannot be read"):
        _recorded(tmp_path / "cf1.mcap", [3, 4], about=about)


def test_other_control_instants_than_those_of_the_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnusableBag, match=f"control instants a slot, not {CONFIG.steps}"):
        _recorded(tmp_path / "cf1.mcap", [3, 4], steps=CONFIG.steps + 1)
