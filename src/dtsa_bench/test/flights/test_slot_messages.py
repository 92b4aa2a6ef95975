"""What follows from a slot, as messages that rclpy reads."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Decision, Reception
from rclpy.serialization import deserialize_message

from dtsa_agent.core import REASONS, SwarmConfig, make_scenario
from dtsa_agent.ros.common.wire.stamps import header_of
from dtsa_bench.flights.slot_messages import SlotMessages
from dtsa_channel_sim.model.verdict import COLLISION, SUCCESS, Verdict
from dtsa_channel_sim.ros.answers import Answers

AGENTS, RUN, SLOT_NS = 9, 77, 10_000_000
PACKED = SlotMessages(make_scenario(SwarmConfig(agents=AGENTS)), SLOT_NS, RUN)


def head(slot: int, at: int) -> dict[str, Any]:
    return {"header": header_of(1_000_000_000 + at * SLOT_NS), "run": RUN, "slot": slot}


@settings(max_examples=50)
@given(st.integers(0, 2**31), st.lists(st.integers(0, len(REASONS) + 2), min_size=AGENTS, max_size=AGENTS))
def test_decisions(slot: int, reasons: list[int]) -> None:
    answers = Answers(AGENTS, 1)
    answers.reason[:] = reasons
    answers.chosen[:] = np.arange(AGENTS) * 7
    answers.digest[:] = np.arange(AGENTS) + 2**31
    answers.score[:] = np.arange(AGENTS) / 3
    message = deserialize_message(PACKED.decision(slot, answers), Decision)
    told = [message.reason_name[index] for index in message.reason_index]
    assert told == [REASONS[code] if code < len(REASONS) else str(code) for code in reasons]
    expected = {name: getattr(answers, name).tolist() for name in ("chosen", "digest", "score")}
    names = {"reason_name": message.reason_name, "reason_index": message.reason_index}
    assert message == Decision(**head(slot, slot), agent=range(1, AGENTS + 1), reason=reasons, **expected, **names)
    assert len(set(message.reason_name)) == len(message.reason_name) == len(set(reasons))


def test_combinations_of_reasons_are_not_kept_for_ever() -> None:
    packed, answers = SlotMessages(make_scenario(SwarmConfig(agents=AGENTS)), SLOT_NS, RUN), Answers(AGENTS, 1)

    def pack(first: int) -> int:
        for slot in range(first, first + 700):
            answers.reason[:] = [(slot >> bit) & 1 for bit in range(AGENTS)][::-1]
            answers.reason[0] = slot % 7
            packed.decision(slot, answers)
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = pack(0)
        assert pack(700) < before + 50_000
    finally:
        tracemalloc.stop()


def test_receptions() -> None:
    mask = np.zeros((2, AGENTS), dtype=np.bool_)
    mask[0, 8] = mask[1, 0] = True
    crash = Verdict(COLLISION, (2, 5), mask, (1, 0), (6, 7))
    message = deserialize_message(PACKED.reception(3, crash), Reception)
    assert message == Reception(
        **head(3, 4), outcome=COLLISION, sender=[2, 5], received=[0, 1, 1, 0], lost=[1, 0], collided=[6, 7]
    )
    single = deserialize_message(PACKED.reception(3, Verdict(SUCCESS, (9,), None, None, None)), Reception)
    assert single == Reception(**head(3, 4), outcome=SUCCESS, sender=[9], received=[255, 0], lost=[0], collided=[0])
    nobody = deserialize_message(PACKED.reception(3, Verdict(0, (), None, None, None)), Reception)
    assert nobody == Reception(**head(3, 4))
