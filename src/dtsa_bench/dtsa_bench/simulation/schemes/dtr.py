"""The token ring of the Crazyflie firmware: every packet is answered, and everybody is told separately."""

from __future__ import annotations

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.plugins import Table
from dtsa_bench.simulation.unslotted import Radio

_MOST_AGENTS = 20  # MAX_NETWORK_SIZE
_HEADER = 5  # bytes: size of the packet, kind, source, target, size of the data
_TIMEOUT_NS = 4_000_000_000  # PROTOCOL_TIMEOUT_MS
_RETRY_NS = 100_000  # while the radio still sends another packet
_IDLE_NS = 1_000_000_000

_DATA, _TOKEN, _CTS, _RTS, _ACK = range(5)  # kinds of packets, numbered as in the firmware
_IDLE, _WAIT_CTS, _WAIT_RTS, _WAIT_ACK = range(4)


class Dtr:
    """A static ring in the order of ids (crazyflie-firmware, ``src/modules/src/p2pDTR/token_ring.c``).

    The agent with the token sends its frame to each other agent separately, which acknowledges it; then it offers the
    token (TOKEN), its successor asks for it (RTS), gets it (CTS), and sends. What is not answered is sent again. An
    agent that hears nothing for 4 s starts anew, but for id 1, with whose turn the ring starts. At most 20 agents.

    Options: ``dtr.react_ms`` (0.3: from the arrival of a packet until the answer is at the radio) and ``dtr.resend_ms``
    (20: the firmware names 10, 11 and 12 ms, but never sets its timer to them).
    """

    options = ("react_ms", "resend_ms")
    port = ("send", "received")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        if config.agents > _MOST_AGENTS:
            raise ConfigError("agents", config.agents, f"2 to {_MOST_AGENTS} with policy dtr, as the firmware has it")
        self._react_ns = max(0, round(config.options.get("dtr.react_ms", 0.3) * 1e6))
        self._resend_ns = max(1_000_000, round(config.options.get("dtr.resend_ms", 20.0) * 1e6))
        self._agent, self._count, self._length = agent, config.agents, config.frame_length
        self._state = _IDLE
        self._packet: tuple[int, int] | None = None  # kind and target of what is to be sent, or sent again
        self._due_ns = 0
        self._heard_ns = 0
        self._begun = False

    def _after(self, agent: int) -> int:
        """The id that follows another one in the ring."""
        return agent % self._count + 1

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Sends what is due."""
        if not self._begun:
            self._begun = True
            if self._agent == 1:
                self._prepare(_DATA, self._after(1), _WAIT_ACK, now_ns)
        if now_ns - self._heard_ns > _TIMEOUT_NS and self._agent != 1:
            self._state, self._packet = _IDLE, None
        if self._packet is not None and now_ns >= self._due_ns:
            kind, target = self._packet
            note = self._note(kind, target)
            sent = radio.send(note, target) if kind == _DATA else radio.send_note(note)
            self._due_ns = now_ns + (self._resend_ns if sent else _RETRY_NS)
            if sent and self._state == _IDLE:
                self._packet = None  # CTS and acknowledgements are sent once
        return self._next(now_ns)

    def received(self, table: Table, now_ns: int, sender: int, note: bytes) -> int:
        """Answers a packet, if this agent waits for one of its kind."""
        self._heard_ns = now_ns
        _, kind, source, target, _ = note
        before = (self._agent - 2) % self._count + 1
        mine, follows = target == self._agent, source == self._after(self._agent)
        if self._state == _IDLE and kind == _DATA and mine:
            self._prepare(_ACK, source, _IDLE, now_ns)
        elif self._state == _IDLE and kind == _TOKEN and source == before:
            self._prepare(_RTS, source, _WAIT_CTS, now_ns)
        elif self._state in (_IDLE, _WAIT_RTS) and kind == _RTS and follows:
            self._prepare(_CTS, source, _IDLE, now_ns)
        elif self._state == _WAIT_CTS and kind == _CTS and source == before:
            self._prepare(_DATA, self._after(self._agent), _WAIT_ACK, now_ns)
        elif self._state == _WAIT_ACK and kind == _ACK and mine:
            following = self._after(self._packet[1] if self._packet else self._agent)
            if following == self._agent:
                self._prepare(_TOKEN, self._after(self._agent), _WAIT_RTS, now_ns)
            else:
                self._prepare(_DATA, following, _WAIT_ACK, now_ns)
        return self._next(now_ns)

    def _prepare(self, kind: int, target: int, state: int, now_ns: int) -> None:
        self._packet, self._state, self._due_ns = (kind, target), state, now_ns + self._react_ns

    def _next(self, now_ns: int) -> int:
        """When there is something to do."""
        return max(now_ns + 1, self._due_ns if self._packet is not None else now_ns + _IDLE_NS)

    def _note(self, kind: int, target: int) -> bytes:
        size = self._length if kind == _DATA else 0
        return bytes((_HEADER + size, kind, self._agent, target, size))
