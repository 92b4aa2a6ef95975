"""Integration: radios that listen before they send: hidden senders, turning to sending, rules that cannot be."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dtsa_agent.core.errors import PluginError
from dtsa_agent.core.plugins import Guarded
from dtsa_bench.simulation.unslotted import ListeningRadios
from dtsa_channel_sim import Air, Channel, ChannelConfig
from dtsa_channel_sim.model.air import NEVER

MS = 1_000_000
LENGTH = 60
AIRTIME = ChannelConfig(agents=3).airtime
TURN, WHOLE = AIRTIME.ramp_up_ns, AIRTIME.total_ns(LENGTH)


class Waits:
    """Begins if the air is free, else listens again a tenth of a millisecond later."""

    def __init__(self, config: object = None, agent: int = 0) -> None:
        pass

    def wake(self, table: object, now_ns: int, radio: object) -> int:
        return now_ns + 1

    def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> Any:
        return 100_000 if busy else 0


def radios(air: Air[Any], rule: type = Waits) -> ListeningRadios:
    return ListeningRadios(air, [Guarded("policy", "waits", rule, None, agent) for agent in (1, 2, 3)])


def sends(range_m: float, *at_ns: int) -> tuple[list[int], dict[int, int]]:
    """Agents 1, 2, 3 stand in a line, 3 m apart: when those with a time begin, and at how many others they collide."""
    places = np.array([[0.0, 3.0, 6.0], [0.0] * 3, [0.0] * 3])
    air: Air[int] = Air(Channel(ChannelConfig(agents=3, range_m=range_m)))
    of_all = radios(air)
    for agent, start_ns in zip((1, 3, 2), at_ns, strict=False):
        of_all.hand_over(agent, start_ns)
    begun = []
    while of_all.next[0] < NEVER:
        released = of_all.listen(places)
        if released is not None:
            now_ns, agent = released
            begun.append(now_ns)
            air.begin(agent, agent, now_ns, LENGTH)
    return begun, {verdict.sender: verdict.collided for verdict in air.resolve(20 * MS, places)}


def test_who_hears_another_one_waits_and_hidden_or_turning_senders_collide() -> None:
    (first, second), collided = sends(7.0, 1 * MS, 1 * MS + TURN)
    assert first == 1 * MS
    assert first + WHOLE <= second < first + WHOLE + 100_000
    assert collided == {1: 0, 3: 0}
    assert sends(4.0, 1 * MS, 1 * MS + TURN) == ([1 * MS, 1 * MS + TURN], {1: 1, 3: 1})
    begun, collided = sends(7.0, 1 * MS, 1 * MS + TURN - 1)
    assert begun == [1 * MS, 1 * MS + TURN - 1]
    assert collided == {1: 2, 3: 2}


@pytest.mark.parametrize(("answer", "said"), [
    (0, "sensed: gave 0 ns; allowed: whole numbers from 1, as the air is in use"), (None, "sensed: gave None ns"),
    (1, "sensed: listened 10000 times for one frame"),
])  # fmt: skip
def test_rules_that_cannot_be_are_named(answer: Any, said: str) -> None:
    class Wrong(Waits):
        def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> Any:
            return answer if busy else 0

    air: Air[int] = Air(Channel(ChannelConfig(agents=3)))
    of_all = radios(air, Wrong)
    air.begin(0, 1, 0, 255)
    of_all.hand_over(2, TURN)
    with pytest.raises(PluginError, match=f"policy waits, {said}"):
        all(of_all.listen() is None for _ in range(20_000))
