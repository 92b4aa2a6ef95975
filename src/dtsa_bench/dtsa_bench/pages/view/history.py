"""What a page shows of a run: moments, built slot by slot, and the history of the last of them; what it commands."""

from __future__ import annotations

import json
import threading
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS, Scenario, Swarm
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.pages.html import flatten, pack
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim.model.schedule import scheduled_changes

MAX_MOMENTS = 12_000  # in a history: ten minutes at 20 a second
MAX_BYTES = 256 << 20  # likewise
MAX_FRAMES = 4000  # in one moment: of more than these the last
MAX_POSITIONS = 400  # likewise
MAX_EVENTS = 100  # likewise
MAX_BELIEVERS = 100  # agents: of larger swarms a page does not get what each believes about each
UNKNOWN = 65535  # an age that is not known
_PERIOD_NS = 50_000_000  # simulated, from one moment to the next
_AGE_STEPS = 10  # mean ages are in tenths of slots
_MM = 1000.0  # believed positions are in mm
_FARTHEST = 32767
_OVERHEAD = 200  # bytes of a moment beside its contents
_FRAME = (("slot", "<u4"), ("sender", "<u2"), ("outcome", "u1"), ("reason", "u1"), ("received", "u1"))

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moment:
    """One moment of a run."""

    slot: int  # slots flown; positions are those at the start of this one
    text: str  # what the page reads, a JSON object
    heard: bytes  # (N, N) uint16, slots since each observer heard each agent; empty: not known
    believed: bytes  # (N, 3, N) int16 mm, frame map, where each observer takes each agent to be; empty: not known

    def belief(self, observer: int, agents: int) -> tuple[bytes, bytes]:
        """Rows of `heard` and `believed` of one observer (id); empty where they are not known."""
        row = observer - 1
        heard = self.heard[2 * agents * row : 2 * agents * (row + 1)]
        return heard, self.believed[6 * agents * row : 6 * agents * (row + 1)]

    @property
    def size(self) -> int:
        """Bytes that it takes."""
        return len(self.text) + len(self.heard) + len(self.believed) + _OVERHEAD


@dataclass(frozen=True, slots=True)
class VehicleStates:
    """Crazyflies as their bridge reports them now."""

    rows: tuple[tuple[str, str, float, float, str], ...]  # name, state, battery in V, link quality 0 to 1, reason
    answer: str = ""  # result of the last command


def run_info(name: str, run: RunConfig, scenario: Scenario) -> dict[str, Any]:
    """What a page has to know of a run before its first moment, as JSON types."""
    both = np.concatenate([scenario.start, scenario.target], axis=1)
    swarm = run.swarm
    return {
        "name": name,
        "agents": swarm.agents,
        "moving": scenario.moving.tolist(),
        "slot_s": swarm.slot_ns / 1e9,
        "mode": run.mode,
        "policy": swarm.policy,
        "estimator": swarm.estimator,
        "avoider": swarm.avoider,
        "target": np.round(scenario.target, 3).T.tolist(),
        "box": [np.round(both.min(axis=1), 3).tolist(), np.round(both.max(axis=1), 3).tolist()],
        "collision_m": run.limits.collision_m,
        "reasons": list(REASONS),
        "config": flatten(run.to_dict()),
    }


class RunHistory:
    """The last moments of a run; one thread writes, others read. The oldest moments go when there are too many.

    :param name: of the run until its settings are known.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._lock = threading.Lock()
        self._moments: deque[Moment] = deque()
        self._first = 0  # number of the oldest moment that is kept
        self._bytes = 0
        self._info: dict[str, Any] | None = None
        self._runs = 0
        #: How the run is doing, as people read it; empty: it is under way.
        self.state = ""
        #: Crazyflies beside or without a run: replaced, never changed. None: there are none.
        self.vehicles: VehicleStates | None = None

    @property
    def info(self) -> tuple[int, dict[str, Any] | None]:
        """Number of the run that is shown, and its `run_info`; None: nothing is known yet."""
        with self._lock:
            return self._runs, self._info

    def start_run(self, info: dict[str, Any]) -> None:
        """Start a run, `info` as `run_info` returns it; moments of another one are dropped."""
        with self._lock:
            self._runs += 1
            self._info, self.state = info, ""
            self._first += len(self._moments)
            self._moments.clear()
            self._bytes = 0

    def append(self, moment: Moment) -> None:
        """Add the next moment."""
        with self._lock:
            self._moments.append(moment)
            self._bytes += moment.size
            while len(self._moments) > MAX_MOMENTS or (self._bytes > MAX_BYTES and len(self._moments) > 1):
                self._bytes -= self._moments.popleft().size
                self._first += 1

    def since(self, number: int, most: int) -> tuple[int, list[Moment]]:
        """At most so many moments from a number on, and the first one's number: a later one where older are gone."""
        with self._lock:
            start = max(number, self._first)
            place = start - self._first
            return start, list(islice(self._moments, place, place + most))


class MomentBuilder:
    """Collects what happens in a run until its next moment, and adds that to a history; all that it holds is bounded.

    :param info: further values for the page.
    :param absent: ids of agents that do not take part yet.
    """

    def __init__(
        self, history: RunHistory, run: RunConfig, scenario: Scenario, info: dict[str, Any],
        absent: Collection[int] = (),
    ) -> None:  # fmt: skip
        history.start_run(run_info(history.name, run, scenario) | info)
        self._history, self._scheduled = history, deque(scheduled_changes(run.air))
        self.agents, self.absent = run.swarm.agents, set(absent)
        #: Slots from one moment to the next.
        self.period = max(1, round(_PERIOD_NS / run.swarm.slot_ns))
        self._moving = scenario.moving
        self._frames: deque[tuple[int, int, int, int, int]] = deque(maxlen=MAX_FRAMES)  # the columns of `_FRAME`
        self._positions: deque[tuple[int, Floats]] = deque(maxlen=MAX_POSITIONS)
        self._events: deque[tuple[int, str, str]] = deque(maxlen=MAX_EVENTS)
        self._crashes: deque[tuple[int, int, int, float]] = deque(maxlen=MAX_EVENTS)
        self._compared = self._same = 0

    def add_frames(
        self, slot: int, outcome: int, senders: Sequence[int], reason: Any, received: NDArray[np.bool_] | None
    ) -> None:
        """Add the frames of a slot.

        :param outcome: as in dtsa_msgs/SlotRecord.
        :param reason: (N,) index into ``REASONS``: why each agent decided as it did.
        :param received: (F, N) which agents received each frame; None: not known.
        """
        for row, sender in enumerate(senders):
            most = max(1, self.agents - len(self.absent | {sender}))
            share = 255 if received is None else min(254, round(254 * np.count_nonzero(received[row]) / most))
            self._frames.append((slot, sender, outcome, reason.item(sender - 1), share))

    def add_choices(self, chosen: NDArray[Any]) -> None:
        """Add the senders (ids) that agents choose for a slot, those that have reported it."""
        if len(chosen):
            self._compared += 1
            self._same += bool((chosen == chosen[0]).all())

    def add_positions(self, slot: int, position: Floats) -> None:
        """Add the positions of all agents when a slot starts, (3, N) m, frame map."""
        self._positions.append((slot, position.astype("<f4")))

    def add_event(self, slot: int, kind: str, text: str) -> None:
        """Add a line for people; `kind` is the page's style: note, lost, back, air, bad, end."""
        self._events.append((slot, kind, text))

    def lose(self, slot: int, agent: int, text: str) -> None:
        """Add that an agent (id) does not take part any more."""
        self.absent.add(agent)
        self.add_event(slot, "lost", text)

    def regain(self, slot: int, agent: int, text: str) -> None:
        """Add that an agent (id) takes part again."""
        self.absent.discard(agent)
        self.add_event(slot, "back", text)

    def add_crash(self, slot: int, pair: tuple[int, int], distance_m: float) -> None:
        """Add that two agents (ids) have crashed."""
        self._crashes.append((slot, *pair, round(distance_m, 4)))

    def append_moment(
        self, slot: int, tables: Swarm | None, chosen: NDArray[Any], digest: NDArray[Any] | None, **more: Any
    ) -> None:
        """Add a moment: all that was added since the last one, and what the agents know now.

        :param slot: the slot that starts.
        :param tables: one table an agent, with the estimates for this time; None: not known.
        :param chosen: (N,) ids of the senders that the agents choose.
        :param digest: digests of the tables of those that have reported; None: not known.
        :param more: further values for the page.
        """
        while self._scheduled and self._scheduled[0].slot <= slot:
            change = self._scheduled.popleft()
            values = ", ".join(f"{name} is {value!r}" for name, value in change.values)
            self.add_event(change.slot, "air", f"{values} from now on")
        rows = np.array(self._frames, np.int64).reshape(-1, len(_FRAME))
        content = {
            "slot": slot,
            "at": pack(np.array([at for at, _ in self._positions], "<u4")),
            "place": pack(np.array([position for _, position in self._positions], "<f4")),
            "frames": {name: pack(rows[:, column].astype(kind)) for column, (name, kind) in enumerate(_FRAME)},
            "tables": 0 if digest is None else len(set(digest.tolist())),
            "chosen": pack(chosen.astype("<u2")),
            "age": pack(self._mean_ages(slot, tables)),
            "agree": [self._compared, self._same],
            "absent": sorted(self.absent),
            "events": list(self._events),
            "crashes": list(self._crashes),
            **more,
        }
        heard = believed = b""
        if tables is not None and self.agents <= MAX_BELIEVERS and len(tables.sent_slot) == self.agents:
            heard, believed = _beliefs(slot, tables.sent_slot, tables.estimate_position)
        for collected in (self._frames, self._positions, self._events, self._crashes):
            collected.clear()
        self._compared = self._same = 0
        self._history.append(Moment(slot, json.dumps(content, separators=(",", ":")), heard, believed))

    def _mean_ages(self, slot: int, tables: Swarm | None) -> NDArray[np.uint16]:
        """(N,) tenths of slots since the others last heard each mover, mean over those that expect it to move.

        Agents that do not take part are left out, as movers and as those that heard.
        """
        ages = np.full(self.agents, UNKNOWN, np.uint16)
        if tables is None:
            return ages
        counted = (tables.in_ap != 0) & (tables.sent_slot >= 0) & self._moving
        absent = np.array(sorted(self.absent), np.intp) - 1
        counted[:, absent] = False
        if len(counted) == self.agents:
            np.fill_diagonal(counted, False)
            counted[absent] = False  # what they heard last does not grow old
        observers = counted.sum(axis=0)
        some = observers > 0
        old = np.where(counted, slot - 1 - tables.sent_slot, 0).sum(axis=0)
        ages[some] = np.minimum(UNKNOWN - 1, np.rint(_AGE_STEPS * np.maximum(0, old[some]) / observers[some]))
        return ages


def _beliefs(slot: int, sent_slot: NDArray[np.int64], estimate: Floats) -> tuple[bytes, bytes]:
    """Age and place in mm of each agent as each observer knows them."""
    age = np.clip(slot - 1 - sent_slot, 0, UNKNOWN - 1).astype("<u2")
    age[sent_slot < 0] = UNKNOWN
    place = np.nan_to_num(estimate, nan=0.0) * _MM  # not a number: of an agent never heard
    return age.tobytes(), np.rint(np.clip(place, -_FARTHEST, _FARTHEST)).astype("<i2").tobytes()


# -- what a page may command, where the user has allowed it -----------------------------------------------------------
PROCESS_COMMANDS = ("kill", "start")  # of an agent's process, by a flight in real time
CONFIRMATION = "stop all motors"  # value of an emergency stop: it is never commanded by accident
_MAX_LENGTH = 2000  # characters of a partition


@dataclass(frozen=True, slots=True)
class PageCommand:
    """One command of a page."""

    kind: str
    value: float | bool | str | None = None


# By kind: whether a value is valid, and which values are.
_VALUES = {
    **dict.fromkeys(PROCESS_COMMANDS, (lambda value: type(value) is int and 1 <= value <= 65535, "the id of an agent")),
    "loss": (lambda value: type(value) in (int, float) and 0.0 <= value <= 1.0, "0 to 1"),
    "jam": (lambda value: type(value) is bool, "true or false"),
    "partition": (
        lambda value: type(value) is str and len(value) <= _MAX_LENGTH, "groups of ids, as [[1, 2, 3], [4, 5, 6]]"
    ),
    "land": (lambda value: value is None, "nothing"),
    "emergency": (lambda value: value == CONFIRMATION, f"{CONFIRMATION!r}, the second step"),
}  # fmt: skip


def parse_command(content: Any) -> PageCommand:
    """Return the command in decoded JSON of a page; whether it can be carried out is not known yet.

    :raises ConfigError: if it is none.
    """
    if not isinstance(content, dict) or content.get("kind") not in _VALUES:
        raise ConfigError("command", str(content)[:80], f"one of {', '.join(_VALUES)}")
    kind, value = content["kind"], content.get("value")
    is_valid, allowed = _VALUES[kind]
    if not is_valid(value):
        raise ConfigError(kind, str(value)[:80], allowed)
    return PageCommand(kind, float(value) if kind == "loss" else value)
