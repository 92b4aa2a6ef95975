"""Whether frames say where their senders really were."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.authentication import TAG_LENGTH, Authenticator
from dtsa_agent.core.errors import RemoteProtocolError
from dtsa_agent.core.frame import ExtendedFrame, Frame, decode_extended, decode_frame, encode_extended, encode_frame
from dtsa_agent.keys import VARIABLE

from .result import Difference, Mismatch, Result

_SLOT_MASK = 0xFFFFFFFF  # slots have 32 bits in frames


class OwnStates:
    """Compares frames with the states that their senders reported."""

    def __init__(self, config: SwarmConfig, result: Result) -> None:
        self._config, self._result = config, result
        self._authenticator: Authenticator | None = None
        if config.auth:
            if key := os.environ.get(VARIABLE, ""):
                self._authenticator = Authenticator.from_hex(key, config.auth_session)
            else:
                result.skipped["tags of frames"] = f"no key in {VARIABLE}"

    @property
    def has_key(self) -> bool:
        """Whether the key of sealed frames is at hand."""
        return self._authenticator is not None

    def check(self, slot: int, agent: int, data: bytes, *state: NDArray[np.float64]) -> None:
        """One frame: it decodes, names its sender and slot, and says where its sender really was.

        :param state: (3,) each, frame map: position, m, velocity and commanded velocity, m/s, at the slot's start.
        :raises Mismatch: if it does not.
        """
        try:
            found, right = self._compared(data, slot, agent, *state)
        except RemoteProtocolError as error:
            why = "agents send what others can decode"
            raise Mismatch(Difference("transmission.data", "a frame", str(error), why, slot, agent)) from None
        for name in ("sender", "slot", "position", "velocity", "intent"):
            expected, recorded = getattr(right, name), getattr(found, name)
            if expected != recorded:
                why = "a frame names its sender and its slot" if name in ("sender", "slot") else (
                    "the sender's own state, as the codec rounds it")  # fmt: skip
                raise Mismatch(Difference(f"frame.{name}", str(expected), str(recorded), why, slot, agent))
        self._result.count("frames equal to their sender's state")

    def _compared(self, data: bytes, slot: int, agent: int, *state: NDArray[np.float64]) -> tuple[Frame, Frame]:
        """The sender's own state in a frame, and what it should be."""
        position, velocity, command = (tuple(vector.tolist()) for vector in state)
        if self._config.auth:
            data = self._opened(data, slot)
        data = self._config.protocol_part(data)
        extent, extended = self._config.extent_m, self._config.extended
        found: Any = decode_extended(data, extent).own if extended else decode_frame(data, extent)
        right = Frame(agent, slot & _SLOT_MASK, found.c_r, position, velocity, command if found.intent else None)
        if extended:
            return found, decode_extended(encode_extended(ExtendedFrame(right), extent), extent).own
        return found, decode_frame(encode_frame(right, extent), extent)

    def _opened(self, data: bytes, slot: int) -> bytes:
        """A sealed frame without its tag, which is checked where the key is at hand."""
        if self._authenticator is None:
            return data[:-TAG_LENGTH]
        opened = self._authenticator.open(data, slot)
        if opened is None:
            raise RemoteProtocolError("a tag that the key does not make")
        self._result.count("tags")
        return opened
