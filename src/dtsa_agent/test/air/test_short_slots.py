"""Slots that are too short for a network: when an agent says so."""

from __future__ import annotations

from dtsa_agent.air.short_slots import ShortSlots


def test_an_agent_says_once_that_slots_are_too_short() -> None:
    said: list[str] = []
    slots = ShortSlots(10.0, said.append)
    for timed, off in ((99, 99), (100, 100), (199, 199), (200, 105), (300, 110)):
        slots.judge(timed, off)
        assert not slots.found  # the first hundred do not count, nor do a few
    slots.judge(410, 121)
    assert slots.found
    assert said == [
        "slots of 10 ms are too short for this network: 10% of the last 110 frames were off by more than a quarter of "
        "a slot"
    ]
    slots.judge(600, 300)
    assert len(said) == 1
    ShortSlots(10.0, None).judge(200, 200)
