"""Integration: the queue between a thread that reads a device and an agent's hearing."""

from __future__ import annotations

import select
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.air import _queue
from dtsa_agent.air.udp import _socket

ROOM, BURST, LONGEST = 64, 16, 512


def readable(queue: Any) -> bool:
    """Whether `select` says that something has arrived."""
    return bool(select.select([_queue.descriptor(queue)], [], [], 0)[0])


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, 40), max_size=12))
def test_what_is_put_in_comes_out_in_order_and_what_finds_no_room_is_counted(rounds: list[int]) -> None:
    queue, number, waiting, lost = _queue.open_queue(), 0, [], 0
    lent = 0
    for count in rounds:
        for _ in range(count):
            one = (number.to_bytes(2, "little"), number * 10**9, number % 3 == 0)
            taken = _queue.put(queue, *one)
            assert taken == (len(waiting) + lent < ROOM)  # what was read last is kept until the next read
            lost += not taken
            if taken:
                waiting.append(one)
            number += 1
        assert readable(queue) == bool(waiting)
        got = _queue.get(queue)
        assert got == waiting[:BURST]
        waiting, lent = waiting[BURST:], len(got)
        assert readable(queue) == bool(waiting)
    assert _queue.overflowed(queue) == lost


def test_a_datagram_that_is_too_long_is_cut() -> None:
    queue = _queue.open_queue()
    _queue.put(queue, bytes(1000), 1, False)
    assert _queue.get(queue) == [(bytes(LONGEST), 1, False)]


def test_a_port_of_another_kind_is_refused() -> None:
    with pytest.raises(TypeError, match="port of something else"):
        _queue.put(_socket.open_port(-1, bytes(4), 9), b"", 0, False)
