"""The far end of one link: answers the host's packets and sends the log data that it asked for."""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from . import crtp
from .estimate import Estimate, log_values
from .firmware import Firmware

PROTOCOLS = (10, 12)
MAX_BLOCK_BYTES = 26
Handler = Callable[[bytes, float], "bytes | None"]


@dataclass(slots=True)
class LogBlock:
    """One log block: variables that are sent together."""

    variables: list[tuple[str, str]] = field(default_factory=list)  # full name, struct format of the fetched type
    period: int = 0  # ticks of 10 ms; 0: stopped
    phase: int = 0

    @property
    def size(self) -> int:
        return struct.calcsize("<" + "".join(form for _, form in self.variables))

    def data(self, values: dict[str, float]) -> bytes:
        return b"".join(struct.pack("<" + form, crtp.saturate(values[name], form)) for name, form in self.variables)


class OnboardApp(Protocol):
    """An app on board: it adds parameters and log variables, and gets packets of the app channel."""

    parameters: Sequence[crtp.VariableEntry]
    logs: Sequence[crtp.VariableEntry]
    receive: Callable[[bytes], object]

    def parameter(self, name: str) -> float: ...

    def set_parameter(self, name: str, value: float) -> None: ...

    def log_values(self) -> Mapping[str, float]: ...


class CrtpPeer:
    """Protocol state of one simulated Crazyflie: log blocks and parameter values. Times (`t`) are s, the fleet's clock.

    The last byte of its address is its number, by which packets to several name it.
    """

    def __init__(self, firmware: Firmware, estimate: Estimate, protocol: int = 12, number: int = 1) -> None:
        self.firmware = firmware
        self.estimate = estimate
        self.protocol = protocol
        self.number = number
        self.positions_received = 0
        self.blocks: dict[int, LogBlock] = {}
        self._app: OnboardApp | None = None
        self._params, self._logs = crtp.PARAM_ENTRIES, crtp.LOG_ENTRIES
        self._param_table, self._log_table = crtp.PARAM_TABLE, crtp.LOG_TABLE
        self.values = [entry.value for entry in self._params]
        self._handlers: dict[tuple[int, int], Handler] = {
            (crtp.LINK, 0): lambda data, t: data,
            (crtp.LINK, 1): lambda data, t: b"Bitcraze Crazyflie".ljust(30, b"\0"),
            (crtp.LINK, 3): lambda data, t: data,
            (crtp.PLATFORM, 0): self._platform,
            (crtp.PLATFORM, 1): lambda data, t: bytes((0, self.protocol)) if data[:1] == b"\0" else None,
            (crtp.PLATFORM, 2): self._app_channel,
            (crtp.LOG, 0): lambda data, t: self._log_table.answer(data),
            (crtp.LOG, 1): self._log_settings,
            (crtp.PARAM, 0): lambda data, t: self._param_table.answer(data),
            (crtp.PARAM, 1): self._param_read,
            (crtp.PARAM, 2): self._param_write,
            (crtp.PARAM, 3): self._param_misc,
            (crtp.MEMORY, 0): lambda data, t: b"\x01\0" if data[:1] == b"\x01" else None,  # there are none
            (crtp.COMMANDER, 0): lambda data, t: self.firmware.manual(data, t),
            (crtp.LOCALIZATION, 0): self._ext_position,
            (crtp.LOCALIZATION, 1): self._localization,
            (crtp.LOCALIZATION, 2): self._ext_positions,
            (crtp.GENERIC_COMMANDER, 0): lambda data, t: self.firmware.stream(data, t),
            (crtp.GENERIC_COMMANDER, 1): self._meta,
            (crtp.HIGH_LEVEL, 0): lambda data, t: data[:3] + bytes((self.firmware.high_level(data, t),)),
        }
        if protocol >= 12:
            self._handlers[crtp.SUPERVISOR, 0] = self._supervisor_info
            self._handlers[crtp.SUPERVISOR, 1] = self._supervisor_command

    def reset(self) -> None:
        """Power on: no log blocks, default parameters."""
        self.blocks.clear()
        self.values = [entry.value for entry in self._params]

    def adopt(self, app: OnboardApp) -> None:
        """An app has started on board: its variables are in the tables of contents."""
        self._app = app
        self._params = (*crtp.PARAM_ENTRIES, *app.parameters)
        self._logs = (*crtp.LOG_ENTRIES, *app.logs)
        self._param_table, self._log_table = (
            crtp.VariableTable(self._params, log=False),
            crtp.VariableTable(self._logs, log=True),
        )
        self.values[len(crtp.PARAM_ENTRIES) :] = [entry.value for entry in app.parameters]

    def receive(self, datagram: bytes, t: float) -> bytes | None:
        """Handle one datagram at time t (s); the reply, or None."""
        packet = crtp.unpack(datagram)
        if packet is None:
            return None
        port, channel, data = packet
        handler = self._handlers.get((port, channel))
        if handler is None:
            return None
        try:
            reply = handler(data, t)
        except (struct.error, IndexError):  # too short for its kind: the firmware would not answer it either
            return None
        return None if reply is None else crtp.pack(port, channel, reply)

    def log_packets(self, tick: int, t: float) -> Iterator[bytes]:
        """Log data that is due in this tick of 10 ms."""
        due = [(i, b) for i, b in self.blocks.items() if b.period and (tick - b.phase) % b.period == 0]
        if due:
            values = log_values(self.estimate, self.firmware, t)
            if self._app is not None:
                values.update(self._app.log_values())
            stamp = (int(t * 1000) & 0xFFFFFF).to_bytes(3, "little")
            for number, block in due:
                yield crtp.pack(crtp.LOG, 2, bytes((number,)) + stamp + block.data(values))

    def _app_channel(self, data: bytes, t: float) -> None:
        if self._app is not None:
            self._app.receive(data)

    # -- handlers: request's data and time in, reply's data out -----------------------------------------------------
    def _platform(self, data: bytes, t: float) -> bytes | None:
        if data[:1] == b"\x01" and len(data) > 1:
            ok = self.firmware.supervisor.request_arming(bool(data[1]))
            return bytes((1, ok, self.firmware.supervisor.armed))
        if data[:1] == b"\x02":
            return bytes((2, self.firmware.supervisor.request_recovery()))
        return None

    def _supervisor_info(self, data: bytes, t: float) -> bytes | None:
        if data[:1] != b"\x0c":
            return None
        info = log_values(self.estimate, self.firmware, t)["supervisor.info"]
        return struct.pack("<BH", 0x8C, int(info))

    def _supervisor_command(self, data: bytes, t: float) -> bytes | None:
        kind = data[0]
        supervisor = self.firmware.supervisor
        if kind == 1:
            ok = supervisor.request_arming(bool(data[1]))
            return bytes((0x81, ok, supervisor.armed))
        if kind == 2:
            ok = supervisor.request_recovery()
            return bytes((0x82, ok, ok))
        return self._emergency(kind, t)

    def _ext_position(self, data: bytes, t: float) -> None:
        x, y, z = struct.unpack_from("<3f", data)
        self._positioned((x, y, z))

    def _ext_positions(self, data: bytes, t: float) -> None:
        """Up to four places: id and mm of each."""
        for number, x, y, z in struct.iter_unpack("<B3h", data[: len(data) // 7 * 7]):
            if number == self.number:
                self._positioned((x / 1000, y / 1000, z / 1000))

    def _positioned(self, place: tuple[float, float, float]) -> None:
        self.positions_received += 1
        if all(map(math.isfinite, place)):
            self.estimate.correct(place, max(self.values[crtp.PARAM_ID["locSrv.extPosStdDev"]], 1e-4))

    def _localization(self, data: bytes, t: float) -> bytes | None:
        if data[:1] == b"\x08":
            x, y, z, *_ = struct.unpack_from("<7f", data, 1)
            self._positioned((x, y, z))
            return None
        if data[:1] == b"\x09":  # up to two poses: id, mm, and the attitude in 32 bits
            for number, x, y, z, _ in struct.iter_unpack("<B3hI", data[1 : 1 + len(data[1:]) // 11 * 11]):
                if number == self.number:
                    self._positioned((x / 1000, y / 1000, z / 1000))
            return None
        return self._emergency(data[0] if data else 0, t)

    def _emergency(self, kind: int, t: float) -> None:
        if kind == 3:
            self.firmware.supervisor.stop("emergency stop")
        elif kind == 4:
            self.firmware.supervisor.watchdog(t)

    def _meta(self, data: bytes, t: float) -> None:
        if data[:1] == b"\0":
            self.firmware.notify_stop()

    def _log_settings(self, data: bytes, t: float) -> bytes | None:
        command = data[0]
        if command == 5:
            self.blocks.clear()
            return b"\x05\0\0"
        number = data[1]
        if command in (6, 7):
            return bytes((command, number, self._log_append(command == 6, number, data[2:])))
        if command not in (2, 3, 4):
            return bytes((command, number, errno.ENOEXEC))
        block = self.blocks.get(number)
        if block is None:
            return bytes((command, number, errno.ENOENT))
        if command == 2:
            del self.blocks[number]
        else:
            block.period = data[2] if command == 3 else 0
            block.phase = int(t * 100)
        return bytes((command, number, 0))

    def _log_append(self, create: bool, number: int, data: bytes) -> int:
        if create and number in self.blocks:
            return errno.EEXIST
        if not create and number not in self.blocks:
            return errno.ENOENT
        block = LogBlock() if create else self.blocks[number]
        variables = list(block.variables)
        for kind, index in struct.iter_unpack("<BH", data[: len(data) // 3 * 3]):
            form = crtp.LOG_FORMAT_BY_CODE.get(kind & 15)
            if form is None or index >= len(self._logs):
                return errno.ENOENT
            variables.append((self._logs[index].full_name, form))
        if LogBlock(variables).size > MAX_BLOCK_BYTES:
            return errno.E2BIG
        block.variables = variables
        self.blocks[number] = block
        return 0

    def _param_format(self, index: int) -> str:
        return "<" + crtp.PARAM_TYPES[self._params[index].type][1]

    def _param_read(self, data: bytes, t: float) -> bytes:
        (index,) = struct.unpack_from("<H", data)
        if index >= len(self.values):
            return data[:2] + bytes((errno.ENOENT,))
        return data[:2] + b"\0" + self._packed(index)

    def _packed(self, index: int) -> bytes:
        form = self._param_format(index)
        if self._app is not None and index >= len(crtp.PARAM_ENTRIES):
            self.values[index] = self._app.parameter(self._params[index].full_name)
        return struct.pack(form, crtp.saturate(self.values[index], form[1]))

    def _param_write(self, data: bytes, t: float) -> bytes:
        (index,) = struct.unpack_from("<H", data)
        if index >= len(self.values):
            return data[:2] + bytes((errno.ENOENT,))
        self.set_parameter(index, struct.unpack_from(self._param_format(index), data, 2)[0], t)
        return data[:2] + self._packed(index)

    def _param_misc(self, data: bytes, t: float) -> bytes | None:
        if data[:1] in (b"\x06", b"\x08"):  # default value
            (index,) = struct.unpack_from("<H", data, 1)
            if index >= len(self.values):
                return data[:3] + bytes((errno.ENOENT,))
            form = self._param_format(index)
            default = struct.pack(form, crtp.saturate(self._params[index].value, form[1]))
            return data[:3] + (b"\0" if data[:1] == b"\x08" else b"") + default
        return None

    def set_parameter(self, index: int, value: float, t: float) -> None:
        """Set a parameter (its index in the table), unless it can only be read."""
        entry = self._params[index]
        if entry.read_only:
            return
        self.values[index] = value
        if self._app is not None and index >= len(crtp.PARAM_ENTRIES):
            self._app.set_parameter(entry.full_name, value)
        if entry.full_name == "kalman.resetEstimation" and value:
            x, y, z = (self.values[crtp.PARAM_ID[f"kalman.initial{axis}"]] for axis in "XYZ")
            self.estimate.reset(t, (x, y, z))
        elif entry.full_name == "hlCommander.groupmask":
            self.firmware.groups = int(value)
        elif entry.full_name == "stabilizer.stop" and value:
            self.firmware.supervisor.stop("parameter stabilizer.stop")
