"""Recorded runs."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import DtsaError
from dtsa_bench.drawing.card import as_html, as_text
from dtsa_bench.recordings.bag.metadata import find_files
from dtsa_bench.recordings.bag.run import RecordedRun, load_run
from dtsa_bench.recordings.tables.ages import follow_run
from dtsa_bench.recordings.tables.export import ages_table, arrow_table
from dtsa_bench.recordings.tables.followed import Followed
from dtsa_bench.recordings.verify import Result, verify_bag
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import CRASHED
from dtsa_bench.runs.summary_text import result_rows, setting_rows, what_came_of_it, what_flew

from ._frames import data_frame, from_arrow

if TYPE_CHECKING:
    import pandas as pd


class Recording:
    """A recorded run. Tables are made when first asked for.

    They have the columns of `dtsa export`: docs/reference/columns.md.

    :param path: run directory, bag directory or .mcap file.
    :raises UnusableBag: if it is no bag of this project, or is damaged.
    """

    def __init__(self, path: str | Path) -> None:
        self.file: Path = find_files(path)[0]  # the .mcap file, the first of several
        self._run: RecordedRun = load_run(path)

    def __repr__(self) -> str:
        return as_text(self._title, self._rows())

    def _repr_html_(self) -> str:
        from dtsa_bench.drawing.flight_paths import svg_from_above  # Matplotlib takes longer to load than all the rest

        crash = self.summary.get("collided_pair") if self.summary.get("end") == CRASHED else None
        picture = svg_from_above(self.path, self.moving, self._title, crash) if len(self.path) else ""
        config, summary = self._usable_config, self.summary
        folded = [("all settings", setting_rows(config))] if config is not None else []
        folded += [("all results", result_rows(summary))] if summary else []
        return as_html(self._title, self._rows(), picture=picture, folded=folded)

    @property
    def _usable_config(self) -> RunConfig | None:
        try:
            return self.config
        except DtsaError:
            return None

    @property
    def _title(self) -> str:
        config = self._usable_config
        what = f"{self._run.agents} agents" if config is None else what_flew(config)
        return f"Recording {self.name}: {what}"

    def _rows(self) -> list[tuple[str, str]]:
        run, config = self._run, self._usable_config
        rows = [] if config is None else what_came_of_it(self.summary, config)
        counts = (
            f"{len(run.slots)} slots, {len(run.frames.slot)} frames, {len(run.decisions.slot)} slots with decisions"
        )
        rows.append(("recorded", f"{counts}; missing: {run.missing}" if run.missing else counts))
        rows += [("note", note) for note in self._followed.notes]
        more = "summary, config, slots, frames, receptions, decisions, states, ages; dtsa.plot_ages(recording)"
        return [*rows, ("kept", str(self.file)), ("more", more)]

    @property
    def name(self) -> str:
        """Name of the run, from that of its directory."""
        return self._run.name

    @property
    def settings(self) -> dict[str, Any]:
        """The recorded configuration as plain values."""
        return self._run.config

    @cached_property
    def config(self) -> RunConfig:
        """The recorded configuration.

        :raises ConfigError: if it cannot be used, for example because another version wrote it.
        """
        values = self._run.config
        return RunConfig.from_dict(values if "swarm" in values else {"swarm": values})

    @cached_property
    def _followed(self) -> Followed:
        return follow_run(self._run)

    @property
    def summary(self) -> dict[str, Any]:
        """The results, with the keys of summary.json; empty where the bag does not hold enough."""
        return self._followed.summary

    @property
    def moving(self) -> NDArray[np.bool_]:
        """(N,) which agents move; all, where the configuration cannot be used."""
        scenario = self._followed.scenario
        return np.ones(len(self._run.motion.ids), np.bool_) if scenario is None else scenario.moving

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(T,) s from the start of slot 0: the instants of `path`."""
        return np.asarray((self._run.motion.time_ns - self._run.start_ns) / 1e9)

    @property
    def path(self) -> NDArray[np.float64]:
        """(T, 3, N) m, frame map: true positions; not a number where an agent was not recorded yet."""
        return self._run.motion.position

    @property
    def start(self) -> NDArray[np.float64]:
        """(3, N) m, frame map: the first recorded positions."""
        return np.asarray(self._run.motion.position[0])

    @cached_property
    def slots(self) -> pd.DataFrame:
        """A row a slot: slot, time_s (start), outcome, senders (how many), sender (id of the first, 0: nobody).

        :raises ConfigError: if pandas is missing; likewise below.
        """
        return from_arrow(arrow_table(self._run, "slots"))

    @cached_property
    def frames(self) -> pd.DataFrame:
        """A row a frame: slot, time_s, sender, received, lost, collided (receivers), length, data, and what it said."""
        return from_arrow(arrow_table(self._run, "frames"))

    @cached_property
    def receptions(self) -> pd.DataFrame:
        """Who received what, a row a frame and other agent: slot, time_s, sender, receiver, received (or not)."""
        return from_arrow(arrow_table(self._run, "receptions"))

    @cached_property
    def decisions(self) -> pd.DataFrame:
        """A row an agent and slot: slot, time_s, agent, chosen (id, 0: nobody), reason, score, digest of its table."""
        return from_arrow(arrow_table(self._run, "decisions"))

    @cached_property
    def states(self) -> pd.DataFrame:
        """A row an agent and instant: time_s, agent, position_{x,y,z}_m, velocity_{x,y,z}_mps, frame map."""
        return from_arrow(arrow_table(self._run, "states"))

    @cached_property
    def ages(self) -> pd.DataFrame:
        """A row a slot and agent: slot, time_s (end), agent, observers, age_slots, error_m: means over its observers.

        Not a number where nobody still expects the agent to move; no rows where the bag does not hold enough.
        """
        return data_frame(ages_table(self._run, self._followed))

    @cached_property
    def ages_by_observer(self) -> pd.DataFrame:
        """A row a slot, observer and agent: slot, time_s (end), observer, agent, age_slots, error_m, counted.

        That is slots times agents squared: 5 s of 200 agents are 20 million rows.
        """
        return from_arrow(arrow_table(self._run, "ages_by_observer"))


def read_bag(path: str | Path) -> Recording:
    """Reads a recorded run, without ROS.

    :param path: run directory, bag directory or .mcap file.
    :raises UnusableBag: if it is no bag of this project, or is damaged.
    """
    return Recording(path)


def verify(path: str | Path, *, progress: Callable[[int], None] | None = None) -> Result:
    """Checks whether every message of a recorded run is what the protocol gives.

    :param path: run directory, bag directory or .mcap file.
    :param progress: is called with the slot now and then.
    :returns: what was checked, and the first difference if there is one.
    :raises UnusableBag: if it cannot be read as a bag of this project at all.
    """
    return verify_bag(path, progress)
