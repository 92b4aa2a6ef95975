"""Integration: radios that listen before they send: hidden senders, turning to sending, rules that cannot be."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import pytest

import dtsa
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import PluginError
from dtsa_agent.core.plugins import make_swarm
from dtsa_bench.simulation.unslotted import UnslottedTraffic
from dtsa_channel_sim import Air, Channel, ChannelConfig

MS = 1_000_000
AIRTIME = ChannelConfig(agents=3).airtime
TURN = AIRTIME.ramp_up_ns


class Waits:
    """Begins if the air is free, else listens again a tenth of a millisecond later."""

    port = ("send", "sent", "received", "busy")
    starts_ns: dict[int, int]
    answer: Any
    begun: list[int]

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self._start_ns = self.starts_ns.get(agent, 10**12)

    def wake(self, table: object, now_ns: int, radio: Any) -> int:
        if now_ns >= self._start_ns:
            radio.send()
        return max(now_ns + 1, self._start_ns)

    def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> Any:
        return self.answer if busy else 0

    def sent(self, table: object, now_ns: int) -> int:
        self.begun.append(now_ns)
        return 10**12


class RecordingAir(Air[Any]):
    """Keeps at how many others each sender's frame collided."""

    def __init__(self, channel: Channel) -> None:
        super().__init__(channel)
        self.collided: dict[int, int] = {}

    def resolve(self, *arguments: Any) -> Any:
        verdicts = super().resolve(*arguments)
        self.collided.update({verdict.sender: verdict.collided for verdict in verdicts})
        return verdicts


@pytest.fixture(autouse=True, scope="module")
def policy() -> None:
    dtsa.register("policy", "waits", Waits)


def sends(range_m: float, *at_ns: int, answer: Any = 100_000) -> tuple[list[int], dict[int, int]]:
    """Agents 1, 2, 3 stand in a line, 3 m apart: when those with a time begin, and at how many others they collide."""
    Waits.starts_ns, Waits.answer, Waits.begun = dict(zip((1, 3, 2), at_ns, strict=False)), answer, []
    swarm = make_swarm(SwarmConfig(agents=3, policy="waits", slot_ms=20, frame="extended"))
    swarm.position[:] = np.array([[0.0, 3.0, 6.0], [0.0] * 3, [0.0] * 3])
    channel = Channel(ChannelConfig(agents=3, range_m=range_m, slot_ns=20 * MS))
    traffic = UnslottedTraffic(swarm, channel)
    traffic._air = air = RecordingAir(channel)
    traffic.slot(0)
    return Waits.begun, air.collided


def test_who_hears_another_one_waits_and_hidden_or_turning_senders_collide() -> None:
    whole = AIRTIME.total_ns(SwarmConfig(agents=3, frame="extended").frame_length)
    (first, second), at_others = sends(7.0, 1 * MS, 1 * MS + TURN)
    assert first == 1 * MS
    assert first + whole <= second < first + whole + 100_000
    assert at_others == {1: 0, 3: 0}
    assert sends(4.0, 1 * MS, 1 * MS + TURN) == ([1 * MS, 1 * MS + TURN], {1: 1, 3: 1})
    begun, at_others = sends(7.0, 1 * MS, 1 * MS + TURN - 1)
    assert begun == [1 * MS, 1 * MS + TURN - 1]
    assert at_others == {1: 2, 3: 2}


@pytest.mark.parametrize(("answer", "text"), [
    (0, "sensed: gave 0 ns; allowed: whole numbers from 1, as the air is in use"), (None, "sensed: gave None ns"),
    (1, "sensed: listened 10000 times for one frame"),
])  # fmt: skip
def test_rules_that_cannot_be_are_named(answer: Any, text: str) -> None:
    with pytest.raises(PluginError, match=f"policy waits, {text}"):
        sends(7.0, 1 * MS, 1 * MS + TURN, answer=answer)


def test_the_log_says_which_agents_received_a_frame() -> None:
    flight = dtsa.simulate(policy="beacons", agents=4, moving=2, loss=0.5, seed=1)
    assert flight.receptions["received"].mean() == pytest.approx(0.5, abs=0.06)
    assert (flight.frames["received"] + flight.frames["lost"] == 3).all()
    assert flight.frames["collided"].isna().all()


@pytest.mark.parametrize("scheme", ["csma", "mixer"])
def test_tables_of_a_flight_that_is_over_do_not_wait_for_the_garbage_collector(scheme: str) -> None:
    swarm = make_swarm(SwarmConfig(agents=3, policy=scheme))
    traffic = UnslottedTraffic(swarm, Channel(ChannelConfig(agents=3)))
    traffic.slot(0)
    kept = weakref.ref(swarm)
    del swarm, traffic
    assert kept() is None


def test_tables_differ_where_frames_are_lost_and_no_agent_expects_another() -> None:
    summary = dtsa.simulate(agents=6, policy="csma", loss=0.2, timeout_s=1.0).summary
    assert summary["equal_tables_share"] < 0.1
    assert summary["first_divergence_slot"] < 20
    assert summary["agreement_share"] is None
