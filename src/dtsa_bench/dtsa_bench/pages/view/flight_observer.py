"""Tells a page what happens in a flight: an observer of the channel that thins at the source and never waits."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from rclpy.parameter import Parameter

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_bench.flights.measurement import FlightMeasurement
from dtsa_bench.flights.recorded_channel import RecordedFlight
from dtsa_bench.flights.supervisor import RealtimeSupervisor
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.hearing import Unheard
from dtsa_channel_sim import Change
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver, ChannelStatus
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

from .link import BEGIN, END, ViewLink, record
from .moments import Gathered, Moments, estimate_now, run_info
from .orders import Order, read_order

_PERIOD_S = 1 / 20  # wall time from one moment to the next, at least
_MOST_ORDERS = 10  # carried out at a time


class ViewObserver(ChannelObserver):
    """Tells a flight moment by moment.

    Between the last answer and the next slot all agents wait for the channel: what is told is only copied then. It is
    sent when the next slot is on its way, and put into words by the server.

    :param link: to the server.
    :param name: what the page calls the flight.
    :param run: the run.
    :param measurement: the flight so far; its tables are those of the agents.
    :param pace: gives the channel's lag in ms and the number of its stalls; None: in lockstep.
    :param carry_out: carries out an order of the page and says what it did.
    """

    def __init__(
        self,
        link: ViewLink,
        name: str,
        run: RunConfig,
        measurement: FlightMeasurement,
        pace: Callable[[], tuple[float, int]] | None,
        carry_out: Callable[[Order], str],
    ) -> None:
        self._link, self._measurement, self._pace, self._carry_out = link, measurement, pace, carry_out
        self._moments = Moments(measurement.scenario, run.swarm.slot_ns, run.air)
        self._oracle = run.swarm.estimator_row.needs_everybody
        self._slot = 0
        self._next_s = 0.0  # time.monotonic() before which no further moment is told
        self._crashed = False
        self._unheard = Unheard(run.swarm.slot_ns)
        self._kept_out: dict[str, int] = {}  # frames and messages that agents and channel have kept out, by reason
        self._agreed = 0, 0  # of the metrics, at the last moment
        self._answers: Answers | None = None
        self._gathered: Gathered | None = None  # to be sent in this slot
        self._ended = "over"
        info = run_info(name, run, measurement.scenario) | {
            "live": True,
            "control": link.control,
            "kills": pace is not None,
        }
        link.offer(record(BEGIN, info))

    def all_answered(self, slot: int, answers: Answers) -> None:
        self._slot, self._answers = slot, answers
        if slot % self._moments.place_slots:
            return
        self._moments.place(slot, answers.position)
        now = time.monotonic()
        if now >= self._next_s and self._link.ready():  # until then all that comes in waits for the next moment
            self._next_s = now + _PERIOD_S
            self._gathered = self._gather(slot, answers)

    def _gather(self, slot: int, answers: Answers) -> Gathered:
        metrics, tables = self._measurement.metrics, self._measurement.tables
        if metrics.collided_pair and not self._crashed:
            self._crashed = True
            self._moments.crash(metrics.crash_slot, metrics.collided_pair, metrics.closest()[0])
        if problem := self._unheard.news(slot, self._measurement.hearing.problem(self._kept_out)):
            self._moments.event(slot, "bad", problem)
        estimate_now(tables, self._oracle, slot, answers.position)
        lag_ms, stalls = self._pace() if self._pace else (0.0, 0)
        lost = sorted(metrics.lost)
        compared, same = metrics.agreed
        agree = [compared - self._agreed[0], same - self._agreed[1]]
        self._agreed = compared, same
        more = {"lag_ms": round(lag_ms, 2), "stalls": stalls, "agree": agree}
        return self._moments.gather(slot, tables, answers.chosen, answers.digest, lost, **more)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        if self._gathered is not None:
            self._link.moment(self._gathered)
            self._gathered = None
        if verdict.senders:
            self._moments.frames(slot, verdict.outcome, verdict.senders, answers.reason, verdict.received)

    def stalled(self, from_ns: int, to_ns: int) -> None:
        self._moments.event(self._slot, "bad", f"the channel stood still for {(to_ns - from_ns) / 1e6:.0f} ms")

    def agent_silent(self, agent: int) -> None:
        self._moments.event(self._slot, "lost", f"cf{agent} has fallen silent")

    def agents_back(self, agents: list[int]) -> None:
        for agent in agents:
            self._moments.event(self._slot, "back", f"cf{agent} takes part")

    def settings_changed(self, change: Change) -> None:
        self._moments.change(change)

    def idle(self, status: ChannelStatus) -> None:
        self._kept_out = status.dropped
        for content in self._link.orders()[:_MOST_ORDERS]:
            try:
                text = self._carry_out(read_order(content))
            except DtsaError as error:
                text = f"refused: {error}"
            self._moments.event(self._slot, "note", text)

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        self._ended = reason
        self._moments.event(max(0, slot), "bad" if failed else "end", f"the run has ended: {reason}")

    def close(self) -> None:
        """Tells the last moment."""
        with suppress(DtsaError):
            if self._gathered is not None:
                self._link.moment(self._gathered)
            if self._answers is not None:
                self._link.moment(self._gather(self._slot, self._answers))
        self._link.last(record(END, self._ended))


class Control:
    """Carries out what a page orders.

    :param flight: the flight.
    :param supervisor: looks after its processes.
    """

    def __init__(self, flight: RecordedFlight, supervisor: object) -> None:
        self._node, self._supervisor = flight.channel.node, supervisor

    def __call__(self, order: Order) -> str:
        """Carries out an order; says what was done.

        :raises ConfigError: if it is refused.
        """
        if order.kind in ("kill", "start"):
            if not isinstance(self._supervisor, RealtimeSupervisor):
                raise ConfigError("order", order.kind, "in real time only: in lockstep all wait for all")
            act = self._supervisor.kill if order.kind == "kill" else self._supervisor.start
            return act(order.agent)
        if order.kind in ("land", "emergency"):
            raise ConfigError("order", order.kind, "only with Crazyflies: `dtsa view --control` beside their bridge")
        # As `ros2 param set` does it: the node's parameters and the channel stay the same.
        (result,) = self._node.set_parameters([Parameter(order.kind, value=order.value)])
        if not result.successful:
            raise ConfigError(order.kind, order.value, result.reason)
        return f"ordered: {order.kind} {order.value!r}"


def show_flight(link: ViewLink, flight: RecordedFlight, supervisor: object) -> None:
    """Lets a page show a flight.

    :param link: to the server.
    :param flight: the flight, before it begins.
    :param supervisor: looks after its processes.
    """
    channel, pace = flight.channel, None
    if isinstance(channel, RealtimeChannel):
        pace = partial(_pace, channel)
    control = Control(flight, supervisor)
    channel.observe(ViewObserver(link, flight.directory.name, flight.run_config, flight.measurement, pace, control))


def _pace(channel: RealtimeChannel) -> tuple[float, int]:
    """How late a channel is: ms, and its stalls so far."""
    return channel.pace.lag.quantile_ms(0.5) or 0.0, channel.pace.stall_count
