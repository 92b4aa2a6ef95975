"""Orders to one Crazyflie that are about trajectories in its memory: write, look ahead, fly."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Protocol

from dtsa_agent.crazyflie.links.delivery import TRAJECTORY
from dtsa_agent.crazyflie.motion.trajectories import Planned, Trajectory, why_not
from dtsa_agent.crazyflie.settings.config import StationSettings
from dtsa_agent.crazyflie.state.state_machine import State

from .known_state import KnownState
from .onboard import Onboard


class Led(Protocol):
    """What these orders need of a vehicle."""

    name: str
    action: str
    station: StationSettings
    lock: threading.RLock
    known: KnownState
    onboard: Onboard

    @property
    def state(self) -> State: ...

    @property
    def standing(self) -> str: ...

    def not_led(self) -> str: ...

    def fly(self, kind: str, action: Callable[[Any], None], duration: float, *, again: bool = True) -> None: ...


class TrajectoryOrders:
    """Trajectories of one Crazyflie.

    :param vehicle: whose. Its lock protects all of it.
    """

    def __init__(self, vehicle: Led) -> None:
        self._vehicle = vehicle

    def upload(self, trajectory: Trajectory) -> str:
        """Write a trajectory to its memory, on the ground; waits; why not, or an empty text."""
        vehicle = self._vehicle
        if vehicle.state not in (State.READY, State.ARMED):  # in the air it might be flying what is there
            return f"{vehicle.name} is {vehicle.standing}: trajectories are uploaded on the ground"
        problem = vehicle.onboard.upload(trajectory)
        return f"{vehicle.name}: trajectory {trajectory.number}: {problem}" if problem else ""

    def problem(self, number: int, timescale: float, *, reverse: bool, relative: bool) -> str:
        """Why it must not start a trajectory; empty if it may. Parameters as of `start`."""
        vehicle = self._vehicle
        with vehicle.lock:
            if (problem := vehicle.not_led()) or vehicle.known.last is None:
                return problem or f"{vehicle.name} is {vehicle.standing}"
            if vehicle.known.wrong:
                return f"{vehicle.name}: {vehicle.known.wrong}"
            trajectory = vehicle.onboard.trajectories.get(number)
            if trajectory is None:
                return f"{vehicle.name}: trajectory {number} was not uploaded"
            here = vehicle.known.last.position
            problem = why_not(trajectory, here, vehicle.station, timescale, reverse=reverse, relative=relative)
            return f"{vehicle.name}: {problem}" if problem else ""

    def planned(self, number: int, timescale: float, *, reverse: bool, relative: bool) -> Planned | None:
        """Where a trajectory would lead it; None: it has none of that number, or does not know where it is.

        :param timescale: factor: it takes that many times as long as it says.
        """
        vehicle = self._vehicle
        with vehicle.lock:
            trajectory = vehicle.onboard.trajectories.get(number)
            if trajectory is None or vehicle.known.last is None:
                return None
            return Planned(vehicle.name, trajectory, vehicle.known.last.position, timescale, reverse, relative)

    def start(self, number: int, timescale: float, *, reverse: bool, relative: bool) -> str:
        """Fly a trajectory of its memory, then hold its end; why not, or an empty text.

        :param timescale: factor: it takes that many times as long as it says.
        :param reverse: from its end to its beginning.
        :param relative: moved so that it begins where the vehicle is.
        :param number: of the trajectory, 0 to 9.
        """
        vehicle = self._vehicle
        with vehicle.lock:
            if problem := self.problem(number, timescale, reverse=reverse, relative=relative):
                return problem
            vehicle.action = f"trajectory {number}"
            vehicle.fly(
                TRAJECTORY,
                lambda cf: cf.high_level_commander.start_trajectory(
                    number, timescale, relative_position=relative, reversed=reverse
                ),
                timescale * vehicle.onboard.trajectories[number].duration,
                again=False,  # it would begin once more
            )
            return ""
