"""Reports of agents in real time: what fits fills the accounts, anything else is refused and changes nothing."""

from __future__ import annotations

from array import array
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Report
from rclpy.serialization import serialize_message

from dtsa_agent.ros.common.checks import BadMessage
from dtsa_agent.ros.common.messages import Fields, read_report
from dtsa_channel_sim.ros.answers import Accounts, places_of

AGENTS, STEPS, LATEST = 5, 1, 50
IDS, SLOTS = (2, 3), (7, 8)


def report(**changed: Any) -> Fields:
    """A report of agents 2 and 3 on slots 7 and 8, in which each has taken in the frame of agent 1."""
    entries = len(IDS) * len(SLOTS)
    fields: dict[str, Any] = {
        "agent": array("H", IDS), "slot": array("I", SLOTS), "offset_ns": array("q", [1000] * entries),
        "length": array("B", [0] * entries), "chosen": array("H", [1] * entries), "reason": array("B", [1] * entries),
        "digest": array("I", [9] * entries), "score": array("d", [0.0] * entries), "steps": STEPS,
        "track": array("d", [1.0] * (3 * entries)), "velocity": array("d", [0.5] * (3 * entries)),
        "command": array("d", [0.5] * (3 * entries)), "goal": array("d", [2.0] * (3 * entries)),
        "heard_sender": array("H", [1]), "heard_slot": array("I", [6]), "heard_in": array("I", [7]),
        "heard_ns": array("q", [70_000_000]), "heard_by": array("B", [3]),
    }  # fmt: skip
    return read_report(bytes(serialize_message(Report(**{**fields, **changed}))))


def add(made: Accounts, message: Fields) -> int:
    return made.add(places_of(message.agent, AGENTS), message, LATEST)


def accounts() -> Accounts:
    """Accounts in which the frame of agent 1 in slot 6 was delivered to agent 2 alone."""
    made = Accounts(AGENTS, STEPS, keep=100)
    received = np.array([False, True, False, False, False])
    made.deliver(6, 1, b"frame", 61_000_000, received)
    return made


def test_a_report_fills_accounts_and_only_what_was_delivered_counts_as_taken_in() -> None:
    made = accounts()
    assert add(made, report()) == 8
    assert made[7].silent == [1, 4, 5]
    assert made[8].position[:, 1].tolist() == [1.0, 1.0, 1.0]
    (taken,) = made[7].receipts.values()
    assert taken.at_ns.tolist() == [-1, 70_000_000, -1, -1, -1]
    made.close(7)
    assert add(made, report()) == -1  # slot 7 is over, slot 8 is told twice
    assert made.missed == 2


@pytest.mark.parametrize(("field", "values", "reason"), [
    ("agent", array("H", [3, 2]), "unknown agent"), ("agent", array("H", [2, 6]), "unknown agent"),
    ("agent", array("H"), "unknown agent"), ("slot", array("I", [8, 7]), "slot"),
    ("slot", array("I", [7, LATEST + 1]), "slot"), ("slot", array("I", [7, 2**32 - 1]), "slot"),
    ("heard_in", array("I", [2**32 - 1]), "slot"), ("offset_ns", array("q", [0, 0, 0, 2**62]), "range"),
    ("offset_ns", array("q", [0, -(2**63), 0, 0]), "range"), ("steps", 2, "range"),
    ("score", array("d", [float("nan")] * 4), "range"), ("track", array("d", [float("inf")] * 12), "range"),
    ("velocity", array("d", [1e300] * 12), "range"), ("goal", array("d", [1.0] * 11), "sizes"),
    ("heard_by", array("B", [3, 3]), "sizes"),
])  # fmt: skip
def test_what_cannot_be_is_refused_and_changes_nothing(field: str, values: Any, reason: str) -> None:
    made = accounts()
    with pytest.raises(BadMessage) as caught:
        add(made, report(**{field: values}))
    assert caught.value.reason == reason
    assert not made[7].answered.any()
    assert not made[7].receipts


@given(
    st.dictionaries(
        st.sampled_from(["agent", "slot", "offset_ns", "length", "chosen", "track", "goal", "heard_slot", "heard_by"]),
        st.lists(st.integers(0, 255), max_size=14),
        max_size=4,
    )
)
def test_no_report_does_anything_but_fit_or_be_refused(changed: dict[str, list[int]]) -> None:
    kinds = {"agent": "H", "slot": "I", "offset_ns": "q", "chosen": "H", "track": "d", "goal": "d", "heard_slot": "I"}
    fields = {name: array(kinds.get(name, "B"), values) for name, values in changed.items()}
    made = accounts()
    with suppress(BadMessage):  # any other error would end the channel
        add(made, report(**fields))
    for slot in range(LATEST + 1):
        made.close(slot)
