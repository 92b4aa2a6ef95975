"""The frame codec, profile paper: golden vectors, round trips, saturation, rejection."""

from __future__ import annotations

import math

import pytest
from frame_helpers import encode_extended
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.core import Frame, LocalProtocolError, RemoteProtocolError, decode_frame, encode_frame
from dtsa_agent.core.frame import ExtendedFrame, named_in

# Written down by hand from the layout in docs/reference/protocol.md: header 10 or 11, id, c_r, slot, position / 2 mm,
# velocity / 1 cm/s in 12 bits each, low nibble first.
GOLDEN = [
    (Frame(1, 0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), "10 0100 00 00000000 0000 0000 0000 000000 0000"),
    (Frame(18, 1000, 1, (1.0, -2.0, 0.5), (1.5, -0.01, 0.0)), "10 1200 01 e8030000 f401 18fc fa00 96f0ff 0000"),
    (
        Frame(300, 2**32 - 1, 255, (65.534, -65.536, 0.002), (20.47, -20.48, -0.02)),
        "10 2c01 ff ffffffff ff7f 0080 0100 ff0780 fe0f",
    ),
    (
        Frame(2, 7, 1, (0.0, 0.0, 0.004), (0.0, 0.0, 0.01), (0.02, -0.01, 0.03)),
        "11 0200 01 07000000 0000 0000 0200 000000 012000 ff3f00",
    ),
]

coordinate = st.floats(-65.5, 65.5)
speed = st.floats(-20.4, 20.4)
vectors = st.tuples(coordinate, coordinate, coordinate)
speeds = st.tuples(speed, speed, speed)
frames = st.builds(
    Frame, st.integers(1, 65535), st.integers(0, 2**32 - 1), st.integers(0, 255), vectors, speeds, st.none() | speeds
)


@pytest.mark.parametrize(("frame", "text"), GOLDEN)
def test_golden_vectors(frame: Frame, text: str) -> None:
    data = bytes.fromhex(text)
    assert encode_frame(frame) == data
    back = decode_frame(data)
    assert (back.sender, back.slot, back.c_r) == (frame.sender, frame.slot, frame.c_r)
    assert back.position == pytest.approx(frame.position, abs=1e-12)
    assert back.velocity == pytest.approx(frame.velocity, abs=1e-12)
    assert back.intent is None if frame.intent is None else back.intent == pytest.approx(frame.intent, abs=1e-12)


@given(frames)
def test_round_trip_is_within_half_a_step(frame: Frame) -> None:
    data = encode_frame(frame)
    assert len(data) == (19 if frame.intent is None else 23) <= 30
    back = decode_frame(data)
    assert encode_frame(back) == data
    assert (back.sender, back.slot, back.c_r) == (frame.sender, frame.slot, frame.c_r)
    assert all(abs(a - b) <= 0.001 + 1e-12 for a, b in zip(frame.position, back.position, strict=True))
    assert all(abs(a - b) <= 0.005 + 1e-12 for a, b in zip(frame.velocity, back.velocity, strict=True))
    assert (frame.intent is None) == (back.intent is None)


@given(st.binary(max_size=40))
def test_what_decodes_encodes_to_the_same_bytes(data: bytes) -> None:
    try:
        frame = decode_frame(data)
    except RemoteProtocolError:
        return
    assert encode_frame(frame) == data


@pytest.mark.parametrize("huge", [1e9, 1e300, math.inf])
def test_fields_saturate_and_never_wrap(huge: float) -> None:
    back = decode_frame(encode_frame(Frame(1, 0, 1, (huge, -huge, 0.0), (-huge, huge, 0.0), (huge, 0.0, -huge))))
    assert back.position == pytest.approx((65.534, -65.536, 0.0))
    assert back.velocity == pytest.approx((-20.48, 20.47, 0.0))
    assert back.intent == pytest.approx((20.47, 0.0, -20.48))


@pytest.mark.parametrize("change", [{"position": (math.nan, 0, 0)}, {"sender": 0}, {"sender": 70000}, {"c_r": 256}])
def test_our_own_mistakes_are_refused(change: dict[str, object]) -> None:
    fields: dict[str, object] = {"sender": 1, "slot": 0, "c_r": 1, "position": (0.0,) * 3, "velocity": (0.0,) * 3}
    with pytest.raises(LocalProtocolError):
        encode_frame(Frame(**(fields | change)))  # type: ignore[arg-type]


def test_what_is_no_frame_is_refused() -> None:
    good = encode_frame(GOLDEN[1][0])
    for length in range(len(good)):
        with pytest.raises(RemoteProtocolError, match="length"):
            decode_frame(good[:length])
    with pytest.raises(RemoteProtocolError, match="length"):
        decode_frame(good + b"\0")
    with pytest.raises(RemoteProtocolError, match="version"):
        decode_frame(b"\x20" + good[1:])
    with pytest.raises(RemoteProtocolError, match="profile"):
        decode_frame(b"\x1f" + good[1:])
    with pytest.raises(RemoteProtocolError, match="range"):
        decode_frame(good[:1] + b"\0\0" + good[3:])
    with pytest.raises(RemoteProtocolError, match="range"):
        decode_frame(good[:-1] + bytes([good[-1] | 0xF0]))


@given(st.integers(1, 254), st.integers(0, 2**32 - 1), st.booleans(), st.binary(max_size=20))
def test_a_frame_of_any_profile_names_its_sender_and_slot(sender: int, slot: int, intent: bool, tail: bytes) -> None:
    zero = (0.0, 0.0, 0.0)
    own = Frame(sender, slot, 1, zero, zero, zero if intent else None)
    for data in (encode_frame(own), encode_extended(ExtendedFrame(own))):
        assert named_in(data + tail) == (sender, slot)
        assert named_in(data[:7]) is None
    assert named_in(bytes(24)) is None
