"""Swarms whose frames are authenticated: the same flights, and nothing from outside gets in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from slot_helpers import one_slot

from dtsa_agent.core import ConfigError, Swarm, SwarmConfig
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.keys import VARIABLE, check_key, with_key

KEY = "7c1f0a93e4d25b6880b13f96c2de470a"


@pytest.fixture(autouse=True)
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, KEY)


def swarm(**settings: Any) -> Swarm:
    return with_key(make_swarm(SwarmConfig(agents=6, auth=True, **settings)))


@pytest.mark.parametrize("policy", ["tdma", "dtsa", "lease"])
def test_forged_replayed_cut_and_foreign_frames_are_rejected_and_counted(policy: str) -> None:
    agents, stranger = swarm(policy=policy), Swarm(SwarmConfig(agents=6, policy=policy))
    other_session = swarm(policy=policy, auth_session=7)
    swarms = agents, stranger, other_session
    early, *_, unsealed, elsewhere = [next(iter(one_slot(s, slot).values())) for slot in range(20) for s in swarms]
    before = agents.sent_position.copy(), agents.sent_slot.copy()
    changed = bytes([elsewhere[0] ^ 1]) + elsewhere[1:]
    for data in (early, unsealed, elsewhere, changed, b"", b"abc", early[:-1], bytes(60)):
        assert not agents.hear(20, data)
    assert agents.rejected == 8
    assert agents.malformed == agents.foreign == 0
    assert np.array_equal(before[0], agents.sent_position)
    assert np.array_equal(before[1], agents.sent_slot)


@pytest.mark.parametrize("text", ["", "xyz", "0011", "00" * 16])
def test_a_missing_or_bad_key_is_said_without_showing_it(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    check_key(SwarmConfig(auth=True))
    monkeypatch.setenv(VARIABLE, text)
    check_key(SwarmConfig())
    for look in (swarm, lambda: check_key(SwarmConfig(auth=True))):
        with pytest.raises(ConfigError) as caught:
            look()
        assert not text or text not in str(caught.value)


def test_a_session_can_begin_when_the_flight_does() -> None:
    sealed, other = swarm(policy="tdma"), swarm(policy="tdma")
    first = one_slot(sealed, 0)[1]
    other.begin_session(7)
    assert one_slot(other, 0)[1][:-4] == first[:-4]
    before = other.rejected
    assert not other.hear(0, first)
    assert other.rejected == before + 1
