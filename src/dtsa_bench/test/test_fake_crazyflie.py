"""The simulated Crazyflies without a network: protocol, firmware, flight."""

from __future__ import annotations

import json
import math
import socket
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.fake_crazyflie import Fleet, FleetConfig, cli, crtp, layout, planner, toc
from dtsa_bench.fake_crazyflie.battery import Battery
from dtsa_bench.fake_crazyflie.estimate import Estimate, attitude, compress, quaternion
from dtsa_bench.fake_crazyflie.firmware import FLY, LEVEL, OFF, Firmware, yaw_of
from dtsa_bench.fake_crazyflie.peer import Peer
from dtsa_bench.fake_crazyflie.truth import read_truth

finite = st.floats(-5, 5)


class Craft:
    """Firmware of one Crazyflie on a test stand that follows every command at once."""

    def __init__(self, protocol: int = 12) -> None:
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.firmware = Firmware(lambda name, **details: self.events.append((name, details)), tau=0.0)
        self.estimate = Estimate()
        self.peer = Peer(self.firmware, self.estimate, protocol)
        self.t = 0.0
        self.mode = OFF
        self.command = (0.0, 0.0, 0.0)

    def ask(self, port: int, channel: int, data: bytes) -> bytes | None:
        reply = self.peer.receive(crtp.pack(port, channel, data), self.t)
        return None if reply is None else reply[1:]

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.mode, self.command = self.firmware.step(self.t, 0.01, self.estimate.position)
            p = tuple(a + 0.01 * b for a, b in zip(self.estimate.position, self.command, strict=True))
            self.estimate.position, self.estimate.velocity = (p[0], p[1], max(p[2], 0.0)), self.command
            self.t += 0.01

    def velocity(self, *v: float) -> None:
        self.ask(crtp.GENERIC_COMMANDER, 0, struct.pack("<B4f", 8, *v, 0.0))

    def take_off(self) -> None:
        assert self.ask(crtp.SUPERVISOR, 1, b"\x01\x01") == b"\x81\x01\x01"
        self.fly(0.02)
        self.ask(crtp.HIGH_LEVEL, 0, struct.pack("<BBff?f", 7, 0, 1.0, 0.0, True, 1.0))
        self.fly(1.2)
        assert self.estimate.position[2] == pytest.approx(1.0, abs=0.1)

    @property
    def state(self) -> str:
        return self.firmware.supervisor.state


# -- packets and tables -----------------------------------------------------------------------------------------------
@settings(deadline=None)
@given(st.integers(0, 15), st.integers(0, 3), st.binary(max_size=30))
def test_packets_round_trip(port: int, channel: int, data: bytes) -> None:
    assert crtp.unpack(crtp.pack(port, channel, data)) == (port, channel, data)


@settings(deadline=None)
@given(st.binary(max_size=40))
def test_nothing_from_the_air_stops_a_peer(datagram: bytes) -> None:
    reply = Craft().peer.receive(datagram, 0.0)
    assert reply is None or 1 <= len(reply) <= 31


def test_tables_fit_and_their_checksum_comes_from_their_contents() -> None:
    for table, log in ((toc.LOG_TABLE, True), (toc.PARAM_TABLE, False)):
        answers = [table.answer(struct.pack("<BH", 2, k)) for k in range(len(table.entries))]
        assert all(a is not None and len(a) <= crtp.MAX_DATA for a in answers)
        assert table.checksum == zlib.crc32(b"".join(a[3:] for a in answers if a))
        assert table.answer(b"\x03")[:7] == struct.pack("<BHI", 3, len(answers), table.checksum)  # type: ignore[index]
        assert toc.Table(table.entries[1:], log=log).checksum != table.checksum
        assert not any(a[3] & 0x10 for a in answers if a)  # extended types are not offered
    float_codes = toc.LOG_TYPES["float"][0], toc.PARAM_TYPES["float"][0]
    assert float_codes == (7, 6)


def test_answers_of_the_connection() -> None:
    craft = Craft()
    assert craft.peer.receive(b"\xff", 0.0) is not None  # the scan's probe
    assert craft.ask(15, 1, b"\x00").startswith(b"Bitcraze Crazyflie")  # type: ignore[union-attr]
    assert craft.ask(15, 0, b"echo") == b"echo"
    assert craft.ask(13, 1, b"\x00") == b"\x00\x0c"
    assert Craft(10).ask(13, 1, b"\x00") == b"\x00\x0a"
    assert craft.ask(4, 0, b"\x01") == b"\x01\x00"
    assert Craft(10).ask(9, 1, b"\x01\x01") is None  # the supervisor's port came with protocol 12
    assert Craft(10).ask(13, 0, b"\x01\x01") == b"\x01\x01\x01"


def test_log_blocks() -> None:
    craft = Craft()
    names = [entry.full_name for entry in toc.LOG_ENTRIES]
    craft.estimate.position = (1.5, -40.0, 0.25)
    block = b"".join(struct.pack("<BH", 5, names.index(f"stateEstimateZ.{axis}")) for axis in "xyz")
    assert craft.ask(5, 1, b"\x06\x01" + block) == b"\x06\x01\x00"
    assert craft.ask(5, 1, b"\x06\x01" + block) == b"\x06\x01\x11"  # there already
    assert craft.ask(5, 1, b"\x03\x02\x02") == b"\x03\x02\x02"  # no such block
    assert craft.ask(5, 1, b"\x07\x01" + block * 3) == b"\x07\x01\x00"
    assert craft.ask(5, 1, b"\x07\x01" + block) == b"\x07\x01\x07"  # 30 bytes are too many
    assert craft.ask(5, 1, b"\x03\x01\x02") == b"\x03\x01\x00"
    packets = [p for tick in range(10) for p in craft.peer.log_packets(tick, 70.0)]
    assert len(packets) == 5  # every 20 ms
    port, channel, data = crtp.unpack(packets[0])  # type: ignore[misc]
    assert (port, channel, data[0]) == (5, 2, 1)
    assert int.from_bytes(data[1:4], "little") == 70000
    assert struct.unpack("<12h", data[4:]) == (1500, -32768, 250) * 4  # mm, kept within 16 bits
    assert craft.ask(5, 1, b"\x05") == b"\x05\x00\x00"
    assert not craft.peer.blocks


def test_parameters() -> None:
    craft = Craft()
    index = toc.PARAM_ID["ring.effect"]
    head = struct.pack("<H", index)
    assert craft.ask(2, 1, head) == head + b"\x00\x06"
    assert craft.ask(2, 2, head + b"\x09") == head + b"\x09"
    assert craft.ask(2, 1, head) == head + b"\x00\x09"
    assert craft.ask(2, 3, b"\x08" + head) == b"\x08" + head + b"\x00\x06"
    assert craft.ask(2, 3, b"\x00ring\x00effect\x00\x08\x03") == b"\x00ring\x00effect\x00\x00"
    assert craft.ask(2, 1, head) == head + b"\x00\x03"
    assert craft.ask(2, 1, b"\xff\x00") == b"\xff\x00\x02"
    fixed = struct.pack("<H", toc.PARAM_ID["deck.bcLighthouse4"])
    assert craft.ask(2, 2, fixed + b"\x00") == fixed + b"\x01"


# -- firmware ---------------------------------------------------------------------------------------------------------
@settings(deadline=None)
@given(finite, finite, finite, st.floats(0.2, 10))
def test_paths_begin_and_end_as_they_should(p0: float, v0: float, p1: float, duration: float) -> None:
    path = planner.septic(p0, v0, p1, duration)
    assert planner.evaluate(path, 0.0) == (p0, v0, 0.0)
    p, v, a = planner.evaluate(path, duration)
    assert (p, v, a) == pytest.approx((p1, 0.0, 0.0), abs=1e-6 / duration**2)


def test_a_flight_by_high_level_commands() -> None:
    craft = Craft()
    assert craft.mode == OFF
    craft.take_off()
    craft.ask(crtp.HIGH_LEVEL, 0, struct.pack("<B3B5f", 12, 0, 0, 0, 0.5, -0.5, 0.8, math.pi / 2, 1.0))
    craft.fly(1.5)
    assert craft.estimate.position == pytest.approx((0.5, -0.5, 0.8), abs=0.02)
    assert craft.firmware.yaw == pytest.approx(math.pi / 2)
    craft.ask(crtp.HIGH_LEVEL, 0, struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 1.0))
    craft.fly(1.2)
    assert (craft.mode, craft.state) == (OFF, "flying")  # the firmware waits for two seconds
    craft.fly(2.0)
    assert craft.state == "landed"
    craft.fly(3.1)
    assert not craft.firmware.supervisor.armed


def test_high_level_commands_have_no_effect_while_setpoints_are_streamed() -> None:
    craft = Craft()
    craft.take_off()
    craft.velocity(0.0, 0.0, 0.0)
    land = struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 1.0)
    craft.ask(crtp.HIGH_LEVEL, 0, land)
    craft.fly(0.4)
    assert craft.estimate.position[2] > 0.9
    craft.ask(crtp.GENERIC_COMMANDER, 1, struct.pack("<BI", 0, 0))
    craft.ask(crtp.HIGH_LEVEL, 0, land)
    craft.fly(1.2)
    assert craft.estimate.position[2] < 0.05


def test_old_setpoints_level_out_then_fall() -> None:
    craft = Craft()
    craft.take_off()
    craft.velocity(0.3, 0.0, 0.0)
    craft.fly(0.49)
    assert (craft.mode, craft.command) == (FLY, pytest.approx((0.3, 0.0, 0.0)))
    craft.fly(0.05)
    assert (craft.mode, craft.state) == (LEVEL, "level out")
    craft.velocity(0.3, 0.0, 0.0)
    craft.fly(0.02)
    assert (craft.mode, craft.state) == (FLY, "flying")
    craft.fly(2.1)
    assert (craft.mode, craft.state) == (OFF, "crashed")
    craft.velocity(0.3, 0.0, 0.0)
    craft.fly(0.1)
    assert craft.mode == OFF
    assert craft.ask(9, 1, b"\x02") == b"\x82\x01\x01"  # recovered: it stands upright
    craft.fly(0.05)
    assert craft.state == "pre-flight checks passed"


def test_the_emergency_watchdog_begins_with_its_first_packet_and_latches() -> None:
    craft = Craft()
    craft.take_off()
    for _ in range(4):
        craft.ask(9, 1, b"\x04")
        craft.fly(0.9)
        assert craft.mode == FLY
    craft.fly(0.15)
    assert (craft.mode, craft.state) == (OFF, "locked")
    craft.ask(9, 1, b"\x04")
    craft.fly(0.1)
    assert craft.ask(9, 1, b"\x01\x01") == b"\x81\x00\x00"
    craft.firmware.reset()
    craft.take_off()


@pytest.mark.parametrize(("port", "channel", "protocol"), [(9, 1, 12), (6, 1, 10)])
def test_emergency_stop(port: int, channel: int, protocol: int) -> None:
    craft = Craft(protocol)
    craft.firmware.supervisor.request_arming(True)
    craft.fly(0.02)
    craft.velocity(0.0, 0.0, 0.5)
    craft.fly(0.3)
    assert craft.mode == FLY
    craft.ask(port, channel, b"\x03")
    craft.fly(0.02)
    assert (craft.mode, craft.state) == (OFF, "locked")


def test_arming_needs_a_crazyflie_that_may_fly() -> None:
    craft = Craft()
    craft.firmware.supervisor.refuse_arming = True
    assert craft.ask(9, 1, b"\x01\x01") == b"\x81\x00\x00"
    craft.firmware.supervisor.refuse_arming = False
    craft.velocity(0.0, 0.0, 1.0)
    craft.fly(0.1)
    assert craft.mode == OFF  # not armed: no thrust
    assert craft.ask(9, 1, b"\x01\x01") == b"\x81\x01\x01"
    craft.fly(30.5)  # nobody takes off
    assert not craft.firmware.supervisor.armed


def test_full_state_setpoints_and_yaw() -> None:
    craft = Craft()
    craft.take_off()
    bits = compress(quaternion(0.0, 0.0, 1.0))
    packet = struct.pack("<B9hI3h", 6, 200, -100, 1100, 0, 0, 0, 0, 0, 0, bits, 0, 0, 0)
    for _ in range(40):
        craft.ask(crtp.GENERIC_COMMANDER, 0, packet)
        craft.fly(0.1)
    assert craft.estimate.position == pytest.approx((0.2, -0.1, 1.1), abs=0.01)
    assert craft.firmware.yaw == pytest.approx(1.0, abs=0.01)


@settings(deadline=None)
@given(st.floats(-3.1, 3.1))
def test_heading_survives_compression(yaw: float) -> None:
    assert yaw_of(compress(quaternion(0.1, -0.2, yaw))) == pytest.approx(yaw, abs=0.01)


def test_a_quadcopter_leans_where_it_accelerates() -> None:
    roll, pitch = attitude((2.0, 0.0, 0.0), 0.0)
    assert (roll, pitch > 0.1) == (pytest.approx(0.0), True)  # forward: nose down, positive in REP-103
    roll, pitch = attitude((0.0, 2.0, 0.0), 0.0)
    assert (roll < -0.1, pitch) == (True, pytest.approx(0.0))  # to the left: left side down


def test_battery_drains_in_flight_and_can_be_forced() -> None:
    battery = Battery()
    full = battery.voltage
    battery.update(210.0, motors=True)
    assert battery.charge == pytest.approx(0.5)
    assert battery.voltage < full - 0.4
    battery.force(3.0, motors=True)
    assert battery.voltage == pytest.approx(3.0)


# -- fleet ------------------------------------------------------------------------------------------------------------
def base_port(count: int) -> int:
    """Ports that are free now."""
    for base in range(31000, 60000, 50):
        sockets = []
        try:
            for port in range(base - 1, base + count):
                sockets.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                sockets[-1].bind(("127.0.0.1", port))
        except OSError:
            continue
        finally:
            for sock in sockets:
                sock.close()
        return base
    raise RuntimeError("no free ports")


def hop(seed: int, truth: Path | None = None, **fault: Any) -> Fleet:
    """Two Crazyflies take off and land again, driven tick by tick."""
    fleet = Fleet(FleetConfig(count=2, base_port=base_port(2), seed=seed, truth=truth))
    for firmware in fleet.firmware:
        firmware.supervisor.request_arming(True)
    for tick in range(500):
        for k, firmware in enumerate(fleet.firmware):
            estimate = fleet.estimates[k]
            if tick == 10:
                data = struct.pack("<BBff?f", 7, 0, 0.8, 0.0, True, 1.5)
                firmware.high_level(data, fleet.time, estimate.position, estimate.velocity)
            if tick == 250:
                data = struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 2.0)
                firmware.high_level(data, fleet.time, estimate.position, estimate.velocity)
        if tick == 220 and fault:
            fleet.fault(fault)
        fleet.step()
    fleet.close()
    return fleet


def test_same_seed_same_flight_and_its_record(tmp_path: Path) -> None:
    hop(3, tmp_path / "a.jsonl")
    hop(3, tmp_path / "b.jsonl")
    hop(4, tmp_path / "c.jsonl")
    (times, a, events), (_, b, _), (_, c, _) = (read_truth(tmp_path / f"{name}.jsonl") for name in "abc")
    assert a.shape == (500, 3, 2)
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    assert np.allclose(np.diff(times), 0.01)
    assert a[225, 2] == pytest.approx([0.8, 0.8], abs=0.03)
    assert a[-1, 2] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert [e["event"] for e in events if e["cf"] == 1 and e["event"] != "state"][:3] == ["armed", "takeoff", "land"]
    with (tmp_path / "a.jsonl").open("a") as record:
        record.write('{"t": 5.0')  # cut off by a crash
    assert len(read_truth(tmp_path / "a.jsonl")[0]) == 500


def test_tumbling_falls_and_the_other_one_does_not() -> None:
    fleet = hop(1, fault="tumble", cf=1)
    names = [e["event"] for e in fleet.truth.events if e["cf"] == 1]
    assert "hard landing" in names
    assert fleet.firmware[0].supervisor.state == "crashed"
    assert "hard landing" not in [e["event"] for e in fleet.truth.events if e["cf"] == 2]


def test_two_that_meet_fall() -> None:
    start = np.array([[0.0, 0.4], [0.0, 0.0], [0.0, 0.0]])
    fleet = Fleet(FleetConfig(count=2, base_port=base_port(2), start=start))
    for firmware in fleet.firmware:
        firmware.supervisor.request_arming(True)
    for tick in range(400):
        for k, firmware in enumerate(fleet.firmware):
            speed = (0.0, 0.0, 1.0) if tick < 100 else ((0.5, 0.0, 0.0) if k == 0 else (-0.5, 0.0, 0.0))
            firmware.stream(struct.pack("<B4f", 8, *speed, 0.0), fleet.time)
        fleet.step()
    fleet.close()
    names = [e["event"] for e in fleet.truth.events]
    assert names.index("collision") < names.index("crash")
    assert all(f.supervisor.state == "crashed" for f in fleet.firmware)


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        ({"fault": "explode"}, "fault"),
        ({"fault": "drop", "cf": 3}, "cf"),
        ({"fault": "drop", "cf": "one"}, "cf"),
        ({"fault": "drop", "rate": 1.5}, "rate"),
        ({"fault": "drop", "direction": "left"}, "direction"),
        ({"fault": "battery", "voltage": 9}, "voltage"),
    ],
)
def test_bad_faults_are_refused(request_: dict[str, Any], field: str) -> None:
    fleet = Fleet(FleetConfig(count=2, base_port=base_port(2)))
    try:
        with pytest.raises(ConfigError) as error:
            fleet.fault(request_)
        assert error.value.field == field
    finally:
        fleet.close()


@pytest.mark.parametrize(
    ("values", "field"),
    [({"count": 0}, "count"), ({"count": 201}, "count"), ({"base_port": 80}, "base_port"),
     ({"protocol": 11}, "protocol"), ({"model": "kite"}, "avoider"), ({"start": np.zeros((3, 2))}, "start")],
)  # fmt: skip
def test_bad_fleets_are_refused(values: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as error:
        FleetConfig(**values)
    assert error.value.field == field


@pytest.mark.parametrize("name", layout.LAYOUTS)
def test_layouts_keep_their_distance(name: str) -> None:
    p = layout.positions(name, 12)
    assert p.shape == (3, 12)
    assert np.abs(p[0]).max() <= 1.2 + 1e-12
    assert np.abs(p[1]).max() <= 2.0 + 1e-12
    gap = np.linalg.norm(p[:, :, None] - p[:, None, :], axis=0) + 10 * np.eye(12)
    assert gap.min() > 0.3


def test_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    port = base_port(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as busy:
        busy.bind(("127.0.0.1", port))
        assert cli.main(["--count", "1", "--base-port", str(port)]) == 2
    assert "port: got" in capsys.readouterr().err
    assert cli.main(["--count", "0"]) == 2
    assert cli.main(["--fault", "drop", "--base-port", str(port)]) == 2
    assert "control port of a running fleet" in capsys.readouterr().err


def test_a_running_fleet_answers_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    port, truth = base_port(2), tmp_path / "truth.jsonl"
    command = [sys.executable, "-m", "dtsa_bench.fake_crazyflie.cli", "--count", "2", "--base-port", str(port)]
    with subprocess.Popen([*command, "--truth", str(truth)], stdout=subprocess.PIPE, text=True) as process:
        try:
            lines = [process.stdout.readline() for _ in range(3)]  # type: ignore[union-attr]
            assert lines[:2] == [f"udp://127.0.0.1:{port}\n", f"udp://127.0.0.1:{port + 1}\n"]
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host:
                host.settimeout(5)
                host.connect(("127.0.0.1", port))
                host.send(b"\xff")
                assert host.recv(64)
                host.connect(("127.0.0.1", port - 1))
                host.send(b"nonsense")
                assert json.loads(host.recv(512))["ok"] is False
            assert cli.main(["--fault", "freeze", "--cf", "2", "--seconds", "0.2", "--base-port", str(port)]) == 0
            process.send_signal(2)
            assert process.wait(10) == 0
        finally:
            process.kill()
    assert {"t", "cf", "event", "seconds"} == set(read_truth(truth)[2][0])
