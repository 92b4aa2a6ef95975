"""The flight in which an agent is killed: when that happens, and when everything has been seen."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

from dtsa_agent.ros.common.process.loop import Stop
from dtsa_bench.flights.children import Children
from dtsa_channel_sim.ros.observer import ChannelObserver, ChannelStatus

KILL_AFTER_S = 1.0  # s after slot 0
SHOWN_S = 1.5  # s for which the flight goes on when the agent takes part again
GIVE_UP_S = 40.0  # s after slot 0: the flight ends even if the agent has not come back


@dataclass(frozen=True, slots=True)
class Times:
    """What happened when, s after slot 0 by this machine's clock; None: it did not."""

    killed_s: float | None
    back_s: float | None


class Killing(ChannelObserver):
    """Kills the process of one agent (SIGKILL) while the flight is under way, and waits until it is back.

    :param agent: its id.
    """

    def __init__(self, agent: int) -> None:
        self._agent = agent
        self._children: Children | None = None
        self._begin_s = 0.0
        self._killed_s = self._back_s = 0.0

    def started(self, children: Children) -> None:
        """Takes note of the flight's processes."""
        self._children = children

    def begun(self, at_s: float) -> None:
        self._begin_s = at_s

    def idle(self, status: ChannelStatus) -> None:
        if self._killed_s or not self._begin_s or time.monotonic() < self._begin_s + KILL_AFTER_S:
            return
        assert self._children is not None
        for child in self._children.all:
            if list(child.agents) == [self._agent]:
                os.kill(child.process.pid, signal.SIGKILL)
        self._killed_s = time.monotonic()

    def agents_back(self, agents: list[int]) -> None:
        if self._agent in agents:
            self._back_s = time.monotonic()

    @property
    def seen(self) -> bool:
        """Whether everything has happened, or will not happen any more."""
        now = time.monotonic()
        late = bool(self._begin_s) and now > self._begin_s + GIVE_UP_S
        return late or (bool(self._back_s) and now > self._back_s + SHOWN_S)

    def times(self) -> Times:
        """When it happened."""
        killed, back = (at - self._begin_s if at else None for at in (self._killed_s, self._back_s))
        return Times(killed, back)


class Until(Stop):
    """A stop flag that is also up once something is the case.

    :param stop: the flag of the signals.
    :param over: says whether it is the case.
    """

    def __init__(self, stop: Stop, over: Callable[[], bool]) -> None:
        super().__init__()
        self._stop, self._over = stop, over

    def __bool__(self) -> bool:
        return bool(self._stop) or self._over()
