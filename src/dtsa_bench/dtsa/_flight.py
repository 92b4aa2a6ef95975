"""One simulated flight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import REASONS
from dtsa_bench.drawing.card import as_html, as_text
from dtsa_bench.experiments.sweep import run_config as _run_config
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import CRASHED
from dtsa_bench.runs.summary_text import result_rows, setting_rows, what_came_of_it, what_flew
from dtsa_bench.simulation.simulate import simulate as _simulate
from dtsa_bench.simulation.slot_arrays import SlotArrays
from dtsa_channel_sim import OUTCOMES

from ._frames import data_frame

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Flight:
    """A simulated flight and what came of it."""

    config: RunConfig
    summary: dict[str, Any]  # the results, with the keys of summary.json; units are in the names
    observer: int  # id of the agent whose table the trace follows
    moving: NDArray[np.bool_]  # (N,) which agents move; the others hover
    start: NDArray[np.float64]  # (3, N) m, frame map: where the agents start
    _kept: SlotArrays | None

    def __repr__(self) -> str:
        return as_text(f"Flight: {what_flew(self.config)}", self._rows())

    def _repr_html_(self) -> str:
        from dtsa_bench.drawing.flight_paths import svg_from_above  # Matplotlib takes longer to load than all the rest

        title = f"Flight: {what_flew(self.config)}"
        picture = ""
        if self._kept is not None:
            crash = self.summary["collided_pair"] if self.summary["end"] == CRASHED else None
            picture = svg_from_above(self.path, self.moving, title, crash)
        folded = ("all settings", setting_rows(self.config)), ("all results", result_rows(self.summary))
        return as_html(title, self._rows(), picture=picture, folded=folded)

    def _rows(self) -> list[tuple[str, str]]:
        more = "summary, config"
        if self._kept is None:
            kept = "in memory, without what happened in its slots (trace=False)"
        else:
            kept = f"in memory, with what happened in its slots and what agent {self.observer} knew"
            more += ", slots, states, decisions, ages_by_observer; dtsa.plot_trajectories(flight)"
        return [*what_came_of_it(self.summary, self.config), ("kept", kept), ("more", more)]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """(T,) s from the start of slot 0: the control instants of `path`, the last of each slot at its end."""
        swarm = self.config.swarm
        instants = np.arange(1, len(self.path) + 1, dtype=np.float64)
        return np.asarray(instants * (swarm.slot_s / swarm.steps))

    @cached_property
    def path(self) -> NDArray[np.float64]:
        """(T, 3, N) m, frame map: true positions at all control instants.

        :raises ConfigError: if the flight was simulated without its trace.
        """
        return self._trace.positions()

    @property
    def slots(self) -> pd.DataFrame:
        """A row a slot: slot, time_s (start), outcome, senders (how many), sender (id of the first, 0: nobody).

        :raises ConfigError: if the flight was simulated without its trace, or pandas is missing.
        """
        trace = self._trace
        slot = np.arange(len(trace))
        return data_frame(
            {
                "slot": slot,
                "time_s": slot * self.config.swarm.slot_s,
                "outcome": [OUTCOMES[outcome] for outcome in trace.outcome],
                "senders": trace.sent.sum(axis=1),
                "sender": np.where(trace.sent.any(axis=1), trace.sent.argmax(axis=1) + 1, 0),
            }
        )

    @property
    def decisions(self) -> pd.DataFrame:
        """What the observer decided, a row a slot: slot, time_s (start), agent, chosen (0: nobody), reason, score.

        :raises ConfigError: if the flight was simulated without its trace, or pandas is missing.
        """
        trace = self._trace
        slot, column = np.arange(len(trace)), self.observer - 1
        return data_frame(
            {
                "slot": slot,
                "time_s": slot * self.config.swarm.slot_s,
                "agent": np.full(len(slot), self.observer),
                "chosen": trace.chosen[:, column].astype(np.int64),
                "reason": [REASONS[code] for code in trace.reason[:, column]],
                "score": trace.score[:, column],
            }
        )

    @property
    def ages_by_observer(self) -> pd.DataFrame:
        """What the observer knew, a row a slot and agent that it had heard: columns as in :class:`Recording`.

        :raises ConfigError: if the flight was simulated without its trace, or pandas is missing.
        """
        trace, swarm = self._trace, self.config.swarm
        heard = trace.heard_slot
        known = heard >= 0
        known[:, self.observer - 1] = False
        slot, column = np.nonzero(known)
        gap = trace.estimate - trace.position[:, -1]
        return data_frame(
            {
                "slot": slot,
                "time_s": (slot + 1) * swarm.slot_s,
                "observer": np.full(len(slot), self.observer),
                "agent": column + 1,
                "age_slots": slot - heard[slot, column],
                "error_m": np.sqrt((gap**2).sum(axis=1))[slot, column],
                "counted": (trace.in_ap != 0)[slot, column] & self.moving[column],
            }
        )

    @property
    def states(self) -> pd.DataFrame:
        """A row an agent and control instant: time_s, agent (id), position_{x,y,z}_m in frame map.

        :raises ConfigError: if the flight was simulated without its trace, or pandas is missing.
        """
        path, agents = self.path, self.config.swarm.agents
        columns: dict[str, Any] = {
            "time_s": np.repeat(self.time_s, agents),
            "agent": np.tile(np.arange(1, agents + 1), len(path)),
        }
        columns |= {f"position_{axis}_m": path[:, number].ravel() for number, axis in enumerate("xyz")}
        return data_frame(columns)

    @property
    def _trace(self) -> SlotArrays:
        if self._kept is None:
            raise ConfigError("trace", False, "True in simulate(): this flight did not keep what happened in its slots")
        return self._kept


def run_config(**settings: Any) -> RunConfig:
    """The configuration of a run from settings by name.

    :param settings: settings of the swarm, of the channel and of the end of a run side by side, such as
        `agents=12, loss=0.1, timeout_s=20`, with the units and ranges of :class:`SwarmConfig`, :class:`ChannelConfig`
        and :class:`RunLimits`. `seed` is that of the swarm and of the channel.
    :raises ConfigError: for a name that does not exist or a value that is not allowed.
    """
    return _run_config(settings)


def simulate(config: RunConfig | None = None, *, trace: bool = True, observer: int = 1, **settings: Any) -> Flight:
    """Flies one run without ROS; equal configurations give equal flights, bit for bit.

    :param config: the run; None: made from the settings.
    :param trace: keep what happened in every slot, which `path`, data frames and figures need: about 24 bytes an agent
        and control instant.
    :param observer: id of the agent whose table the trace follows.
    :param settings: as for :func:`run_config`, if there is no config.
    :raises ConfigError: for a setting that is not usable, or both a config and settings.
    """
    if config is not None and settings:
        raise ConfigError("settings", sorted(settings), "none beside a config")
    run = run_config(**settings) if config is None else config
    if not 1 <= observer <= run.swarm.agents:
        raise ConfigError("observer", observer, f"1 to {run.swarm.agents}")
    flight = _simulate(run, log=trace, observer=observer)
    scenario = flight.scenario
    return Flight(run, flight.summary(), observer, scenario.moving, scenario.start, flight.log)
