"""Integration: agents over simulated Crazyradios on one air: bags merged and judged, and a listener."""

from __future__ import annotations

import json
import os
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import air_helpers as helpers
import pytest
from waiting import wait_for

pytest.importorskip("usb")

from dtsa_agent.air.crazyradio import CrazyradioSettings
from dtsa_agent.air.crazyradio.packets import broadcast, datagram_in
from dtsa_agent.air.datagram import link_of
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.station import StationSettings
from dtsa_agent.keys import authenticator
from dtsa_bench.commands.cli import main
from dtsa_bench.crazyflies.peer_lab.app import LabSettings
from dtsa_bench.crazyflies.peer_lab.compiling import compiler
from dtsa_bench.crazyflies.peer_lab.onboard import OnBoard
from dtsa_bench.crazyflies.simulated.process import running_fleet
from dtsa_bench.pages.view.network_listener import NetworkListener
from dtsa_bench.pages.view.track import MOST_MOMENTS, Track
from dtsa_bench.recordings.merge.agent_bag import read
from dtsa_bench.recordings.merge.merge import Merge, verified
from dtsa_bench.recordings.merge.merged_run import lay
from dtsa_bench.recordings.merge.merged_writer import write
from dtsa_bench.recordings.verify import verify_bag

KEY = "8f3c1d5e7a9b2460c1e3f5a7b9d8c6e4"
# Nothing but an owner or its one lessee may send: no two in a slot, whatever is lost.
CONFIG = SwarmConfig(agents=4, policy="lease", slot_ms=20.0, open_every=0, adoption=False, auth=True, auth_session=7)
AGENTS = (1, 2, 3, 4)
OFFSET_NS = 700_000_000


def dongles(path: Path, *options: str) -> Any:
    """Simulated Crazyradios in a process of their own."""
    return running_fleet(["--dongles-only", "--simulated-radio", str(path), *options])


def settings(path: Path, radio: int) -> CrazyradioSettings:
    """One of them."""
    return CrazyradioSettings(uri=f"radio://{radio}/80/2M", simulated_radio=str(path))


@pytest.fixture(scope="module", autouse=True)
def key() -> Iterator[None]:
    """The key of the swarm."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DTSA_AUTH_KEY", KEY)
        yield


@dataclass
class Flight:
    """All agents, and one who listens."""

    bags: list[Path]
    summaries: dict[int, dict[str, Any]]
    said: list[str]
    merged: dict[str, Any]
    whole: Path  # directory with the merged bag
    sniffed: dict[str, Any]
    heard: Path  # bag of the listener
    told: list[dict[str, Any]]  # what a page gets of one who listens


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory, key: None) -> Flight:
    """Agents start one after the other, with clocks that differ."""
    directory = tmp_path_factory.mktemp("crazyradio")
    radio, heard = directory / "radio", directory / "sniffed.mcap"
    paths = [directory / f"cf{agent}.mcap" for agent in AGENTS]
    flying: list[helpers.Flying] = []
    with dongles(radio, "--radio-dongles", "6"):
        track = Track("listener")
        source = NetworkListener(track, CONFIG, settings(radio, 5))
        listening = threading.Thread(target=source.run)
        listening.start()
        sniffing = helpers.Sniffing(CONFIG, settings(radio, 4), heard)
        sniffing.start()
        try:
            for agent, path in zip(AGENTS, paths, strict=True):
                own = AgentSettings(id=agent, clock_offset_ns=OFFSET_NS * agent, clock_drift_ppb=20_000 * (agent - 2))
                flying.append(helpers.Flying(own, CONFIG, settings(radio, agent - 1), path))
            wait_for(lambda: all(len(one.heard) == 3 and min(one.heard.values()) > 10 for one in flying))
            seen = [len(one.slots) for one in flying]
            wait_for(lambda: all(len(one.slots) > before + 100 for one, before in zip(flying, seen, strict=True)))
        finally:
            for one in flying:
                one.end()
            sniffed = sniffing.end()
            source.stopped = True
            listening.join()
    together = Merge([read(path) for path in reversed(paths)])
    merged, whole = together.judge(), directory / "whole"
    write(whole, lay(together, merged), merged)
    summaries = {one.agent.own.id: one.agent.summary() for one in flying}
    said = [line for one in flying for line in one.said]
    told = [json.loads(moment.text) for moment in track.since(0, MOST_MOMENTS)[1]]
    return Flight(paths, summaries, said, merged, whole, sniffed, heard, told)


def test_agents_become_one_group_and_hear_each_other(flight: Flight) -> None:
    assert flight.merged["common_slot"] is not None
    assert flight.merged["missing"] == []
    for agent, summary in flight.summaries.items():
        assert summary["state"] == "joined"
        assert summary["heard_of"] == [other for other in AGENTS if other != agent]
        assert (summary["dropped_by_dongle"], summary["garbled_transfers"], summary["strange_stamps"]) == (0, 0, 0)
    assert [line for line in flight.said if not line.startswith(("flies: ", "is new", "listens"))] == []


def test_nobody_speaks_in_the_turn_of_another(flight: Flight) -> None:
    assert flight.merged["slots_with_two_senders"] == 0
    assert flight.merged["frames_sent"] > 60


def test_the_same_receptions_give_the_same_decisions(flight: Flight) -> None:
    again = flight.merged["decisions_again"]
    assert again["differences"] == []
    assert again["equal"] == again["of"] > 300
    assert flight.merged["frames_heard_not_as_sent"] == 0
    assert verified(flight.merged)
    assert verify_bag(flight.whole).to_dict()["difference"] is None


def test_stamps_of_the_dongles_tell_when_frames_arrived(flight: Flight) -> None:
    """A dongle sends up to a millisecond after it was told to; no more than that is left of the equations."""
    line = flight.merged["time_line"]
    assert flight.merged["not_on_the_time_line"] == []
    for agent in AGENTS[1:]:
        assert line["clocks"][f"cf{agent}"]["offset_ms"] == pytest.approx(OFFSET_NS / 1e6 * (agent - 1), abs=3.0)
    assert line["residual_us"]["p50"] < 1000


def test_bags_say_by_what_port(flight: Flight) -> None:
    assert {read(path).port.name for path in flight.bags} == {"crazyradio"}


def test_who_only_listens_finds_that_all_keep_the_rules(flight: Flight) -> None:
    found = flight.sniffed
    assert found["heard"].keys() == {f"cf{agent}" for agent in AGENTS}
    assert (found["rules_broken"], found["slots_with_two_senders"]) == (0, 0), found["which"]
    assert found["dropped_by_dongle"] == 0


def test_a_page_is_told_who_is_heard(flight: Flight) -> None:
    words = "\n".join(event[2] for moment in flight.told for event in moment["events"])
    assert all(f"cf{agent} is heard" in words for agent in AGENTS)


@pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler")
@pytest.mark.parametrize("auth", [True, False])
def test_a_computer_reads_what_the_app_on_board_says(auth: bool, tmp_path: Path) -> None:
    """On its port, with its header or its tag; and its own frames are such ones."""
    swarm = SwarmConfig(agents=3, policy="lease", auth=auth, auth_session=3 if auth else 0)
    with OnBoard(swarm, LabSettings(), tmp_path, key=bytes.fromhex(KEY) if auth else b"", enable_s=6.0) as flight:
        flight.lab.run(5.0)
        port = flight.lab.parameter(1, "dtsa.port")
        flight.finish()
    heard = CrazyradioSettings(uri="radio://0/80/2M")
    assert port == heard.p2p_port
    datagrams = StationSettings(swarm, link_of(swarm, heard.properties), authenticator(swarm))
    said = [record for k in (1, 2, 3) for record in read(tmp_path / f"cf{k}.mcap").slots if record.datagram]
    assert len(said) > 100
    for record in said:
        datagram = datagram_in(broadcast(record.datagram, heard.p2p_port)[5:], heard.p2p_port)
        assert datagram is not None
        told = datagrams.read(datagram)
        assert (told.fault, told.slot, told.frame) == ("", record.slot, record.frame)
    last = said[-1]
    assert datagrams.write(last.frame, last.slot, told.late_ns) == last.datagram


def test_a_dongle_that_goes_and_is_back_is_said_and_flies_on(tmp_path: Path) -> None:
    radio = tmp_path / "radio"
    flying: list[helpers.Flying] = []
    try:
        with dongles(radio, "--radio-dongles", "2"):
            for agent in (1, 2):
                path = tmp_path / f"cf{agent}.mcap"
                flying.append(helpers.Flying(AgentSettings(id=agent), CONFIG, settings(radio, agent - 1), path))
            wait_for(lambda: all(one.heard.total() > 10 for one in flying))
        wait_for(lambda: all(any("has gone" in line for line in one.said) for one in flying))
        with dongles(radio, "--radio-dongles", "2"):
            wait_for(lambda: all(any("is back" in line for line in one.said) for one in flying))
            before = [one.heard.total() for one in flying]
            wait_for(lambda: all(one.heard.total() > b + 10 for one, b in zip(flying, before, strict=True)))
            for one in flying:
                one.end()
    finally:
        for one in flying:
            one.end()
    assert {one.agent.summary()["times_unplugged"] for one in flying} == {1}
    assert "crazyradio" not in {thread.name for thread in threading.enumerate()}
    merged = Merge([read(tmp_path / f"cf{agent}.mcap") for agent in (1, 2)]).judge()
    assert merged["decisions_again"]["differences"] == []


@pytest.mark.parametrize(("words", "line"), [
    (["--uri", "radio://5/80/2M"], "plugged in; there are 1"),
    (["--uri", "radio://0/80/2M", "--slot-ms", "8"], "slot_ms"), (["--uri", "radio://0/80/250K"], "rate 1M or 2M"),
    ([], "uri"),
    (["--uri", "radio://0/80/2M", "--interface", "lo"], "interface: got 'lo'; allowed: one of the settings"),
])  # fmt: skip
def test_bad_input_is_one_line(
    tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str], words: list[str], line: str
) -> None:
    radio = tmp_path_factory.mktemp("bad") / "radio"
    with dongles(radio, "--radio-dongles", "1"):
        command = ["agent", "--air", "crazyradio", "--simulated-radio", str(radio), "--id", "1", "--agents", "2"]
        assert main([*command, "--auth-session", "1", "--slot-ms", "20", "--duration-s", "1", *words]) == 2
    said = capsys.readouterr().err
    assert line in said
    assert said.count("\n") == 1


def test_a_dongle_in_use_and_an_old_one_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    radio = tmp_path / "radio"
    command = ["sniff", "--air", "crazyradio", "--simulated-radio", str(radio), "--uri", "radio://0/80/2M"]
    command += ["--agents", "2", "--auth-session", "1", "--duration-s", "0.1"]
    with dongles(radio, "--radio-dongles", "1"):
        sniffing = helpers.Sniffing(CONFIG, settings(radio, 0))
        try:
            assert main(command) == 2
            assert "no other program" in capsys.readouterr().err
        finally:
            sniffing.end()
        assert main(command) == 0
    with dongles(radio, "--radio-dongles", "1", "--radio-device", "pa"):
        assert main(command) == 2
        assert "firmware 5.4 or later" in capsys.readouterr().err
    assert main(command) == 2
    assert "simulated_radio" in capsys.readouterr().err
    assert not os.path.exists(radio)
