"""What a page shows of one moment of a run: collected slot by slot, handed over a few times a second."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS, Scenario, Swarm
from dtsa_bench.pages.html import flatten, pack
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim import Change, ChannelConfig
from dtsa_channel_sim.model.schedule import scheduled_changes

MOST_FRAMES = 4000  # frames in one moment: of more than these the last
MOST_PLACES = 400  # likewise positions
MOST_EVENTS = 100  # likewise events
BELIEFS = 100  # agents: of larger swarms a page does not get what each believes about each
UNKNOWN = 65535  # an age that is not known
_AGE_STEPS = 10  # mean ages are in tenths of slots
_MM = 1000.0  # believed positions are in mm
_FARTHEST = 32767
_FRAME = (("slot", "<u4"), ("sender", "<u2"), ("outcome", "u1"), ("reason", "u1"), ("received", "u1"))

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moment:
    """One moment of a run."""

    slot: int  # slots flown; positions are those at the start of this one
    text: str  # what the page takes in, a JSON object
    heard: bytes  # (N, N) uint16, slots since each observer heard each agent; empty: not known
    believed: bytes  # (N, 3, N) int16 mm, frame map, where each observer takes each agent to be; empty: not known

    def belief(self, observer: int, agents: int) -> tuple[bytes, bytes]:
        """Rows of `heard` and `believed` of one observer; empty where they are not known."""
        row = observer - 1
        heard = self.heard[2 * agents * row : 2 * agents * (row + 1)]
        return heard, self.believed[6 * agents * row : 6 * agents * (row + 1)]


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


class Moments:
    """Collects what happens in a run, and hands it over moment by moment; all that it holds is bounded.

    :param scenario: the run's scenario.
    :param air: the channel's settings, whose scheduled changes become events; None: there are none.
    """

    def __init__(self, scenario: Scenario, air: ChannelConfig | None = None) -> None:
        self._scheduled = deque([] if air is None else scheduled_changes(air))
        self.agents = scenario.start.shape[1]
        self._moving = scenario.moving
        self._frames: deque[tuple[int, int, int, int, int]] = deque(maxlen=MOST_FRAMES)  # the columns of `_FRAME`
        self._places: deque[tuple[int, Floats]] = deque(maxlen=MOST_PLACES)
        self._events: deque[tuple[int, str, str]] = deque(maxlen=MOST_EVENTS)
        self._crashes: deque[tuple[int, int, int, float]] = deque(maxlen=MOST_EVENTS)
        self._compared = self._same = 0

    def frames(
        self, slot: int, outcome: int, senders: Sequence[int], reason: Any, received: NDArray[np.bool_] | None
    ) -> None:
        """Adds the frames of a slot.

        :param outcome: the channel's verdict, as in dtsa_msgs/Reception.
        :param reason: (N,) why each agent decided as it did, index into ``REASONS``.
        :param received: (F, N) which agents received each frame; None: all others.
        """
        most = max(1, self.agents - 1)
        for row, sender in enumerate(senders):
            share = 255 if received is None else min(255, round(255 * np.count_nonzero(received[row]) / most))
            self._frames.append((slot, sender, outcome, reason.item(sender - 1), share))

    def choices(self, chosen: NDArray[Any]) -> None:
        """Adds whom the agents that take part take for a slot's sender (ids)."""
        if len(chosen):
            self._compared += 1
            self._same += bool((chosen == chosen[0]).all())

    def place(self, slot: int, position: Floats) -> None:
        """Adds where all agents are, (3, N) m, frame map, when a slot starts."""
        self._places.append((slot, position.astype("<f4")))

    def event(self, slot: int, kind: str, text: str) -> None:
        """Adds a line for people; `kind` is a word for the page's style: note, lost, back, air, bad, end."""
        self._events.append((slot, kind, text))

    def change(self, change: Change) -> None:
        """Adds that settings of the channel have changed."""
        values = ", ".join(f"{name} is {value!r}" for name, value in change.values)
        self.event(change.slot, "air", f"{values} from now on")

    def crash(self, slot: int, pair: tuple[int, int], distance_m: float) -> None:
        """Adds that two agents (ids) have crashed, and how close they came."""
        self._crashes.append((slot, *pair, round(distance_m, 4)))

    def take(
        self,
        slot: int,
        tables: Swarm | None,
        chosen: NDArray[Any],
        digest: NDArray[Any] | None,
        absent: Collection[int] = (),
        **more: Any,
    ) -> Moment:
        """All that has come in since the last moment, and what the agents know now.

        :param slot: the slot that starts.
        :param tables: one table an agent, with the estimates for this time; None: not known.
        :param chosen: (N,) ids that the agents take for the sender.
        :param digest: (N,) digests of their tables; None: not known.
        :param absent: ids of agents that have fallen silent.
        :param more: further values for the page.
        """
        while self._scheduled and self._scheduled[0].slot <= slot:
            self.change(self._scheduled.popleft())
        here = np.ones(self.agents, bool)
        here[[agent - 1 for agent in absent]] = False
        rows = np.array(self._frames, np.int64).reshape(-1, len(_FRAME))
        places = np.array([place for _, place in self._places], "<f4")
        content = {
            "slot": slot,
            "at": pack(np.array([at for at, _ in self._places], "<u4")),
            "place": pack(places),
            "frames": {name: pack(rows[:, column].astype(kind)) for column, (name, kind) in enumerate(_FRAME)},
            "tables": 0 if digest is None else len(set(digest[here].tolist())),
            "chosen": pack(chosen.astype("<u2")),
            "age": pack(self._mean_ages(slot, tables)),
            "agree": [self._compared, self._same],
            "absent": sorted(absent),
            "events": list(self._events),
            "crashes": list(self._crashes),
            **more,
        }
        heard = believed = b""
        if tables is not None and self.agents <= BELIEFS and len(tables.sent_slot) == self.agents:
            heard, believed = _beliefs(slot, tables.sent_slot, tables.estimate_position)
        for kept in (self._frames, self._places, self._events, self._crashes):
            kept.clear()
        self._compared = self._same = 0
        return Moment(slot, json.dumps(content, separators=(",", ":")), heard, believed)

    def _mean_ages(self, slot: int, tables: Swarm | None) -> NDArray[np.uint16]:
        """(N,) tenths of slots since the others last heard each mover, mean over those that expect it to move."""
        ages = np.full(self.agents, UNKNOWN, np.uint16)
        if tables is None:
            return ages
        counted = (tables.in_ap != 0) & (tables.sent_slot >= 0) & self._moving
        if len(counted) == self.agents:
            np.fill_diagonal(counted, False)
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
