"""An agent says in flight that no frame of its own leaves."""

from __future__ import annotations

from dtsa_agent.air.outage import Outage

SECOND = 1_000_000_000


def test_an_outage_is_said_after_a_second_and_at_its_end() -> None:
    said: list[str] = []
    outage = Outage(said.append)
    for now in (0.25, 0.5, 1.24):
        outage.refused("its queue is full", round(now * SECOND))
    assert said == []
    for now in (1.25, 1.5):
        outage.refused("the interface is down", round(now * SECOND))
    assert said == ["no frame has left for 1.0 s: the interface is down"]
    outage.left(round(2.25 * SECOND))
    assert said[1:] == ["frames leave again; for 2.0 s none did, 5 were refused"]
    assert outage.since_ns == 0


def test_a_short_outage_is_only_counted() -> None:
    said: list[str] = []
    outage = Outage(said.append)
    for now in range(10, 20):
        outage.refused("its queue is full", now * SECOND)
        outage.left(now * SECOND + 1)
    Outage(None).refused("nobody is told", 1)
    assert said == []
