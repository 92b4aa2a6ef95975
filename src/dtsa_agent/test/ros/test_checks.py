"""What may come in over the graph: each check takes what can be, and nothing else."""

from __future__ import annotations

import math
import signal
import subprocess
from array import array
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, call

import pytest
from hypothesis import given
from hypothesis import strategies as st
from waiting import wait_for

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Process, Slot
from nav_msgs.msg import Odometry

from dtsa_agent.ros.common import checks
from dtsa_agent.ros.common.checks import RANGE, SIZES, SLOT, UNKNOWN, BadMessage, Intake, check_slot
from dtsa_agent.ros.common.runs import Call, Run

HEARD = {"sender": [2, 12], "length": [2, 1], "data": [1, 2, 3], "received": [1, 2, 3, 4]}


def reason(check: Any, *arguments: Any) -> str:
    try:
        check(*arguments)
    except BadMessage as error:
        return error.reason
    return ""


@pytest.mark.parametrize(("change", "expected"), [
    ({}, ""), ({"sender": [2, 13]}, UNKNOWN), ({"sender": [0, 2]}, UNKNOWN), ({"sender": [2, 2]}, UNKNOWN),
    ({"sender": [2]}, SIZES), ({"sender": []}, SIZES), ({"length": []}, SIZES), ({"length": [2, 2]}, SIZES),
    ({"length": [3, 0]}, SIZES), ({"length": [61, 1], "data": [0] * 62}, SIZES), ({"data": []}, SIZES),
    ({"received": []}, SIZES), ({"received": [1, 2, 3]}, SIZES), ({"slot": 4_000_000_000}, SLOT),
    ({"heard_slot": 2**32 - 1}, SLOT), ({"phase": 9}, RANGE), ({"phase": Slot.END}, SIZES),
])  # fmt: skip
def test_slot_messages(change: dict[str, Any], expected: str) -> None:
    assert reason(check_slot, Slot(**{**HEARD, **change}), 12) == expected


@pytest.mark.parametrize(("change", "expected"), [
    ({}, ""), ({"agent": []}, UNKNOWN), ({"agent": [2, 1]}, UNKNOWN), ({"agent": [4]}, UNKNOWN),
    ({"dropped": [1]}, SIZES), ({"settings": "x" * 100_000}, SIZES),
])  # fmt: skip
def test_process_messages(change: dict[str, Any], expected: str) -> None:
    assert reason(checks.check_process, Process(**{"agent": [1, 3], **change}), 3) == expected


@pytest.mark.parametrize(("field", "value", "expected"), [
    ("position.x", 3.0, ""), ("position.x", math.nan, RANGE), ("position.z", 1e6, RANGE), ("orientation.w", 0.0, RANGE),
    ("orientation.x", math.inf, RANGE),
])  # fmt: skip
def test_odometry(field: str, value: float, expected: str) -> None:
    message = Odometry()
    part, axis = field.split(".")
    setattr(getattr(message.pose.pose, part), axis, value)
    assert reason(checks.check_odometry, message) == expected


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**50))
def test_transmissions_start_about_now(start_ns: int, now_ns: int) -> None:
    assert (reason(checks.check_start, start_ns, now_ns) == "") == (-60e9 <= start_ns - now_ns <= 10e9)


def test_only_the_channel_can_end_its_run() -> None:
    run = Run.draw()
    call = Call.from_bytes(run.call("/swarm/channel"))
    assert call.ended_by(run.proof)
    assert not call.ended_by(Run.draw().proof)
    assert not call.ended_by(b"")
    assert not call.has_ended
    assert not replace(call, machine="elsewhere").has_ended
    assert replace(call, started=call.started + 1).has_ended


def test_a_stopped_process_is_paused_and_not_gone() -> None:
    call = Call.from_bytes(Run.draw().call("/swarm/channel"))
    with subprocess.Popen(["sleep", "60"]) as process:
        fields = Path(f"/proc/{process.pid}/stat").read_text(encoding="ascii").split()
        call = replace(call, pid=process.pid, started=int(fields[21]))
        try:
            assert not call.is_paused
            assert not call.has_ended
            process.send_signal(signal.SIGSTOP)
            wait_for(lambda: call.is_paused)
            assert not call.has_ended
            assert not replace(call, started=call.started + 1).is_paused
        finally:
            process.kill()
        wait_for(lambda: call.has_ended)
        assert not call.is_paused
    assert not replace(call, machine="elsewhere").is_paused


@given(
    st.one_of(
        st.binary(),
        st.text().map(str.encode),
        st.sampled_from([b"[]", b"{}", b'{"node": 1}', b"1" * 5000, b"[" * 4000]),
    )
)
def test_calls_of_nobody(data: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        Call.from_bytes(data)


def test_texts_from_outside_stand_in_one_line_and_are_never_too_deep() -> None:
    assert checks.plain("/cf1/agent\n\x1b[2J" + "x" * 5000) == "/cf1/agent??[2J" + "x" * 185
    with pytest.raises(ValueError, match="nested"):
        checks.parse_json("[" * 60_000)


def test_what_is_dropped_is_counted_by_reason_and_said_once_in_a_while() -> None:
    log = MagicMock()
    intake = Intake(log)
    for _ in range(1000):
        with intake.guard():
            check_slot(Slot(phase=9), 3)
    with intake.guard():
        check_slot(Slot(sender=array("H", [1])), 3)
    assert intake.counts == {RANGE: 1000, SIZES: 1}
    assert log.mock_calls == [call.warning("not taken in (range): slot message of phase 9; 1 so far")]
