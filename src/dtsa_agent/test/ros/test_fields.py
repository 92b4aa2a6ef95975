"""Integration: messages that are packed and unpacked without rclpy say what rclpy says."""

from __future__ import annotations

from array import array
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Report, Slot, Transmission
from rclpy.serialization import deserialize_message, serialize_message

from dtsa_agent.ros.common.wire import report_fields
from dtsa_agent.ros.common.wire.report_fields import ReportFields, pack_report, read_report
from dtsa_agent.ros.common.wire.slot_fields import SlotFields, _fields, _read_usual, read_slot
from dtsa_agent.ros.common.wire.stamps import header_of, ns_of
from dtsa_agent.ros.common.wire.transmission_fields import TransmissionFields, pack_transmission, read_transmission

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


def told_by(fields: ReportFields) -> list[Any]:
    """All values of a report, as what can be compared: arrays may hold values that are no numbers."""
    return [value if isinstance(value, int) else value.tobytes() for value in fields]


def fields_of(message: Transmission) -> TransmissionFields:
    values = {name: getattr(message, name) for name in TransmissionFields._fields[4:]}
    told = {name: value.tobytes() for name, value in values.items()}
    return TransmissionFields(ns_of(message.header.stamp), message.run, message.slot, message.agent, **told)


def damaged(data: bytes, cut: int, at: int, value: int) -> bytes:
    changed = bytearray(data)
    changed[at % len(data)] ^= value
    return bytes(changed[: len(data) - cut])


@given(transmissions())
def test_transmissions(message: Transmission) -> None:
    told = fields_of(message)
    assert read_transmission(bytes(serialize_message(message)), STEPS) == told
    packed = pack_transmission(told, STEPS)
    assert deserialize_message(packed, Transmission) == message
    assert read_transmission(packed, STEPS) == told


@given(reports())
def test_reports(message: Report) -> None:
    found, by_rclpy = read_report(bytes(serialize_message(message))), report_fields._fields(message)
    assert told_by(found) == told_by(by_rclpy)
    rows = {name: value.tobytes() for name, value in found._asdict().items() if not isinstance(value, int)}
    packed = pack_report(found.time_ns, found.run, found.steps, rows)
    assert report_fields._read_usual(packed) is not None
    assert deserialize_message(packed, Report) == message


@given(slots())
def test_slots(message: Slot) -> None:
    data = bytes(serialize_message(message))
    assert _read_usual(data) == read_slot(data) == _fields(message)


places, bits = st.integers(0, 10_000), st.integers(0, 255)


@given(transmissions() | slots() | reports(), st.integers(0, 40) | st.just(0), places, bits)
def test_what_is_damaged_is_read_alike(message: Transmission | Slot | Report, cut: int, at: int, value: int) -> None:
    data = damaged(bytes(serialize_message(message)), cut, at, value)
    found: TransmissionFields | SlotFields | None
    if isinstance(message, Report):
        report = report_fields._read_usual(data)
        if report is not None:
            assert told_by(report) == told_by(report_fields._fields(deserialize_message(data, Report)))
    elif isinstance(message, Slot):
        found = _read_usual(data)
        assert found is None or found == _fields(deserialize_message(data, Slot))
    else:
        found = read_transmission(data, STEPS)
        assert found is None or found == fields_of(deserialize_message(data, Transmission))


def test_what_is_laid_out_in_another_way_is_left_to_rclpy() -> None:
    message = Slot(slot=7, data=[1, 2])
    message.header.frame_id = "elsewhere"
    data = bytes(serialize_message(message))
    assert _read_usual(data) is None
    assert read_slot(data) == _fields(message)
    assert read_transmission(data, STEPS) is None
    with pytest.raises(Exception, match="deserialize"):
        read_slot(data[:30])
