"""Policies, estimators and avoiders from other packages: made, checked, called. See docs/reference/plug-ins.md.

An error that a plug-in raises, or a wrong return value, becomes a PluginError with its name.
"""

from __future__ import annotations

import math
import operator
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from .errors import DtsaError, PluginError, shown
from .frame import decode_frame
from .registry import REASONS, Registry
from .settings.config import REGISTRIES, SwarmConfig
from .settings.scenario import Scenario
from .swarm import Bytes, SlotOutcome, Swarm

_PLUGIN_REASON = REASONS.index("plugin")
# The method that a plug-in must have, by its kind; policies for comparison have another one instead.
_REQUIRED = {
    "policy": "choose(table, slot)",
    "estimator": "estimate(table, slot, step, position, velocity)",
    "avoider": "command(table, slot, step)",
}
_FOR_COMPARISON = ("senders(swarm, slot)", "wake(table, now_ns, radio)")
_OWN_DATA = ["own_data(table, slot)", "receive_data(table, slot, sender, data)"]  # with `own_bytes`


def make_swarm(
    config: SwarmConfig, scenario: Scenario | None = None, local: Sequence[int] | None = None,
    shared_table: bool = False, observers: Sequence[int] | None = None,
) -> Swarm:  # fmt: skip
    """Create a :class:`Swarm`, or a :class:`PluginSwarm` if the configuration names plug-ins.

    Parameters are those of ``Swarm``; with plug-ins every agent has its own table.

    :raises ConfigError: for ids and plug-ins that do not exist.
    """
    if not config.plug_ins:
        return Swarm(config, scenario, local, shared_table, observers)
    return PluginSwarm(config, scenario, local, False, observers)


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

        :param slot: number of the slot that begins.
        :returns: (10 + 9 N,), with the units of ``dtsa.env.fields``.
        :raises ValueError: for the table of an agent that is elsewhere.
        """
        observed: NDArray[np.float32] = self._swarm.observations(slot, self._row, self._row + 1)[0]
        return observed


def _window(array: NDArray[Any]) -> NDArray[Any]:
    window: NDArray[Any] = array.view()
    window.flags.writeable = False
    return window


class PluginSwarm(Swarm):
    """A swarm with plug-ins. Every observer has its own instances; the kernel runs the built-in parts.

    Parameters are those of :class:`Swarm`.
    """

    all_in_c = False

    def __init__(self, *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self.tables = [Table(self, row) for row in range(len(self.observer))]  # of each observer
        self._outcome = np.zeros(len(self.tables), dtype=np.uint8)  # SlotOutcome of this slot, without collisions
        self._appended: dict[int, bytes] = {}  # own data of this slot's frames, by position in ids
        self._own_bytes = self.config.own_bytes
        self._make_parts()

    def _make_parts(self) -> None:
        has_genie = self.config.policy_row.needs_everybody and bool(self.ids)
        self._genie = self._make_part(REGISTRIES["policy"], 0) if has_genie else None
        #: Plug-ins of each observer; empty if the part is built in, or the policy is a genie.
        self.policies, self.estimators, self.avoiders = (
            self._make_instances(registry, [table.agent for table in self.tables]) for registry in REGISTRIES.values()
        )
        self.flies_in_c = not (self.estimators or self.avoiders)
        self._list_data_parts()

    def _make_instances(self, registry: Registry[Any], ids: list[int]) -> list[Guarded]:
        name = getattr(self.config, registry.kind)
        if name in registry.rows or getattr(registry.row(name), "needs_everybody", False):
            return []
        return [self._make_part(registry, agent) for agent in ids]

    def _make_part(self, registry: Registry[Any], agent: int) -> Guarded:
        name = getattr(self.config, registry.kind)
        return Guarded(registry.kind, name, registry.factory(name), self.config, agent)

    def _list_data_parts(self) -> None:
        """List the policy and the estimator of each observer with the size of their data, in the frame's order."""
        policy, estimator = self.config.policy_row, self.config.estimator_row
        parts = ((self.policies, policy.own_bytes), (self.estimators, estimator.own_bytes))
        self._data_parts = [
            [(instances[row], size) for instances, size in parts if instances] for row in range(len(self.tables))
        ]
        self._needs_outcome = any(hasattr(part, "slot_over") for row in self._data_parts for part, _ in row)

    def decide(self, slot: int) -> None:
        if self._genie is not None:
            senders = self._genie.check_senders(self._genie.senders(self, slot), slot, self.config.agents)
            self.chosen[:], self.sends[:] = senders[0] if senders else 0, 0
            for agent in senders:
                self.sends[agent - 1] = self.present[agent - 1] > 0
        elif self.policies:
            self.estimate(slot)  # for the slot's start; those of control instants and metrics depend on the vehicle
            for index, agent in enumerate(self.ids):
                policy = self.policies[index]
                choice = policy.choose(self.tables[index], slot)
                chosen = policy.check_id(choice, "choose", slot, 0, self.config.agents)
                self.chosen[index], self.sends[index] = chosen, chosen == agent and self.present[index]
        else:
            super().decide(slot)
            return
        self.reason[:], self.score[:] = _PLUGIN_REASON, 0.0
        self.digest[:] = self.table_hash[: len(self.ids)]

    def emit(self, slot: int) -> tuple[int, ...]:
        senders = super().emit(slot)
        if self._own_bytes:
            self._appended = {index: b"".join(self._own_data(index, slot)) for index in senders}
        return senders

    def _own_data(self, index: int, slot: int) -> Iterator[bytes]:
        for part, size in self._data_parts[index]:
            if size:
                yield part.check_own_data(part.own_data(self.tables[index], slot), size)

    def _encoded(self, local_index: int) -> bytes:
        data = super()._encoded(local_index)
        return data + self._appended[local_index] if data and self._own_bytes else data

    def _receive(self, slot: int, frame: bytes, mask: Bytes | None) -> bool:
        end = max(0, len(frame) - self._own_bytes)
        if not super()._receive(slot, frame[:end], mask):
            return False
        if not (self._own_bytes or self._needs_outcome):
            return True
        sender = decode_frame(frame[:end]).sender
        for row, table in enumerate(self.tables):
            if table.agent == sender or (mask is not None and not mask[row]):
                continue
            self._outcome[row] = SlotOutcome.FRAME
            offset = end
            for part, size in self._data_parts[row]:
                if size:
                    part.receive_data(table, slot, sender, frame[offset : offset + size])
                offset += size
        return True

    def estimate(self, slot: int, step: int = 0) -> None:
        if not self.estimators:
            super().estimate(slot, step)
            return
        for estimator, table, position, velocity in zip(
            self.estimators, self.tables, self.estimate_position, self.estimate_velocity, strict=True
        ):
            estimator.estimate(table, slot, step, position, velocity)
            estimator.check_estimates(position, velocity, slot=slot)

    def end(self, slot: int, collided: Bytes | None = None) -> None:
        super().end(slot, collided)
        if self._needs_outcome:
            self._report_outcome(slot, collided)
        if self.estimators:
            self.estimate(slot + 1)  # for the metrics

    def _report_outcome(self, slot: int, collided: Bytes | None) -> None:
        self._outcome[np.flatnonzero(self.sends & (self.frame_length > 0))] = SlotOutcome.FRAME
        for row, table in enumerate(self.tables):
            outcome = SlotOutcome(int(self._outcome[row]))
            if collided is not None and collided[row] and outcome == SlotOutcome.SILENCE:
                outcome = SlotOutcome.COLLISION
            for part, _ in self._data_parts[row]:
                if hasattr(part, "slot_over"):
                    part.slot_over(table, slot, outcome)
        self._outcome[:] = SlotOutcome.SILENCE

    def reset(self) -> None:
        super().reset()
        self._outcome[:] = SlotOutcome.SILENCE
        self._make_parts()

    def restart(self, local_index: int) -> None:
        super().restart(local_index)
        for registry, parts in zip(REGISTRIES.values(), (self.policies, self.estimators, self.avoiders), strict=True):
            parts[local_index : local_index + 1] = self._make_instances(registry, [self.ids[local_index]])
        self._list_data_parts()

    def steer(self, slot: int, step: int, estimate: bool = True) -> None:
        if estimate and self.estimators:
            self.estimate(slot, step)
        super().steer(slot, step, estimate and not self.estimators)
        for index, avoider in enumerate(self.avoiders[: len(self.ids)]):
            if self.active[index] and self.present[index]:
                self.command[:, index] = avoider.check_command(avoider.command(self.tables[index], slot, step), slot)


class Guarded:
    """One instance of a plug-in, of a kind as in ``_REQUIRED``, with the instance's methods.

    :raises PluginError: if the factory or a method raises an error, lacks the method of its kind, or returns a value
        that is not allowed. A ConfigError (of options, for instance) stays one.
    """

    def __init__(self, kind: str, name: str, factory: Callable[..., Any], *arguments: object) -> None:
        self.name = f"{kind} {name}"
        self.instance = _guarded(self.name, factory)(*arguments)
        required = [_REQUIRED[kind]]
        if kind == "policy":
            required = [next((text for text in _FOR_COMPARISON if _has(factory, text)), required[0])]
        if kind != "avoider" and getattr(factory, "own_bytes", None):
            required += _OWN_DATA
        missing = [text for text in required if not _has(self.instance, text)]
        if missing:
            raise PluginError(self.name, f"{type(self.instance).__name__} has no method {' and '.join(missing)}")

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """A method of the instance, guarded; made at the first call."""
        call = _guarded(f"{self.name}, {method}", getattr(self.instance, method))
        setattr(self, method, call)
        return call

    def check_senders(self, answer: Any, slot: int, agents: int) -> list[int]:
        """Check the return value of ``senders``: ids."""
        try:
            ids = list(answer)
        except Exception:
            self._fail("senders", f"gave {shown(answer)} in slot {slot}; allowed: a list of the ids that send")
        return [self.check_id(agent, "senders", slot, 1, agents) for agent in ids]

    def check_id(self, answer: object, method: str, slot: int, low: int, high: int) -> int:
        """Check an id that a method returned; 0, where it is allowed, means no agent."""
        least = "1" if low else "0 (no agent)"
        try:
            number = operator.index(answer)  # type: ignore[arg-type]
        except Exception:  # whatever its __index__ raises
            number, least = low - 1, f"an integer, {least}"
        if not low <= number <= high:
            self._fail(method, f"chose agent {shown(answer)} in slot {slot}; allowed: {least} to {high}")
        return number

    def check_own_data(self, answer: object, size: int) -> bytes:
        """Check the return value of ``own_data``: as many bytes as ``own_bytes`` declares."""
        if not isinstance(answer, (bytes, bytearray)) or len(answer) != size:
            given = f"{len(answer)} bytes" if isinstance(answer, (bytes, bytearray)) else shown(answer)
            self._fail("own_data", f"gave {given}, declared {size}")
        return bytes(answer)

    def check_command(self, answer: Any, slot: int) -> tuple[float, ...]:
        """Check the return value of ``command``: three finite numbers, m/s."""
        try:
            velocity = tuple(float(value) for value in answer)
        except Exception:
            velocity = ()
        if len(velocity) != 3 or not all(map(math.isfinite, velocity)):
            self._fail("command", f"gave {shown(answer)} in slot {slot}; allowed: three finite numbers")
        return velocity

    def check_estimates(self, *arrays: NDArray[np.float64], slot: int) -> None:
        """Check that ``estimate`` has written finite numbers."""
        if not all(np.isfinite(array).all() for array in arrays):
            self._fail("estimate", f"wrote a number that is not finite in slot {slot}")

    def _fail(self, method: str, fault: str) -> NoReturn:
        raise PluginError(f"{self.name}, {method}", fault) from None


def _has(part: object, method: str) -> bool:
    return callable(getattr(part, method.partition("(")[0], None))


def _guarded(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*arguments: object) -> Any:
        try:
            return function(*arguments)
        except DtsaError:
            raise
        except (Exception, SystemExit, GeneratorExit) as error:  # a plug-in does not end the program
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{frame.filename}:{frame.lineno}"
            raise PluginError(part, f"{type(error).__name__}: {error} ({place})") from error

    return call
