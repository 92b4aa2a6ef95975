"""Radios that listen before they send: hidden senders, turning to sending, patience, and rules that cannot be."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import PluginError
from dtsa_agent.core.plugins.guard import Guarded
from dtsa_agent.core.registry import POLICIES
from dtsa_channel_sim import Air, Channel, ChannelConfig
from dtsa_channel_sim.model.air import NEVER
from dtsa_channel_sim.model.radios import Radios, radio_rules
from dtsa_channel_sim.ros.live_air import LiveAir

MS = 1_000_000
LENGTH = 60
AIRTIME = ChannelConfig(agents=3).airtime
TURN, WHOLE = AIRTIME.ramp_up_ns, AIRTIME.total_ns(LENGTH)


class Waits:
    """Begins if the air is free, else listens again a tenth of a millisecond later."""

    def __init__(self, config: object = None, agent: int = 0) -> None:
        self.answer: Any = 100_000

    def wake(self, table: object, now_ns: int, radio: object) -> int:
        return now_ns + 1

    def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> Any:
        return self.answer if busy else 0


def radios(air: Air[Any], rule: type = Waits) -> Radios[Any]:
    return Radios(air, [Guarded("policy", "waits", rule, None, agent) for agent in (1, 2, 3)])


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
            begun.append(released.now_ns)
            air.begin(released.agent, released.agent, released.now_ns, LENGTH)
    return begun, {verdict.sender: verdict.collided for verdict in air.settle(20 * MS, places)}


def test_who_hears_another_one_waits_and_hidden_senders_collide_between_them() -> None:
    (first, second), collided = sends(7.0, 1 * MS, 1 * MS + TURN)
    assert first == 1 * MS
    assert first + WHOLE <= second < first + WHOLE + 100_000
    assert collided == {1: 0, 3: 0}
    assert sends(4.0, 1 * MS, 1 * MS + TURN) == ([1 * MS, 1 * MS + TURN], {1: 1, 3: 1})


def test_a_radio_that_turns_to_sending_is_not_heard() -> None:
    begun, collided = sends(7.0, 1 * MS, 1 * MS + TURN - 1)
    assert begun == [1 * MS, 1 * MS + TURN - 1]
    assert collided == {1: 2, 3: 2}


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (0, "sensed: gave 0 ns; allowed: whole numbers from 1, as the air is in use"),
        (None, "sensed: gave None ns"),
        (1, "sensed: listened 10000 times for one frame"),
    ],
)
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


def test_every_radio_has_random_numbers_of_its_own() -> None:
    """Also other ones than the agent draws for itself with the same seed."""
    config = SwarmConfig(agents=3, policy="csma", seed=4)
    rules = radio_rules(config)
    own = POLICIES.factory("csma")(config, 1)
    waits = [tuple(rule.sensed(True, 9 * MS, 0) for _ in range(4)) for rule in (*rules, own)]
    assert len(set(waits)) == 4
    assert [rule.sensed(False, 9 * MS, 0) for rule in rules] == [0, 0, 0]


PLACES = np.zeros((3, 3))
FRAME = bytes(LENGTH)


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Iterator[LiveAir]:
    """The air of a run in real time, slots of 10 ms, with radios that listen; frames of 60 bytes take 7.8 ms."""
    monkeypatch.setattr(POLICIES, "_plug_ins", {})
    POLICIES.register("waits", type("Whole", (Waits,), {"wake": print, "sent": print, "port": ("send", "busy")}))
    air = LiveAir(Channel(ChannelConfig(agents=3, bitrate=74_000)))
    with air.radios({"policy": "waits", "agents": 3, "slot_ms": 10, "mode": "realtime", "steps": 1}):
        yield air


def test_frames_in_real_time_begin_when_their_radios_find_the_air_free(live: LiveAir) -> None:
    assert live.listens
    assert live.spare_ns(0, 2 * MS) == 2 * MS
    for agent, start_ns in ((2, 3 * MS), (1, 2 * MS)):  # in any order, ahead of time
        assert live.hand_over((0, agent), start_ns, FRAME) is None
    assert live.spare_ns(2 * MS, 2 * MS) == live.hold_ns
    live.hand_over((1, 3), 12 * MS, FRAME)
    live.hand_over((1, 2), 10 * MS, FRAME)  # agent 2 has something newer to say
    assert live.given_up == 1
    assert live.holds((1, 2))
    assert not live.holds((0, 2))
    starts, received = {}, []
    for now in range(0, 60 * MS, MS):
        starts |= {begun.key: begun.start_ns for begun in live.listen(now, PLACES)}
        received += [int(verdict.received.sum()) for verdict in live.settle(now, PLACES)]
    assert list(starts) == [(0, 1), (1, 2), (1, 3)]
    assert starts[0, 1] == 2 * MS
    assert starts[1, 2] == 10 * MS
    assert 0 <= starts[1, 3] - 10 * MS - ChannelConfig(agents=3, bitrate=74_000).airtime.total_ns(LENGTH) < 100_000
    assert received == [2, 2, 2]
    # One that comes when others have been listened to listens from then on; one that comes a slot late is dropped.
    live.hand_over((5, 1), 58 * MS, FRAME)
    live.hand_over((4, 2), 48 * MS, FRAME)
    assert (live.late, live.given_up) == (1, 1)
    (late,) = live.listen(70 * MS, PLACES)
    assert late.start_ns == 59 * MS - live.hold_ns


def test_a_radio_gives_up_after_a_slot_without_free_air(live: LiveAir) -> None:
    live.hand_over((0, 1), 0, bytes(255))
    live.hand_over((0, 2), 1 * MS, FRAME)
    assert [begun.key for begun in live.listen(11 * MS + live.hold_ns, PLACES)] == [(0, 1)]
    assert (live.given_up, live.holds((0, 2))) == (0, True)
    assert list(live.listen(12 * MS, PLACES)) == []
    assert (live.given_up, live.holds((0, 2))) == (1, False)
