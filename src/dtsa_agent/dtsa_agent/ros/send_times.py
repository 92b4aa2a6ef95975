"""When frames start: when they are due, with the jitter of a timer, once they are ready."""

from __future__ import annotations

import time

from dtsa_agent.core.settings.scenario import STREAM_CLOCKS, generator
from dtsa_agent.core.swarm import Swarm


class SendTimes:
    """The transmissions of a process's agents.

    :param swarm: the agents.
    :param jitter_ns: ns, standard deviation of the time of a single transmission.
    :param flight_time_ns: ns from the order to send a frame until the receivers' flight processors have it: for any
        frame, and for each of its bytes.
    """

    def __init__(self, swarm: Swarm, jitter_ns: float, flight_time_ns: tuple[int, int]) -> None:
        self._latest_ns = swarm.config.slot_ns // 2  # so much later the turn is as good as over
        self._jitter_ns = jitter_ns
        self._random = [generator(swarm.config.seed, STREAM_CLOCKS, agent) for agent in swarm.ids]
        self._fixed_ns, self._per_byte_ns = flight_time_ns

    def under_way_ns(self, length: int) -> int:
        """From the order to send a frame until its receivers have it, ns.

        :param length: bytes of the frame.
        """
        return self._fixed_ns + self._per_byte_ns * length

    def start_ns(self, index: int, due_ns: int) -> int | None:
        """When a frame starts, ns, CLOCK_MONOTONIC; None: so late that it would disturb the next turn.

        :param index: position of its agent.
        :param due_ns: ns, CLOCK_MONOTONIC, when it should start.
        """
        jitter = self._jitter_ns * self._random[index].standard_normal() if self._jitter_ns else 0.0
        start = max(due_ns + int(jitter), time.monotonic_ns())
        return None if start - due_ns > self._latest_ns else start
