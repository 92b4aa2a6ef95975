"""Integration: what goes to the Crazyflie's firmware and comes from it, against golden values."""

from __future__ import annotations

import math
import struct
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.crazyflie import commands
from dtsa_agent.crazyflie import state as states

finite = st.floats(-1e6, 1e6)
vectors = st.tuples(finite, finite, finite)
component = st.floats(-1, 1)


LEVEL = (0.0, 0.0, 0.0, 1.0)


def test_log_block_fits_one_packet() -> None:
    size = struct.calcsize("<6hIHH")
    assert size <= 26
    assert len(states.LOG_VARIABLES) == 9


def test_state_log_is_in_millimetres_and_millivolts() -> None:
    numbers = dict.fromkeys(states.LOG_VARIABLES, 0.0) | {"stateEstimateZ.quat": 0xC0000000}
    numbers |= {"pm.vbatMV": 3712, "supervisor.info": 0x1A}
    measured = {"x": 1234, "y": -2000, "z": 950, "vx": -1500, "vy": 20, "vz": 7}
    state = states.decode_log(numbers | {f"stateEstimateZ.{name}": value for name, value in measured.items()})
    assert state.position == pytest.approx((1.234, -2.0, 0.95))
    assert state.velocity == pytest.approx((-1.5, 0.02, 0.007))
    assert state.battery == pytest.approx(3.712)
    assert state.info == 0x1A
    assert state.orientation == LEVEL


# Worked out by hand: index of the largest in bits 31-30, then sign and 511 |q| sqrt(2) of the others, x first.
GOLDEN_QUATERNIONS = [
    (0xC0000000, (0.0, 0.0, 0.0, 1.0)),
    (0x00000000, (1.0, 0.0, 0.0, 0.0)),
    (0xC0000000 | 511, (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))),  # heading +90 degrees
    (0xC0000000 | 512 | 511, (0.0, 0.0, -math.sqrt(0.5), math.sqrt(0.5))),  # heading -90 degrees
    (0xC0000000 | 256 << 10, (0.0, 256 / 511 * math.sqrt(0.5), 0.0, 0.93516)),  # nose down
]


@pytest.mark.parametrize(("bits", "expected"), GOLDEN_QUATERNIONS)
def test_quaternion_golden_values(bits: int, expected: tuple[float, ...]) -> None:
    assert states.decompress_quaternion(bits) == pytest.approx(expected, abs=1e-5)


@settings(deadline=None)
@given(st.tuples(component, component, component, component).filter(lambda q: sum(c * c for c in q) > 0.01))
def test_quaternion_agrees_with_the_library(q: tuple[float, float, float, float]) -> None:
    encoding = pytest.importorskip("cflib.utils.encoding")
    bits = encoding.compress_quaternion(list(q))
    ours = states.decompress_quaternion(bits)
    assert ours == pytest.approx(tuple(encoding.decompress_quaternion(bits)), abs=1e-9)
    norm = math.sqrt(sum(c * c for c in q))
    same = abs(sum(a * b / norm for a, b in zip(ours, q, strict=True)))  # q and -q are the same attitude
    assert same == pytest.approx(1.0, abs=1e-4)


def of_message(kind: str, **fields: object) -> commands.Setpoint:
    """What a message in the world becomes, unless its fields say otherwise."""
    message = SimpleNamespace(**({"header": SimpleNamespace(frame_id="world")} | fields))
    return commands.of_message(kind, message, (0.0, 0.0, 0.95), 7.0)


def point(x: float = 0.0, y: float = 0.0, z: float = 0.0, **w: float) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y, z=z, **w)


def full_state(
    place: Any = (), velocity: Any = (), acceleration: Any = (), rates: Any = (), q: Any = LEVEL, **more: Any
):
    pose = SimpleNamespace(position=point(*place), orientation=point(*q[:3], w=q[3]))
    twist = SimpleNamespace(linear=point(*velocity), angular=point(*rates))
    return of_message(commands.FULL_STATE, pose=pose, twist=twist, acc=point(*acceleration), **more)


def test_yaw_of_streamed_commands_is_in_degrees() -> None:
    position = of_message(commands.POSITION, x=1.0, y=2.0, z=0.5, yaw=90.0)
    assert (position.arguments, position.place) == ((1.0, 2.0, 0.5, 90.0), (1.0, 2.0, 0.5))
    velocity = of_message(commands.VELOCITY_WORLD, vel=point(0.3, -0.4), yaw_rate=45.0)
    assert (velocity.arguments, velocity.stamp, velocity.speed) == ((0.3, -0.4, 0.0, 45.0), 7.0, 0.5)
    assert (velocity.place, full_state((1.0,), (0.0, 9.0)).speed) == (None, 9.0)


@pytest.mark.parametrize(("frame", "height"), [("map", 1.45), ("world", 0.5), ("", 0.5), ("/world", 0.5)])
def test_places_are_in_the_world_unless_the_header_says_map(frame: str, height: float) -> None:
    header = SimpleNamespace(frame_id=frame)
    setpoint = full_state((1.0, 0.0, 0.5), (0.3,), (0.0, 0.0, 1.0), (0.1, 0.2, 0.3), header=header)
    place, _, _, _, *rates = setpoint.arguments
    assert (place, setpoint.place) == ((1.0, 0.0, height), (1.0, 0.0, height))
    assert rates == [0.1, 0.2, 0.3]  # rad/s


def test_full_state_is_in_rad_per_second_and_never_overflows() -> None:
    setpoint = full_state((40.0, -40.0, 1.0), (1.0, 2.0, 3.0), (0.0, 0.0, 9.0), (0.1, 99.0, -0.2), (0, 0, 2.0, 0))
    vectors = (32.767, -32.767, 1.0), (1.0, 2.0, 3.0), (0.0, 0.0, 9.0), (0, 0, 1.0, 0)
    assert setpoint.arguments == (*vectors, 0.1, 32.767, -0.2)


def test_full_state_without_attitude_means_level() -> None:
    assert full_state(q=(0.0, 0.0, 0.0, 0.0)).arguments[3] == LEVEL


@settings(deadline=None)
@given(vectors, vectors, vectors, vectors)
def test_every_full_state_fits_its_packet(p: Any, v: Any, a: Any, w: Any) -> None:
    commander = pytest.importorskip("cflib.crazyflie.commander")
    packets: list[Any] = []
    commander.Commander(SimpleNamespace(send_packet=packets.append)).send_full_state_setpoint(
        *full_state(p, v, a, w).arguments
    )
    kind, x, y, z, *_ = struct.unpack("<B9hI3h", bytes(packets[0].data))
    assert kind == 6
    for sent, wanted in zip((x, y, z), p, strict=True):
        assert sent / 1000 == pytest.approx(max(-32.767, min(32.767, wanted)), abs=0.0011)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        of_message(commands.VELOCITY_WORLD, vel=point(0.0, bad), yaw_rate=0.0)
    with pytest.raises(ValueError, match="finite"):
        of_message(commands.POSITION, x=0.0, y=0.0, z=0.0, yaw=bad)
    with pytest.raises(ValueError, match="finite"):
        full_state(rates=(0.0, bad))


def test_map_is_the_middle_of_the_room_and_world_is_the_floor() -> None:
    assert states.to_map((0.3, 0.0, 0.0), (0.0, 0.0, 0.95)) == (0.3, 0.0, -0.95)
    assert states.to_world((0.3, 0.0, -0.95), (0.0, 0.0, 0.95)) == (0.3, 0.0, 0.0)


def test_rotation_into_the_body() -> None:
    left = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))  # heading along y
    assert states.rotate_inverse(left, (0.0, 1.0, 0.5)) == pytest.approx((1.0, 0.0, 0.5))
    assert states.yaw_of(left) == pytest.approx(math.pi / 2)
