"""A run: its random id, how its channel calls the agents, the proof that only it can end the run; and patience."""

from __future__ import annotations

import json
import os
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
class ProcessName:
    """A process as others name it in messages; it can be looked for on its machine."""

    node: str  # with the namespace
    machine: str  # its boot and its process namespace
    pid: int
    started: int  # clock ticks after the boot

    @classmethod
    def own(cls, node: str) -> ProcessName:
        """Return the name of this process, by its node's name with the namespace."""
        return cls(node, _machine(), os.getpid(), _state(os.getpid())[1])

    @property
    def has_ended(self) -> bool:
        """Whether the process has ended for sure. A stopped one has not; of other machines nothing is known."""
        state, started = self._state()
        return bool(state) and (started != self.started or state in "ZX")

    @property
    def is_paused(self) -> bool:
        """Whether the process is there but stopped, by a signal or a debugger; of other machines nothing is known."""
        state, started = self._state()
        return state in ("T", "t") and started == self.started

    def _state(self) -> tuple[str, int]:
        here = self.started and self.machine == _machine() and self.pid > 0
        return _state(self.pid) if here else ("", 0)


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
        import secrets  # channels draw, agents do not

        proof = secrets.token_bytes(_PROOF_BYTES)
        return cls(secrets.randbelow(2**32 - 1) + 1, proof, session or secrets.randbelow(_MOST_SESSIONS - 1) + 1)

    def __str__(self) -> str:
        return run_text(self.number)

    def call(self, node: str) -> bytes:
        """Return the call of a channel in this process, of a node of this name, as slot messages carry it."""
        return Call(ProcessName.own(node), sha256(self.proof).hexdigest(), self.session).to_bytes()


@dataclass(frozen=True, slots=True)
class Call:
    """What the agents learn about a run from its channel's call."""

    channel: ProcessName
    end: str  # SHA-256 of the proof that the end shows, in hexadecimal digits
    session: int  # of authenticated frames

    @classmethod
    def from_bytes(cls, data: bytes) -> Call:
        """Return the call that :meth:`to_bytes` wrote.

        :raises ValueError: for anything else.
        """
        if len(data) > _LONGEST:
            raise ValueError(f"a call of {len(data)} bytes")
        given = parse_json(data)
        kinds = {"node": str, "machine": str, "pid": int, "started": int, "end": str, "session": int}
        if not isinstance(given, dict) or set(given) != set(kinds):
            raise ValueError("not a call")
        for name, kind in kinds.items():
            if type(given[name]) is not kind:
                raise ValueError(f"{name} of a call: {given[name]!r:.40}")
        end, session = given.pop("end"), given.pop("session")
        if not 0 < session < _MOST_SESSIONS:
            raise ValueError(f"session {session} of a call")
        return cls(ProcessName(**given), end, session)

    def to_bytes(self) -> bytes:
        """Return the call as JSON."""
        values = {**asdict(self.channel), "end": self.end, "session": self.session}
        return json.dumps(values, separators=(",", ":")).encode()

    def ended_by(self, proof: bytes) -> bool:
        """Whether the bytes that a message shows end the run."""
        return len(proof) == _PROOF_BYTES and sha256(proof).hexdigest() == self.end


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
