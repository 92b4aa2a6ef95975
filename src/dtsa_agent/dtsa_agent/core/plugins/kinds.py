"""The kinds of plug-ins: what policies, estimators and avoiders from other packages have, and what they are given.

``table`` is what the observer knows, ``slot`` the number of a slot, ``now_ns`` ns since the start of slot 0. Ids count
from 1; positions are m, velocities m/s, frame map.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.swarm import SlotOutcome, Swarm

Array = NDArray[np.float64]


class Table:
    """What one observer knows; arrays are read-only windows on its table and are always up to date.

    Positions are m, velocities m/s, frame map, with shape (3, N); agent ``id`` is column ``id - 1``.
    """

    def __init__(self, swarm: Swarm, row: int) -> None:
        self._swarm, self._row = weakref.proxy(swarm), row  # a swarm has its tables: no cycle
        self.agent = int(swarm.observer[row]) + 1  # id of the observer, 0: one that hears everything
        self.config = swarm.config
        self.scenario = swarm.scenario
        self.sent_position = _window(swarm.sent_position[row])  # last heard (own: last sent) state
        self.sent_velocity = _window(swarm.sent_velocity[row])
        self.sent_intent = _window(swarm.sent_intent[row])  # commanded velocity, zero unless frames carry it
        self.sent_slot = _window(swarm.sent_slot[row])  # (N,) slot of that state, -1: never heard
        self.last_turn = _window(swarm.last_turn[row])  # (N,) slot of the last turn; h = slot - 1 - last_turn
        self.in_ap = _window(swarm.in_ap[row])  # (N,) A_p
        self.estimate_position = _window(swarm.estimate_position[row])  # as the estimator last filled them
        self.estimate_velocity = _window(swarm.estimate_velocity[row])
        here = row < len(swarm.ids)
        self.own_position = _window(swarm.position[:, row]) if here else None  # (3,) own true state
        self.own_velocity = _window(swarm.velocity[:, row]) if here else None
        self.goal = _window(swarm.goal[:, row]) if here else None

    def observation(self, slot: int) -> NDArray[np.float32]:
        """What the agent has heard before a slot and its own state, as numbers for learning (docs/how-to/learning.md).

        :raises ValueError: for the table of an agent that is elsewhere.
        """
        observed: NDArray[np.float32] = self._swarm.observations(slot, self._row, self._row + 1)[0]
        return observed


def _window(array: NDArray[Any]) -> NDArray[Any]:
    window: NDArray[Any] = array.view()
    window.flags.writeable = False
    return window


class OwnFrameData(Protocol):
    """What policies and estimators may have besides: bytes of their own in frames, and the outcome of each slot.

    All of it may be left out. ``own_bytes``, a class attribute, is the number of bytes, 0 to ``MAX_OWN_BYTES``.
    """

    own_bytes: ClassVar[int] = 0

    def say(self, table: Table, slot: int) -> bytes:
        """The bytes for the frame that this agent sends in a slot: exactly ``own_bytes`` of them."""

    def heard(self, table: Table, slot: int, sender: int, data: bytes) -> None:
        """Receive what the same part of another agent has said, in a frame whose state the table has already."""

    def slot_over(self, table: Table, slot: int, outcome: SlotOutcome) -> None:
        """A slot is over for this observer; collisions are silence to receivers that cannot tell."""


class Policy(Protocol):
    """Who sends next. It may have what :class:`OwnFrameData` has.

    ``port``, a class attribute, says what it uses of the air (``dtsa_agent.core.registry.PORT``); ``may_join = True``:
    agents may come late, because nobody needs a table that all have equal.
    """

    def choose(self, table: Table, slot: int) -> int:
        """The id that this observer takes for the sender of a slot, 0: nobody. It sends if that is its own."""


class Genie(Protocol):
    """Who sends next, said by one who looks into all agents: a bound to compare with. Made once, for agent 0."""

    def senders(self, swarm: Swarm, slot: int) -> Sequence[int]:
        """The ids that send in a slot; ``swarm``: true states and everybody's table, to be read only."""


class Radio(Protocol):
    """The radio of an agent that is not bound to slots."""

    def send(self) -> bool:
        """Begin to send the agent's frame, with its state at the start of the slot; False: it still sends another.

        A radio that listens takes the frame, and begins when :meth:`CarrierSensing.sensed` says so.
        """


class UnslottedPolicy(Protocol):
    """A policy that is not bound to slots, in the simulator only.

    Slots only say how often vehicles are steered and ages are counted.
    """

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Act at an instant, first at 0, with the table of the slot's start; returns when to be called again, ns."""


class CarrierSensing(UnslottedPolicy, Protocol):
    """The same with ``busy`` in its ``port``: its radio listens before it sends, as radios do that sense the carrier.

    ``wake`` hands a frame over by ``radio.send()``; what it returns then does not count, and it is not called again
    before the radio has told what became of the frame.
    """

    def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> int:
        """What the radio does that holds a frame and has just listened.

        :param busy: whether it has found the air in use, or sends itself.
        :param sent_ns: ns, when it began its last frame; 0: none yet.
        :returns: ns until it listens again; 0: it begins now, if the air is free.
        """

    def sent(self, table: Table, now_ns: int) -> int:
        """The radio has begun to send at ``now_ns``; returns when ``wake`` is to be called, ns, later than that."""


class PacketRadio(Radio, Protocol):
    """The radio of an agent whose policy has packets of its own. It sends nothing while it still sends another."""

    def send(self, note: bytes = b"", to: int = 0) -> bool:
        """As for all, with some bytes that precede the frame; ``to``: id of the only agent that takes it in, 0: all."""

    def say(self, note: bytes) -> bool:
        """Begin to send a packet without a frame."""

    def frame(self) -> bytes:
        """The agent's frame, with its state at the start of the slot, for packets of the policy's own.

        The agent counts as having sent it. Empty: it has none.
        """

    def take_in(self, frame: bytes, slot: int) -> None:
        """The agent hears a frame, as its sender's :meth:`frame` gave it in a slot, that its policy has put together.

        The slot may be over for long: a round may take many slots.
        """


class PacketReceiver(UnslottedPolicy, Protocol):
    """An unslotted policy that acts on each packet as it arrives, for example a token ring."""

    def received(self, table: Table, now_ns: int, sender: int, note: bytes) -> int:
        """A packet has arrived, as far as the air lets this agent hear it; ``note``: its bytes without the frame.

        Returns when ``wake`` is to be called next, in place of what was asked for before, ns, later than now.
        """


class Estimator(Protocol):
    """Where the others are by now. It may have what :class:`OwnFrameData` has.

    ``needs_intent = True`` makes frames carry the commanded velocity.
    """

    needs_intent: ClassVar[bool] = False

    def estimate(self, table: Table, slot: int, step: int, position: Array, velocity: Array) -> None:
        """Write the estimates for control instant ``step`` of a slot into (3, N) arrays, m and m/s."""


class Avoider(Protocol):
    """Where to fly. ``model`` names the built-in flight model whose vehicle and spacing are used."""

    model: ClassVar[str] = "orca"

    def command(self, table: Table, slot: int, step: int) -> Sequence[float]:
        """Commanded velocity, (3,), m/s, frame map; the estimates in ``table`` are those of this instant."""
