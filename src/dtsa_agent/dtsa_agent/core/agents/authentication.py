"""Frames that only holders of a key can make: a truncated message authentication code over frame, slot and session.

Without a key, whoever can send can be anybody. With one, a frame from outside, a changed one, one of another session
and one that is played again in another slot are all rejected and counted. A tag of 4 bytes lets a blind guess through
once in 4.3e9 tries, at one try a slot; the same frame played again within its own slot changes nothing, since a table
takes only what is newer. Frames are not secret, and jamming is not prevented.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from dtsa_agent.core.errors import ConfigError, LocalProtocolError
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_agent.core.reference.tag import keyed, tag
from dtsa_agent.core.swarms.abstract_swarm import FRAME_MAX, AbstractSwarm, Bytes, SwarmWrapper

if TYPE_CHECKING:
    from dtsa_agent.core.reference.tag import Keyed

MIN_KEY, MAX_KEY = 16, 32  # bytes


class Authenticator:
    """Seals own frames and opens those of others.

    :param key: 16 to 32 secret bytes, the same for all agents of a swarm.
    :param session: number of the flight, 0 to 2**64 - 1: choose a new one whenever the slots count from 0 again.
    :raises ConfigError: for a key or a session that is not usable.
    """

    __slots__ = ("_begun", "_key", "_session", "forged", "truncated")

    def __init__(self, key: bytes, session: int = 0) -> None:
        if not MIN_KEY <= len(key) <= MAX_KEY:
            raise ConfigError("auth_key", f"{len(key)} bytes", f"{MIN_KEY} to {MAX_KEY} bytes")
        self._key = key
        self.begin(session)
        #: Frames whose tag was wrong: forged, changed, of another session or another slot.
        self.forged = 0
        #: Frames too short to have a tag.
        self.truncated = 0

    @classmethod
    def from_hex(cls, text: str, session: int = 0) -> Authenticator:
        """An authenticator from a key in hexadecimal digits, as settings carry it.

        :param text: 32 to 64 hexadecimal digits.
        :param session: number of the flight, 0 to 2^64 - 1; see the class.
        :raises ConfigError: if it is none, or one that can be guessed; the key itself is not in the message.
        """
        try:
            key = bytes.fromhex(text)
        except ValueError:
            raise ConfigError("auth_key", f"{len(text)} characters", "32 to 64 hexadecimal digits") from None
        if is_pattern(key):
            raise ConfigError("auth_key", "bytes in a pattern", "random ones, as of `openssl rand -hex 32`")
        return cls(key, session)

    def begin(self, session: int) -> None:
        """From now on frames are those of another session.

        :param session: number of the flight, 0 to 2^64 - 1; see the class.
        :raises ConfigError: for one that is not usable.
        """
        if not 0 <= session < 2**64:
            raise ConfigError("auth_session", session, "0 to 2**64 - 1")
        self._begun: Keyed | None = None
        self._session = session

    @property
    def _keyed(self) -> Keyed:
        """What all tags have in common: made with the first one."""
        if self._begun is None:
            self._begun = keyed(self._key, self._session)
        return self._begun

    @property
    def key_and_session(self) -> tuple[bytes, int]:
        """The secret and the flight, for compiled code that does the same."""
        return self._key, self._session

    @property
    def rejected(self) -> int:
        """Frames rejected so far, for whatever reason."""
        return self.forged + self.truncated

    def seal(self, data: bytes, slot: int, beside: bytes = b"") -> bytes:
        """A frame with its tag.

        :param data: the frame, 1 to 56 bytes.
        :param slot: the slot it is sent in.
        :param beside: what else the tag covers; it is sent beside the frame.
        :raises LocalProtocolError: if frame and tag do not fit on the air.
        """
        if not 0 < len(data) <= FRAME_MAX - TAG_LENGTH:
            raise LocalProtocolError(f"a frame of {len(data)} bytes cannot be sealed: 1 to {FRAME_MAX - TAG_LENGTH}")
        return data + tag(self._keyed, slot, data + beside)

    def open(self, data: bytes, slot: int, late: int = 0, beside: bytes = b"") -> bytes | None:
        """The frame without its tag, or None (and counted) if it is not authentic.

        :param data: the bytes heard.
        :param slot: the slot they were heard in.
        :param late: slots by which a frame may arrive after its own; 1 where agents have clocks of their own.
        :param beside: what else the tag covers.
        """
        if len(data) <= TAG_LENGTH:
            self.truncated += 1
            return None
        import hmac  # as hashlib

        frame, said = data[:-TAG_LENGTH], data[-TAG_LENGTH:]
        for sent in range(slot, max(-1, slot - late - 1), -1):
            if hmac.compare_digest(said, tag(self._keyed, sent, frame + beside)):
                return frame
        self.forged += 1
        return None


def is_pattern(key: bytes) -> bool:
    """Whether a key is no random one: a short text again and again, or bytes that go up or down in equal steps.

    :param key: 1 byte or more.
    """
    length = len(key)
    if any(key[period:] == key[:-period] for period in range(1, length // 2 + 1)):
        return True
    return len({(after - before) % 256 for before, after in pairwise(key)}) <= 1


class AuthenticatedSwarm(SwarmWrapper):
    """A swarm whose frames leave with a tag; only frames with a right one come in, others are counted.

    :param inner: the swarm.
    :param authenticator: holds the key; one for this swarm alone, because it counts.
    """

    def __init__(self, inner: AbstractSwarm, authenticator: Authenticator) -> None:
        super().__init__(inner)
        self.authenticator = authenticator
        self._slot = 0  # the one that frames are sealed for

    def emit(self, slot: int) -> tuple[int, ...]:
        self._slot = slot
        return self.inner.emit(slot)

    def begin(self, slot: int) -> tuple[int, ...]:
        self._slot = slot
        return self.inner.begin(slot)

    def frame(self, local_index: int) -> bytes:
        data = self.inner.frame(local_index)
        return self.authenticator.seal(data, self._slot) if data else data

    def hear(self, slot: int, data: bytes, mask: Bytes | None = None) -> bool:
        frame = self.authenticator.open(bytes(data), slot, late=1)
        return frame is not None and self.inner.hear(slot, frame, mask)

    def unseal(self, data: bytes, slot: int, late: int = 0) -> bytes | None:
        return self.authenticator.open(data, slot, late)

    def begin_session(self, session: int) -> None:
        self.authenticator.begin(session)

    def with_own_tables(self, slot: int) -> AuthenticatedSwarm:
        swarm = AuthenticatedSwarm(self.inner.with_own_tables(slot), self.authenticator)
        swarm._slot = slot
        return swarm

    @property
    def rejected(self) -> int:
        """Frames heard that were not authentic: forged, changed, replayed or cut."""
        return self.authenticator.rejected
