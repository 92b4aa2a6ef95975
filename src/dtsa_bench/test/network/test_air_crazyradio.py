"""Integration: agents over simulated Crazyradios on one air: bags merged and judged, and a listener."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import air_helpers as helpers
import pytest
from waiting import wait_for

pytest.importorskip("usb")

from dtsa_agent.air.crazyradio_port import broadcast, datagram_in
from dtsa_agent.air.port import frame_in, link_of
from dtsa_agent.air.settings import CrazyradioSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_agent.core.station import StationSettings
from dtsa_agent.keys import authenticator
from dtsa_bench.commands.cli import main
from dtsa_bench.crazyflies.peer_lab.app import LabSettings
from dtsa_bench.crazyflies.peer_lab.compiling import compiler
from dtsa_bench.crazyflies.peer_lab.onboard import OnboardSwarm
from dtsa_bench.crazyflies.simulated.process import running_fleet
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.merge.merge import Merge

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


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory, key: None) -> SimpleNamespace:
    """Agents start one after the other, with clocks that differ."""
    directory = tmp_path_factory.mktemp("crazyradio")
    radio, heard = directory / "radio", directory / "sniffed.mcap"
    ports = [settings(radio, agent - 1) for agent in AGENTS]
    with dongles(radio, "--radio-dongles", "6"), helpers.listening(CONFIG, settings(radio, 5)) as told:
        sniffing = helpers.Sniffing(CONFIG, settings(radio, 4), heard)
        sniffing.start()
        try:
            with helpers.flying(CONFIG, ports, directory, own) as flying:
                helpers.hear_each_other(flying, 10)
                helpers.go_on(flying, 100)
        finally:
            sniffed = sniffing.end()
    paths = [directory / f"cf{agent}.mcap" for agent in AGENTS]
    _, merged = helpers.merge_bags(reversed(paths), directory / "whole")
    summaries = {one.agent.own.id: one.agent.summary() for one in flying}
    said = [line for one in flying for line in one.said]
    return SimpleNamespace(
        bags=paths, summaries=summaries, said=said, merged=merged, whole=directory / "whole", sniffed=sniffed,
        heard=heard, told=told(),
    )  # fmt: skip


def own(agent: int) -> dict[str, int]:
    return {"clock_offset_ns": OFFSET_NS * agent, "clock_drift_ppb": 20_000 * (agent - 2)}


def test_agents_become_one_group_on_one_time_line_and_keep_the_rules(flight: SimpleNamespace) -> None:
    helpers.check_merged(flight.merged, flight.whole, 300)
    assert flight.merged["missing"] == []
    for agent, summary in flight.summaries.items():
        assert (summary["state"], summary["heard_of"]) == ("joined", [k for k in AGENTS if k != agent])
        assert (summary["dropped_by_dongle"], summary["garbled_transfers"], summary["strange_stamps"]) == (0, 0, 0)
    assert [line for line in flight.said if not line.startswith(("flies: ", "is new", "listens"))] == []
    assert {read(path).port.name for path in flight.bags} == {"crazyradio"}
    # A dongle sends up to a millisecond after it was told to; no more than that is left of the equations.
    line = flight.merged["time_line"]
    assert flight.merged["not_on_the_time_line"] == []
    for agent in AGENTS[1:]:
        assert line["clocks"][f"cf{agent}"]["offset_ms"] == pytest.approx(OFFSET_NS / 1e6 * (agent - 1), abs=3.0)
    assert line["residual_us"]["p50"] < 1000
    found = flight.sniffed
    assert found["heard"].keys() == {f"cf{agent}" for agent in AGENTS}
    assert (found["rules_broken"], found["slots_with_two_senders"]) == (0, 0), found["which"]
    assert found["dropped_by_dongle"] == 0
    words = "\n".join(event[2] for moment in flight.told for event in moment["events"])
    assert all(f"cf{agent} is heard" in words for agent in AGENTS)


@pytest.mark.skipif(shutil.which(compiler()[0]) is None, reason="no C compiler")
@pytest.mark.parametrize("auth", [True, False])
def test_a_computer_reads_what_the_app_on_board_says(auth: bool, tmp_path: Path) -> None:
    """On its port, with its header or its tag; and its own frames are such ones."""
    swarm = SwarmConfig(agents=3, policy="lease", auth=auth, auth_session=3 if auth else 0)
    with OnboardSwarm(swarm, LabSettings(), tmp_path, key=bytes.fromhex(KEY) if auth else b"", enable_s=6.0) as flight:
        flight.lab.run(5.0)
        port = flight.lab.parameter(1, "dtsa.port")
    heard = CrazyradioSettings(uri="radio://0/80/2M")
    assert port == heard.p2p_port
    datagrams = StationSettings(swarm, link_of(swarm, heard.properties), authenticator(swarm))
    logs = [read(tmp_path / f"cf{k}.mcap").log for k in (1, 2, 3)]
    said = [
        (log.first_slot + row, data)
        for log in logs
        for row, data in zip(log.sent_frames.row.tolist(), log.sent_frames.data, strict=True)
    ]
    assert len(said) > 100
    for slot, sent in said:
        datagram = datagram_in(broadcast(sent, heard.p2p_port)[5:], heard.p2p_port)
        assert datagram is not None
        told = datagrams.read(datagram)
        frame = frame_in(sent, swarm)
        assert (told.fault, told.slot, told.frame) == ("", slot, frame[: len(frame) - (TAG_LENGTH if auth else 0)])
    assert datagrams.write(told.frame, told.slot, told.late_ns) == said[-1][1]


def test_a_dongle_that_goes_and_is_back_is_said_and_flies_on(tmp_path: Path) -> None:
    radio = tmp_path / "radio"
    with ExitStack() as stack:
        with dongles(radio, "--radio-dongles", "2"):
            ports = [settings(radio, 0), settings(radio, 1)]
            flying = stack.enter_context(helpers.flying(CONFIG, ports, tmp_path))
            wait_for(lambda: all(one.heard.total() > 10 for one in flying))
        wait_for(lambda: all(any("has gone" in line for line in one.said) for one in flying))
        with dongles(radio, "--radio-dongles", "2"):
            wait_for(lambda: all(any("is back" in line for line in one.said) for one in flying))
            before = [one.heard.total() for one in flying]
            wait_for(lambda: all(one.heard.total() > b + 10 for one, b in zip(flying, before, strict=True)))
            stack.close()
    assert {one.agent.summary()["times_unplugged"] for one in flying} == {1}
    assert "dongle" not in {thread.name for thread in threading.enumerate()}
    merged = Merge([read(tmp_path / f"cf{agent}.mcap") for agent in (1, 2)]).summary()
    assert merged["decisions_again"]["differences"] == []


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
        assert main([*command, "--uri", "radio://5/80/2M"]) == 2
        assert "plugged in; there are 1" in capsys.readouterr().err
    with dongles(radio, "--radio-dongles", "1", "--radio-device", "pa"):
        assert main(command) == 2
        assert "firmware 5.4 or later" in capsys.readouterr().err
    assert main(command) == 2
    assert "simulated_radio" in capsys.readouterr().err
    assert not os.path.exists(radio)
