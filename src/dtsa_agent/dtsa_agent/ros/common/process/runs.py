"""A run's random id, how its channel calls the agents, and the proof that only this channel can end it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from hashlib import sha256

from dtsa_agent.ros.common.wire.checks import parse_json

from .peers import ProcessName

_PROOF_BYTES = 16
_LONGEST = 4096  # bytes
MOST_SESSIONS = 2**63


@dataclass(frozen=True, slots=True)
class Run:
    """What the channel knows about its run.

    The hash of a secret is in the call. The secret is shown with the message that ends the run, so nobody else can send
    that one before.
    """

    number: int  # the id that all messages carry, 1 to 2^32 - 1; 64 bits would be more than some viewers can show
    proof: bytes  # 16 bytes
    session: int  # of authenticated frames, 1 to 2^63 - 1

    @classmethod
    def draw(cls, session: int = 0) -> Run:
        """A new one: no two runs share one.

        :param session: session of authenticated frames; 0: a random one.
        """
        import secrets  # channels draw, agents do not

        proof = secrets.token_bytes(_PROOF_BYTES)
        return cls(secrets.randbelow(2**32 - 1) + 1, proof, session or secrets.randbelow(MOST_SESSIONS - 1) + 1)

    def __str__(self) -> str:
        return run_text(self.number)

    def call(self, node: str) -> bytes:
        """The call of a channel in this process, as slot messages carry it.

        :param node: name of the channel's node, with the namespace.
        """
        return Call(ProcessName.own(node), sha256(self.proof).hexdigest(), self.session).to_bytes()


@dataclass(frozen=True, slots=True)
class Call:
    """What the agents learn about a run from its channel's call."""

    channel: ProcessName
    end: str  # SHA-256 of the proof that the end shows, in hexadecimal digits
    session: int  # of authenticated frames

    @classmethod
    def from_bytes(cls, data: bytes) -> Call:
        """What :meth:`to_bytes` made.

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
        if not 0 < session < MOST_SESSIONS:
            raise ValueError(f"session {session} of a call")
        return cls(ProcessName(**given), end, session)

    def to_bytes(self) -> bytes:
        """As JSON."""
        values = {**asdict(self.channel), "end": self.end, "session": self.session}
        return json.dumps(values, separators=(",", ":")).encode()

    def ended_by(self, proof: bytes) -> bool:
        """Whether the bytes that a message shows end the run."""
        return len(proof) == _PROOF_BYTES and sha256(proof).hexdigest() == self.end


def run_text(number: int) -> str:
    """A run's id as logs and bags show it.

    :param number: the id.
    """
    return f"{number:08x}"
