"""The far end of one link: answers the host's packets and sends the log data that it asked for."""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

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


@dataclass(frozen=True, slots=True)
class OnboardApp:
    """An app on board: it adds parameters and log variables, and receives packets of the app channel."""

    parameters: Sequence[crtp.VariableEntry]
    logs: Sequence[crtp.VariableEntry]
    receive: Callable[[bytes], object]
    get_parameter: Callable[[str], float]
    set_parameter: Callable[[str, float], None]
    log_values: Callable[[], Mapping[str, float]]


class CrtpPeer:
    """Protocol state of one simulated Crazyflie: log blocks and parameter values. Times (`t`) are s, the fleet's clock.

    The last byte of its address is its number, by which packets to several name it.
    """

    def __init__(self, firmware: Firmware, estimate: Estimate, protocol: int = 12, number: int = 1) -> None:
        self.firmware = firmware
        self.estimate = estimate
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
            (crtp.PLATFORM, 1): lambda data, t: bytes((0, protocol)) if data[0] == 0 else None,
            (crtp.PLATFORM, 2): self._app_channel,
            (crtp.LOG, 0): lambda data, t: self._log_table.answer(data),
            (crtp.LOG, 1): self._log_settings,
            (crtp.PARAM, 0): lambda data, t: self._param_table.answer(data),
            (crtp.PARAM, 1): self._param_read,
            (crtp.PARAM, 2): self._param_write,
            (crtp.PARAM, 3): self._param_default,
            (crtp.MEMORY, 0): lambda data, t: b"\x01\0" if data[0] == 1 else None,  # there are none
            (crtp.COMMANDER, 0): lambda data, t: self.firmware.manual(data, t),
            (crtp.LOCALIZATION, 0): lambda data, t: self._positioned(struct.unpack_from("<3f", data)),
            (crtp.LOCALIZATION, 1): self._localization,
            (crtp.LOCALIZATION, 2): lambda data, t: self._packed_positions("<B3h", data),
            (crtp.GENERIC_COMMANDER, 0): lambda data, t: self.firmware.stream(data, t),
            (crtp.GENERIC_COMMANDER, 1): lambda data, t: None if data[0] else self.firmware.notify_stop(),
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
        self._param_table = crtp.VariableTable(self._params, log=False)
        self._log_table = crtp.VariableTable(self._logs, log=True)
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
                data = b"".join(crtp.pack_value(values[name], form) for name, form in block.variables)
                yield crtp.pack(crtp.LOG, 2, bytes((number,)) + stamp + data)

    # -- handlers: request's data and time in, reply's data out -----------------------------------------------------
    def _app_channel(self, data: bytes, t: float) -> None:
        if self._app is not None:
            self._app.receive(data)

    def _platform(self, data: bytes, t: float) -> bytes | None:
        supervisor = self.firmware.supervisor
        if data[0] == 1:
            return bytes((1, supervisor.request_arming(bool(data[1])), supervisor.armed))
        if data[0] == 2:
            recovered = supervisor.request_recovery()
            return bytes((2, recovered, recovered))
        return None

    def _supervisor_info(self, data: bytes, t: float) -> bytes | None:
        if data[0] != 0x0C:
            return None
        info = log_values(self.estimate, self.firmware, t)["supervisor.info"]
        return struct.pack("<BH", 0x8C, int(info))

    def _supervisor_command(self, data: bytes, t: float) -> bytes | None:
        reply = self._platform(data, t)
        if reply is not None:
            return bytes((0x80 | reply[0],)) + reply[1:]
        return self._emergency(data[0], t)

    def _positioned(self, place: Sequence[float]) -> None:
        """A position from outside, m, world."""
        self.positions_received += 1
        x, y, z = place
        if math.isfinite(x + y + z):
            self.estimate.correct((x, y, z), max(self.values[crtp.PARAM_ID["locSrv.extPosStdDev"]], 1e-4))

    def _packed_positions(self, form: str, data: bytes) -> None:
        """Places of several: id, mm, and with poses the attitude in 32 bits."""
        size = struct.calcsize(form)
        for number, *values in struct.iter_unpack(form, data[: len(data) // size * size]):
            if number == self.number:
                self._positioned([value / 1000 for value in values[:3]])

    def _localization(self, data: bytes, t: float) -> bytes | None:
        if data[0] == 8:
            self._positioned(struct.unpack_from("<7f", data, 1)[:3])
        elif data[0] == 9:
            self._packed_positions("<B3hI", data[1:])
        else:
            self._emergency(data[0], t)
        return None

    def _emergency(self, kind: int, t: float) -> None:
        if kind == 3:
            self.firmware.supervisor.stop("emergency stop")
        elif kind == 4:
            self.firmware.supervisor.watchdog(t)

    def _log_settings(self, data: bytes, t: float) -> bytes | None:
        command = data[0]
        if command == 5:
            self.blocks.clear()
            return b"\x05\0\0"
        number = data[1]
        block = self.blocks.get(number)
        error = 0
        if command not in (2, 3, 4, 6, 7):
            error = errno.ENOEXEC
        elif command == 6:
            error = errno.EEXIST if block is not None else self._log_append(LogBlock(), number, data[2:])
        elif block is None:
            error = errno.ENOENT
        elif command == 7:
            error = self._log_append(block, number, data[2:])
        elif command == 2:
            del self.blocks[number]
        else:
            block.period = data[2] if command == 3 else 0
            block.phase = int(t * 100)
        return bytes((command, number, error))

    def _log_append(self, block: LogBlock, number: int, data: bytes) -> int:
        """Add variables to a block; 0, or an error number of the firmware's."""
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

    def _param_read(self, data: bytes, t: float) -> bytes:
        (index,) = struct.unpack_from("<H", data)
        if index >= len(self.values):
            return data[:2] + bytes((errno.ENOENT,))
        return data[:2] + b"\0" + self._packed(index)

    def _packed(self, index: int) -> bytes:
        entry = self._params[index]
        if self._app is not None and index >= len(crtp.PARAM_ENTRIES):
            self.values[index] = self._app.get_parameter(entry.full_name)
        return crtp.pack_value(self.values[index], crtp.PARAM_TYPES[entry.type][1])

    def _param_write(self, data: bytes, t: float) -> bytes:
        (index,) = struct.unpack_from("<H", data)
        if index >= len(self.values):
            return data[:2] + bytes((errno.ENOENT,))
        form = crtp.PARAM_TYPES[self._params[index].type][1]
        self.set_parameter(index, struct.unpack_from("<" + form, data, 2)[0], t)
        return data[:2] + self._packed(index)

    def _param_default(self, data: bytes, t: float) -> bytes | None:
        if data[0] not in (6, 8):
            return None
        (index,) = struct.unpack_from("<H", data, 1)
        if index >= len(self.values):
            return data[:3] + bytes((errno.ENOENT,))
        entry = self._params[index]
        default = crtp.pack_value(entry.value, crtp.PARAM_TYPES[entry.type][1])
        return data[:3] + (b"\0" if data[0] == 8 else b"") + default

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
