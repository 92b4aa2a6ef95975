"""One line that shows how a flight goes."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel
from dtsa_channel_sim.ros.ros_channel import RosChannel

from .measurement import FlightMeasurement

_TERMINAL_S, _LOG_S = 0.2, 5.0


class ProgressLine:
    """Rewrites one line on a terminal (default: standard error); elsewhere prints a line every few seconds."""

    def __init__(self, label: str, stream: TextIO | None = None) -> None:
        self._label = label
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._next = 0.0
        self._shown = False

    def due(self) -> bool:
        """Whether it is time for a new line."""
        return time.monotonic() >= self._next

    def show(self, text: str) -> None:
        """Shows a text in place of the last one."""
        self._next = time.monotonic() + (_TERMINAL_S if self._terminal else _LOG_S)
        self._shown = True
        self._write(text, "" if self._terminal else "\n")

    def _write(self, text: str, end: str) -> None:
        clear = "\r\x1b[K" if self._terminal else ""
        print(f"{clear}{self._label}: {text}", end=end, file=self._stream, flush=True)

    def print_line(self, text: str) -> None:
        """Prints a line that stays."""
        self._write(text, "\n")
        self._next = 0.0

    def end(self) -> None:
        """Leaves the last line where it is."""
        if self._terminal and self._shown:
            print(file=self._stream, flush=True)
        self._shown = False


def flight_text(slot: int, simulated_s: float, wall_s: float, closest_m: float, pair: tuple[int, int]) -> str:
    """The line of a flight under way."""
    factor = simulated_s / wall_s if wall_s > 0.0 else 0.0
    near = f"  closest cf{pair[0]} cf{pair[1]} {closest_m:.3f} m" if pair[0] else ""  # no slot is over, or one agent
    return f"slot {slot}  simulated {simulated_s:.2f} s  wall {wall_s:.1f} s  real-time factor {factor:.2f}{near}"


class FlightProgress(ChannelObserver):
    """Keeps the line up to date while a flight is under way."""

    def __init__(self, line: ProgressLine, measurement: FlightMeasurement, channel: RosChannel) -> None:
        self._line, self._measurement, self._channel = line, measurement, channel
        self._agents, self._slot_ns = channel.agents, channel.slot_ns
        self._start = time.monotonic()

    def idle(self, slot: int, awaited: list[int]) -> None:
        if not self._line.due():
            return
        if self._measurement.begin_s:
            self.show()
        else:
            waited = time.monotonic() - self._start
            missing = len(awaited)
            self._line.show(f"starting, {waited:.0f} s, waiting for {missing} of {self._agents} agents")

    def show(self) -> None:
        """Brings the line up to date."""
        metrics = self._measurement.metrics
        flown_s = metrics.slots * self._slot_ns / 1e9
        closest, pair = metrics.closest()
        text = flight_text(metrics.slots, flown_s, self._measurement.wall_time_s, closest, pair)
        if isinstance(self._channel, RealtimeChannel):
            pace = self._channel.pace
            text += f"  lag {pace.lag.quantile_ms(0.99) or 0.0:.1f} ms"
            text += f"  stalls {pace.stall_count}" if pace.stall_count else ""
        self._line.show(text)
