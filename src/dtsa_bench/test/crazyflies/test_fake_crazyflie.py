"""The simulated Crazyflies without a network: protocol, firmware, flight."""

from __future__ import annotations

import json
import socket
import struct
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from craft import Craft
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.commands.cli import main
from dtsa_bench.crazyflies.simulated import Fleet, FleetConfig, crtp
from dtsa_bench.crazyflies.simulated.fleet_config import ellipse_positions
from dtsa_bench.crazyflies.simulated.process import free_base_port
from dtsa_bench.crazyflies.simulated.truth import read_truth


@settings(deadline=None)
@given(st.integers(0, 15), st.integers(0, 3), st.binary(max_size=30))
def test_packets_round_trip(port: int, channel: int, data: bytes) -> None:
    assert crtp.unpack(crtp.pack(port, channel, data)) == (port, channel, data)


@settings(deadline=None)
@given(st.binary(max_size=40))
def test_nothing_from_the_air_stops_a_peer(datagram: bytes) -> None:
    reply = Craft().peer.receive(datagram, 0.0)
    assert reply is None or 1 <= len(reply) <= 31


def test_log_blocks() -> None:
    craft = Craft()
    names = [entry.full_name for entry in crtp.LOG_ENTRIES]
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


def hop(seed: int, truth: Path) -> None:
    fleet = Fleet(FleetConfig(count=2, base_port=free_base_port(2), seed=seed, truth=truth))
    for firmware in fleet.firmware:
        firmware.supervisor.request_arming(True)
    for tick in range(500):
        if order := {10: (7, 0, 0.8, 0.0, True, 1.5), 250: (8, 0, 0.0, 0.0, True, 2.0)}.get(tick):
            for firmware in fleet.firmware:
                firmware.high_level(struct.pack("<BBff?f", *order), fleet.time)
        fleet.step()
    fleet.close()


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
    assert [e["event"] for e in events if e["cf"] == 1 and e["event"] != "state"][:2] == ["takeoff", "land"]
    with (tmp_path / "a.jsonl").open("a") as record:
        record.write('{"t": 5.0')  # cut off by a crash
    assert len(read_truth(tmp_path / "a.jsonl")[0]) == 500


def test_two_that_meet_fall() -> None:
    start = np.array([[0.0, 0.4], [0.0, 0.0], [0.0, 0.0]])
    fleet = Fleet(FleetConfig(count=2, base_port=free_base_port(2), start=start))
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


@pytest.mark.parametrize(("request_", "field"), [
    ({"fault": "explode"}, "fault"), ({"fault": "drop", "cf": 3}, "cf"), ({"fault": "drop", "cf": "one"}, "cf"),
    ({"fault": "drop", "rate": 1.5}, "rate"), ({"fault": "drop", "direction": "left"}, "direction"),
    ({"fault": "battery", "voltage": 9}, "voltage"), ({"fault": "battery", "voltage": None}, "voltage"),
    ({"fault": "estimate_jump", "distance": None}, "distance"),
])  # fmt: skip
def test_bad_faults_are_refused(request_: dict[str, Any], field: str) -> None:
    with closing(Fleet(FleetConfig(count=2, base_port=free_base_port(2)))) as fleet:
        with pytest.raises(ConfigError) as error:
            fleet.fault(request_)
        assert error.value.field == field


def test_nothing_that_comes_to_the_port_for_faults_ends_a_fleet() -> None:
    config = FleetConfig(count=1, base_port=free_base_port(1))
    fleet = Fleet(config)
    flying = threading.Thread(target=fleet.run)
    flying.start()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host:
            host.settimeout(5)
            host.connect(("127.0.0.1", config.control_port))
            for request, field in (
                (b'{"fault": ["drop"]}', "fault"), (b'{"fault": {}}', "fault"), (b"[]", "request"),
                (b"[" * 2000, "request"), (b'{"fault": ' + b"[" * 1010 + b"]" * 1010 + b"}", "request"),
            ):  # fmt: skip
                host.send(request)
                answer = json.loads(host.recv(8192))
                assert (answer["ok"], answer["field"]) == (False, field)
            host.send(b'{"fault": "heal"}')
            assert json.loads(host.recv(512))["ok"] is True
    finally:
        fleet.stop()
        flying.join(10)


@pytest.mark.parametrize(
    ("values", "field"),
    [({"count": 0}, "count"), ({"count": 201}, "count"), ({"base_port": 80}, "base_port"),
     ({"protocol": 11}, "protocol"), ({"model": "kite"}, "avoider"), ({"start": np.zeros((3, 2))}, "start")],
)  # fmt: skip
def test_bad_fleets_are_refused(values: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as error:
        FleetConfig(**values)
    assert error.value.field == field


def test_start_positions_keep_their_distance() -> None:
    p = ellipse_positions(12)
    assert p.shape == (3, 12)
    assert np.abs(p[0]).max() <= 1.2 + 1e-12
    assert np.abs(p[1]).max() <= 2.0 + 1e-12
    gap = np.linalg.norm(p[:, :, None] - p[:, None, :], axis=0) + 10 * np.eye(12)
    assert gap.min() > 0.3


def test_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    port = free_base_port(1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as busy:
        busy.bind(("127.0.0.1", port))
        assert main(["fake-crazyflie", "--count", "1", "--base-port", str(port)]) == 2
    assert "port: got" in capsys.readouterr().err
    assert main(["fake-crazyflie", "--count", "0"]) == 2
    assert main(["fake-crazyflie", "--fault", "drop", "--base-port", str(port)]) == 2
    assert "control port of a running fleet" in capsys.readouterr().err


def test_a_running_fleet_answers_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    pytest.importorskip("cflib")
    from bridge_helpers import fake_fleet

    with fake_fleet(tmp_path, 2) as fleet, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host:
        port = fleet.base_port
        host.settimeout(5)
        host.connect(("127.0.0.1", port))
        host.send(b"\xff")
        assert host.recv(64)
        host.connect(("127.0.0.1", port - 1))
        host.send(b"nonsense")
        assert json.loads(host.recv(512))["ok"] is False
        assert (
            main(["fake-crazyflie", "--fault", "freeze", "--cf", "2", "--seconds", "0.2", "--base-port", str(port)])
            == 0
        )
    (fault,) = fleet.events(name="fault: freeze")
    assert (set(fault), fault["cf"]) == ({"t", "cf", "event", "seconds"}, 2)


def test_external_positions_reach_the_filter_of_the_one_that_they_are_for() -> None:
    pytest.importorskip("rclpy")
    from motion_capture_helper import HostEstimate

    def restarted() -> tuple[Craft, HostEstimate]:
        craft, estimate = Craft(), HostEstimate()
        craft.estimate = craft.peer.estimate = estimate
        for name, value in (("initialX", 0.3), ("resetEstimation", 1)):
            index = crtp.PARAM_ID[f"kalman.{name}"]
            form = "<H" + crtp.PARAM_TYPES[crtp.PARAM_ENTRIES[index].type][1]
            craft.ask(2, 2, struct.pack(form, index, value))
        assert estimate.filter.position == (pytest.approx(0.3), 0.0, 0.0)
        return craft, estimate

    packets = (
        (0, struct.pack("<3f", 1.0, 2.0, 0.5)),
        (1, struct.pack("<B7f", 8, 1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 1.0)),
        (1, b"\x09" + struct.pack("<B3hI", 2, 9, 9, 9, 0) + struct.pack("<B3hI", 1, 1000, 2000, 500, 0)),
        (2, struct.pack("<B3h", 7, 9, 9, 9) + struct.pack("<B3h", 1, 1000, 2000, 500)),
    )
    for channel, data in packets:
        craft, estimate = restarted()
        assert estimate.variance(0.0) == pytest.approx(100.0)
        for _ in range(30):
            estimate.filter.predict(0.01, (0.0, 0.0, 0.0))
            assert craft.ask(crtp.LOCALIZATION, channel, data) is None
        assert estimate.filter.position == pytest.approx((1.0, 2.0, 0.5), abs=0.002)
        assert estimate.variance(0.0) < 1e-4
        assert craft.peer.positions_received == 30
    craft.ask(crtp.LOCALIZATION, 0, struct.pack("<3f", float("nan"), 0.0, 0.0))
    assert estimate.filter.position == pytest.approx((1.0, 2.0, 0.5), abs=0.5)
