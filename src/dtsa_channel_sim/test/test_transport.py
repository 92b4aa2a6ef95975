"""Messages over the shared medium: who may send when, what collides, what noise takes away."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from dtsa_agent.core.errors import ConfigError
from dtsa_channel_sim.relay.transport import ACCESS, COUNTS, Mask, MessageChannel, RadioMessage, Transport

MS = 1_000_000
AGENTS = 6
Received = dict[tuple[int, int], list[int]]  # (sender, number): ids of those that have it


def transport(agents: int = AGENTS, **settings: Any) -> Transport:
    return Transport(MessageChannel.of(settings, agents))


def message(carrier: Transport, sender: int, number: int, at_ns: int, length: int = 40) -> RadioMessage:
    receivers = np.arange(1, carrier.config.agents + 1) != sender
    return RadioMessage(sender, "pose", number, length, at_ns, receivers)


def outcome(delivered: list[tuple[RadioMessage, Mask]]) -> Received:
    return {(m.sender, m.number): (np.flatnonzero(received) + 1).tolist() for m, received in delivered}


def flown(rounds: int = 100, spread_ms: int = 8, **settings: Any) -> tuple[Transport, Received]:
    """All agents send a message in each 100 ms, one after the other."""
    carrier = transport(**{"slot_ms": 5, "loss": 0.2, "seed": 7, **settings})
    received: Received = {}
    for number in range(rounds):
        for sender in range(1, AGENTS + 1):
            now_ns = (100 * number + spread_ms * sender) * MS
            received |= outcome(carrier.advance(now_ns))
            carrier.send(message(carrier, sender, number, now_ns))
    return carrier, received | outcome(carrier.advance((100 * rounds + 1000) * MS))


def accounted(carrier: Transport) -> bool:
    ends = sum(carrier.counts[name] for name in COUNTS[1:-1])
    return bool((ends == carrier.counts["sent"]).all())


UNLIMITED = flown()[1]


@pytest.mark.parametrize("access", ACCESS)
def test_noise_takes_the_same_messages_whoever_sends_when(access: str) -> None:
    carrier, received = flown(access=access, spread_ms=3)
    assert accounted(carrier)
    assert not carrier.counts["out_of_range"].any()
    assert all(set(ids) <= set(UNLIMITED[key]) for key, ids in received.items())
    if access in ("unlimited", "tdma"):
        assert received == UNLIMITED
        assert carrier.counts["lost"].sum() == pytest.approx(0.2 * carrier.counts["sent"].sum(), rel=0.15)


def test_another_seed_loses_others_and_another_topic_too() -> None:
    assert flown(seed=8)[1] != UNLIMITED
    carrier = transport(loss=0.5, seed=7)
    masks = {}
    for topic in ("pose", "map"):
        for number in range(50):
            told = message(carrier, 1, number, 0)
            carrier.send(RadioMessage(1, topic, number, 40, 0, told.receivers))
        masks[topic] = [tuple(r) for _, r in sorted(carrier.advance(10 * MS), key=lambda d: d[0].number)]
    assert masks["pose"] != masks["map"]


def test_bursts_last_for_messages_of_a_topic() -> None:
    lengths = {}
    for burst in (0.0, 8.0):
        carrier, received = flown(rounds=600, burst_length=burst)
        assert accounted(carrier)
        lost = np.array([2 not in received.get((1, number), []) for number in range(600)])
        lengths[burst] = lost.sum() / max(1, np.count_nonzero(np.diff(lost.astype(int)) == 1))
    assert lengths[8.0] > 3 * lengths[0.0]


def test_range_by_places_that_may_be_unknown() -> None:
    carrier = transport(3, range_m=10.0)
    places = np.array([[0.0, 8.0, np.nan], [0.0, 0.0, np.nan], [0.0, 0.0, np.nan]])
    carrier.send(message(carrier, 1, 0, 0))
    assert outcome(carrier.advance(10 * MS, places)) == {(1, 0): [2]}
    assert carrier.counts["out_of_range"][0].tolist() == [0, 0, 1]


@pytest.mark.parametrize("access", ["aloha", "csma"])
@pytest.mark.parametrize("apart_us", [0, 300])
def test_overlap_and_carrier_sense(access: str, apart_us: int) -> None:
    """Under ALOHA two that overlap are lost to the third; a radio that listens waits for one that it hears."""
    carrier = transport(3, access=access, backoff_ms=0.3 if apart_us else 0.001)
    for sender in (1, 2):
        carrier.send(message(carrier, sender, 0, apart_us * 1000 * (sender - 1), length=200))
    received = outcome(carrier.advance(100 * MS))
    assert accounted(carrier)
    heard = access == "csma" and apart_us
    assert received == ({(1, 0): [2, 3], (2, 0): [1, 3]} if heard else {})
    assert carrier.counts["collided"].sum() == (0 if heard else 4)


def test_hidden_senders_collide_at_the_one_between_them() -> None:
    carrier = transport(3, access="csma", range_m=10.0, backoff_ms=0.001)
    places = np.array([[-8.0, 0.0, 8.0], [0.0] * 3, [0.0] * 3])
    for sender in (1, 3):
        carrier.send(message(carrier, sender, 0, 300_000 * (sender == 3), length=200))
    assert outcome(carrier.advance(100 * MS, places)) == {}
    assert carrier.counts["collided"][:, 1].tolist() == [1, 0, 1]


def test_a_radio_that_finds_no_free_air_gives_up() -> None:
    carrier = transport(2, access="csma", longest=100_000, backoff_ms=0.1)
    carrier.send(message(carrier, 1, 0, 0, length=100_000))
    carrier.advance(10 * MS)
    carrier.send(message(carrier, 2, 0, 10 * MS))
    carrier.advance(2_000 * MS)
    assert carrier.counts["dropped"][1, 0] == 1
    assert carrier.counts["received"][0, 1] == 1


def test_what_waits_behind_a_message_that_is_given_up_is_listened_for_from_then_on() -> None:
    """However often it is advanced: the air before is resolved already."""
    counts = []
    for step_ms in (1, 2_000):
        carrier = transport(2, access="csma", longest=100_000, backoff_ms=0.5)
        carrier.send(message(carrier, 1, 0, 0, length=100_000))
        carrier.advance(10 * MS)
        for number in range(20):
            carrier.send(RadioMessage(2, str(number), number, 40, 10 * MS, np.array([True, False])))
        for now_ms in range(10, 2_011, step_ms):
            carrier.advance(now_ms * MS)
        carrier.advance(2_010 * MS)
        assert accounted(carrier)
        counts.append({name: values.tolist() for name, values in carrier.counts.items()})
    assert counts[0] == counts[1]
    assert 0 < counts[0]["dropped"][1][0] < 20


def test_the_newest_message_is_that_sent_last_though_longer_ones_arrive_later() -> None:
    carrier = transport(2)
    long, short = message(carrier, 1, 0, 0, length=4000), message(carrier, 1, 1, MS)
    for sent in (long, short):
        carrier.send(sent)
    assert [arrived for arrived, _ in carrier.advance(100 * MS)] == [short, long]
    assert carrier.newest[1, 0] is short


@pytest.mark.parametrize("access", ACCESS[1:])
def test_queues_keep_the_newest(access: str) -> None:
    carrier = transport(2, access=access, queue=3, bitrate=10_000, slot_ms=100)
    for number in range(8):
        carrier.send(message(carrier, 2, number, 1))
    received = outcome(carrier.advance(10_000 * MS))
    assert sorted(received) == [(2, 5), (2, 6), (2, 7)]
    assert carrier.counts["dropped"][1, 0] == 5
    assert accounted(carrier)


def test_without_limits_a_burst_arrives_whole() -> None:
    carrier = transport(2, queue=1)
    for number in range(50):
        carrier.send(message(carrier, 1, number, 0))
    assert len(outcome(carrier.advance(10 * MS))) == 50


@pytest.mark.parametrize("access", ["age", "error"])
def test_equal_agents_have_equal_shares_of_an_air_that_is_too_slow(access: str) -> None:
    """Three that stand still and have more to send than slots."""
    carrier, places = transport(3, access=access, slot_ms=10), np.zeros((3, 3))
    for number in range(500):
        carrier.advance(20 * number * MS, places)
        for sender in (1, 2, 3):
            carrier.send(message(carrier, sender, number, 20 * number * MS))
    received = carrier.counts["received"].sum(axis=1)
    assert received.max() <= received.min() + 4


def test_slots_of_silent_agents_are_used_under_lease_only() -> None:
    delay = {}
    for access in ("tdma", "lease"):
        carrier = transport(10, access=access, slot_ms=10)
        for number in range(500):
            now_ns = number * 30 * MS
            carrier.advance(now_ns)
            carrier.send(message(carrier, 3, number, now_ns))
        carrier.advance(500 * 30 * MS)
        delay[access] = carrier.counts["delay_ns"][2, 0] / carrier.counts["received"][2, 0] / MS
    assert delay["lease"] < 0.5 * delay["tdma"]


def test_long_messages_go_in_packets_and_delay_is_added() -> None:
    short, long = transport(2, delay_ms=5), transport(2, delay_ms=5)
    for carrier, length in ((short, 40), (long, 2000)):
        carrier.send(message(carrier, 1, 0, 0, length))
        carrier.advance(1000 * MS)
    on_air_ns = long.counts["delay_ns"][0, 1] - short.counts["delay_ns"][0, 1]
    assert on_air_ns > 1960 * 8 * 500 + 7 * 130_000  # 2 Mbit/s, seven more packets turn to sending
    assert 5 * MS < short.counts["delay_ns"][0, 1] < 7 * MS


@pytest.mark.parametrize("access", ACCESS)
def test_nothing_is_missed_by_advancing_when_it_says(access: str) -> None:
    """Advanced only when due, it delivers what it delivers in one go."""
    settings: dict[str, Any] = {"access": access, "loss": 0.1, "slot_ms": 3}
    once, stepwise = transport(4, **settings), transport(4, **settings)
    for carrier in (once, stepwise):
        for sender in range(1, 5):
            carrier.send(message(carrier, sender, 0, 2 * MS))
    received, now_ns = {}, 2 * MS
    while (now_ns := max(now_ns + 1000, stepwise.due_ns)) < 100 * MS:
        received |= outcome(stepwise.advance(now_ns))
    assert received == outcome(once.advance(100 * MS))


@pytest.mark.parametrize(
    ("settings", "field"),
    [({"access": "fdma"}, "access"), ({"jam": True}, "jam"), ({"schedule": []}, "schedule"), ({"losss": 1}, "losss"),
     ({"slot_ms": 0}, "slot_ms"), ({"loss": 2}, "loss"), ({"queue": 0}, "queue"), ({"agents": 3}, "agents"),
     ({"slot_ns": 3}, "slot_ns")],
)  # fmt: skip
def test_settings_that_cannot_be_are_named(settings: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        MessageChannel.of(settings, AGENTS)
    assert caught.value.field == field


def test_messages_that_do_not_fit_are_named() -> None:
    carrier = transport(access="lease", slot_ms=1)
    carrier.check_length(40)
    with pytest.raises(ConfigError, match="a slot has 1 ms"):
        carrier.check_length(400)
    with pytest.raises(ConfigError, match="longest"):
        transport().check_length(5000)
    transport().check_length(4096)
