"""`ros2 run dtsa_agent agent` with a port; a vehicle on the graph. See docs/how-to/several-computers.md."""

from __future__ import annotations

import json
import math
import time
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any

import numpy as np
from dtsa_msgs.msg import VelocityWorld
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from dtsa_agent.air.driver import AgentVehicle, LiveAgent
from dtsa_agent.air.port import open_port, settings_class
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.settings.declaration import Setting, Settings, setting, settings_of
from dtsa_agent.core.swarm import Swarm
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import ns_of
from dtsa_agent.ros.common.checks import OTHER_SENDER, RANGE, BadMessage, Intake, check_odometry
from dtsa_agent.ros.common.loop import Loop
from dtsa_agent.ros.common.parameters import check_parameters, declare_setting, declare_settings
from dtsa_agent.stop import Stop

_DEFAULTS = {"policy": "lease", "auth": True}  # as of `tools/dtsa agent`
_OUT = Setting("out", "text", "", "directory for its bag and summary.json, empty or new; empty text: none")
_RECORDERS = "dtsa.recorders"  # group of entry points: what records is in a package above this one

SIMULATED, ODOMETRY = "simulated", "odometry"
BODY, MAP = "body", "map"
TWIST, VELOCITY_WORLD = "twist", "velocity_world"
LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
_LONGEST_PREDICTION_S = 0.15
_SILENT_S = 0.3  # after such a silence another publisher may take over
_SLACK_M = 0.5  # odometry may be off by this from one message to the next
_BACKLOG_S = 0.1  # after a stand-still the middleware hands over what has waited within this time
HOLD_GAIN, HOLD_MPS = 1.0, 0.3  # 1/s, m/s: of an agent that hovers: real air does not leave it where it is
_STOPS, _STOPS_S = 5, 0.1  # how often an agent that ends tells its vehicle to stop, within which time


@dataclass(frozen=True, slots=True)
class VehicleSettings(Settings):
    """The vehicle of an agent on a network."""

    vehicle: str = setting(
        SIMULATED, "what the agent flies: the simulated vehicle, or one with odometry", choices=(SIMULATED, ODOMETRY)
    )
    odometry_topic: str = setting("odom", "topic of the vehicle's odometry, nav_msgs/Odometry")
    odometry_origin: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), "where the origin of the odometry lies in the swarm's map", unit="m", kind="vector"
    )
    twist_frame: str = setting(
        BODY, "axes of the velocity in the odometry: the body's (REP-103), or the map's", choices=(BODY, MAP)
    )
    command_topic: str = setting("cmd_vel", "topic on which the vehicle takes velocities")
    command_frame: str = setting(MAP, "axes of these velocities: the map's, or the body's", choices=(MAP, BODY))
    command_type: str = setting(
        TWIST, "geometry_msgs/TwistStamped, or dtsa_msgs/VelocityWorld as the bridge takes",
        choices=(TWIST, VELOCITY_WORLD),
    )  # fmt: skip
    command_hz: float = setting(50.0, "rate of the commands, at most one a slot", unit="Hz", minimum=1, maximum=200)
    stale_s: float = setting(0.3, "odometry older than this holds the vehicle", unit="s", minimum=0.02, maximum=5)
    fastest_mps: float = setting(
        5.0, "odometry that moves faster than this is refused", unit="m/s", minimum=0.1, maximum=50
    )


class VehicleOdometry:
    """The newest odometry of a vehicle that can be.

    What cannot be, or lies where the vehicle cannot have got since the last accepted one, is counted and not used.

    :param intake: counts what is not used.
    :param frame: of the messages whose origin is that of the settings, others are in the map; empty: all.
    :param is_stamped: stamps are of this machine's clock: they say how old the odometry is, not when it came.
    :param standstill_s: where nobody has asked for odometry for longer, what has waited is not used: it would pass for
        new.
    """

    def __init__(
        self, node: Node, settings: VehicleSettings, intake: Intake, frame: str = "", is_stamped: bool = False,
        standstill_s: float = math.inf,
    ) -> None:  # fmt: skip
        self._settings, self._frame, self._is_stamped = settings, frame, is_stamped
        self._standstill_s, self._asked_s, self._used_from_s = standstill_s, 0.0, 0.0  # s, the latter two monotonic
        self._sender: bytes | None = None  # of the last accepted one
        self._came_s = -math.inf  # s, monotonic: when that came
        self._measured_s = 0.0  # when its vehicle was there
        self._position = self._velocity = np.zeros(3)  # m, m/s, map: of the same
        self.attitude = (0.0, 0.0, 0.0, 1.0)  # of the same, x, y, z, w
        self.feed = Loop(node, Odometry, settings.odometry_topic, LATEST, intake=intake, check=self._accept)

    @property
    def is_known(self) -> bool:
        """Whether any has been accepted."""
        return self._came_s > 0.0

    @property
    def is_fresh(self) -> bool:
        """Whether the last accepted one came just now."""
        return time.monotonic() - self._came_s < self._settings.stale_s

    def take(self) -> None:
        """Accept what has come, if anything has."""
        now = time.monotonic()
        if now - self._asked_s > self._standstill_s:
            self._used_from_s = now + _BACKLOG_S
        self._asked_s = now
        self.feed.take()

    def sense(self, swarm: Swarm) -> None:
        """Write the newest odometry, moved on by its age, into an agent; without any for a while the agent stands."""
        self.take()
        if not self.is_fresh:
            swarm.velocity[:, 0] = 0.0
            return
        swarm.velocity[:, 0] = self._velocity
        # What was measured is as old as it is: a vehicle at 1 m/s has moved on by centimetres since.
        age_s = min(time.monotonic() - self._measured_s, _LONGEST_PREDICTION_S)
        swarm.position[:, 0] = self._position + self._velocity * age_s
        swarm.track[:, :, 0] = swarm.position[:, 0]

    def _accept(self, message: Odometry, sender: bytes | None) -> None:
        check_odometry(message)
        now, fastest = time.monotonic(), self._settings.fastest_mps
        if now < self._used_from_s:
            return
        if sender != self._sender and now - self._came_s < _SILENT_S:
            raise BadMessage(OTHER_SENDER, f"{self._settings.odometry_topic} from two publishers")
        place, speed, q = message.pose.pose.position, message.twist.twist.linear, message.pose.pose.orientation
        position = np.array((place.x, place.y, place.z))
        if self._frame in ("", message.header.frame_id):
            position += self._settings.odometry_origin
        velocity, attitude = np.array((speed.x, speed.y, speed.z)), (q.x, q.y, q.z, q.w)
        if self._settings.twist_frame == BODY:
            velocity = rotate(attitude, velocity)
        if math.hypot(*velocity) > fastest:
            raise BadMessage(RANGE, f"odometry of more than {fastest:g} m/s")
        if math.dist(position, self._position) > _SLACK_M + fastest * (now - self._came_s):
            raise BadMessage(RANGE, "odometry that has jumped")
        age_s = time.time() - ns_of(message.header.stamp) / 1e9 if self._is_stamped else 0.0
        self._sender, self._came_s, self._measured_s = sender, now, now - min(max(0.0, age_s), _LONGEST_PREDICTION_S)
        self._position, self._velocity, self.attitude = position, velocity, attitude


class OdometryVehicle(AgentVehicle):
    """A vehicle that publishes odometry and follows velocities; without odometry for a while it gets the velocity 0."""

    def __init__(self, node: Node, settings: VehicleSettings, slot_s: float) -> None:
        self._settings, self._node = settings, node
        self._every = max(1, round(1.0 / settings.command_hz / slot_s))
        self._next_s = -math.inf  # s, monotonic: of the next command before the first slot
        self._frame = names.FRAME if settings.command_frame == MAP else names.body_frame(node.get_namespace())
        self._hold: Any = None  # m, map: where it was when it began to hover
        self._kind = TwistStamped if settings.command_type == TWIST else VelocityWorld
        self._publisher = node.create_publisher(self._kind, settings.command_topic, 1)
        self._intake = Intake(node.get_logger())
        standstill_s = max(settings.stale_s, 2 * slot_s)  # it is asked for once a slot
        self._odometry = VehicleOdometry(node, settings, self._intake, standstill_s=standstill_s)

    def close(self) -> None:
        """Stop the vehicle: the agent has ended.

        One message may be lost, above all one whose publisher is gone a moment later: several are sent, and reliable
        receivers have a while to acknowledge them.
        """
        try:
            for _ in range(_STOPS):
                self._command(np.zeros(3))
                time.sleep(_STOPS_S / _STOPS)
            self._publisher.wait_for_all_acked(Duration(seconds=_STOPS_S))
        finally:
            self._odometry.feed.close()

    def is_ready(self) -> bool:
        """Whether odometry has come, and is fresh."""
        self._odometry.take()
        self._odometry.feed.housekeeping()
        return self._odometry.is_fresh

    @property
    def why_unknown(self) -> str:
        """Why it was never known where the vehicle is; empty: it was."""
        if self._odometry.is_known:
            return ""
        refused = ", ".join(f"{number} refused ({reason})" for reason, number in self._intake.counts.items())
        return refused or f"none came on {self._settings.odometry_topic}"

    def sense(self, swarm: Swarm) -> None:
        self._odometry.sense(swarm)
        self._odometry.feed.housekeeping()

    def hover(self, swarm: Swarm) -> None:
        self.sense(swarm)
        now = time.monotonic()
        if now >= self._next_s:
            self._next_s = now + 1.0 / self._settings.command_hz
            self._command(self._hold_velocity(swarm))

    def fly(self, swarm: Swarm, slot: int) -> None:
        """Publish the velocity for a slot: the agent's command, or one that holds the vehicle."""
        if slot % self._every:
            return
        swarm.steer(slot, 0)
        if swarm.active[0] and self._odometry.is_fresh:
            self._hold = None
        else:
            swarm.command[:, 0] = self._hold_velocity(swarm)
        self._command(swarm.command[:, 0])

    def _hold_velocity(self, swarm: Swarm) -> Any:
        """Return the velocity, (3,) m/s, map, that holds the vehicle where that began; 0 without odometry."""
        if not self._odometry.is_fresh:
            return np.zeros(3)
        if self._hold is None:
            self._hold = swarm.position[:, 0].copy()
        return velocity_to(self._hold - swarm.position[:, 0])

    def _command(self, velocity: Any) -> None:
        """Publish a velocity, (3,) m/s, map."""
        if self._settings.command_frame == BODY:
            x, y, z, w = self._odometry.attitude
            velocity = rotate((-x, -y, -z, w), velocity)
        message = self._kind()
        if self._kind is TwistStamped:
            message.header.frame_id, speed = self._frame, message.twist.linear
        else:
            speed = message.vel
        message.header.stamp = self._node.get_clock().now().to_msg()
        speed.x, speed.y, speed.z = map(float, velocity)
        self._publisher.publish(message)


def velocity_to(away: Any) -> Any:
    """Return the velocity, m/s, of vehicles that hover and are so far, m, from where they shall be."""
    return np.clip(HOLD_GAIN * away, -HOLD_MPS, HOLD_MPS)


def rotate(q: tuple[float, float, float, float], v: Any) -> Any:
    """Return a vector (3,) of the body in the map's axes; q: attitude x, y, z, w, body in map."""
    axis, w = np.array(q[:3]), q[3]
    across = 2.0 * np.cross(axis, v)
    return v + w * across + np.cross(axis, across)


def fly_over_port(node: Node, air: str, agent: int, stop: Stop) -> int:
    """Declare the rest of the parameters and fly an agent over a kind of port until a signal; return the exit code."""
    config = SwarmConfig.from_dict(declare_settings(node, SwarmConfig, defaults=_DEFAULTS))
    own = AgentSettings(id=agent, **declare_settings(node, AgentSettings, skip=("id",)))
    cls = settings_class(air)
    needed = {setting.name: "" for setting in settings_of(cls) if setting.required}  # an error if they are not given
    chosen = cls.from_dict(declare_settings(node, cls, defaults=needed))
    settings = VehicleSettings.from_dict(declare_settings(node, VehicleSettings))
    vehicle = OdometryVehicle(node, settings, config.slot_s) if settings.vehicle == ODOMETRY else None
    out = str(declare_setting(node, _OUT))
    check_parameters(node)
    record = _recorder(out) if out else None
    logger = node.get_logger()
    try:
        with open_port(chosen) as port:
            flying = LiveAgent(own, config, port, vehicle=vehicle, log=logger.warning)
            with nullcontext() if record is None else record(out, flying, chosen) as recorder:
                flying.run(stop)
            summary = flying.summary() if recorder is None else recorder.summary
            logger.info(f"ends: {json.dumps(summary)}")
    finally:
        if vehicle is not None:
            vehicle.close()
    if vehicle is not None and vehicle.why_unknown:
        raise DtsaError(f"no odometry that can be used: {vehicle.why_unknown}")
    if recorder is not None and recorder.failure:
        raise DtsaError(recorder.failure)
    return 0


def _recorder(out: str) -> Any:
    """Return what records an agent, as ``recorder(out, agent, port_settings)``: a context in which it flies."""
    recorders = [*entry_points(group=_RECORDERS, name="agent")]
    if not recorders:
        raise ConfigError("out", out, "no directory, for the package dtsa_bench, which records, is not here")
    try:
        return recorders[0].load()
    except ImportError as error:
        raise ConfigError("out", out, f"no directory, for what records cannot be imported ({error})") from None
