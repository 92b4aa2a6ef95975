"""The engine's face in Python: one process has one."""

from __future__ import annotations

import ctypes
import math
import struct
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_int32, c_int64, c_uint8, c_uint64
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_bench.crazyflies.simulated.crtp import LOG_TYPES, PARAM_TYPES, READ_ONLY, VariableEntry
from dtsa_bench.crazyflies.simulated.firmware import FirmwareSetpoint

_PARAM_NAMES = {code: name for name, (code, _) in PARAM_TYPES.items()}
_LOG_NAMES = {code: name for name, (code, _) in LOG_TYPES.items()}
_SETPOINT = struct.Struct("<9i13f")  # native/crazyflie.c
_ABSOLUTE, _VELOCITY = 1, 2  # modes of an axis


class EngineEvent(IntEnum):
    """What the engine tells (native/lab.h)."""

    NONE, SEND, HEARD, COMMAND, PRINT, APP_CHANNEL, ENDED, SPINS, ASSERT, MISUSE, RECORD = range(11)


class AppCommand(IntEnum):
    """What an app asks for (native/lab.h)."""

    SETPOINT, RELAX, TAKEOFF, LAND, STOP, GO_TO, ARM, RECOVER, PARAMETER, DISABLE = range(10)


class AppError(DtsaError):
    """An app did what no app may do."""


class _Report(Structure):
    _fields_ = [
        ("kind", c_int32), ("vehicle", c_int32), ("code", c_int32), ("size", c_int32), ("time_ns", c_int64),
        ("other_ns", c_int64), ("answer", c_int32), ("data", c_uint8 * 1024),
    ]  # fmt: skip


_SIGNATURES = {
    "lab_begin": (c_int, [c_int, c_int, POINTER(c_char_p), c_int, POINTER(c_char_p), c_int64, c_int64, c_int64]),
    "lab_run": (POINTER(_Report), [c_int64]),
    "lab_log_values": (POINTER(c_double), [c_int]),
    "lab_parameter_values": (POINTER(c_double), [c_int]),
    "lab_off": (None, [c_int]),
    "lab_boot": (c_char_p, [c_int, c_char_p, c_int64, c_int64, c_int64, c_uint64, c_int, c_int]),
    "lab_receive": (c_int, [c_int, c_int64, c_char_p, c_int, c_int]),
    "lab_app_channel": (c_int, [c_int, c_int64, c_char_p, c_int]),
    "lab_count": (c_int, [c_int, c_int]),
    "lab_name": (c_char_p, [c_int, c_int, c_int]),
    "lab_type": (c_int, [c_int, c_int, c_int]),
    "lab_get": (c_double, [c_int, c_int, c_int]),
    "lab_set": (None, [c_int, c_int64, c_int, c_double]),
    "lab_end": (None, []),
}


def decode_setpoint(data: bytes, t: float, yaw: float) -> tuple[int, FirmwareSetpoint]:
    """Priority and set-point that an app gave at t (s), with its heading (rad) then.

    Thrust and attitude alone mean level flight, or stopped motors without thrust: no more of them is simulated.
    """
    priority, x, _, z, _, _, yaw_mode, _, body, *values = _SETPOINT.unpack(data)
    place, speed, heading, rate = values[:3], values[3:6], values[8], values[11]
    setpoint = FirmwareSetpoint(t)
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


class Engine:
    """Apps of many vehicles in virtual time. Vehicles are numbered from 0, times are ns.

    :param names: of the firmware's own log variables. :param parameters: of its own parameters.
    :param line_fixed_ns: ns that any packet takes on the line to the radio. :param line_byte_ns: ns that a byte adds.
    :param spin_ns: ns after which a task that does not wait is an error.
    """

    def __init__(
        self, library: Path, count: int, names: list[str], parameters: list[str], line_fixed_ns: int,
        line_byte_ns: int, spin_ns: int,
    ) -> None:  # fmt: skip
        self._library = ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)  # apps find the firmware's functions in it
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, arguments
        texts, more = ((c_char_p * len(some))(*(name.encode() for name in some)) for some in (names, parameters))
        times = line_fixed_ns, line_byte_ns, spin_ns
        if self._library.lab_begin(count, len(names), texts, len(parameters), more, *times):
            raise MemoryError
        #: Values of the firmware's log variables by vehicle, in the order of their names: written by the owner.
        self.firmware_logs: list[NDArray[np.float64]] = [
            np.ctypeslib.as_array(self._library.lab_log_values(k), (len(names),)) for k in range(count)
        ]
        #: Values of the firmware's parameters by vehicle, likewise.
        self.firmware_parameters: list[NDArray[np.float64]] = [
            np.ctypeslib.as_array(self._library.lab_parameter_values(k), (len(parameters),)) for k in range(count)
        ]
        self._variables: dict[tuple[int, bool], dict[str, int]] = {}  # index by name, by vehicle: parameters, or logs

    def close(self) -> None:
        """Switch all off."""
        self._library.lab_end()

    def run(self, until_ns: int) -> _Report:
        """Run the apps until a time, or until one asks or tells something: then `kind` is not NONE."""
        return self._library.lab_run(until_ns).contents  # type: ignore[no-any-return]

    def boot(
        self, vehicle: int, app: Path, now_ns: int, drift_ppb: int, address: int, channel: int, speed: int
    ) -> None:
        """Switch a vehicle on, with a copy of the app that no other one has; AppError: it cannot be loaded.

        :param drift_ppb: by so much its clock is fast. :param address: of its radio, as channel and speed.
        """
        wrong = self._library.lab_boot(vehicle, str(app).encode(), now_ns, 0, drift_ppb, address, channel, speed)
        if wrong:
            raise AppError(f"app of agent {vehicle + 1}: {wrong.decode(errors='replace').replace(str(app), 'app')}")
        for parameters in (False, True):
            count = self._library.lab_count(vehicle, parameters)
            names = (self._library.lab_name(vehicle, parameters, i).decode() for i in range(count))
            self._variables[vehicle, parameters] = {name: i for i, name in enumerate(names)}

    def off(self, vehicle: int) -> None:
        """Switch a vehicle off: its app and all that it knew are gone."""
        self._library.lab_off(vehicle)
        self._variables.pop((vehicle, False), None)
        self._variables.pop((vehicle, True), None)

    def receive(self, vehicle: int, now_ns: int, raw: bytes, rssi: int) -> bool:
        """A packet (port, data) has come to a vehicle's processor; False: its queue is full."""
        return bool(self._library.lab_receive(vehicle, now_ns, raw, len(raw), rssi))

    def app_channel(self, vehicle: int, now_ns: int, data: bytes) -> bool:
        """A packet of the app channel has come to a vehicle; False: its queue is full."""
        return bool(self._library.lab_app_channel(vehicle, now_ns, data, len(data)))

    # The app's own parameters and log variables, by name (group.name).
    def names(self, vehicle: int, *, parameters: bool) -> list[str]:
        """Names of the app's parameters, or of its log variables; none while it is switched off."""
        return list(self._variables.get((vehicle, parameters), ()))

    def _index(self, vehicle: int, name: str, parameter: bool) -> int:
        names = self._variables.get((vehicle, parameter), {})
        if name not in names:
            what = "parameter" if parameter else "log variable"
            raise ConfigError(what, name, f"of agent {vehicle + 1}: {', '.join(names) or 'none'}")
        return names[name]

    def get(self, vehicle: int, name: str, *, parameter: bool) -> float:
        """Value of a parameter or a log variable of the app; ConfigError: none of that name, or switched off."""
        return float(self._library.lab_get(vehicle, parameter, self._index(vehicle, name, parameter)))

    def set(self, vehicle: int, now_ns: int, name: str, value: float) -> None:
        """Set a parameter of the app; ConfigError: none of that name, or switched off."""
        self._library.lab_set(vehicle, now_ns, self._index(vehicle, name, True), value)

    def entries(self, vehicle: int, *, parameters: bool) -> list[VariableEntry]:
        """Parameters or log variables of the app, as a ground station sees them."""
        found = []
        for name, index in self._variables[vehicle, parameters].items():
            code = self._library.lab_type(vehicle, parameters, index)
            value = self.get(vehicle, name, parameter=True) if parameters else 0.0
            group, _, rest = name.partition(".")
            kind = (_PARAM_NAMES if parameters else _LOG_NAMES)[code & 15]
            found.append(VariableEntry(group, rest, kind, value, read_only=parameters and bool(code & READ_ONLY)))
        return found
