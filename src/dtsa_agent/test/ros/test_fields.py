"""Integration: messages that are packed and unpacked without rclpy say what rclpy says."""

from __future__ import annotations

from array import array
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Frame, Report, Slot, Transmission
from rclpy.serialization import deserialize_message, serialize_message

from dtsa_agent.ros.common.cdr import ns_of
from dtsa_agent.ros.common.messages import (
    FRAME,
    REPORT,
    SLOT,
    TRANSMISSION,
    CdrMessage,
    Fields,
    header_of,
    read_report,
)

MOST, STEPS = 12, 2
words, stamps = st.integers(0, 2**32 - 1), st.integers(-(2**60), 2**60)
VALUES = {
    "B": st.integers(0, 255), "H": st.integers(0, 2**16 - 1), "I": words, "q": st.integers(-(2**63), 2**63 - 1),
    "d": st.floats(allow_nan=False),
}  # fmt: skip


def sequences(draw: Any, count: Any, **kinds: str) -> dict[str, array[Any]]:
    """Arrays of that many values each, or of as many as a strategy draws, by name: names of their kinds."""
    counts = {name: draw(count) if isinstance(count, st.SearchStrategy) else count for names in kinds.values()
              for name in names.split()}  # fmt: skip
    return {
        name: array(code, draw(st.lists(VALUES[code], min_size=counts[name], max_size=counts[name])))
        for code, names in kinds.items()
        for name in names.split()
    }


@st.composite
def transmissions(draw: Any) -> Transmission:
    n = draw(st.integers(1, MOST))
    lengths = draw(st.lists(st.integers(0, 9), min_size=n, max_size=n))
    fields = sequences(draw, n, H="agent chosen", B="reason", I="digest", d="score")
    fields |= sequences(draw, 3 * n, d="velocity command") | sequences(draw, 3 * STEPS * n, d="track")
    fields |= sequences(draw, draw(st.sampled_from([0, 3 * n])), d="goal") | sequences(draw, sum(lengths), B="data")
    fields["length"] = array("B", lengths)
    header = header_of(draw(st.integers(0, 2**60)))
    return Transmission(header=header, run=draw(words), slot=draw(words), steps=STEPS, **fields)


@st.composite
def slots(draw: Any) -> Slot:
    fields = sequences(draw, draw(st.integers(0, 4)), H="sender", B="length")
    fields |= sequences(draw, st.integers(0, 20), B="data received")
    numbers = {name: draw(words) for name in ("run", "slot", "heard_slot")}
    return Slot(header=header_of(draw(stamps)), phase=draw(st.integers(0, 9)), **numbers, **fields)


@st.composite
def reports(draw: Any) -> Report:
    """Reports of any lengths of their fields, fitting or not."""
    fields = sequences(
        draw, st.integers(0, 4), H="agent chosen heard_sender", I="slot digest heard_slot heard_in",
        q="offset_ns heard_ns", B="length reason heard_by", d="score track velocity command goal",
    )  # fmt: skip
    return Report(header=header_of(draw(stamps)), run=draw(words), steps=draw(VALUES["B"]), **fields)


def values_of(fields: Fields) -> list[Any]:
    """All values of a message, as what can be compared: arrays may hold values that are no numbers."""
    return [value if isinstance(value, int) else bytes(value) for value in fields]


def values_by_rclpy(message: Transmission | Slot | Report) -> list[Any]:
    return values_of([ns_of(message.header.stamp), *(getattr(message, name) for name in type_of(message).fields)])


def type_of(message: Transmission | Slot | Report) -> CdrMessage:
    return {Transmission: TRANSMISSION, Slot: SLOT, Report: REPORT}[type(message)]


def damaged(data: bytes, cut: int, at: int, value: int) -> bytes:
    changed = bytearray(data)
    changed[at % len(data)] ^= value
    return bytes(changed[: len(data) - cut])


@given(transmissions() | slots() | reports(), st.sampled_from(["map", "", "elsewhere"]))
def test_messages_are_read_and_packed_as_by_rclpy(message: Transmission | Slot | Report, frame: str) -> None:
    kind = type_of(message)
    fields = kind.read_fields(bytes(serialize_message(message)))
    assert values_of(fields) == values_by_rclpy(message)
    packed = kind.pack(fields.time_ns, [v if isinstance(v, int) else bytes(v) for v in fields[1:]])
    assert deserialize_message(packed, type(message)) == message
    assert kind.read_fields(packed) == fields
    message.header.frame_id = frame
    assert kind.read_fields(bytes(serialize_message(message))) == fields


@given(reports())
def test_arrays_of_a_report(message: Report) -> None:
    fields = read_report(bytes(serialize_message(message)))
    for name in REPORT.fields:
        value, expected = getattr(fields, name), getattr(message, name)
        if not isinstance(expected, int):
            assert (value.itemsize, value.tobytes()) == (expected.itemsize, expected.tobytes())


@given(words, words, VALUES["H"], st.binary(max_size=60), st.integers(0, 2**60))
def test_frames_are_packed_as_by_rclpy(run: int, slot: int, agent: int, data: bytes, time_ns: int) -> None:
    message = Frame(header=header_of(time_ns), run=run, slot=slot, agent=agent, data=array("B", data))
    assert deserialize_message(FRAME.pack(time_ns, (run, slot, agent, data)), Frame) == message


places, bits = st.integers(0, 10_000), st.integers(0, 255)


@given(transmissions() | slots() | reports(), st.integers(0, 40) | st.just(0), places, bits)
def test_what_is_damaged_is_read_alike_or_not_at_all(
    message: Transmission | Slot | Report, cut: int, at: int, value: int
) -> None:
    data, kind = damaged(bytes(serialize_message(message)), cut, at, value), type_of(message)
    try:
        fields = kind.read_fields(data)
    except ValueError:
        return
    assert values_of(fields) == values_by_rclpy(deserialize_message(data, type(message)))


@pytest.mark.parametrize("data", [b"", b"\0\1\0\0", b"\0\0" + bytes(98), b"\0\1" + b"\xff" * 98])
def test_what_is_no_message_is_an_error(data: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        SLOT.read_fields(data)
