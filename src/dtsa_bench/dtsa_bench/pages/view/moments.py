"""What a page shows of one moment of a run: gathered where it arises, told where nobody waits for it."""

from __future__ import annotations

import json
from array import array
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS, AbstractSwarm, Scenario
from dtsa_bench.pages.report.json_values import flatten, pack
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim import Change, ChannelConfig
from dtsa_channel_sim.model.schedule import scheduled_changes

PLACES_HZ = 20.0  # positions in a simulated second
MOST_FRAMES = 4000  # frames told in one moment: of more than these the last
MOST_PLACES = 400  # likewise positions
MOST_EVENTS = 100  # likewise events
BELIEFS = 100  # agents: of larger swarms it is not told what each believes about each
UNKNOWN = 65535  # an age that is not known
_AGE_STEPS = 10  # mean ages are told in tenths of slots
_MM = 1000.0  # believed positions are told in mm
_FARTHEST = 32767
_FRAME = (("slot", "<u4"), ("sender", "<u2"), ("outcome", "u1"), ("reason", "u1"), ("received", "u1"))

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Moment:
    """One moment of a run."""

    slot: int  # slots flown; positions are those at the start of this one
    text: str  # what the page takes in, a JSON object
    heard: bytes  # (N, N) uint16, slots since each observer heard each agent; empty: not told
    believed: bytes  # (N, 3, N) int16 mm, frame map, where each observer takes each agent to be; empty: not told


@dataclass(frozen=True, slots=True)
class Gathered:
    """What has come in between two moments, and what the agents know now: bytes as they are, quickly made."""

    slot: int  # slots flown; positions are those at the start of this one
    frames: bytes  # (F, 5) int64, slot, sender, outcome, reason and share of receivers of each frame
    at: bytes  # (P,) uint32, slots of the positions
    place: bytes  # (P, 3, N) float32 m, frame map
    chosen: bytes  # (N,) uint16, ids that the agents take for the sender
    digest: bytes  # (N,) uint32, of their tables; empty: not known
    in_ap: bytes  # (M, N) uint8, what the tables hold; empty: not known
    sent_slot: bytes  # (M, N) int64, likewise
    estimate: bytes  # (M, 3, N) float64 m, frame map, likewise; empty: not told
    more: dict[str, Any]  # the rest as JSON types; absent: ids of agents that have fallen silent


@dataclass(frozen=True, slots=True)
class Belief:
    """What one observer believes at one moment."""

    heard: bytes  # (N,) uint16
    believed: bytes  # (3, N) int16


def run_info(name: str, run: RunConfig, scenario: Scenario) -> dict[str, Any]:
    """What a page has to know of a run before its first moment, as JSON types.

    :param name: what the page calls it.
    :param run: its settings.
    :param scenario: its scenario.
    """
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
    """Collects what happens in a run, and gives it away moment by moment; all that it holds is bounded.

    :param scenario: the run's scenario.
    :param slot_ns: ns, length of a slot.
    :param air: the channel's settings: what changes by their schedule is told; None: nothing does.
    """

    def __init__(self, scenario: Scenario, slot_ns: int, air: ChannelConfig | None = None) -> None:
        self._scheduled = deque([] if air is None else scheduled_changes(air))
        self.agents = scenario.start.shape[1]
        self.place_slots = max(1, round(1e9 / PLACES_HZ / slot_ns))  # slots from one position to the next
        self._moving = scenario.moving.tolist()
        most = max(1, self.agents - 1)
        self._shares = [min(255, round(255 * count / most)) for count in range(self.agents + 1)]  # by receivers
        self._frames = array("q")  # the columns of one frame after the other
        self._places: deque[tuple[int, bytes]] = deque(maxlen=MOST_PLACES)
        self._events: deque[tuple[int, str, str]] = deque(maxlen=MOST_EVENTS)
        self._crashes: deque[tuple[int, int, int, float]] = deque(maxlen=MOST_EVENTS)
        self._compared = self._same = 0

    def frames(
        self, slot: int, outcome: int, senders: Sequence[int], reason: Any, received: NDArray[np.bool_] | None
    ) -> None:
        """Takes in what became of a slot.

        :param slot: its number.
        :param outcome: the channel's verdict, as in dtsa_msgs/Reception.
        :param senders: ids of those that sent.
        :param reason: (N,) why each agent decided as it did, index into ``REASONS``.
        :param received: (F, N) who received each frame; None: all others.
        """
        for row, sender in enumerate(senders):
            share = 255 if received is None else self._shares[np.count_nonzero(received[row])]
            self._frames.extend((slot, sender, outcome, reason.item(sender - 1), share))
        if len(self._frames) > 2 * len(_FRAME) * MOST_FRAMES:  # not at every frame: all that is left moves
            del self._frames[: -len(_FRAME) * MOST_FRAMES]

    def choices(self, chosen: NDArray[Any]) -> None:
        """Takes in whom the agents take for a slot's sender.

        :param chosen: ids, of those that take part.
        """
        data, size = chosen.tobytes(), chosen.itemsize
        if data:  # compared as bytes, which is faster: this is asked in every slot
            self._compared += 1
            self._same += data == data[:size] * len(chosen)

    def place(self, slot: int, position: Floats) -> None:
        """Takes in where all agents are.

        :param slot: the slot that starts.
        :param position: (3, N) m, frame map.
        """
        self._places.append((slot, position.astype("<f4").tobytes()))

    def event(self, slot: int, kind: str, text: str) -> None:
        """Takes in something that people should read.

        :param slot: when.
        :param kind: a word for the page's style: note, lost, back, air, bad, end.
        :param text: one line.
        """
        self._events.append((slot, kind, text))

    def change(self, change: Change) -> None:
        """Takes in that settings of the channel have changed.

        :param change: what, and when.
        """
        values = ", ".join(f"{name} is {value!r}" for name, value in change.values)
        self.event(change.slot, "air", f"{values} from now on")

    def crash(self, slot: int, pair: tuple[int, int], distance_m: float) -> None:
        """Takes in that two agents have crashed.

        :param slot: the slot that starts.
        :param pair: their ids.
        :param distance_m: m, how close they came.
        """
        self._crashes.append((slot, *pair, round(distance_m, 4)))

    def gather(
        self,
        slot: int,
        tables: AbstractSwarm | None,
        chosen: NDArray[Any],
        digest: NDArray[Any] | None,
        absent: Iterable[int] = (),
        **more: Any,
    ) -> Gathered:
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
        in_ap = sent_slot = estimate = b""
        if tables is not None:
            in_ap, sent_slot = tables.in_ap.tobytes(), tables.sent_slot.tobytes()
            if self.agents <= BELIEFS and len(tables.sent_slot) == self.agents:
                estimate = tables.estimate_position.tobytes()
        gathered = Gathered(
            slot,
            self._frames[-len(_FRAME) * MOST_FRAMES :].tobytes(),
            array("I", [at for at, _ in self._places]).tobytes(),
            b"".join([place for _, place in self._places]),
            chosen.astype("<u2").tobytes(),
            b"" if digest is None else digest.astype("<u4").tobytes(),
            in_ap,
            sent_slot,
            estimate,
            {
                "agree": [self._compared, self._same],  # of those that `choices` has taken in
                "absent": sorted(absent),
                "events": list(self._events),
                "crashes": list(self._crashes),
                **more,
            },
        )
        del self._frames[:]
        self._places.clear()
        self._events.clear()
        self._crashes.clear()
        self._compared = self._same = 0
        return gathered

    def moment(self, gathered: Gathered) -> Moment:
        """The moment as it goes to a page.

        :param gathered: what :meth:`gather` has given.
        """
        return told(gathered, self._moving)


def told(gathered: Gathered, moving: Sequence[bool]) -> Moment:
    """The moment as it goes to a page.

    :param gathered: what it is made of.
    :param moving: (N,) which agents move.
    :raises ValueError: if its parts do not fit together.
    """
    agents, slot = len(moving), gathered.slot
    rows = np.frombuffer(gathered.frames, np.int64).reshape(-1, len(_FRAME))
    here = np.ones(agents, dtype=bool)
    here[[agent - 1 for agent in gathered.more["absent"]]] = False
    in_ap = np.frombuffer(gathered.in_ap, np.uint8).reshape(-1, agents)
    sent_slot = np.frombuffer(gathered.sent_slot, np.int64).reshape(-1, agents)
    estimate = np.frombuffer(gathered.estimate).reshape(-1, 3, agents)
    content = {
        "slot": slot,
        "at": pack(np.frombuffer(gathered.at, np.uint32).astype("<u4")),
        "place": pack(np.frombuffer(gathered.place, "<f4")),
        "frames": {name: pack(rows[:, column].astype(kind)) for column, (name, kind) in enumerate(_FRAME)},
        "tables": len(set(np.frombuffer(gathered.digest, "<u4")[here].tolist())) if gathered.digest else 0,
        "chosen": pack(np.frombuffer(gathered.chosen, "<u2")),
        "age": pack(_mean_ages(slot, in_ap, sent_slot, np.array(moving, dtype=bool))),
        **gathered.more,
    }
    heard, believed = _beliefs(slot, sent_slot, estimate) if len(estimate) else (b"", b"")
    return Moment(slot, json.dumps(content, separators=(",", ":")), heard, believed)


def _mean_ages(
    slot: int, in_ap: NDArray[np.uint8], sent_slot: NDArray[np.int64], moving: NDArray[np.bool_]
) -> NDArray[np.uint16]:
    """(N,) tenths of slots since the others last heard each mover, mean over those that expect it to move."""
    ages = np.full(len(moving), UNKNOWN, np.uint16)
    counted = (in_ap != 0) & (sent_slot >= 0) & moving
    if len(counted) == len(moving):
        np.fill_diagonal(counted, False)
    observers = counted.sum(axis=0)
    some = observers > 0
    old = np.where(counted, slot - 1 - sent_slot, 0).sum(axis=0)
    ages[some] = np.minimum(UNKNOWN - 1, np.rint(_AGE_STEPS * np.maximum(0, old[some]) / observers[some]))
    return ages


def _beliefs(slot: int, sent_slot: NDArray[np.int64], estimate: Floats) -> tuple[bytes, bytes]:
    """Age and place in mm of each agent as each observer knows them."""
    age = np.clip(slot - 1 - sent_slot, 0, UNKNOWN - 1).astype("<u2")
    age[sent_slot < 0] = UNKNOWN
    place = estimate * _MM
    np.clip(place, -_FARTHEST, _FARTHEST, out=place)
    place[place != place] = 0.0  # not a number: of somebody never heard
    return age.tobytes(), np.rint(place, out=place).astype("<i2").tobytes()


def estimate_now(tables: AbstractSwarm, oracle: bool, slot: int, position: Floats) -> None:
    """Fills the estimates of tables for the start of a slot.

    :param tables: what the agents know.
    :param oracle: whether their estimator is the truth.
    :param slot: the slot.
    :param position: (3, N) m, frame map: the truth.
    """
    if oracle:
        tables.estimate_position[:] = position
    else:
        tables.estimate(slot)


def belief(moment: Moment, observer: int, agents: int) -> Belief:
    """What one observer believed at a moment; empty where that was not told.

    :param moment: the moment.
    :param observer: its id.
    :param agents: number of agents N.
    """
    row = observer - 1
    return Belief(
        moment.heard[2 * agents * row : 2 * agents * (row + 1)],
        moment.believed[6 * agents * row : 6 * agents * (row + 1)],
    )
