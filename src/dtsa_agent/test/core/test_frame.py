"""The frame codec, profiles paper and extended: golden vectors, round trips, saturation, rejection."""

from __future__ import annotations

import dataclasses
import math

import pytest
from frame_helpers import encode_extended
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.core import Frame, LocalProtocolError, RemoteProtocolError, decode_frame, encode_frame
from dtsa_agent.core.frame import EXTENDED_LENGTH, ExtendedFrame, Gossip, decode_extended, named_in
from dtsa_agent.core.reference import frame as plain

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


OWN = Frame(3, 17, 1, (1.0, 2.0, -3.0), (0.5, -0.5, 0.0), (1.0, 0.0, 0.0))
FULL = ExtendedFrame(
    OWN, 2, False, True, (Gossip(7, 5, True, (1.0, 1.0, 1.0), (0.0, 0.0, -1.0)),), b"\x01\xff" + bytes(9),
    ((1, 4), (24, 255)),
)  # fmt: skip
FAR = ExtendedFrame(OWN, far=(25, 33, 104), far_lessee=9)
GOLDEN_EXTENDED = [
    (ExtendedFrame(OWN), "1203000111000000f401e80324fa32e0fc004006000000" + "00" * 33),
    (FULL, "1203022711000000f401e80324fa32e0fc004006000000" + "01ff000000000000000000" + "01008004ff000000000000"
           + "070bfa803ea00f000080f3"),
    (FAR, "1203000d11000000f401e80324fa32e0fc004006000000" + "09" + "0101" + "00" * 7 + "80" + "00" * 22),
    (ExtendedFrame(OWN, leaving=True), "1203ff0111000000f401e80324fa32e0fc004006000000" + "00" * 33),
]  # fmt: skip

metres = st.integers(-8000, 8000).map(lambda q: q * 0.004)
steps = st.integers(-500, 500).map(lambda q: q * 0.02)
places = st.tuples(metres, metres, metres)
velocities = st.tuples(steps, steps, steps)
gossips = st.builds(Gossip, st.integers(1, 254), st.integers(1, 127), st.booleans(), places, velocities)
relays = st.dictionaries(st.integers(1, 24), st.integers(1, 255), max_size=8).map(lambda d: tuple(sorted(d.items())))
fars = st.sets(st.integers(25, 104), max_size=80)


@st.composite
def extended_frames(draw: st.DrawFn) -> ExtendedFrame:
    relay = draw(relays)
    lease_sections = draw(st.integers(0, 2))
    leases = draw(st.binary(min_size=11 * lease_sections, max_size=11 * lease_sections))
    room = 3 - lease_sections - bool(relay)
    far = tuple(sorted(draw(fars))) if room else ()
    room -= bool(far)
    own = Frame(
        draw(st.integers(1, 254)), draw(st.integers(0, 2**32 - 1)), draw(st.integers(0, 1)), draw(places),
        draw(velocities), draw(velocities),
    )  # fmt: skip
    leaving = draw(st.booleans())
    c_s = 0 if leaving else draw(st.integers(0, 253))
    return ExtendedFrame(
        own, c_s, leaving, draw(st.booleans()), tuple(draw(st.lists(gossips, max_size=room))), leases, relay,
        far, draw(st.integers(1, 254)) if far else 0,
    )  # fmt: skip


@pytest.mark.parametrize(("frame", "text"), GOLDEN_EXTENDED)
def test_golden_bytes_of_extended_frames(frame: ExtendedFrame, text: str) -> None:
    assert encode_extended(frame).hex() == text
    assert decode_extended(bytes.fromhex(text)) == frame


@given(extended_frames())
def test_extended_frames_come_back(frame: ExtendedFrame) -> None:
    data = encode_extended(frame)
    assert len(data) == EXTENDED_LENGTH
    assert decode_extended(data) == frame
    assert encode_extended(decode_extended(data)) == data


def test_the_state_has_the_bytes_of_the_papers_frame() -> None:
    paper = encode_frame(OWN)
    assert encode_extended(ExtendedFrame(OWN))[4:23] == paper[4:23]


def test_gossip_saturates() -> None:
    far = Gossip(1, 1, True, (1e9, -1e9, 40.0), (99.0, -99.0, 0.0))
    own = dataclasses.replace(OWN, position=(1e9, -1e9, 0.0), velocity=(1e9, -1e9, 0.0))
    heard = decode_extended(encode_extended(ExtendedFrame(own, gossip=(far,))))
    assert heard.gossip[0].position == pytest.approx((32.764, -32.768, 32.764))
    assert heard.gossip[0].velocity == pytest.approx((10.22, -10.24, 0.0))
    assert heard.own.position == pytest.approx((65.534, -65.536, 0.0))
    assert heard.own.velocity == pytest.approx((20.47, -20.48, 0.0))


GONE = ((0.0,) * 3, (0.0,) * 3)


@pytest.mark.parametrize(("base", "change"), [
    *((FULL, change) for change in (
        {"c_s": 254}, {"c_s": -1}, {"leases": bytes(34)}, {"relay": ((0, 1),)}, {"relay": ((25, 1),)},
        {"relay": ((2, 1), (1, 1))}, {"relay": ((1, 0),)}, {"relay": tuple((d, 1) for d in range(1, 10))},
        *({"gossip": (Gossip(agent, age, True, *GONE),)} for agent, age in ((255, 1), (1, 0), (1, 128))),
        {"gossip": (Gossip(1, 1, True, (float("nan"),) * 3, (0.0,) * 3),)}, {"gossip": FULL.gossip * 3},
        *({"own": dataclasses.replace(OWN, sender=sender)} for sender in (0, 255)),
    )),
    *((FAR, {"far": far, "far_lessee": lessee}) for far, lessee in (
        ((24,), 1), ((105,), 1), ((26, 25), 1), ((25, 25), 1), ((25,), 0), ((), 1), ((25,), 255), ((25,), -1),
        ((25,), 256),
    )),
])  # fmt: skip
def test_what_cannot_be_said(base: ExtendedFrame, change: dict[str, object]) -> None:
    frame = dataclasses.replace(base, **change)  # type: ignore[arg-type]
    for encode in (encode_extended, lambda frame: plain.encode_extended(frame, 0.002)):
        with pytest.raises(LocalProtocolError, match="not encodable"):
            encode(frame)


@pytest.mark.parametrize(("at", "value"), [(23, 0), (23, 255), (3, 0x0D | 0x30)])
def test_what_is_no_far_section(at: int, value: int) -> None:
    """No lessee, OPEN as one, two such sections; and below none that hands nothing on."""
    empty = bytearray(encode_extended(FAR))
    empty[24:34] = bytes(10)
    wrong = bytearray(encode_extended(FAR))
    wrong[at] = value
    for data in (bytes(empty), bytes(wrong)):
        with pytest.raises(RemoteProtocolError):
            decode_extended(data)
        with pytest.raises(plain.Refused):
            plain.decode_extended(data, 0.002)


@pytest.mark.parametrize("change", [
    {"far": (25,), "far_lessee": 254}, {"far": tuple(range(25, 105)), "far_lessee": 1},
    {"c_s": 253}, {"c_s": 0}, {"leases": bytes(22)}, {"leases": b"\x01" * 33, "relay": (), "gossip": ()},
    {"relay": ((1, 1),)}, {"relay": ((24, 255),)}, {"relay": tuple((d, 1) for d in range(1, 9))},
    {"gossip": (Gossip(254, 127, True, *GONE),)}, {"gossip": (Gossip(1, 1, False, *GONE),)},
    {"gossip": FULL.gossip * 3, "leases": b"", "relay": ()},
    {"own": dataclasses.replace(OWN, sender=254)}, {"own": dataclasses.replace(OWN, sender=1)},
])  # fmt: skip
def test_what_is_at_a_limit_can_be_said(change: dict[str, object]) -> None:
    frame = dataclasses.replace(FULL, **{"leases": b"", "relay": (), **change})  # type: ignore[arg-type]
    data = encode_extended(frame)
    assert plain.encode_extended(frame, 0.002) == data
    assert plain.decode_extended(data, 0.002) == decode_extended(data)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_gossip_fits_up_to_a_step_before_it_saturates(sign: float) -> None:
    step, rest = 0.002, (0.0, 0.0, 0.0)
    far, fast = sign * 2.0 * step * 8190, sign * plain.GOSSIP_VELOCITY_STEP * 510
    for axis in range(3):
        for value, fits in ((1.0, True), (1.001, False)):
            at = tuple(far * value if k == axis else 0.0 for k in range(3))
            by = tuple(fast * value if k == axis else 0.0 for k in range(3))
            assert plain.gossip_fits(at, rest, step) is fits  # type: ignore[arg-type]
            assert plain.gossip_fits(rest, by, step) is fits  # type: ignore[arg-type]
    assert not plain.gossip_fits((float("nan"), 0.0, 0.0), rest, step)


@pytest.mark.parametrize(("at", "value"), [
    (0, 0x22), (0, 0x13), (1, 0), (1, 255), (2, 254), (3, 0x2B), (3, 0x29), (3, 0x0F), (34, 0xFF), (39, 9), (37, 0),
    (46, 0), (45, 255), (46, 1), (50, 1),
])  # fmt: skip
def test_what_is_no_extended_frame(at: int, value: int) -> None:
    """Version, profile, ids, c_s, kinds of sections (two relays, an unknown one), a wrong relay, gossip of nobody."""
    data = bytearray(encode_extended(FULL if at < 50 else ExtendedFrame(OWN)))
    data[at] = value
    with pytest.raises(RemoteProtocolError):
        decode_extended(bytes(data))
    for length in (*range(24), 55, 57, 60):
        with pytest.raises(RemoteProtocolError, match="wrong length"):
            decode_extended((encode_extended(FULL) + bytes(4))[:length])
