"""Which slot it is, from what is heard."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.reference.timebase import (
    ALIGNED,
    ALONE,
    FOREIGN,
    JOINED,
    LISTENING,
    RESTARTED,
    ClockAligner,
    TimeBase,
)

SLOT = 10_000_000
ROUND = 5 * 4 * SLOT


def base(agent: int = 1, seed: int = 1) -> TimeBase:
    return TimeBase(
        agents=4, anchor_every=5, slot_ns=SLOT, agent=agent, seed=seed, aligner=ClockAligner(receptions=1, gain=0.5)
    )


def test_the_first_frame_says_which_slot_it_is() -> None:
    b = base()
    b.start(1_000)
    assert b.slot(2_000) is None
    assert b.hear(777, 123_456) == RESTARTED
    assert b.state == JOINED
    assert b.slot_start_ns(777) == 123_456
    assert (b.slot(123_455), b.slot(123_456), b.slot(123_456 + SLOT)) == (776, 777, 778)
    assert b.restarts == 0


@given(st.integers(0, 2**62), st.integers(1, 254), st.integers(0, 10**15))
def test_silence_makes_an_agent_begin_by_itself(seed: int, agent: int, now: int) -> None:
    b = base(agent, seed)
    deadline = b.start(now)
    assert ROUND <= deadline - now < 2 * ROUND  # everybody alive would have been heard by then
    assert not b.wake(deadline - 1)
    assert b.state == LISTENING
    assert b.wake(deadline)
    assert b.state == ALONE
    assert b.slot(deadline) == 5 * 4  # not slot 0, which is for those who start together
    assert not b.wake(deadline)


def test_agents_wait_for_different_times() -> None:
    assert len({base(agent).start(0) for agent in range(1, 51)}) == 50
    assert base(1, seed=2).start(0) != base(1, seed=3).start(0)


def test_of_two_times_the_later_one_wins() -> None:
    ahead, behind = base(), base()
    ahead.hear(1000, 0)
    behind.hear(500, 0)
    assert ahead.hear(500, 0) == FOREIGN
    assert ahead.slot_start_ns(1000) == 0
    assert behind.hear(1003, 3 * SLOT) == RESTARTED
    assert behind.slot_start_ns(1000) == 0
    assert behind.restarts == 1
    alone = base()
    alone.wake(alone.start(0))
    assert alone.hear(100_000, 5 * ROUND) == RESTARTED
    assert alone.state == JOINED


def test_slots_move_towards_what_is_heard() -> None:
    b = base()
    b.hear(10, 0)
    assert b.hear(11, SLOT + 1000) == ALIGNED
    assert b.slot_start_ns(12) == 2 * SLOT + 500
    assert b.hear(12, 2 * SLOT - 500) == ALIGNED
    assert b.slot_start_ns(13) == 3 * SLOT
    assert b.restarts == 0


def test_alone_until_somebody_of_the_same_time_is_heard() -> None:
    b = base()
    b.wake(b.start(0))
    slot = b.slot(2 * ROUND)
    assert slot is not None
    assert b.hear(slot, b.slot_start_ns(slot) + 10) == ALIGNED
    assert b.state == JOINED


@pytest.mark.parametrize("wrong", [(0, 5, SLOT, 1), (4, 0, SLOT, 1), (4, 5, 0, 1), (4, 5, SLOT, 0)])
def test_settings_that_are_refused(wrong: tuple[int, int, int, int]) -> None:
    assert not lib.dtsa_timebase_init(ffi.new("dtsa_timebase *"), *wrong, 1)
