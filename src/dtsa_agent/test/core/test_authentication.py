"""Keyed frames: only those of a holder of the key, of this session and of this slot, are taken."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from slot_helpers import one_slot

from dtsa_agent.core import ConfigError, LocalProtocolError, Swarm, SwarmConfig
from dtsa_agent.core.authentication import TAG_LENGTH, Authenticator
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.keys import VARIABLE, check_key, with_key

KEY = bytes(range(32))
RANDOM_KEY = "7c1f0a93e4d25b6880b13f96c2de470a"


def test_golden_tag() -> None:
    """Ties the tag to its definition: BLAKE2s with key and person, over session, slot and frame."""
    assert Authenticator(KEY, 5).seal(b"frame", 7).hex() == "6672616d6500ba891a"


def test_replays_and_foreign_frames() -> None:
    auth = Authenticator(KEY, session=1)
    frame = auth.seal(b"frame", 100)
    assert auth.open(frame, 101) is None
    assert auth.open(frame, 99, late=1) is None
    assert Authenticator(KEY, session=2).open(frame, 100) is None
    assert Authenticator(KEY[::-1], session=1).open(frame, 100) is None
    assert auth.open(frame, 101, late=1) == b"frame"
    assert auth.rejected == 2


@pytest.mark.parametrize("key", [b"", bytes(15), bytes(33)])
def test_bad_keys(key: bytes) -> None:
    with pytest.raises(ConfigError, match=r"auth_key: got '\d+ bytes'; allowed: 16 to 32 bytes"):
        Authenticator(key)


def test_the_key_is_never_shown() -> None:
    with pytest.raises(ConfigError) as caught:
        Authenticator.from_hex("secret" * 6)
    assert "secret" not in str(caught.value)
    with pytest.raises(ConfigError, match="auth_session"):
        Authenticator.from_hex(RANDOM_KEY, 2**64)
    assert Authenticator.from_hex(RANDOM_KEY).seal(b"x", 1) == Authenticator(bytes.fromhex(RANDOM_KEY)).seal(b"x", 1)


@pytest.mark.parametrize("key", [
    bytes(16), b"\xa5" * 32, b"secret" * 4, b"swarmkey" * 2, bytes(range(32)), bytes(range(255, 239, -1)),
    bytes(17 * k % 256 for k in range(16)),
])  # fmt: skip
def test_keys_that_are_a_pattern_are_refused(key: bytes) -> None:
    with pytest.raises(ConfigError, match="auth_key: got 'bytes in a pattern'; allowed: random ones"):
        Authenticator.from_hex(key.hex())


@given(
    st.integers(0, 11), st.lists(st.tuples(st.integers(0, 59), st.integers(1, 255)), max_size=3), st.integers(0, 60),
    st.binary(max_size=60),
)  # fmt: skip
@pytest.mark.parametrize("policy", ["tdma", "lease"])
def test_damaged_frames(policy: str, pick: int, changes: list[tuple[int, int]], cut: int, tail: bytes) -> None:
    auth, swarm = Authenticator(KEY), Swarm(SwarmConfig(agents=12, moving=6, policy=policy, avoider="none"))
    frames = [auth.seal(*one_slot(swarm, slot).values(), slot) for slot in range(12)]
    data = bytearray(frames[pick])
    for place, mask in changes:
        data[place % len(data)] ^= mask
    data = data[:cut] + tail
    assert auth.open(bytes(data), pick) is None or bytes(data) in frames
    swarm.begin(12)
    swarm.hear(12, bytes(data[:-TAG_LENGTH]))
    swarm.end(12)
    for slot in range(13, 30):
        one_slot(swarm, slot)
    assert np.isfinite([swarm.sent_position, swarm.sent_velocity]).all()
    assert np.isfinite(swarm.position).all()


@pytest.mark.parametrize("length", [0, 57])
def test_frames_that_do_not_fit(length: int) -> None:
    with pytest.raises(LocalProtocolError, match="cannot be sealed"):
        Authenticator(KEY).seal(bytes(length), 1)


@pytest.fixture
def key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, RANDOM_KEY)


def swarm_with_key(**settings: Any) -> Swarm:
    return with_key(make_swarm(SwarmConfig(agents=6, auth=True, **settings)))


@pytest.mark.parametrize("policy", ["tdma", "dtsa", "lease"])
@pytest.mark.usefixtures("key")
def test_forged_replayed_cut_and_foreign_frames_are_rejected_and_counted(policy: str) -> None:
    agents, stranger = swarm_with_key(policy=policy), Swarm(SwarmConfig(agents=6, policy=policy))
    other_session = swarm_with_key(policy=policy, auth_session=7)
    swarms = agents, stranger, other_session
    early, *_, unsealed, elsewhere = [next(iter(one_slot(s, slot).values())) for slot in range(20) for s in swarms]
    before = agents.sent_position.copy(), agents.sent_slot.copy()
    assert agents.authenticator is not None
    good = agents.authenticator.seal(unsealed, 20)
    changed = bytes([good[0] ^ 1]) + good[1:], good[:-1] + bytes([good[-1] ^ 0x80])
    for data in (early, unsealed, elsewhere, *changed, good[:-1], good[:4], good + b"\0", b"", b"abc", bytes(60)):
        assert not agents.hear(20, data)
    assert agents.rejected == 11
    assert agents.malformed == agents.foreign == 0
    assert np.array_equal(before[0], agents.sent_position)
    assert np.array_equal(before[1], agents.sent_slot)


@pytest.mark.parametrize("text", ["", "xyz", "0011", "00" * 16])
@pytest.mark.usefixtures("key")
def test_a_missing_or_bad_key_is_said_without_showing_it(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    check_key(SwarmConfig(auth=True))
    monkeypatch.setenv(VARIABLE, text)
    check_key(SwarmConfig())
    for look in (swarm_with_key, lambda: check_key(SwarmConfig(auth=True))):
        with pytest.raises(ConfigError) as caught:
            look()
        assert not text or text not in str(caught.value)


@pytest.mark.usefixtures("key")
def test_a_session_can_begin_when_the_flight_does() -> None:
    sealed, other = swarm_with_key(policy="tdma"), swarm_with_key(policy="tdma")
    first = one_slot(sealed, 0)[1]
    other.begin_session(7)
    assert one_slot(other, 0)[1][:-4] == first[:-4]
    before = other.rejected
    assert not other.hear(0, first)
    assert other.rejected == before + 1
