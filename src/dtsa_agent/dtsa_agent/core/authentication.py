"""Frames that only holders of a key can make: a truncated message authentication code over frame, slot and session.

Without a key, whoever can send can be anybody. With one, a frame from outside, a changed one, one of another session
and one that is played again in another slot are all rejected and counted. A tag of 4 bytes lets a blind guess through
once in 4.3e9 tries, at one try a slot; the same frame played again within its own slot changes nothing, since a table
takes only what is newer. Frames are not secret, and jamming is not prevented. The code is ``libdtsa/tag.c``.
"""

from __future__ import annotations

from itertools import pairwise

from .errors import ConfigError, LocalProtocolError
from .frame import FRAME_MAX, TAG_LENGTH
from .kernel import ffi, lib

MIN_KEY, MAX_KEY = 16, 32  # bytes


class Authenticator:
    """Signs own frames and verifies those of others.

    :param key: 16 to 32 secret bytes, the same for all agents of a swarm.
    :param session: number of the flight, 0 to 2**64 - 1: choose a new one whenever the slots count from 0 again.
    :raises ConfigError: for a key or a session that is not usable.
    """

    def __init__(self, key: bytes, session: int = 0) -> None:
        if not MIN_KEY <= len(key) <= MAX_KEY:
            raise ConfigError("auth_key", f"{len(key)} bytes", f"{MIN_KEY} to {MAX_KEY} bytes")
        self._key = key
        self.begin(session)
        self.rejected = 0  # frames that were too short, forged, changed, of another session or of another slot

    @classmethod
    def from_hex(cls, text: str, session: int = 0) -> Authenticator:
        """An authenticator from a key in 32 to 64 hexadecimal digits, as settings carry it.

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
        """From now on frames are those of another session."""
        if not 0 <= session < 2**64:
            raise ConfigError("auth_session", session, "0 to 2**64 - 1")
        self._session = session

    @property
    def key_and_session(self) -> tuple[bytes, int]:
        """The secret and the flight, for compiled code that does the same."""
        return self._key, self._session

    def seal(self, data: bytes, slot: int) -> bytes:
        """A frame, 1 to 56 bytes, with its tag.

        :raises LocalProtocolError: if frame and tag do not fit on the air.
        """
        if not 0 < len(data) <= FRAME_MAX - TAG_LENGTH:
            raise LocalProtocolError(f"a frame of {len(data)} bytes cannot be sealed: 1 to {FRAME_MAX - TAG_LENGTH}")
        tag = ffi.new("uint8_t[]", TAG_LENGTH)
        lib.dtsa_tag(self._key, len(self._key), self._session, slot, data, len(data), tag)
        return data + bytes(tag)

    def open(self, data: bytes, slot: int, late: int = 0) -> bytes | None:
        """The frame without its tag, or None (and counted) if it is not authentic.

        :param slot: the slot in which it was heard.
        :param late: slots by which a frame may arrive after its own; 1 where agents have clocks of their own.
        """
        key = self._key
        if len(data) > TAG_LENGTH and lib.dtsa_open(key, len(key), self._session, slot, late, data, len(data)):
            return data[:-TAG_LENGTH]
        self.rejected += 1
        return None


def is_pattern(key: bytes) -> bool:
    """Whether a key is no random one: a short text again and again, or bytes that go up or down in equal steps."""
    length = len(key)
    if any(key[period:] == key[:-period] for period in range(1, length // 2 + 1)):
        return True
    return len({(after - before) % 256 for before, after in pairwise(key)}) <= 1
