"""Integration: agents over simulated modems on pseudo terminals, whose air is the medium of the simulator."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import air_helpers as helpers
import pytest
import serial
from dtsa_dev.network.fake_modems import FakeModems, FakeModemSettings
from waiting import wait_for

from dtsa_agent.air.serial_port import SerialPort
from dtsa_agent.air.settings import SerialSettings
from dtsa_agent.core import SwarmConfig
from dtsa_bench.commands.cli import main
from dtsa_bench.pages.report.data import run_data
from dtsa_bench.pages.view.history import RunHistory
from dtsa_bench.pages.view.network_listener import NetworkListener

# Nothing but an owner or its one lessee may send: no two in a slot, whatever is lost.
CONFIG = SwarmConfig(agents=3, policy="lease", slot_ms=50.0, open_every=0, adoption=False)
QUICK = FakeModemSettings(modem="esp-now", count=4)
LISTENER = 4


@contextmanager
def modems(settings: FakeModemSettings, directory: Path, **channel: Any) -> Iterator[FakeModems]:
    """Modems, and the air between them."""
    with FakeModems(settings, FakeModems.channel(settings.count, **channel), directory) as made:
        yield made


def port_settings(made: FakeModems, number: int) -> SerialSettings:
    """What an agent says of a modem."""
    kind = made.settings
    return SerialSettings(device=str(made.devices[number - 1]), baud=kind.line_baud, modem=kind.modem)


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    directory = tmp_path_factory.mktemp("serial")
    with modems(QUICK, directory, loss=0.05, seed=3) as made:
        ports = [port_settings(made, agent) for agent in (1, 2, 3)]
        sniffing = helpers.Sniffing(CONFIG, port_settings(made, LISTENER))
        try:
            with helpers.flying(CONFIG, ports, directory, own) as flying:
                helpers.hear_each_other(flying, 5)
                sniffing.start()
                helpers.go_on(flying, 60)
                made.unplug(2)
                wait_for(lambda: any("has gone" in line for line in flying[1].said))
                helpers.go_on(flying, 20)
                made.plug(2)
                wait_for(lambda: any("is back" in line for line in flying[1].said))
                made.set(partition=[[1, 2, 4], [3]])
                helpers.go_on(flying, 30)
                made.set(partition="")
                helpers.go_on(flying, 100)
        finally:
            sniffed = sniffing.end()
        history = RunHistory("listener")
        source = NetworkListener(history, CONFIG, port_settings(made, LISTENER))
        source.stopped = True
        source.run()
    _, merged = helpers.merge_bags([directory / f"cf{agent}.mcap" for agent in (1, 2, 3)], directory / "whole")
    return SimpleNamespace(agents=flying, sniffed=sniffed, shown=history.name, merged=merged, whole=directory / "whole")


def own(agent: int) -> dict[str, int]:
    return {"clock_offset_ns": agent * 10**9, "clock_drift_ppb": 30_000 * (agent - 2)}


def test_groups_become_one_flight_in_which_all_keep_the_rules(flight: SimpleNamespace) -> None:
    helpers.check_merged(flight.merged, flight.whole, 200)
    assert run_data(flight.whole)["slots"]["count"] > 100
    for one in flight.agents:
        found = one.agent.summary()
        assert found["state"] == "joined"
        assert found["dropped_by_computer"] == 0
        assert found["arrivals_off_ms"].keys() == {"p50", "p99", "max"}
    assert flight.agents[1].agent.summary()["times_unplugged"] == 1
    assert flight.agents[1].agent.summary()["unsent_because"].keys() <= {"the device is not there", "too late"}
    assert flight.sniffed["heard"].keys() == {"cf1", "cf2", "cf3"}
    assert flight.sniffed["slots_with_two_senders"] == 0  # it misses frames: of rules it cannot be sure
    assert flight.shown == "listener"


@contextmanager
def three_ports(made: FakeModems) -> Iterator[list[SerialPort]]:
    with ExitStack() as stack:
        yield [stack.enter_context(SerialPort(port_settings(made, number))) for number in (1, 2, 3)]


def test_packets_that_overlap_are_lost_and_a_modem_that_sends_is_deaf(tmp_path: Path) -> None:
    with modems(FakeModemSettings(modem="e22-19k", count=3), tmp_path) as made, three_ports(made) as ends:
        assert ends[0].send(b"one") == ""
        wait_for(lambda: made.counts["received"] == 2)
        with made._lock:  # both are read at one time
            assert ends[0].send(b"two") == ends[1].send(b"three") == ""
        wait_for(lambda: made.counts["packets"] == 3)
        wait_for(lambda: made.counts["collided"] == 4)
        assert made.counts["received"] == 2
        got: list[list[bytes]] = [[], [], []]
        wait_for(lambda: gather(ends, got) == [[], [b"one"], [b"one"]])


def gather(ends: list[SerialPort], got: list[list[bytes]]) -> list[list[bytes]]:
    """What has come out of the modems so far."""
    for found, end in zip(got, ends, strict=True):
        found.extend(datagram.data for datagram in end.receive(16))
    return got


def test_modems_with_a_time_division_of_their_own_take_turns(tmp_path: Path) -> None:
    with modems(FakeModemSettings(modem="sik-64k", count=3), tmp_path) as made, three_ports(made) as ends:
        with made._lock:
            for number, end in enumerate(ends):
                assert end.send(bytes([number]) * 60) == ""
        wait_for(lambda: made.counts["received"] == 6)
        assert (made.counts["packets"], made.counts["collided"]) == (3, 0)


def test_a_line_of_another_speed_garbles_what_goes_over_it(tmp_path: Path) -> None:
    with modems(FakeModemSettings(modem="esp-now", count=2), tmp_path) as made:
        wrong = SerialSettings(device=str(made.devices[0]), baud=9600)
        with SerialPort(wrong) as one, SerialPort(port_settings(made, 2)) as other:
            for _ in range(3):
                one.send(b"unheard")
                time.sleep(0.05)  # else they overlap
                other.send(b"unheard")
                time.sleep(0.05)
            wait_for(lambda: made.counts["received"] >= 2)
            wait_for(lambda: other.counts()["garbled_bytes"] > 0 or other.counts()["garbled_pieces"] > 0)
            assert one.receive(16) == other.receive(16) == []


def test_echoes_garbage_and_late_bytes_lose_no_frame(tmp_path: Path) -> None:
    settings = FakeModemSettings(modem="esp-now", count=2, echo=True, garbage=1.0, latency_ms=3.0, jitter_ms=5.0)
    with (
        modems(settings, tmp_path) as made,
        SerialPort(port_settings(made, 1)) as one,
        SerialPort(port_settings(made, 2)) as other,
    ):
        heard: list[bytes] = []
        for number in range(5):
            assert one.send(bytes([number]) * 30) == ""
            wait_for(lambda number=number: heard.extend(d.data for d in other.receive(16)) or len(heard) > number)
        assert heard == [bytes([number]) * 30 for number in range(5)]
        wait_for(lambda: one.counts()["echoes"] == 5)
        assert one.receive(16) == []
        assert other.counts()["garbled_pieces"] >= 5


@pytest.mark.parametrize(("words", "said"), [
    (["sniff", "--device=/dev/nothing"], "device: got '/dev/nothing'; allowed: a device that is there"),
    (["sniff", "--device=/dev/null"], "device: got '/dev/null'; allowed: a serial device"),
    (["sniff"], "device: got None; allowed: the serial device of the modem, as /dev/ttyUSB0"),
    (["sniff", "--device=/dev/null", "--interface=lo"], "interface: got 'lo'; allowed: one of the settings device"),
    (["agent", "--id=1", "--device=/dev/null", "--slot-ms=20"], "slot_ms: got 20.0; allowed: at least"),
])  # fmt: skip
def test_what_cannot_be_is_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "--air=serial", "--no-seal", "--modem=sik-64k"]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") == 1


def test_a_device_that_may_not_be_opened_is_named(monkeypatch, capsys):
    def refused(*words: object, **more: object) -> None:  # root may open every device
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "Serial", refused)
    assert main(["sniff", "--air=serial", "--no-seal", "--device=/dev/ttyUSB0"]) == 2
    assert "allowed: a device that this user may open: add the user to its group, mostly dialout" in (
        capsys.readouterr().err
    )
