"""Integration: Crazyradios as the port of an agent, part by part: settings, bytes of USB, stamps, dongles that fail."""

from __future__ import annotations

import errno
import random
import struct
import threading
import time
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from waiting import wait_for

from dtsa_agent.air.crazyradio_port import (
    BROADCAST,
    CrazyradioPort,
    DongleClock,
    PacketReader,
    broadcast,
    datagram_in,
)
from dtsa_agent.air.port import check_fits, flight_ns, link_of, settings_class
from dtsa_agent.air.settings import CrazyradioSettings
from dtsa_agent.core import ConfigError, SwarmConfig

URI = "radio://0/80/2M"
SEALED = SwarmConfig(agents=5, policy="lease", slot_ms=20.0, auth=True, auth_session=7)
WRONG = (
    "udp://0/80/2M", "radio://0/80", "radio://0/101/2M", "radio://0/-1/2M", "radio://0/80/250K", "radio:///80/2M",
    "radio://0/80/2M/E7E7E7E7E7", "radio://²/80/2M", "radio://0/8²/2M", "",
)  # fmt: skip
US, MS, SECOND = 1_000, 1_000_000, 1_000_000_000


def heard(payload: bytes, stamp: int = 0, rssi: int = 45, pipe: int = 0) -> bytes:
    return struct.pack("<BBBI", 7 + len(payload), rssi, pipe, stamp) + payload


@pytest.mark.parametrize(
    ("field", "values"),
    [("uri", {}), ("p2p_port", {"uri": URI, "p2p_port": 16}), ("send_time_ns", {"uri": URI, "send_time_ns": -1})]
    + [("uri", {"uri": uri}) for uri in WRONG],
)
def test_dongles_that_cannot_be_are_refused_by_name(field: str, values: dict[str, Any]) -> None:
    with pytest.raises(ConfigError) as error:
        settings_class("crazyradio").from_dict(values)
    assert error.value.field == field


def test_a_sealed_frame_fills_the_packet_and_others_have_room_for_two_bytes() -> None:
    properties = CrazyradioSettings(uri=URI).properties
    assert SEALED.frame_length + properties.header(signed=True).size == properties.longest
    check_fits(SEALED, properties)
    check_fits(SwarmConfig(agents=5, policy="lease", slot_ms=20.0), properties)
    slow = CrazyradioSettings(uri="radio://0/80/1M").properties
    bits = 73 + 8 * (2 + SEALED.frame_length)
    assert flight_ns(SEALED, properties) == 1_100_000 + bits * 500
    assert flight_ns(SEALED, slow) == 1_100_000 + bits * 1000
    assert link_of(SEALED, properties).trust_ns == SEALED.slot_ns // 4, "a wrong send_time_ns is no other time"
    with pytest.raises(ConfigError, match="slot_ms"):
        check_fits(SwarmConfig(agents=5, policy="lease", slot_ms=9.9), properties)


@given(
    st.lists(st.tuples(st.binary(max_size=63), st.integers(0, 2**32 - 1), st.integers(0, 255)), max_size=8),
    st.booleans(),
)
def test_packets_are_found_in_whole_and_in_split_transfers(packets: list[tuple[bytes, int, int]], split: bool) -> None:
    reader, found = PacketReader(), []
    for payload, stamp, rssi in packets:
        data = heard(payload, stamp, rssi)
        for part in [data[:64], data[64:]] if split and len(data) > 64 else [data]:
            found += reader.feed(part)
    assert [(p.payload, p.stamp_us) for p in found] == [packet[:2] for packet in packets]
    assert reader.garbled == 0


@given(st.lists(st.binary(max_size=130), max_size=10), st.binary(max_size=63))
def test_whatever_comes_the_next_packet_but_one_is_found(garbage: list[bytes], payload: bytes) -> None:
    reader = PacketReader()
    for data in garbage:
        for packet in reader.feed(data):
            datagram_in(packet.payload, 7)
    reader.feed(b"")  # a while without packets
    assert [p.payload for p in reader.feed(heard(payload))] == [payload]


def test_a_packet_whose_empty_end_is_missing_runs_into_the_next() -> None:
    """57 bytes fill a USB packet, and the empty one after it may get lost: the transfer goes on with what comes."""
    reader = PacketReader()
    long, short = heard(bytes(57), 1), heard(b"short", 2)
    assert [p.stamp_us for p in reader.feed(long + short)] == [1, 2]
    longest = heard(bytes(63), 3)
    assert [p.stamp_us for p in reader.feed(long + longest[:64])] == [1]
    assert [p.stamp_us for p in reader.feed(longest[64:])] == [3]
    assert reader.garbled == 0


@given(st.binary(max_size=60), st.integers(0, 15), st.integers(0, 15))
def test_a_datagram_comes_out_as_it_went_in_on_its_port_alone(data: bytes, sent_on: int, heard_on: int) -> None:
    transfer = broadcast(data, sent_on)
    assert transfer[:5] == BROADCAST == b"\xff\xe7\xe7\xe7\xe7"
    assert transfer[5:7] == bytes((0xFF, 0x80 | sent_on))
    assert datagram_in(transfer[5:], heard_on) == (data if sent_on == heard_on else None)


@given(st.integers(0, 2**32 - 1), st.floats(-40e-6, 40e-6), st.integers(1, 2**20))
def test_arrivals_follow_the_stamps_whatever_usb_does(first_us: int, drift: float, seed: int) -> None:
    """Over a turn of the stamps too, and after a pause of a quarter of a turn."""
    draw, clock = random.Random(seed), DongleClock()
    least = 150 * US
    now = 10**12
    began = now
    worst = 0
    for number in range(600):
        now += draw.randrange(5 * MS, 25 * MS) if number != 300 else 1000 * SECOND
        stamp = (first_us + round((now - began) * (1 + drift)) // US) % 2**32
        late = draw.choice((0, 0, 0, draw.randrange(4 * MS), draw.randrange(200) * MS))
        arrival = clock.arrival_ns(stamp, now + least + late)
        assert arrival <= now + least + late
        if 100 < number < 300 or number > 400:
            worst = max(worst, abs(arrival - now - least))
    assert worst < 200 * US
    assert clock.unusable == 0


@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**40)), min_size=1, max_size=50))
def test_stamps_of_any_value_give_times_that_are_not_in_the_future(stamps: list[tuple[int, int]]) -> None:
    clock, now = DongleClock(), 0
    for stamp, step in stamps:
        now += step
        assert now - 61 * SECOND < clock.arrival_ns(stamp, now) <= now


def test_a_wrong_stamp_does_not_move_the_clock_and_a_dongle_that_began_anew_does() -> None:
    clock, now = DongleClock(), 10**12
    for k in range(100):
        now += 10 * MS
        assert clock.arrival_ns(400_000_000 + 10_000 * k, now) == now
    assert clock.arrival_ns(523_456_789, now + 1) == now + 1
    assert clock.unusable == 1
    now += 10 * MS
    assert clock.arrival_ns(401_000_000, now + 3 * MS) == pytest.approx(now, abs=2 * US)
    for k in range(3):
        now += 10 * MS
        clock.arrival_ns(77 + 10_000 * k, now)
    assert clock.arrival_ns(77 + 30_000, now + 14 * MS) == pytest.approx(now + 10 * MS, abs=2 * US)


def test_a_wrong_stamp_that_seems_early_misleads_the_clock_for_a_while_only() -> None:
    clock, now = DongleClock(), 10**12
    for k in range(200):
        now += 10 * MS
        arrival = clock.arrival_ns(10_000 * k + (900_000 if k == 50 else 0), now)
    assert arrival == pytest.approx(now, abs=2 * US)


class FakeDevice:
    bcdDevice, serial_number = 0x0504, "51D0000000"

    def __init__(self, **errors: Exception) -> None:
        self.errors, self.dropped = errors, 0
        self.requests: list[tuple[int, int, bytes]] = []
        self.written: list[bytes] = []
        self.transfers: list[bytes] = []

    def _do(self, name: str) -> None:
        if name in self.errors:
            raise self.errors[name]

    def set_configuration(self, number: int) -> None:
        self._do("set_configuration")

    def ctrl_transfer(self, kind: int, number: int, value: int, index: int, data: Any, timeout: int) -> Any:
        self._do("ctrl_transfer")
        if kind == 0xC0:
            return struct.pack("<I", self.dropped)
        self.requests.append((number, value, bytes(data)))
        return len(data)

    def read(self, endpoint: int, size: int, timeout: int) -> bytes:
        self._do("read")
        if self.transfers:
            return self.transfers.pop(0)
        time.sleep(0.001)
        raise pytest.importorskip("usb.core").USBTimeoutError("no answer", None, errno.ETIMEDOUT)

    def write(self, endpoint: int, data: bytes, timeout: int) -> int:
        self._do("write")
        self.written.append(data)
        return len(data)


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    core = pytest.importorskip("usb.core")
    devices: list[Any] = []
    monkeypatch.setattr(core, "find", lambda **_: iter(devices))
    monkeypatch.setattr("usb.util.claim_interface", lambda *_: None)
    monkeypatch.setattr("usb.util.dispose_resources", lambda *_: None)
    return devices


def usb_error(number: int) -> Any:
    return pytest.importorskip("usb.core").USBError("it does not", None, number)


def test_a_dongle_is_told_channel_rate_address_and_mode(plugged: list[Any]) -> None:
    device = FakeDevice()
    plugged.append(device)
    with CrazyradioPort(CrazyradioSettings(uri="radio://51d0000000/42/1M")) as opened:
        told = [(0x24, 0, b""), (0x01, 42, b""), (0x03, 1, b""), (0x02, 0, BROADCAST), (0x24, 1, b"")]
        assert device.requests == told
        assert opened.send(bytes(60)) == opened.send(bytes(57)) == ""
    assert [len(one) for one in device.written] == [67, 64, 0], "a transfer ends with a shorter packet, be it empty"
    assert device.requests[-1] == (0x24, 0, b"")


@pytest.mark.parametrize(("errors", "allowed"), [
    ({"set_configuration": errno.EACCES}, "udev rule"), ({"ctrl_transfer": errno.EPIPE}, "does what it is told"),
])  # fmt: skip
def test_dongles_that_cannot_be_used_are_one_line(plugged: list[Any], errors: dict[str, int], allowed: str) -> None:
    plugged.append(FakeDevice(**{name: usb_error(number) for name, number in errors.items()}))
    with pytest.raises(ConfigError) as error:
        CrazyradioPort(CrazyradioSettings(uri=URI))
    assert error.value.field == "uri"
    assert allowed in str(error.value)
    assert "\n" not in str(error.value)


def test_without_pyusb_a_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="pip install pyusb"):
        CrazyradioPort(CrazyradioSettings(uri=URI))


def test_what_a_dongle_hears_reaches_the_port_and_what_others_say_is_counted(plugged: list[Any]) -> None:
    device = FakeDevice()
    device.dropped = 3
    device.transfers = [heard(broadcast(b"ours", 7)[5:], 5), heard(broadcast(b"others", 8)[5:], 6), heard(b"x"), b"\1"]
    plugged.append(device)
    with CrazyradioPort(CrazyradioSettings(uri=URI)) as opened:
        found: list[Any] = []
        wait_for(
            lambda: found.extend(opened.receive(16)) or (bool(found) and bool(opened.counts()["garbled_transfers"]))
        )
        assert [one.data for one in found] == [b"ours"]
        assert opened.send(b"mine") == ""
        assert device.written == [broadcast(b"mine", 7)]
        counts = opened.counts()
        assert (counts["other_packets"], counts["dropped_by_dongle"]) == (2, 3)


def test_a_dongle_that_does_not_take_a_packet_is_a_refusal(plugged: list[Any]) -> None:
    device = FakeDevice(write=usb_error(errno.EIO))
    plugged.append(device)
    with CrazyradioPort(CrazyradioSettings(uri=URI)) as opened:
        assert "it does not" in opened.send(b"mine")
    assert "dongle" not in {thread.name for thread in threading.enumerate()}
