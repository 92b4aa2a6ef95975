"""What happened in a flight as arrays: one row a slot, a column an agent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.core.frame import EXTENT_M
from dtsa_agent.core.settings.scenario import make_scenario
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.options import check_memory
from dtsa_channel_sim.model.verdict import OUTCOMES

UNKNOWN = len(OUTCOMES)  # outcome of a slot of which not all that could have sent have told
PRESENT, LEAVING, UNRECORDED, NEW = 1, 2, 64, 128  # presence of an agent; the last two are added
MAX_GAPS_LISTED = 5
_MOST_MISSING = 1_000_000  # control instants of agents without a record
DECIDED = ("chosen", "reason", "digest", "score")  # what an agent decides for a slot
VECTORS = ("velocity", "command", "goal")  # at a slot's start

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class SentFrames(NamedTuple):
    """All frames that were sent, in order of slot and sender; arrays have one row a frame (F)."""

    row: NDArray[np.int64]  # of the log
    sender: NDArray[np.int64]  # ids
    data: list[bytes]
    received: Mask  # (F, N) by id - 1
    lost: NDArray[np.int64]  # receivers that lost it to noise
    collided: NDArray[np.int64]  # receivers at which it collided


class ReceivedFrames(NamedTuple):
    """Frames that agents with clocks of their own took in, in this order; arrays have one row an entry (H)."""

    row: NDArray[np.int64]  # in whose slot they were taken in
    sender: NDArray[np.int64]  # ids
    slot: NDArray[np.int64]  # that the sender counted
    time_ns: NDArray[np.int64]  # ns, when, from the start of slot 0
    receivers: Mask  # (H, N) agents that accepted it
    before: Mask  # (H,) before the slot, by an agent that began with it
    data: list[bytes]

    def part(self, first: int, last: int) -> ReceivedFrames:
        """Those of rows from one to before another."""
        a, b = np.searchsorted(self.row, (first, last)).tolist()
        row, *others = (values[a:b] for values in self)
        return ReceivedFrames(row - first, *others)


@dataclass(eq=False, repr=False, kw_only=True)
class FlightArrays:
    """What happened in a flight: S slots, N agents by id - 1, K control instants a slot.

    Arrays are in frame `map` (the room's centre, ENU) and SI units. What is not known is 0 or not a number, and False
    in `known`.
    """

    name: str
    settings: dict[str, Any]  # the configuration as plain values
    agents: int
    slot_ns: int  # ns, length of a slot
    recorded: Mask  # (S,) slots of which there is a record
    known: Mask  # (S, N) agents that have told of a slot
    start_ns: NDArray[np.int64]  # (S,) ns, when each slot starts, by the clock of the log; of most, from slot 0 on
    outcome: NDArray[np.uint8]  # (S,) index into OUTCOMES, or UNKNOWN
    length: NDArray[np.uint8]  # (S, N) bytes of the frame sent; 0: none
    data: bytes  # all frames, in order of slot and sender
    received: Mask  # (F, N) frame f, in that order, reached agent column + 1
    lost: NDArray[np.uint16]  # (S, N) receivers that lost the sender's frame to noise
    collided: NDArray[np.uint16]  # (S, N) receivers at which it collided
    chosen: NDArray[np.uint16]  # (S, N) id of whom each agent took for the sender; 0: nobody
    reason: NDArray[np.uint8]  # (S, N) why, index into REASONS
    digest: NDArray[np.uint32]  # (S, N) of each agent's table
    score: Floats  # (S, N) priority value g of the chosen
    offset_ns: NDArray[np.int64]  # (S, N) ns, start of an agent's slot, or of its transmission, from the slot's start
    track: Floats  # (S + 1, K, 3, N) m, control instants of the slot before each slot, and of the last one
    velocity: Floats  # (S, 3, N) m/s, at the slot's start
    command: Floats  # (S, 3, N) m/s, commanded, at the slot's start
    goal: Floats  # (S, 3, N) m
    sent_ns: NDArray[np.int64] | None = None  # (S, N) ns, with clocks of their own: start of transmissions, likewise
    presence: NDArray[np.uint8] | None = None  # (S, N) PRESENT or LEAVING, UNRECORDED or NEW added; None: all PRESENT
    heard: ReceivedFrames | None = None  # in flights of agents with clocks of their own
    absent: Mask | None = None  # (S, N) agents that had not come yet, had fallen silent or left; None: not known
    first_slot: int = 0  # number that the agents gave slot 0
    merged: dict[str, Any] | None = None  # what the log was merged from; None: it was recorded as one
    whole: FlightArrays | None = None  # of a merged one: with the slots before the first that all counted alike
    results: dict[str, Any] | None = None  # the results where they are known already
    notes: list[str] = field(default_factory=list)  # what readers should know of the record
    file: Path | None = None  # where it is recorded
    version: str = ""  # of this project, which recorded it
    is_kept: bool = True  # whether slots were kept at all
    has_end: bool = True  # whether it is known where all were at the end of the last slot
    unslotted: bool = False  # agents send at any instant: `lost` counts all that did not receive a frame

    # -- what it is ---------------------------------------------------------------------------------------------------
    def __len__(self) -> int:
        return len(self.outcome)

    @cached_property
    def config(self) -> RunConfig:
        """The configuration.

        :raises ConfigError: if it cannot be used, for example because a plug-in is not installed.
        """
        return recorded_config(self.settings)

    @property
    def usable_config(self) -> RunConfig | None:
        """The configuration; None if it cannot be used."""
        try:
            return self.config
        except (DtsaError, TypeError, ValueError):
            return None

    @cached_property
    def scenario(self) -> Scenario | None:
        """Starts and goals; None if the configuration cannot be used."""
        config = self.usable_config
        try:
            return None if config is None else make_scenario(config.swarm)
        except DtsaError:
            return None

    @property
    def moving(self) -> Mask:
        """(N,) which agents move; all, where the configuration cannot be used."""
        return np.ones(self.agents, np.bool_) if self.scenario is None else self.scenario.moving

    @property
    def sent(self) -> Mask:
        """(S, N) who sent."""
        return self.length > 0

    @property
    def position(self) -> Floats:
        """(S, K, 3, N) m: true positions at the control instants of each slot, the last at its end."""
        return self.track[1:]

    @property
    def missing(self) -> str:
        """Slots and agents of which there is no record, as "slots 158 to 313 and the motion of cf2"; empty: none."""
        if not self.is_kept:
            return ""
        edges = np.flatnonzero(np.diff(np.concatenate(([True], self.recorded, [True])).astype(np.int8)))
        gaps = [f"{a} to {b - 1}" if a < b - 1 else f"{a}" for a, b in edges.reshape(-1, 2).tolist()]
        more = f" and {len(gaps) - MAX_GAPS_LISTED} gaps more" if len(gaps) > MAX_GAPS_LISTED else ""
        absent = np.flatnonzero(~self.known.any(axis=0)).tolist() if len(self) else []
        parts = [f"slots {', '.join(gaps[:MAX_GAPS_LISTED])}{more}"] if gaps else []
        parts += [f"the motion of {', '.join(f'cf{column + 1}' for column in absent)}"] if absent else []
        return " and ".join(parts)

    @property
    def outcome_known(self) -> Mask:
        """(S,) whether a slot's outcome is known."""
        return np.asarray(self.recorded & (self.outcome < UNKNOWN))

    def time_s(self, slot: NDArray[np.int64]) -> Floats:
        """Seconds from the start of slot 0 to the start of slots."""
        return np.asarray(slot * (self.slot_ns / 1e9), np.float64)

    # -- frames and motion --------------------------------------------------------------------------------------------
    @cached_property
    def sent_frames(self) -> SentFrames:
        """All frames that were sent."""
        row, column = np.nonzero(self.length)
        ends = np.cumsum(self.length[row, column], dtype=np.int64)
        starts = ends - self.length[row, column]
        data = [self.data[a:b] for a, b in zip(starts.tolist(), ends.tolist(), strict=True)]
        lost, collided = (values[row, column].astype(np.int64) for values in (self.lost, self.collided))
        return SentFrames(row, column + 1, data, self.received, lost, collided)

    def frame(self, row: int, sender: int) -> bytes:
        """The frame that an agent sent in a slot; empty: none."""
        return self.frames_in(row).get(sender, b"")

    def frames_in(self, row: int) -> dict[int, bytes]:
        """The frames that were sent in a slot, by the sender's id."""
        frames, part = self.sent_frames, slice(*self.sent_ends[row : row + 2])
        return dict(zip(frames.sender[part].tolist(), frames.data[part], strict=True))

    @cached_property
    def sent_ends(self) -> list[int]:
        """(S + 1) where the frames of each slot begin in `sent_frames`, and the last ones end."""
        return [0, *np.cumsum(self.sent.sum(axis=1)).tolist()]

    @cached_property
    def heard_ends(self) -> list[int]:
        """(S + 1) where the entries of `heard` of each slot begin, and the last ones end."""
        rows = np.zeros(0, np.int64) if self.heard is None else self.heard.row
        return [int(end) for end in np.searchsorted(rows, np.arange(len(self) + 1))]

    @cached_property
    def known_receivers(self) -> NDArray[np.int64]:
        """(F,) other agents of which is known whether they lost a frame; the channel counts absent ones, too."""
        frames = self.sent_frames
        if self.merged is None:
            return np.full(len(frames.row), max(0, self.agents - 1), np.int64)
        return np.asarray(frames.received.sum(axis=1) + frames.lost, np.int64)

    @cached_property
    def receivers(self) -> Mask:
        """(F, N) other agents that were there, and of which is known whether they received a frame."""
        frames = self.sent_frames
        others = np.arange(1, self.agents + 1) != frames.sender[:, None]
        if self.merged is not None:
            return np.asarray(others & (frames.received | self.known[frames.row]))
        return others if self.absent is None else others & ~self.absent[frames.row]

    @cached_property
    def reached(self) -> Mask:
        """(F, N) of the `receivers` those that received a frame."""
        return np.asarray(self.received & self.receivers)

    @cached_property
    def sender_known(self) -> Mask:
        """(F,) frames of which there is a record of the sender; others are known only because an agent heard them."""
        frames = self.sent_frames
        return self.known[frames.row, frames.sender - 1] | (self.merged is None)

    @cached_property
    def _instants(self) -> tuple[Floats, Floats, Floats]:
        """Times (T,), positions and velocities (T, 3, N) of the control instants at which an agent was recorded."""
        self.check_kept()
        count, steps = self.track.shape[:2]
        velocity = np.full(self.track.shape, np.nan)
        if len(self):
            velocity[:-1, -1] = np.where(self.known[:, None], self.velocity, np.nan)
            velocity[-1, -1] = velocity[-2, -1] if count > 1 else np.nan
            part = (np.arange(steps)[:-1] + 1)[:, None, None] / steps
            before = np.concatenate((velocity[:1, -1], velocity[:-1, -1]))[:, None]
            velocity[:, :-1] = before + (velocity[:, -1:] - before) * part  # only those at slots' starts are recorded
        times = (np.arange(count)[:, None] - 1) * self.slot_ns + (np.arange(steps) + 1) * self.slot_ns // steps
        flown = times >= 0
        if self.merged is None:  # any agent was there
            flown &= np.isfinite(self.track).all(axis=2).any(axis=2)
        else:
            flown &= times <= (count - 1 if self.has_end else count - 2) * self.slot_ns
        return times[flown] / 1e9, self.track[flown], velocity[flown]

    @property
    def instants_s(self) -> Floats:
        """(T,) s from the start of slot 0: the control instants of `path`."""
        return self._instants[0]

    @property
    def path(self) -> Floats:
        """(T, 3, N) m, frame map: true positions from the start of slot 0; not a number where that is not known."""
        return self._instants[1]

    @property
    def path_velocity(self) -> Floats:
        """(T, 3, N) m/s: true velocities at the instants of `path`."""
        return self._instants[2]

    def check_kept(self) -> None:
        if not self.is_kept:
            raise ConfigError("trace", False, "True in simulate(): this flight did not keep what happened in its slots")

    def __getstate__(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self.__dataclass_fields__}


Log = TypeVar("Log", bound=FlightArrays)


def recorded_config(settings: Mapping[str, Any]) -> RunConfig:
    """Recorded settings as this version understands them.

    :raises DtsaError, TypeError, ValueError: they are not understood, or name a plug-in that is not installed.
    """
    return RunConfig.from_dict(dict(settings) if "swarm" in settings else {"swarm": dict(settings)})


def swarm_section(settings: Mapping[str, Any]) -> Mapping[str, Any]:
    """The swarm's part of recorded settings, whether they have sections or not."""
    section = settings.get("swarm", settings)
    return section if isinstance(section, Mapping) else {}


def extent_of(settings: Mapping[str, Any]) -> float:
    """Largest coordinate that the frames of a flight can say, m."""
    value = swarm_section(settings).get("extent_m", EXTENT_M)
    return float(value) if isinstance(value, (int, float)) and 0 < value < float("inf") else EXTENT_M


def empty_arrays(slots: int, recorded: int, agents: int, steps: int, slot_ns: int) -> dict[str, Any]:
    """The arrays of a log of which nothing is known yet, by their names.

    :param recorded: of how many slots there is a record.
    :raises ConfigError: if there is no memory for them, or so much is missing that a number must be damaged.
    """
    if slots > 2 * recorded + 1000 and (slots - recorded) * agents * steps > _MOST_MISSING:
        raise ConfigError("slots", slots, f"at most twice the {recorded} recorded ones; a number is damaged")
    what = f"{slots} slots of {steps} control instants"
    check_memory(8 * 3 * (steps + len(VECTORS)) * slots * agents, what, "agents", agents)  # the larger part of them
    shape, planes = (slots, agents), (slots, 3, agents)
    kinds = {
        "length": np.uint8, "lost": np.uint16, "collided": np.uint16, "chosen": np.uint16, "reason": np.uint8,
        "digest": np.uint32, "score": np.float64, "offset_ns": np.int64, "sent_ns": np.int64, "presence": np.uint8,
        "known": np.bool_,
    }  # fmt: skip
    return {
        **{name: np.zeros(shape, kind) for name, kind in kinds.items()},
        **{name: np.full(planes, np.nan) for name in VECTORS},
        "recorded": np.zeros(slots, np.bool_), "outcome": np.full(slots, UNKNOWN, np.uint8),
        "start_ns": np.arange(slots) * slot_ns, "track": np.full((slots + 1, max(1, steps), 3, agents), np.nan),
    }  # fmt: skip


def split_log(log: Log, slot: int) -> Log:
    """A log from a slot on; the log itself is kept as its `whole`.

    :raises ValueError: if the slot is not in it.
    """
    row = slot - log.first_slot
    if not 0 <= row <= len(log):
        raise ValueError(f"slot {slot}, the first common one, is not in it")
    fields: dict[str, Any] = log.__getstate__()
    for name, values in fields.items():
        if isinstance(values, np.ndarray) and name != "received":
            fields[name] = values[row:]
    fields["data"] = log.data[int(log.length[:row].sum(dtype=np.int64)) :]
    fields["received"] = log.received[log.sent_ends[row] :]
    fields["heard"] = log.heard and log.heard.part(row, len(log))
    return type(log)(**fields | {"first_slot": slot, "whole": log})
