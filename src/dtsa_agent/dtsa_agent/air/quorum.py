"""Whether an agent may fly: only while it hears, and is heard by, enough of those that are there; else it hovers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from dtsa_agent.core.errors import ConfigError

from .contacts import Contact

ALL_BUT_ONE = "all-but-one"
ALLOWED = f"{ALL_BUT_ONE}, a share of those that are there (80%), or a number of others (0: it never hovers for this)"
_AT_START_NS = 1_000_000_000  # within which an agent that is no longer new does not say yet that it hovers
_AGAIN_NS = 2_000_000_000  # from a line to the next one
_SHARE = re.compile(r"([0-9]+(?:\.[0-9]+)?)%")


class Quorum:
    """How many others an agent must hear, and be heard by.

    :param text: as the setting has it.
    :raises ConfigError: for another text.
    """

    __slots__ = ("_least", "_share")

    def __init__(self, text: str) -> None:
        share = _SHARE.fullmatch(text) if isinstance(text, str) else None
        self._share = float(share[1]) / 100.0 if share else None
        self._least: int | None = None
        if share is None and text != ALL_BUT_ONE:
            if not (isinstance(text, str) and text.isascii() and text.isdigit()):
                raise ConfigError("quorum", text, ALLOWED)
            self._least = int(text)
        if self._share is not None and self._share > 1.0:
            raise ConfigError("quorum", text, ALLOWED)

    @property
    def least(self) -> int:
        """How many others there have to be in any case."""
        return self._least or 0

    def needed(self, there: int) -> int:
        """How many others.

        :param there: number of others that are there.
        """
        if self._least is not None:
            return self._least
        if self._share is not None:
            return math.ceil(there * self._share - 1e-9)
        return max(1, there - 1) if there else 0


class Hold:
    """Whether one agent hovers for want of a quorum; it says so when that changes.

    :param quorum: how many others are needed.
    :param say: is told a line at once, and not again for 2 s; None: nobody is.
    """

    __slots__ = ("_next_ns", "_quorum", "_said", "_say", "flew", "held", "settled", "slots", "slots_at_start")

    def __init__(self, quorum: Quorum, say: Callable[[str], None] | None) -> None:
        self._quorum, self._say = quorum, say
        #: Whether it hovers.
        self.held = True
        #: Whether it had a quorum when it was no longer new.
        self.flew = False
        #: Slots in which it hovered that was no longer new: before it flew for the first time, and since then.
        self.slots_at_start = self.slots = 0
        #: Whether it stays as it is, and has been said, until it stands otherwise with the others.
        self.settled = False
        self._said = False
        self._next_ns: int | None = None  # None: it is new

    def hover(self) -> None:
        """It has hovered through a slot."""
        if self.flew:
            self.slots += 1
        else:
            self.slots_at_start += 1

    @property
    def problem(self) -> str:
        """Why it has never flown, or an empty text."""
        if self.flew or not self.slots_at_start:
            return ""
        return f"never had its quorum, and hovered for {self.slots_at_start} slots"

    def judge(self, contact: Contact, new: bool, now_ns: int) -> None:
        """Looks whether it may fly.

        :param contact: how it stands with the others.
        :param new: it hovers in any case.
        :param now_ns: ns, CLOCK_MONOTONIC.
        """
        needed = self._quorum.needed(contact.there)
        held = self.held = contact.both < needed
        if new:
            self._next_ns, self.settled = None, False
            return
        self.flew = self.flew or not held
        if self._next_ns is None:
            self._next_ns = now_ns + _AT_START_NS
        self.settled = held == self._said
        if self.settled or now_ns < self._next_ns or self._say is None:
            return
        self._said, self._next_ns, self.settled = held, now_ns + _AGAIN_NS, True
        there, hears, heard_by, _ = contact
        does = "hovers" if held else "flies on"
        self._say(f"{does}: hears {hears} of {there}, is heard by {heard_by} (quorum {needed})")
