"""Losses that were measured: a chain for each directed link, or a record that is replayed slot by slot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting

from .gilbert import LinkChains
from .loss_record import LossRecord, unpack

#: Numbers of a link's chain, in their order in a row.
NUMBERS = ("enter", "leave", "loss_good", "loss_bad")
FORMAT = "dtsa-losses 1"
#: What has a chain: each directed link, or a receiver, which then loses all senders alike.
LINK, RECEIVER = SCOPES = ("link", "receiver")
_PROBABILITY = Setting("probability", "float", None, "probability", minimum=0.0, maximum=1.0)
_ID = Setting("id", "int", None, "id of an agent; 0: all of which nothing else is said", minimum=0, maximum=65535)
_AGENTS = Setting("agents", "int", None, "number of agents", minimum=1, maximum=65535)
_SLOT_NS = Setting("slot_ns", "int", None, "length of a slot; 0: not known", unit="ns", minimum=0, maximum=10**12)
_SLOT_MS = Setting("slot_ms", "float", None, "length of a slot", unit="ms", minimum=1e-6, maximum=1e6)

Row = tuple[int, int, float, float, float, float]


class Fitted(NamedTuple):
    """The chains of a swarm."""

    chains: LinkChains  # (N, N) of links, row = sender; or (1, N) of receivers
    loss_good: NDArray[np.float64]  # (N, N), row = sender
    loss_bad: NDArray[np.float64]  # (N, N)


@dataclass(frozen=True, slots=True, repr=False)
class MeasuredLosses:
    """What a file of losses tells the channel. A bag holds all of it, so that nobody needs the file again.

    :param name: name of the file.
    :param sha256: hash of its bytes, hexadecimal.
    :param agents: number of agents that were measured.
    :param slot_ns: ns, length of the slots in which the chains move; 0: not known.
    :param links: sender, receiver, p = P(good -> bad), r = P(bad -> good), loss in the good state, in the bad one.
        A 0 for the sender or the receiver stands for all of which nothing else is said.
    :param record: the packed record to replay (:mod:`.loss_record`); empty: the chains count.
    :param scope: what has a chain, one of :data:`SCOPES`; all links are those of sender 0 where receivers have.
    """

    name: str
    sha256: str
    agents: int
    slot_ns: int
    links: tuple[Row, ...] = ()
    record: str = ""
    scope: str = LINK

    def __repr__(self) -> str:
        """The name of the file, and the beginning of its hash."""
        return f"{self.name} ({self.sha256[:12]})"

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], name: str = "", sha256: str = "") -> MeasuredLosses:
        """Return the losses that plain values say: those of :meth:`to_dict`, or of a file that `losses` has written.

        :param values: ``agents``, ``slot_ns`` or ``slot_ms``, and ``links``, or ``scope: receiver`` and
            ``receivers``, or ``record``; further names are notes.
        :param name: name of the file, unless the values tell.
        :param sha256: its hash, likewise.
        :raises ConfigError: naming the part that is wrong.
        """
        if values.get("format", FORMAT) != FORMAT:
            raise ConfigError("losses.format", values["format"], FORMAT)
        if "slot_ms" in values:
            slot_ns = round(_SLOT_MS.check(values["slot_ms"], "losses.slot_ms") * 1e6)
        else:
            slot_ns = _SLOT_NS.check(values.get("slot_ns", 0), "losses.slot_ns")
        record = values.get("record", "")
        scope = values.get("scope", LINK)
        if scope not in SCOPES:
            raise ConfigError("losses.scope", scope, " or ".join(SCOPES))
        part = "links" if scope == LINK else "receivers"
        links = values.get(part, ())
        if not isinstance(record, str):
            raise ConfigError("losses.record", record, "text")
        if isinstance(links, str) or not isinstance(links, Sequence) or bool(links) == bool(record):
            raise ConfigError(f"losses.{part}", links if links else None, f"a list of {part}, or a record in its place")
        rows = [_row(entry, f"losses.{part}[{place}]") for place, entry in enumerate(links)]
        if "others" in values:
            others = values["others"]
            if not isinstance(others, Mapping):
                raise ConfigError("losses.others", others, f"names with values: {', '.join(NUMBERS)}")
            row = _row({**others, "sender": 0, "receiver": 0}, "losses.others")
            if all(other[:2] != row[:2] for other in rows):  # of a listener's losses, they may stand there already
                rows.append(row)
        seen: set[tuple[int, int]] = set()
        for row in rows:
            if row[:2] in seen:
                raise ConfigError(f"losses.{part}", f"sender {row[0]}, receiver {row[1]}", "each link once")
            if scope == RECEIVER and row[0]:
                raise ConfigError(f"losses.{part}", f"sender {row[0]}", "sender 0: a receiver loses all senders alike")
            seen.add(row[:2])
        found = cls(
            str(values.get("name", name)),
            str(values.get("sha256", sha256)),
            _AGENTS.check(values.get("agents"), "losses.agents"),
            slot_ns,
            tuple(rows),
            record,
            scope,
        )
        if record:
            found.replay(1)
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the losses as :meth:`from_dict` reads them."""
        about = {"name": self.name, "sha256": self.sha256, "agents": self.agents, "slot_ns": self.slot_ns}
        if self.record:
            return {**about, "record": self.record}
        rows = [list(row) for row in self.links]
        return {**about, **({"links": rows} if self.scope == LINK else {"scope": RECEIVER, "receivers": rows})}

    def check(self, agents: int, slot_ns: int) -> None:
        """Check that the losses fit a swarm.

        :param agents: number of agents N.
        :param slot_ns: ns, length of its slots.
        :raises ConfigError: when they do not.
        """
        if self.slot_ns and self.slot_ns != slot_ns:
            allowed = f"slots of {slot_ns / 1e6:g} ms, as in the swarm: chains move once a slot"
            raise ConfigError("losses", f"{self.name}, measured in slots of {self.slot_ns / 1e6:g} ms", allowed)
        if self.record:
            self.replay(agents)
        else:
            self.fitted(agents)

    def replay(self, agents: int) -> LossRecord:
        """Return the record.

        :param agents: number of agents N.
        """
        return unpack(self.record, agents)

    def fitted(self, agents: int) -> Fitted:
        """Return the chains of all links.

        :param agents: number of agents N.
        :raises ConfigError: when nothing is said of a link.
        """
        numbers = np.full((4, agents, agents), np.nan)
        # What is said of all first, then what is said of a sender or of a receiver, then what of a single link.
        for sender, receiver, *values in sorted(self.links, key=lambda row: (row[0] > 0) + (row[1] > 0)):
            if sender <= agents and receiver <= agents:
                rows = slice(None) if sender == 0 else slice(sender - 1, sender)
                columns = slice(None) if receiver == 0 else slice(receiver - 1, receiver)
                numbers[:, rows, columns] = np.array(values)[:, None, None]
        if self.scope == LINK:
            numbers[:, np.arange(agents), np.arange(agents)] = 0.0  # nobody hears itself
        if np.isnan(numbers).any():
            sender, receiver = np.argwhere(np.isnan(numbers[0]))[0] + 1
            raise ConfigError(
                "losses", f"{self.name}, without the link from {sender} to {receiver}", "all links, or others"
            )
        enter, leave, good, bad = numbers
        moves = enter + leave
        leave[moves == 0.0] = 1.0  # a chain that never moves: it is in its good state
        share = np.divide(enter, moves, out=np.zeros_like(enter), where=moves > 0.0)
        rows = slice(None) if self.scope == LINK else slice(1)
        return Fitted(LinkChains(share[rows], enter[rows], leave[rows]), good, bad)


def _row(entry: object, name: str) -> Row:
    """Return a link's numbers, checked."""
    keys = ("sender", "receiver", *NUMBERS)
    if isinstance(entry, Mapping):
        for key in keys:
            if key not in entry:
                raise ConfigError(f"{name}.{key}", None, f"a value: a link needs {', '.join(keys)}")
        entry = [entry[key] for key in keys]
    if isinstance(entry, str) or not isinstance(entry, Sequence) or len(entry) != len(keys):
        raise ConfigError(name, entry, ", ".join(keys))
    ids = [int(_ID.check(value, f"{name}.{key}")) for key, value in zip(keys[:2], entry[:2], strict=True)]
    enter, leave, good, bad = (
        float(_PROBABILITY.check(value, f"{name}.{key}")) for key, value in zip(NUMBERS, entry[2:], strict=True)
    )
    if enter + leave > 1.0 + 1e-12:
        raise ConfigError(f"{name}.leave", leave, f"at most 1 - enter, {1.0 - enter:g}")
    return ids[0], ids[1], enter, leave, good, bad
