"""Interfaces of plug-ins: policies, estimators and avoiders from other packages, and the objects passed to them.

``table`` is the observer's table, ``slot`` the number of a slot, ``now_ns`` ns since the start of slot 0. Ids count
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
    """Table of one observer; arrays are read-only views, always up to date.

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
        is_local = row < len(swarm.ids)
        self.own_position = _window(swarm.position[:, row]) if is_local else None  # (3,) own true state
        self.own_velocity = _window(swarm.velocity[:, row]) if is_local else None
        self.goal = _window(swarm.goal[:, row]) if is_local else None

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
    """Optional members of policies and estimators: data of their own in frames, and the outcome of each slot.

    ``own_bytes``, a class attribute, is the length of the data, 0 to ``MAX_OWN_BYTES``.
    """

    own_bytes: ClassVar[int] = 0

    def own_data(self, table: Table, slot: int) -> bytes:
        """Return the data for the frame that this agent sends in a slot: exactly ``own_bytes`` bytes."""

    def receive_data(self, table: Table, slot: int, sender: int, data: bytes) -> None:
        """Receive the data of another agent's same part; the table has the state of the same frame already."""

    def slot_over(self, table: Table, slot: int, outcome: SlotOutcome) -> None:
        """Note the outcome of a slot for this observer; receivers without collision detection see silence."""


class Policy(Protocol):
    """Rule that decides which agent sends next. It may have the members of :class:`OwnFrameData`.

    ``port``, a class attribute, lists what it uses of the channel (``dtsa_agent.core.registry.PORT``);
    ``may_join = True``: agents may join late, because the policy does not need equal tables.
    """

    def choose(self, table: Table, slot: int) -> int:
        """Return the id of the agent expected to send in a slot, 0: none. The observer sends if it is its own id."""


class Genie(Protocol):
    """Central policy that knows all agents' states: a bound for comparison. Created once, for agent 0."""

    def senders(self, swarm: Swarm, slot: int) -> Sequence[int]:
        """Return the ids that send in a slot; ``swarm``: true states and tables of all agents, read-only."""


class Radio(Protocol):
    """The radio of an agent that is not bound to slots."""

    def send(self) -> bool:
        """Begin to send the agent's frame, with its state at the start of the slot; False: another one is on the air.

        A carrier-sensing radio keeps the frame, and begins when :meth:`CarrierSensing.sensed` returns 0.
        """


class UnslottedPolicy(Protocol):
    """A policy that is not bound to slots, in the simulator only.

    Slots only say how often vehicles are steered and ages are counted.
    """

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Act at an instant, first at 0, with the table of the slot's start; returns when to be called again, ns."""


class CarrierSensing(UnslottedPolicy, Protocol):
    """An unslotted policy with ``busy`` in its ``port``: its radio senses the carrier before it sends.

    ``wake`` passes a frame on by ``radio.send()``; its return value is then ignored, and it is not called again before
    :meth:`sent`.
    """

    def sensed(self, busy: bool, now_ns: int, sent_ns: int) -> int:
        """Decide after carrier sensing, while the radio has a frame to send.

        :param busy: whether the channel is busy, or the radio itself sends.
        :param sent_ns: start of the radio's last frame, ns; 0: none yet.
        :returns: ns until the radio senses again; 0: it begins now, if the channel is free.
        """

    def sent(self, table: Table, now_ns: int) -> int:
        """The radio has begun to send at ``now_ns``; returns when ``wake`` is to be called, ns, later than that."""


class PacketRadio(Radio, Protocol):
    """The radio of an agent whose policy has packets of its own. It sends one packet at a time."""

    def send(self, note: bytes = b"", to: int = 0) -> bool:
        """Send the frame behind a header ``note``; ``to``: id of the only agent that accepts it, 0: all."""

    def send_note(self, note: bytes) -> bool:
        """Begin to send a packet without a frame; False: another one is on the air."""

    def frame(self) -> bytes:
        """Return the agent's frame, with its state at the start of the slot, for the policy's own packets.

        It counts as sent. Empty: the agent has none.
        """

    def receive_frame(self, frame: bytes, slot: int) -> None:
        """Pass a frame to the agent that its policy has decoded from packets.

        :param slot: in which the sender's :meth:`frame` returned it, perhaps many slots ago.
        """


class PacketReceiver(UnslottedPolicy, Protocol):
    """An unslotted policy that acts on each packet as it arrives, for example a token ring."""

    def received(self, table: Table, now_ns: int, sender: int, note: bytes) -> int:
        """Receive a packet; ``note``: its bytes without the frame.

        :returns: when to call ``wake`` next, ns, later than now; replaces the time returned before.
        """


class Estimator(Protocol):
    """Estimator of the other agents' present states. It may have the members of :class:`OwnFrameData`.

    ``needs_intent = True`` makes frames carry the commanded velocity.
    """

    needs_intent: ClassVar[bool] = False

    def estimate(self, table: Table, slot: int, step: int, position: Array, velocity: Array) -> None:
        """Write the estimates for control instant ``step`` of a slot into (3, N) arrays, m and m/s."""


class Avoider(Protocol):
    """Collision avoidance. ``model`` names the built-in flight model whose vehicle and spacing are used."""

    model: ClassVar[str] = "orca"

    def command(self, table: Table, slot: int, step: int) -> Sequence[float]:
        """Return the commanded velocity, (3,), m/s, frame map; ``table`` has the estimates of this instant."""
