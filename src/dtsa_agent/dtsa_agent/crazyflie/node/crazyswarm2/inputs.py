"""What Crazyswarm2's programs send: streamed commands in its units, services without answers, trajectories, logs.

Its units, by what its server does with them: everything is in the world's frame whatever the header says;
`cmd_position` has its yaw in degrees and `cmd_velocity_world` its yaw rate in degrees per second, all others count in
radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from rclpy.node import Node

from dtsa_agent.crazyflie.motion.trajectories import Piece, Trajectory, meeting
from dtsa_agent.crazyflie.node.bridge import Bridge
from dtsa_agent.crazyflie.node.command_thread import CommandThread
from dtsa_agent.crazyflie.node.inputs import Inputs, helper_node, seconds
from dtsa_agent.crazyflie.state import conversions
from dtsa_agent.crazyflie.state.state_machine import State
from dtsa_agent.crazyflie.vehicle.vehicle import Vehicle
from dtsa_agent.ros.common.process.serving import Serving

from .interfaces import Interfaces
from .logs import Logs
from .parameters import FirmwareParameters


@dataclass(slots=True)
class Answer:
    """What our services would answer; Crazyswarm2's say nothing, so it stands in the log alone."""

    success: bool = True
    message: str = ""


class Crazyswarm2Inputs(Inputs):
    """Topics and services of Crazyswarm2's server.

    :param node: offers the services and has the parameters.
    :param bridge: the swarm.
    :param commands: takes the streamed commands; not started yet.
    :param say: called with a level and a line about each order.
    :param interfaces: Crazyswarm2's messages.
    """

    def __init__(
        self,
        node: Node,
        bridge: Bridge,
        commands: CommandThread,
        say: Callable[[str, str], None],
        interfaces: Interfaces,
    ) -> None:
        super().__init__(node, bridge, commands, say)
        self.types = interfaces.types()
        self._interfaces = interfaces
        self._masks = {name: vehicle.robot.group_mask for name, vehicle in bridge.vehicles.items()}
        # An upload takes up to seconds: it must not keep an emergency stop waiting.
        self._uploads = helper_node(node, "uploads")
        self._serving = Serving(node.context, "uploads", self._uploads)

    def offer(self) -> None:
        """Create everything; `/all/emergency` is last."""
        FirmwareParameters(self._node, self._bridge, self._say, self._masks).declare()
        Logs(self._node, self._bridge, self._say, self._interfaces).offer()
        for name, vehicle in self._bridge.vehicles.items():
            kind, service = self._interfaces.srv.UploadTrajectory, f"{name}/upload_trajectory"
            self._uploads.create_service(kind, service, partial(self._upload, vehicle))
        self._serving.start()
        super().offer()

    def close(self) -> None:
        """No more uploads."""
        self._serving.close()
        self._uploads.destroy_node()

    def _services(self) -> list[tuple[Any, str, Callable[[list[str], Any, Any], Any]]]:
        start = (self._interfaces.srv.StartTrajectory, "start_trajectory", self._start_trajectory)
        return [start, *super()._services()]

    def _ordered(self, name: str, callback: Callable[[Any, Any], Any], request: Any, response: Any) -> Any:
        super()._ordered(name, callback, request, Answer())
        return response

    # -- units ------------------------------------------------------------------------------------------------------
    def _world(self, frame: str, x: float, y: float, z: float) -> conversions.Vector:
        return x, y, z

    def _position(self, m: Any, stamp: float) -> conversions.Setpoint:
        return conversions.position((m.x, m.y, m.z), math.radians(m.yaw), stamp)

    def _velocity_world(self, m: Any, stamp: float) -> conversions.Setpoint:
        return conversions.velocity_world((m.vel.x, m.vel.y, m.vel.z), math.radians(m.yaw_rate), stamp)

    # -- services ---------------------------------------------------------------------------------------------------
    def _groups(self, name: str) -> int:
        return self._masks[name]

    def _climb(self, vehicle: Vehicle, height: float, duration: float) -> str:
        return vehicle.takeoff(height, duration, arm=True)  # its programs arm nobody

    def _go_to(self, names: list[str], request: Any, response: Any) -> Any:
        if len(names) > 1 and not request.relative:
            response.success, response.message = False, "a go_to of all must be relative: they would meet in one place"
            return response
        return super()._go_to(names, request, response)

    def _start_trajectory(self, names: list[str], request: Any, response: Any) -> Any:
        """Start all that are addressed, or nobody."""
        number, timescale, group = request.trajectory_id, request.timescale, request.group_mask
        how = {"reverse": request.reversed, "relative": request.relative}
        self._each(names, lambda v: v.trajectories.problem(number, timescale, **how), response, group)
        if response.success and (problem := self._meeting(names, number, timescale, how, group)):
            response.success, response.message = False, problem
        if response.success:
            self._each(names, lambda v: v.trajectories.start(number, timescale, **how), response, group)
        return response

    def _meeting(self, names: list[str], number: int, timescale: float, how: dict[str, bool], group: int) -> str:
        """Who would come too close to whom; empty: nobody."""
        station = self._bridge.settings.station
        flying = {n: v for n, v in self._bridge.vehicles.items() if v.state == State.FLYING and v.last is not None}
        led = [name for name in names if name in flying and (not group or self._groups(name) & group)]
        plans = [
            plan for name in led if (plan := flying[name].trajectories.planned(number, timescale, **how)) is not None
        ]
        hovering = {n: v.last.position for n, v in flying.items() if n not in led and v.last is not None}
        problem = meeting(plans, hovering, station.safety.min_distance_m)
        return f"{problem} (station.safety.min_distance_m is {station.safety.min_distance_m:g})" if problem else ""

    def _upload(self, vehicle: Vehicle, request: Any, response: Any) -> Any:
        number, count = request.trajectory_id, len(request.pieces)
        try:
            pieces = tuple(_piece(piece) for piece in request.pieces)
            trajectory = Trajectory(number, request.piece_offset, pieces)
        except ValueError as error:
            problem = f"{vehicle.name}: {error}"
        else:
            problem = vehicle.trajectories.upload(trajectory)
        order = f"order /{vehicle.name}/upload_trajectory (id {number}, {count} pieces)"
        self._say("warn" if problem else "info", f"{order}: {problem or 'done'}")
        return response


def _piece(m: Any) -> Piece:
    """A piece of a trajectory from its message."""
    return Piece(tuple(m.poly_x), tuple(m.poly_y), tuple(m.poly_z), tuple(m.poly_yaw), seconds(m.duration))
