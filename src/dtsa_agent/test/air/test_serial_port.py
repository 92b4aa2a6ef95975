"""Integration: the port on a serial line: its frames, its times, and a device that comes and goes."""

from __future__ import annotations

import math
import os
import tty
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import wait_for

from dtsa_agent.air.driver import AgentVehicle, LiveAgent
from dtsa_agent.air.port import ReceivedDatagram, check_fits, flight_ns, shortest_slot_ns
from dtsa_agent.air.serial_modems import LONGEST, MODEMS, OVERHEAD, lora_ns
from dtsa_agent.air.serial_port import LineReader, SerialPort, to_line
from dtsa_agent.air.settings import AgentSettings, SerialSettings
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.stop import Stop

DATAGRAMS = st.binary(min_size=1, max_size=LONGEST)


def read(*pieces: bytes) -> list[bytes]:
    reader = LineReader()
    return [datagram for piece in pieces for datagram, _ in reader.feed(piece)]


@given(DATAGRAMS)
def test_a_datagram_comes_back_and_takes_the_same_bytes_whatever_is_in_it(datagram: bytes) -> None:
    line = to_line(datagram)
    assert read(line) == [datagram]
    assert len(line) == len(datagram) + OVERHEAD
    assert line.strip(b"\0").count(0) == 0


@settings(max_examples=200)
@given(st.lists(DATAGRAMS, max_size=5), st.lists(st.integers(0, 1500), max_size=20))
def test_pieces_may_be_cut_anywhere(datagrams: list[bytes], cuts: list[int]) -> None:
    line = b"".join(map(to_line, datagrams))
    ends = sorted({min(cut, len(line)) for cut in cuts} | {0, len(line)})
    reader, found = LineReader(), []
    for begin, end in pairwise(ends):
        for datagram, after in reader.feed(line[begin:end]):
            found.append(datagram)
            assert line[: end - after].endswith(to_line(datagram)[1:])
    assert found == datagrams
    assert (reader.garbled, reader.garbled_bytes) == (0, 0)


@settings(max_examples=200)
@given(st.binary(max_size=2000), DATAGRAMS, DATAGRAMS, st.data())
def test_a_frame_is_found_after_garbage(garbage: bytes, one: bytes, other: bytes, data: st.DataObject) -> None:
    cut = data.draw(st.integers(0, len(to_line(one)) - 2))  # without its last zero it is whole
    found = read(garbage, to_line(one)[:cut], to_line(other))
    assert found[-1] == other
    assert len(found) <= 1 + garbage.count(0)


def test_a_frame_that_ends_before_a_zero_of_its_check_sum_is_none() -> None:
    """With the check sum the other way round the first four bytes were a datagram."""
    datagram = bytes.fromhex("9dca6be6d0")
    assert read(to_line(datagram)[:-2] + b"\0") == []


@settings(max_examples=300)
@given(DATAGRAMS, st.data())
def test_a_changed_byte_is_noticed(datagram: bytes, data: st.DataObject) -> None:
    line = bytearray(to_line(datagram))
    at = data.draw(st.integers(0, len(line) - 1))
    line[at] ^= data.draw(st.integers(1, 255))
    assert datagram not in read(bytes(line)) or at in (0, len(line) - 1)


def test_bytes_without_end_are_not_kept() -> None:
    reader = LineReader()
    for _ in range(1000):
        assert not list(reader.feed(b"x" * 4096))
    assert reader.garbled_bytes > 4_000_000
    assert len(reader._rest) <= LONGEST + 10
    assert [datagram for datagram, _ in reader.feed(to_line(b"again"))] == [b"again"]


def test_lora_takes_what_the_maker_of_the_chip_says() -> None:
    """SX1261/2 data sheet, 6.1.4, as Semtech's calculator gives it: explicit header, check sum, 4/5, 8 symbols."""
    assert lora_ns(60, spreading=7, bandwidth_hz=125_000) == 112_896_000
    assert lora_ns(20, spreading=12, bandwidth_hz=125_000) == 1_318_912_000
    assert lora_ns(60, spreading=7, bandwidth_hz=500_000) == pytest.approx(112_896_000 / 4)
    assert lora_ns(40, spreading=5, bandwidth_hz=500_000) == round((12 + 6.25 + 8 + 17 * 5) * 64_000)


@pytest.mark.parametrize("modem", MODEMS)
def test_arrivals_are_expected_when_modem_and_line_have_carried_the_bytes(modem: str) -> None:
    kind = MODEMS[modem]
    for frame in ("paper", "extended"):
        config = SwarmConfig(agents=6, policy="tdma", frame=frame, slot_ms=900.0)
        ours = SerialSettings(device="x", modem=modem, baud=kind.baud)
        length = ours.properties.header(config.auth).size + config.frame_length + OVERHEAD
        line_ns = (2 * length + kind.gap_bytes) * 10 * 1e9 / kind.baud
        whole_ns = line_ns + kind.turn_round_ns + kind.on_air_ns(length) + 3 * kind.turn_ns
        assert flight_ns(config, ours.properties) == pytest.approx(whole_ns, rel=0.03, abs=1_500_000)


def test_slots_that_are_too_short_are_refused_with_the_shortest() -> None:
    port = SerialSettings(device="x", modem="sik-64k").properties
    config = SwarmConfig(agents=12, policy="lease", slot_ms=50.0)
    with pytest.raises(ConfigError) as refused:
        check_fits(config, port)
    shortest_ms = math.ceil(shortest_slot_ns(config, port) / 1e5) / 10
    said = str(refused.value)
    assert said.startswith(f"slot_ms: got 50.0; allowed: at least {shortest_ms:g} over serial with frames of 56 bytes")
    assert "with 19 (policy tdma, frame paper)" in said
    check_fits(SwarmConfig(agents=12, policy="lease", slot_ms=shortest_ms), port)
    paper = SwarmConfig(agents=12, policy="dtsa", slot_ms=57.0)
    check_fits(paper, port)
    with pytest.raises(ConfigError, match=r"at least 18\.4 over serial with frames of 19 bytes$"):
        check_fits(
            SwarmConfig(agents=12, policy="dtsa", slot_ms=5.0), SerialSettings(device="x", modem="xbee").properties
        )


class Line:
    """A pseudo terminal as the device of a port, behind a link in a directory."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / "modem"
        self.plug()

    def plug(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path.symlink_to(os.ttyname(slave))
        self._slave = slave

    def unplug(self) -> None:
        self.path.unlink()
        os.close(self.master)
        os.close(self._slave)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    made = Line(tmp_path)
    yield made
    made.unplug()


def heard(port: SerialPort, count: int) -> list[ReceivedDatagram]:
    """What has arrived, when so much has."""
    found: list[ReceivedDatagram] = []
    wait_for(lambda: found.extend(port.receive(16)) or len(found) >= count)
    return found


def test_a_port_gives_what_it_is_given_and_knows_an_echo(line: Line) -> None:
    with SerialPort(SerialSettings(device=str(line.path))) as port:
        said: list[str] = []
        port.log = said.append
        assert port.send(b"own") == ""
        wait_for(lambda: os.read(line.master, 100) == to_line(b"own"))
        os.write(line.master, b"garb" + to_line(b"other") + to_line(b"own") + to_line(b"last"))
        first, second = heard(port, 2)
        assert (first.data, second.data) == (b"other", b"last")
        # They came at once; on a line of this speed the first one was there earlier.
        assert second.arrival_ns - first.arrival_ns >= len(to_line(b"own")) * 10 * 10**9 // 57_600
        assert (port.counts()["garbled_pieces"], port.counts()["echoes"]) == (1, 1)
        assert said == [f"device {line.path} gives back what it is given: own frames are left out"]


def test_a_device_has_one_user(line: Line) -> None:
    ours = SerialSettings(device=str(line.path))
    with SerialPort(ours), pytest.raises(ConfigError, match="no other process uses"):
        SerialPort(ours)
    with SerialPort(ours):
        pass
    with pytest.raises(ConfigError, match="allowed: a serial device that can be used"):
        SerialPort(SerialSettings(device=str(line.path.parent)))


def test_a_device_that_is_unplugged_comes_back(line: Line) -> None:
    with SerialPort(SerialSettings(device=str(line.path))) as port:
        said: list[str] = []
        port.log = said.append
        line.unplug()
        wait_for(lambda: bool(said))
        assert port.send(b"lost") == "the device is not there"
        line.plug()
        wait_for(lambda: len(said) == 2)
        assert "has gone" in said[0]
        assert said[1].endswith("is back")
        assert port.send(b"whole") == ""
        wait_for(lambda: os.read(line.master, 100) == to_line(b"whole"))
        os.write(line.master, to_line(b"here"))
        assert heard(port, 1)[0].data == b"here"
        assert port.counts()["times_unplugged"] == 1


def test_a_line_that_takes_nothing_holds_nobody_up(line: Line) -> None:
    with SerialPort(SerialSettings(device=str(line.path))) as port:
        refused = [said for said in (port.send(bytes(200)) for _ in range(1000)) if said]
        assert refused
        assert set(refused) <= {"the line takes no more bytes", "earlier frames still wait for the line"}


@pytest.mark.parametrize(("content", "why"), [(b"\xfd\x09" + b"\x01" * 15, "MAVLink"), (b"\x81\x42", "speed")])
def test_a_line_that_carries_something_else_is_told_once(line: Line, content: bytes, why: str) -> None:
    with SerialPort(SerialSettings(device=str(line.path))) as port:
        said: list[str] = []
        port.log = said.append
        for _ in range(20):
            os.write(line.master, content * (500 // len(content)))
        wait_for(lambda: bool(said))
        os.write(line.master, to_line(b"still"))
        assert heard(port, 1)[0].data == b"still"
        assert len(said) == 1
        assert why in said[0]


def test_what_comes_while_an_agent_waits_for_its_vehicle_is_not_lost(line, monkeypatch):
    config, vehicle, asked = SwarmConfig(agents=2, policy="tdma", slot_ms=100.0), AgentVehicle(), list[int]()
    monkeypatch.setattr(vehicle, "is_ready", lambda: asked.append(os.write(line.master, text)) or len(asked) > 5)
    text = 100 * to_line(b"x")
    with SerialPort(SerialSettings(device=str(line.path))) as port, Stop() as stop:
        LiveAgent(AgentSettings(id=1, duration_s=1.0), config, port, vehicle=vehicle).run(stop)
        assert len(asked) > 5
        assert port.counts()["dropped_by_computer"] == 0
