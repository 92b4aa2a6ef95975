"""Follows a run by its messages, from a bag or from the ROS graph, and tells it moment by moment."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AbstractSwarm, make_scenario
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.wire.packing import split_frames, unpack_received
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.hearing import Hearing, Unheard
from dtsa_bench.runs.metrics import metrics_tables

from .moments import BELIEFS, Moments, estimate_now, run_info
from .track import Track

_PAIRS = 100  # agents: of larger swarms crashes are not looked for
_FARTHEST_M = 1e6
_SLOTS = 64  # whose frames wait for the channel's verdict


class Follower:
    """Takes in a run's messages slot by slot; what cannot be one is counted and left out.

    Objects of rclpy and of other decoders will do: only the fields' names and contents matter.

    :param track: where the moments go.
    :param info: further values for the page.
    """

    def __init__(self, track: Track, info: Mapping[str, Any]) -> None:
        self._track, self._more = track, dict(info)
        self._wanted = 0  # slots from one moment to the next; 0: 20 moments a simulated second
        self._run: RunConfig | None = None
        self.unusable = 0

    @property
    def begun(self) -> bool:
        """Whether the run's settings are known."""
        return self._run is not None

    def set_pace(self, slots: int) -> None:
        """Sets how many slots pass from one moment to the next; before the run begins."""
        self._wanted = slots

    def begin(self, settings: Mapping[str, Any]) -> None:
        """The settings of the run are known; from now on its messages are taken in.

        :param settings: as a bag holds them.
        :raises DtsaError: if they cannot be used.
        """
        if self._run is not None:
            return
        run = RunConfig.from_dict(dict(settings) if "swarm" in settings else {"swarm": dict(settings)})
        self._run, self.scenario = run, make_scenario(run.swarm)
        agents, steps = run.swarm.agents, run.swarm.steps
        self.agents, self.steps = agents, steps
        self._tables = self._make_tables(run)
        self._hearing, self._unheard = Hearing(agents), Unheard(run.swarm.slot_ns)
        self._oracle = run.swarm.estimator_row.needs_everybody
        self._moments = Moments(self.scenario, run.swarm.slot_ns, run.air)
        self._every = self._wanted or self._moments.place_slots
        self._way = np.repeat(np.ascontiguousarray(self.scenario.start)[None], steps, axis=0)  # (S, 3, N) m
        self._chosen = np.zeros(agents, np.uint16)
        self._digest = np.zeros(agents, np.uint32)
        self._reason = np.zeros(agents, np.uint8)
        self._frames: dict[int, dict[int, bytes]] = {}  # by slot and sender, until it is told
        self._slot = 0  # the slot that is being told
        self._next = 0  # first slot of the next moment
        self._absent: frozenset[int] = frozenset()
        self._crashed: set[tuple[int, int]] = set()
        self._lag_ms, self._ended = 0.0, ""
        self._pairs = np.triu_indices(agents, 1)
        self._track.begin(run_info(self._track.name, run, self.scenario) | self._more)

    def _make_tables(self, run: RunConfig) -> AbstractSwarm | None:
        if run.swarm.agents > BELIEFS:
            return None
        try:
            return metrics_tables(run, self.scenario, everyone=True)
        except DtsaError:
            return None  # frames with a key that is not here, or a policy that is not installed

    def take(self, kind: str, message: Any) -> None:
        """Takes in a message.

        :param kind: its type without the package, as ``Reception``.
        :param message: an object with its fields.
        """
        try:
            if kind == "Configuration":
                settings = json.loads(message.settings)
                if isinstance(settings, dict):
                    self.begin(settings)
            elif self._run is not None and (handler := self._HANDLERS.get(kind)):
                handler(self, message)
        except (ValueError, TypeError, IndexError, KeyError, OverflowError, RecursionError, DtsaError):
            self.unusable += 1

    def _index(self, ids: Any) -> NDArray[np.intp]:
        index = np.asarray(ids, dtype=np.intp) - 1
        if len(index) and not (index.min() >= 0 and index.max() < self.agents):
            raise ValueError("an id that is none of the swarm's")
        return index

    def _transmission(self, message: Any) -> None:
        """What some agents answer to a slot: where they are, what they decided, their frames."""
        index, n = self._index(message.agent), len(message.agent)
        way = np.asarray(message.track, dtype=np.float64).reshape(self.steps, 3, n)
        if not np.abs(way).max(initial=0.0) < _FARTHEST_M:
            raise ValueError("positions that are no numbers, or far away")
        frames = split_frames(bytes(np.asarray(message.data, np.uint8)), np.asarray(message.length).tolist())
        self._way[:, :, index] = way
        self._decided(index, message)
        self._slot = int(message.slot)
        self._keep(self._slot, np.asarray(message.agent).tolist(), frames)

    def _keep(self, slot: int, senders: list[int], frames: list[bytes]) -> None:
        """Keeps frames until it is known who received them."""
        self._frames.setdefault(slot, {}).update((s, f) for s, f in zip(senders, frames, strict=False) if f)
        while len(self._frames) > _SLOTS:
            del self._frames[min(self._frames)]

    def _heard(self, message: Any) -> None:
        """The frames that somebody received in a slot, as the channel delivers them."""
        if message.phase == 0 and len(message.sender):  # Slot.RUN
            frames = split_frames(bytes(np.asarray(message.data, np.uint8)), np.asarray(message.length).tolist())
            self._index(message.sender)
            self._keep(int(message.heard_slot), np.asarray(message.sender).tolist(), frames)

    def note(self, text: str, kind: str = "note") -> None:
        """Something that people should read has happened now."""
        if self._run is not None:
            self._moments.event(self._slot, kind, text)

    def _decision(self, message: Any) -> None:
        self._decided(self._index(message.agent), message)

    def place(self, agent: int, position: tuple[float, float, float]) -> None:
        """Takes in where an agent is, where no transmissions tell it.

        :param agent: its id.
        :param position: m, frame map.
        """
        if self._run is not None and 1 <= agent <= self.agents and all(abs(x) < _FARTHEST_M for x in position):
            self._way[:, :, agent - 1] = position

    def _decided(self, index: NDArray[np.intp], message: Any) -> None:
        self._chosen[index] = np.asarray(message.chosen, np.uint16)
        self._digest[index] = np.asarray(message.digest, np.uint32)
        self._reason[index] = np.asarray(message.reason, np.uint8)

    def _reception(self, message: Any) -> None:
        """What became of a slot: with it the slot is told, and what was heard in it is taken in."""
        slot, senders = int(message.slot), np.asarray(message.sender).tolist()
        self._index(senders)
        mask = unpack_received(bytes(np.asarray(message.received, np.uint8)), len(senders), self.agents)
        self._look(slot)
        frames = self._frames.pop(slot, {})
        if self._tables is not None:
            self.scenario.advance(slot, self._tables)
            known = [row for row, sender in enumerate(senders) if sender in frames]
            if known or not senders:
                self._hearing.slot(len(known), mask[known])
            for row, sender in enumerate(senders):
                if sender in frames and mask[row].any() and self._tables.hear(slot, frames[sender], mask[row]):
                    self._hearing.take_in(mask[row])
            self._tables.end(slot)
        self._moments.frames(slot, int(message.outcome), senders, self._reason, mask.astype(bool))
        here = np.ones(self.agents, bool)
        here[[agent - 1 for agent in self._absent]] = False
        self._moments.choices(self._chosen[here])
        self._slot = slot + 1

    def _look(self, slot: int) -> None:
        """All agents have answered a slot: where they are is known."""
        position = self._way[-1]
        self._find_crashes(slot)
        if slot % self._moments.place_slots == 0 or slot >= self._next:
            self._moments.place(slot, position)
        if slot < self._next:
            return
        self._next = slot + self._every
        self._tell(slot)

    def _tell(self, slot: int) -> None:
        if self._tables is not None:
            estimate_now(self._tables, self._oracle, slot, self._way[-1])
        if problem := self._unheard.news(slot, self._hearing.problem()):
            self._moments.event(slot, "bad", problem)
        more: dict[str, Any] = {"lag_ms": round(self._lag_ms, 2)}
        gathered = self._moments.gather(slot, self._tables, self._chosen, self._digest, self._absent, **more)
        self._track.add(self._moments.moment(gathered))

    def _find_crashes(self, slot: int) -> None:
        if self.agents > _PAIRS or self.agents < 2 or self._run is None:
            return
        one, other = self._pairs
        gap = self._way[:, :, one] - self._way[:, :, other]
        least = np.einsum("sip,sip->sp", gap, gap).min(axis=0)
        for k in np.flatnonzero(least < self._run.limits.collision_m**2).tolist():
            pair = int(one[k]) + 1, int(other[k]) + 1
            if pair not in self._crashed:
                self._crashed.add(pair)
                self._moments.crash(slot, pair, math.sqrt(least[k]))

    def _status(self, message: Any) -> None:
        """Who has fallen silent, and whether the run is over."""
        slot, lost = int(message.slot), frozenset((self._index(message.lost) + 1).tolist())
        for agent in sorted(lost - self._absent):
            self._moments.event(slot, "lost", f"cf{agent} has fallen silent")
        for agent in sorted(self._absent - lost):
            self._moments.event(slot, "back", f"cf{agent} takes part again")
        self._absent, self._lag_ms = lost, float(message.lag_ms)
        if message.phase == 2 and not self._ended:  # RunStatus.ENDED
            self._ended = str(message.reason)[:300] or "over"
            self._moments.event(slot, "end", f"the run has ended: {self._ended}")

    def _changed(self, message: Any) -> None:
        """A setting of the channel was changed while it ran."""
        for parameter in list(message.changed_parameters)[:20]:
            value = parameter.value
            fields = (value.bool_value, value.integer_value, value.double_value, value.string_value)
            text = fields[int(value.type) - 1] if 1 <= int(value.type) <= 4 else "?"
            self._moments.event(self._slot, "air", f"{str(parameter.name)[:40]} is {str(text)[:80]!r} from now on")

    def finish(self, state: str) -> None:
        """No more will come.

        :param state: why, as people read it.
        """
        if self._run is not None and self._slot:
            self._find_crashes(self._slot)
            self._moments.place(self._slot, self._way[-1])
            self._tell(self._slot)
        self._track.end(f"{state}: {self._ended}" if getattr(self, "_ended", "") else state)

    _HANDLERS: Mapping[str, Callable[[Follower, Any], None]] = {
        "Transmission": _transmission,
        "Slot": _heard,
        "Decision": _decision,
        "Reception": _reception,
        "RunStatus": _status,
        "ParameterEvent": _changed,
    }
