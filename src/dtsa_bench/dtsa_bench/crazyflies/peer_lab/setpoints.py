"""Set-points of an app as the simulated Crazyflie's."""

from __future__ import annotations

import math
import struct

from dtsa_bench.crazyflies.simulated.firmware import Setpoint

_FORM = struct.Struct("<9i13f")  # native/crazyflie.c
_ABSOLUTE, _VELOCITY = 1, 2  # modes of an axis


def setpoint_of(data: bytes, t: float, yaw: float) -> tuple[int, Setpoint]:
    """Priority and set-point that an app gave.

    Thrust and attitude alone mean level flight, or stopped motors without thrust: no more of them is simulated.

    :param data: as the engine tells them. :param t: s. :param yaw: rad, where the vehicle's nose points.
    """
    priority, x, _, z, _, _, yaw_mode, _, body, *values = _FORM.unpack(data)
    place, speed, heading, rate = values[:3], values[3:6], values[8], values[11]
    setpoint = Setpoint(t)
    if yaw_mode == _ABSOLUTE:
        setpoint.yaw = math.radians(heading)
    elif yaw_mode == _VELOCITY:
        setpoint.yaw_rate = math.radians(rate)
    vx, vy, vz = speed
    if z == _ABSOLUTE:
        setpoint.height, vz = place[2], 0.0
    elif z != _VELOCITY:
        vz = 0.0
    if x == _ABSOLUTE:
        setpoint.position = (place[0], place[1], place[2])
    elif x == _VELOCITY:
        if body:
            c, s = math.cos(yaw), math.sin(yaw)
            vx, vy = c * vx - s * vy, s * vx + c * vy
        setpoint.velocity = (vx, vy, vz)
    else:
        setpoint.velocity = (0.0, 0.0, vz)
        setpoint.motors = z in (_ABSOLUTE, _VELOCITY) or values[12] > 0.0
    return priority, setpoint
