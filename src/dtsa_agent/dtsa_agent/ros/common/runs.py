"""A run: its random id, how its channel calls the agents, the proof that only it can end the run; and patience."""

from __future__ import annotations

import json
import os
import secrets
import time
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from .checks import parse_json

_PROOF_BYTES = 16
_LONGEST = 4096  # bytes
_MOST_SESSIONS = 2**63
_FIRST_LINE_S, _LONGEST_LINE_S = 2.0, 60.0  # from one line to the next
_LONGEST_CHECK_S = 0.25


@dataclass(frozen=True, slots=True)
class Call:
    """What the agents learn about a run from its channel's call. Slot messages carry it as JSON.

    The channel's process can be looked for on its machine; of other machines nothing is known.
    """

    node: str  # the channel's, with its namespace
    machine: str  # its boot and its process namespace
    pid: int
    started: int  # clock ticks after the boot
    end: str  # SHA-256 of the proof that the end shows, in hexadecimal digits
    session: int  # of authenticated frames

    @classmethod
    def from_bytes(cls, data: bytes) -> Call:
        """Return the call that :meth:`Run.call` gave; ValueError: it is something else."""
        given = parse_json(data) if len(data) <= _LONGEST else None
        kinds = {name: type(value).__name__ for name, value in given.items()} if isinstance(given, dict) else None
        if kinds != cls.__annotations__ or not 0 < given["session"] < _MOST_SESSIONS:
            raise ValueError(f"{len(data)} bytes that are no call")
        return cls(**given)

    def ended_by(self, proof: bytes) -> bool:
        """Whether the bytes that a message shows end the run."""
        return len(proof) == _PROOF_BYTES and sha256(proof).hexdigest() == self.end

    @property
    def has_ended(self) -> bool:
        """Whether the channel's process has ended for sure. A stopped one has not."""
        state, started = self._state()
        return bool(state) and (started != self.started or state in "ZX")

    @property
    def is_paused(self) -> bool:
        """Whether the channel's process is there but stopped, by a signal or a debugger."""
        state, started = self._state()
        return state in ("T", "t") and started == self.started

    def _state(self) -> tuple[str, int]:
        return _state(self.pid) if self.started and self.machine == _machine() and self.pid > 0 else ("", 0)


@cache
def _machine() -> str:
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:  # another kernel
        return ""


def _state(pid: int) -> tuple[str, int]:
    """Return the state of a process (X: there is none, Z: a zombie), and when it started, clock ticks after boot."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("ascii", "replace").rpartition(")")[2].split()
    except OSError:
        return "X", 0
    return fields[0], int(fields[19])


@dataclass(frozen=True, slots=True)
class Run:
    """What the channel knows about its run.

    The hash of a secret is in the call. The secret is shown with the message that ends the run, so no other process can
    send that one before.
    """

    number: int  # the id that all messages carry, 1 to 2^32 - 1; 64 bits would be more than some viewers can show
    proof: bytes  # 16 bytes
    session: int  # of authenticated frames, 1 to 2^63 - 1

    @classmethod
    def draw(cls, session: int = 0) -> Run:
        """Return a new one: no two runs share one. ``session``: of authenticated frames; 0: a random one."""
        proof = secrets.token_bytes(_PROOF_BYTES)
        return cls(secrets.randbelow(2**32 - 1) + 1, proof, session or secrets.randbelow(_MOST_SESSIONS - 1) + 1)

    def __str__(self) -> str:
        return run_text(self.number)

    def call(self, node: str) -> bytes:
        """Return the call of a channel in this process, of a node of this name, as slot messages carry it."""
        pid, end = os.getpid(), sha256(self.proof).hexdigest()
        call = Call(node, _machine(), pid, _state(pid)[1], end, self.session)
        return json.dumps(asdict(call), separators=(",", ":")).encode()


def run_text(number: int) -> str:
    """Return a run's id as logs and bags show it."""
    return f"{number:08x}"


class Patience:
    """For how long this process has looked for something in vain.

    Time in which it did not run (Ctrl-Z, a debugger, a frozen container) does not count: what the others have sent
    meanwhile has not reached it yet.
    """

    def __init__(self) -> None:
        self._checked_s, self._spent_s = time.monotonic(), 0.0

    def spent_s(self) -> float:
        """Return the wall time spent so far, s; called several times a second."""
        now = time.monotonic()
        self._spent_s += min(now - self._checked_s, _LONGEST_CHECK_S)
        self._checked_s = now
        return self._spent_s


class WaitingLog:
    """Logs what is waited for, at once and then with a growing period; from the start when it is something else."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._text = ""
        self._since_s = self._next_s = self._period_s = 0.0  # time.monotonic()

    def log(self, text: str) -> None:
        """Log it if it is time to."""
        now = time.monotonic()
        if text != self._text:
            self._text, self._since_s, self._next_s, self._period_s = text, now, now + _FIRST_LINE_S, _FIRST_LINE_S
            self._logger.info(text)
        elif now >= self._next_s:
            self._period_s = min(2 * self._period_s, _LONGEST_LINE_S)
            self._next_s = now + self._period_s
            self._logger.warning(f"{text}, for {now - self._since_s:.0f} s now")
