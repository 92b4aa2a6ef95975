"""A flight: what happened, what the agents knew of each other, tables, and how it is shown."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dtsa_agent.core.frame import named_in
from dtsa_bench.drawing.card import as_html, as_text
from dtsa_bench.runs.metrics import CRASHED
from dtsa_bench.runs.summary_text import result_rows, setting_rows, what_came_of_it, what_flew
from dtsa_bench.simulation.simulate import SimulatedFlight
from dtsa_bench.simulation.slot_arrays import SlotWriter

from .arrays import FlightArrays, ReceivedFrames

if TYPE_CHECKING:
    from typing import Any

    import pandas as pd

    from .knowledge import Knowledge


class _Table(cached_property["pd.DataFrame"]):
    """A table of a flight, made when it is first asked for."""

    def __init__(self, text: str) -> None:
        super().__init__(self._make)
        self.__doc__ = text

    def _make(self, log: FlightLog) -> pd.DataFrame:
        from .tables import table

        log.check_kept()
        return table(log, str(self.attrname))


class FlightLog(FlightArrays):
    """A flight, simulated or recorded: arrays with a row a slot and a column an agent, and what follows from them.

    Tables are pandas frames, made when first asked for; their columns: docs/reference/columns.md.
    """

    # -- what the agents knew -----------------------------------------------------------------------------------------
    @property
    def knowledge(self) -> Knowledge:
        """What the agents knew of each other, and the results; see :mod:`.knowledge`."""
        from .knowledge import knowledge_of

        return knowledge_of(self)

    @property
    def summary(self) -> dict[str, Any]:
        """The results, with the keys of summary.json; empty where the log does not hold enough."""
        return self.knowledge.summary if self.results is None else self.results

    # -- tables, made when first asked for; pandas frames; ConfigError: pandas is missing ----------------------------
    slots = _Table("A row a slot: slot, time_s (start), outcome, senders (count), sender (the first id, 0: nobody).")
    frames = _Table(
        "A row a frame: slot, time_s, sender, received, lost, collided (receivers), length, data and so on."
    )
    receptions = _Table("A row a frame and other agent: slot, time_s, sender, receiver, received (or not).")
    decisions = _Table("A row an agent and slot: slot, time_s, agent, chosen (id, 0: nobody), reason, score, digest.")
    states = _Table("A row an agent and instant: time_s, agent, position_{x,y,z}_m, velocity_{x,y,z}_mps, frame map.")
    ages = _Table(
        """A row a slot and agent: slot, time_s (end), agent, observers, age_slots, error_m: means over its observers.

        Not a number where nobody still expects the agent to move; no rows where the log does not hold enough.
        """
    )
    ages_by_observer = _Table(
        """A row a slot, observer and agent: slot, time_s (end), observer, agent, age_slots, error_m, counted.

        That is slots times agents squared: 5 s of 200 agents are 20 million rows.
        """
    )
    distances = _Table("Smallest distance of any two agents, a row an instant: time_s, distance_m.")

    @property
    def errors(self) -> pd.DataFrame:
        """Estimates and the truth, a row a slot and agent: slot, time_s (end), agent, observers, error_m (mean)."""
        return self.ages[["slot", "time_s", "agent", "observers", "error_m"]]

    def to_parquet(self, directory: str | Path, tables: Sequence[str] | None = None) -> list[Path]:
        """Write tables as Parquet files into a directory that is empty or does not exist yet; return the files.

        :param tables: names, such as "slots"; None: all.
        :raises ConfigError: for a name that does not exist, or a directory that is in use.
        :raises BagError: if a file cannot be written.
        """
        from .tables import export

        return [written.path for written in export(self, directory, tables=tables)]

    # -- how it is shown ----------------------------------------------------------------------------------------------
    def __repr__(self) -> str:
        return as_text(self._title, self._rows())

    def _repr_html_(self) -> str:
        from dtsa_bench.drawing.flight_paths import svg_from_above  # Matplotlib takes longer to load than all the rest

        summary, config = self.summary, self.usable_config
        crash = summary.get("collided_pair") if summary.get("end") == CRASHED else None
        shown = self.is_kept and len(self.path)
        picture = svg_from_above(self.path, self.moving, self._title, crash) if shown else ""
        folded = [("all settings", setting_rows(config))] if config is not None else []
        folded += [("all results", result_rows(summary))] if summary else []
        return as_html(self._title, self._rows(), picture=picture, folded=folded)

    @property
    def _title(self) -> str:
        config = self.usable_config
        what = f"{self.agents} agents" if config is None else what_flew(config)
        return f"Flight{f' {self.name}' if self.name else ''}: {what}"

    def _rows(self) -> list[tuple[str, str]]:
        config = self.usable_config
        rows = [] if config is None else what_came_of_it(self.summary, config)
        counts = f"{int(self.recorded.sum())} slots, {int(self.sent.sum())} frames, {int(self.known.sum())} decisions"
        if not self.is_kept:
            counts = "without what happened in its slots (trace=False)"
        rows.append(("log", f"{counts}; missing: {self.missing}" if self.missing else counts))
        rows += [("note", note) for note in (self.notes if self.results is not None else self.knowledge.notes)]
        rows.append(("kept", "in memory" if self.file is None else str(self.file)))
        more = "summary, config, slots, frames, decisions, states, ages; dtsa.plot_trajectories(flight)"
        return [*rows, ("more", more)]


def log_of_flight(flight: SimulatedFlight) -> FlightLog:
    """What happened in a simulated flight, and what follows from it; without slots if it kept none."""
    arrays = flight.log or SlotWriter(flight.swarm, 0, frames=True).finish()
    config, slots = flight.run.swarm, len(arrays)
    heard, received, lost = None, arrays.received, arrays.lost
    if flight.accepted is not None:  # who accepted a frame that arrived, received its sender's
        heard, received, lost = _received_frames(flight, config.agents), received.copy(), lost.copy()
        place = np.cumsum(arrays.sent).reshape(arrays.sent.shape) - 1
        for frame in flight.accepted:
            sender, slot = named_in(frame.data) or (0, 0)
            if 0 < sender <= config.agents and slot <= frame.row and arrays.sent[slot, sender - 1]:
                received[place[slot, sender - 1]] |= frame.receivers
        lost[arrays.sent] = config.agents - 1 - received.sum(axis=1)
    start = np.broadcast_to(flight.scenario.start, (1, *arrays.position.shape[1:]))
    return FlightLog(
        name="", settings=flight.run.to_dict(), agents=config.agents, slot_ns=config.slot_ns,
        recorded=np.ones(slots, np.bool_), known=np.ones(arrays.sent.shape, np.bool_),
        start_ns=np.arange(slots) * config.slot_ns, outcome=arrays.outcome, length=arrays.length,
        data=arrays.data.tobytes(), received=received, lost=lost, collided=arrays.collided,
        chosen=arrays.chosen, reason=arrays.reason, digest=arrays.digest, score=arrays.score,
        offset_ns=np.zeros(arrays.sent.shape, np.int64), track=np.concatenate((start, arrays.position)),
        velocity=arrays.velocity, command=arrays.command, goal=arrays.goal, heard=heard, results=flight.summary(),
        is_kept=flight.log is not None, unslotted=heard is not None,
    )  # fmt: skip


def _received_frames(flight: SimulatedFlight, agents: int) -> ReceivedFrames:
    frames = flight.accepted or []
    row, slot = (np.array([getattr(frame, name) for frame in frames], np.int64) for name in ("row", "slot"))
    by = np.array([frame.receivers for frame in frames], np.bool_).reshape(len(frames), agents)
    none = np.zeros_like(row)
    return ReceivedFrames(row, none, slot, none, by, none.astype(np.bool_), [frame.data for frame in frames])
