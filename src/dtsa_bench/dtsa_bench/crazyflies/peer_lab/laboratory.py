"""A flight in the laboratory: apps, radios, air, vehicles and ground on one time line."""

from __future__ import annotations

import math
import shutil
import struct
import tempfile
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.crazyflies.simulated.crtp import LOG_ENTRIES, PARAM_ENTRIES
from dtsa_bench.crazyflies.simulated.estimate import log_values
from dtsa_bench.crazyflies.simulated.fleet_config import FleetConfig
from dtsa_bench.crazyflies.simulated.motion import TICK_S, FleetMotion
from dtsa_bench.crazyflies.simulated.peer import CrtpPeer, OnboardApp
from dtsa_bench.crazyflies.simulated.planner import DISABLED, FLYING, IDLE, LANDING
from dtsa_bench.crazyflies.simulated.radio.air import BITRATES, RATE_NAMES, TURN_NS, RadioAir
from dtsa_bench.crazyflies.simulated.truth import TruthLog
from dtsa_channel_sim.model.air import Lines
from dtsa_channel_sim.model.airtime import HEADER_BYTES, airtime_of
from dtsa_channel_sim.model.medium import Mask, OnAir

from .app import App, LabSettings
from .compiling import compile_app, engine_library
from .engine import AppCommand, AppError, Engine, EngineEvent, decode_setpoint
from .polling import Polling
from .record import Observer, PeerPacket, Record

TICK_NS = round(TICK_S * 1e9)
ADDRESS = 0xE7E7E7E700  # of the radios, but for their last byte, which is the id
_NAMES = [entry.full_name for entry in LOG_ENTRIES]
_KNOWN = [entry.full_name for entry in PARAM_ENTRIES]
_OWN_NAMES = ["lab.priority", "lab.planner"]
_PLANNER = {IDLE: 0, FLYING: 1, LANDING: 3, DISABLED: 4}  # firmware/crtp_commander_high_level.h
_NEAR_RSSI, _NEAREST_M = 40, 0.1  # -dBm at 1 m
_FOREIGN_RSSI = 60
_TAKE_OFF, _LAND = 7, 8  # packets of the high-level commander


class Laboratory:
    """Apps that fly. One process has one at a time; a crash of an app ends the process with a line that names it.

    :param out: directory for files; None: none are written.
    :param observers: look on beside the record. :param air: with other radios; `first`: id on it of the first vehicle.
    :raises CompileError: the app does not compile.
    """

    def __init__(
        self, app: App, settings: LabSettings | None = None, out: Path | None = None,
        observers: Sequence[Observer] = (), air: RadioAir | None = None, first: int = 1,
    ) -> None:  # fmt: skip
        self.settings = settings = settings or LabSettings()
        self.app = app
        self.now_ns = 0
        count = settings.agents
        airtime = airtime_of("crazyflie", BITRATES[settings.rate], TURN_NS, 0)
        line = airtime.line
        self._directory = tempfile.TemporaryDirectory(prefix="dtsa-peer-lab-")
        self._library = Path(self._directory.name) / "app.so"
        self.warnings = compile_app(app, self._library)
        self._copies = 0
        self._engine = Engine(
            engine_library(), count, [*_NAMES, *_OWN_NAMES], _KNOWN, line.to_fixed_ns, line.to_byte_ns,
            round(settings.spin_ms * 1e6),
        )  # fmt: skip
        self.record = Record(count, app.addressed, out)
        self._observers: tuple[Observer, ...] = (self.record, *observers)
        config = FleetConfig(
            count=count, start=settings.start, seed=settings.seed, noise=settings.noise, arming=settings.arming
        )
        header = {"count": count, "seed": settings.seed, "start": np.asarray(config.start).tolist()}
        self._truth = TruthLog(out / "truth.jsonl" if out else None, header)
        self.motion = FleetMotion(config, self._report)
        self.peers = [CrtpPeer(*both) for both in zip(self.motion.firmware, self.motion.estimates, strict=True)]
        streams = np.random.SeedSequence(settings.seed).spawn(2)
        # Without one given: all vehicles, a ground station and a foreign radio.
        self.air = air or RadioAir(count + 2, settings.loss, int(streams[0].generate_state(1)[0]))
        self.agenda, self._first = self.air.agenda, first
        self._lines = Lines(airtime, count)
        self.overflows = np.zeros(count, np.int64)  # receptions that found a radio's queue full
        self._handed: list[deque[PeerPacket]] = [deque() for _ in range(count)]  # to the processor, not to the app yet
        #: What an app sends to the ground: s, id, packet of the app channel.
        self.from_apps: list[tuple[float, int, bytes]] = []
        self._on = [False] * count
        self._power_cycles = [0] * count  # how often each was switched off
        self._parameters: list[dict[str, float]] = [dict(app.parameters) for _ in range(count)]
        self.polling = Polling(self.air, settings, self.receive_poll) if settings.polls else None
        generator = np.random.default_rng(streams[1])
        starts = (generator.random(count) * settings.boot_s * 1e9).astype(np.int64).tolist()
        drifts = np.rint(generator.uniform(-1.0, 1.0, count) * settings.drift_ppm * 1000).astype(np.int64)
        self._drifts: list[int] = drifts.tolist()
        for k, start in enumerate(starts):
            self.at(start / 1e9, lambda k=k: self.switch_on(k + 1))  # type: ignore[misc]
        self.agenda.at(TICK_NS, self._tick)

    def __enter__(self) -> Laboratory:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End of the flight."""
        self.record.close()
        self._truth.close()
        self._engine.close()
        self._directory.cleanup()

    # -- time -------------------------------------------------------------------------------------------------------
    @property
    def time(self) -> float:
        """Virtual time, s."""
        return self.now_ns / 1e9

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Let the ground do something at an instant (s, now or later); it may call all that is below."""
        self.agenda.at(max(self.now_ns, round(time_s * 1e9)), action)

    def run(self, until_s: float) -> None:
        """Fly on; AppError: an app did what no app may do."""
        until_ns = round(until_s * 1e9)
        while True:
            due = self.agenda.next_ns
            target = until_ns if due is None else min(due, until_ns)
            report = self._engine.run(target)
            if report.kind != EngineEvent.NONE:
                self.now_ns = report.time_ns
                self._handle_event(report)
                continue
            self.now_ns = target
            if due is None or due >= until_ns:
                return
            self.agenda.run(due)

    def summary(self) -> dict[str, Any]:
        """What came of it."""
        return {
            "app": self.app.name,
            "seed": self.settings.seed,
            **self.record.summary(self.now_ns),
            "queue_overflows": int(self.overflows.sum()),
            "polls_answered": self.polling.answered if self.polling else None,
        }

    # -- what apps tell and ask -------------------------------------------------------------------------------------
    def _handle_event(self, report: Any) -> None:
        k, now, data = report.vehicle, report.time_ns, bytes(report.data[: report.size])
        kind = EngineEvent(report.kind)
        if kind is EngineEvent.SEND:
            packet, at_ns = PeerPacket(k + 1, data, now), report.other_ns
            self._notify("sent", k + 1, now, packet)
            self.agenda.at(at_ns, lambda: self._order_to_send(packet, at_ns))
        elif kind is EngineEvent.HEARD:
            packet = self._handed[k].popleft()
            if report.code >= 0:
                self._notify("heard", k + 1, now, packet)
        elif kind is EngineEvent.COMMAND:
            report.answer = self._command(k, AppCommand(report.code), data)
            self._notify("command", k + 1, now, (report.code, data))
            self.update_app(k)
        elif kind is EngineEvent.PRINT:
            self._notify("print", k + 1, now, data.decode("utf-8", "replace"))
        elif kind is EngineEvent.RECORD:
            self._notify("record", k + 1, now, data)
        elif kind is EngineEvent.APP_CHANNEL:
            self.from_apps.append((now / 1e9, k + 1, data))
            self._notify("app_channel", k + 1, now, data)
        elif kind is not EngineEvent.ENDED:
            text = data.decode("utf-8", "replace")
            reason = {
                EngineEvent.SPINS: f"task {text} has not waited for {self.settings.spin_ms:g} ms: it never yields",
                EngineEvent.ASSERT: f"assertion failed in {text}",
            }.get(kind, f"it used {text}")
            raise AppError(f"app of agent {k + 1} at {now / 1e9:.6f} s: {reason}")

    def _notify(self, kind: str, agent: int, now_ns: int, content: Any) -> None:
        for observer in self._observers:
            observer(kind, agent, now_ns, content)

    def _command(self, k: int, command: AppCommand, data: bytes) -> int:
        firmware, t = self.motion.firmware[k], self.time
        values = struct.unpack(f"<{len(data) // 4}f", data[: len(data) // 4 * 4])
        if command is AppCommand.SETPOINT:
            priority, setpoint = decode_setpoint(data, t, firmware.yaw)
            self.record.setpoints += 1
            firmware.offer(setpoint, priority)
        elif command is AppCommand.RELAX:
            firmware.notify_stop()
        elif command is AppCommand.DISABLE:
            firmware.planner.state = DISABLED
        elif command is AppCommand.PARAMETER:
            self.peers[k].set_parameter(round(values[0]), values[1], t)
        elif command is AppCommand.STOP:
            return firmware.high_level(bytes((3, 0)), t)
        elif command is AppCommand.GO_TO:
            return self._go_to(k, values[:3], values[3], values[4], bool(values[5]))
        elif command is AppCommand.ARM:
            return int(firmware.supervisor.request_arming(bool(values[0])))
        elif command is AppCommand.RECOVER:
            return int(firmware.supervisor.request_recovery())
        else:
            height, duration, yaw, keep = values
            kind = _TAKE_OFF if command is AppCommand.TAKEOFF else _LAND
            return self._change_height(k, kind, height, duration, yaw, bool(keep))
        return 0

    def _change_height(self, k: int, kind: int, height: float, duration: float, yaw: float, keep: bool) -> int:
        packet = struct.pack("<BBff?f", kind, 0, height, yaw, keep, duration)
        return self.motion.firmware[k].high_level(packet, self.time)

    def _go_to(self, k: int, place: Any, yaw: float, duration: float, relative: bool) -> int:
        packet = struct.pack("<BB??5f", 12, 0, relative, False, *place, yaw, duration)
        return self.motion.firmware[k].high_level(packet, self.time)

    # -- world ------------------------------------------------------------------------------------------------------
    def _tick(self) -> None:
        self.motion.step((self.now_ns - TICK_NS) / 1e9)
        position = self.motion.vehicles.position
        self._notify("positions", 0, self.now_ns, position)
        self._truth.positions(self.time, position)
        for k, on in enumerate(self._on):
            if on:
                self.update_app(k)
        self.agenda.at(self.now_ns + TICK_NS, self._tick)

    def update_app(self, k: int) -> None:
        """Tell a vehicle's app (by its index) what its firmware knows."""
        firmware = self.motion.firmware[k]
        values = log_values(self.motion.estimates[k], firmware, self.time)
        own = firmware.priority, _PLANNER[firmware.planner.state]
        self._engine.firmware_logs[k][:] = [*(values[name] for name in _NAMES), *own]
        self._engine.firmware_parameters[k][:] = self.peers[k].values[: len(_KNOWN)]

    def _report(self, index: int, name: str, **details: Any) -> None:
        self._notify("event", index + 1, self.now_ns, name)
        self._truth.event(self.time, index + 1, name, **details)

    # -- air --------------------------------------------------------------------------------------------------------
    def _order_to_send(self, packet: PeerPacket, at_ns: int) -> None:
        """A packet has come over the line to a radio: it is sent as soon as the radio can."""
        start_ns = self._lines.start_ns(packet.sender, at_ns, len(packet.data))
        self._start_sending(packet, self._first + packet.sender - 1, start_ns)

    def _start_sending(self, packet: PeerPacket, radio: int, start_ns: int) -> None:
        length = HEADER_BYTES + len(packet.data)
        frame = self.air.send(self.settings.channel, self.settings.rate, radio, start_ns, length)
        self.agenda.at(frame.end_ns, lambda: self._resolve(packet, frame))

    def _resolve(self, packet: PeerPacket, frame: OnAir) -> None:
        """Find the receivers of a packet that has left the air."""
        self.record.on_air_ns += frame.end_ns - frame.air_ns
        self.deliver_packet(packet, self.air.receivers_of(self.settings.channel, frame), frame)

    def deliver_packet(self, packet: PeerPacket, heard: set[int], frame: OnAir) -> None:
        """A packet has left the air; `heard` has the ids on the air of the radios that can decode it."""
        received = np.array([on and k in heard for k, on in enumerate(self._on, self._first)])
        for agent in self._hand_over(frame.end_ns, len(packet.data), received):
            done_ns, life = self._lines.handed_ns(agent), self._power_cycles[agent - 1]
            self.agenda.at(done_ns, lambda agent=agent, at=done_ns, life=life: self._deliver(agent, at, packet, life))  # type: ignore[misc]

    def _hand_over(self, now_ns: int, length: int, received: Mask) -> list[int]:
        """Radios that have received something hand it over, if their queues have room; the ids of these."""
        taken, _ = self._lines.receive(now_ns, length, received)
        self.overflows += received & ~taken
        return (np.flatnonzero(taken) + 1).tolist()

    def receive_poll(self, agent: int, t: float) -> None:
        """A packet of a ground station has come to a radio, at t (s)."""
        received = np.zeros(self.settings.agents, dtype=np.bool_)
        received[agent - 1] = self._on[agent - 1]
        self._hand_over(round(t * 1e9), 0, received)

    def _deliver(self, agent: int, now_ns: int, packet: PeerPacket, life: int) -> None:
        k, rssi = agent - 1, _FOREIGN_RSSI
        if life != self._power_cycles[k]:
            return  # its power was off meanwhile
        if packet.sender:  # by the distance, without fading
            position = self.motion.vehicles.position
            distance = float(np.linalg.norm(position[:, packet.sender - 1] - position[:, k]))
            rssi = round(_NEAR_RSSI + 20.0 * math.log10(max(_NEAREST_M, distance)))
        if self._engine.receive(k, now_ns, packet.raw, rssi):
            self._handed[k].append(packet)

    def is_on(self, agent: int) -> bool:
        """Whether a vehicle is switched on."""
        return self._on[self._index(agent)]

    # -- the ground -------------------------------------------------------------------------------------------------
    def _index(self, agent: int) -> int:
        if not 1 <= agent <= self.settings.agents:
            raise ConfigError("agent", agent, f"1 to {self.settings.agents}")
        return agent - 1

    def switch_on(self, agent: int) -> None:
        """Power on: the app begins anew, with the parameters that the ground has set."""
        k = self._index(agent)
        if self._on[k]:
            return
        self._copies += 1
        # What is loaded from a copy of its own has variables of its own.
        copy = Path(shutil.copyfile(self._library, Path(self._directory.name) / f"agent_{agent}_{self._copies}.so"))
        self.update_app(k)
        speed = RATE_NAMES.index(self.settings.rate)
        self._engine.boot(k, copy, self.now_ns, self._drifts[k], ADDRESS + agent, self.settings.channel, speed)
        copy.unlink()
        self._on[k] = True
        engine = self._engine
        self.peers[k].adopt(OnboardApp(
            engine.entries(k, parameters=True), engine.entries(k, parameters=False), partial(self.send, agent),
            partial(engine.get, k, parameter=True), lambda name, value: engine.set(k, self.now_ns, name, value),
            partial(self.logs, agent),
        ))  # fmt: skip
        for name, value in self._parameters[k].items():
            self.set_parameter(agent, name, value)

    def switch_off(self, agent: int) -> None:
        """Power off: app and firmware forget all."""
        k = self._index(agent)
        if self._on[k]:
            self._on[k] = False
            self._engine.off(k)
            self._power_cycles[k] += 1
            self._lines.reset(agent)
            self._handed[k].clear()
            self.motion.firmware[k].reset()
            self.peers[k].reset()

    def set_parameter(self, agent: int, name: str, value: float) -> None:
        """Set a parameter (group.name) of the app, now and after each power on; ConfigError: it has none such."""
        k = self._index(agent)
        self._parameters[k][name] = value
        if self._on[k]:
            self._engine.set(k, self.now_ns, name, value)

    def parameter(self, agent: int, name: str) -> float:
        """Value of a parameter of the app; ConfigError: it has none of that name, or is switched off."""
        return self._engine.get(self._index(agent), name, parameter=True)

    def log(self, agent: int, name: str) -> float:
        """Value of a log variable, the firmware's or the app's; ConfigError: there is none, or it is switched off."""
        k = self._index(agent)
        if name in _NAMES:
            return float(self._engine.firmware_logs[k][_NAMES.index(name)])
        return self._engine.get(k, name, parameter=False)

    def logs(self, agent: int) -> dict[str, float]:
        """All log variables of the app; none while it is switched off."""
        k = self._index(agent)
        return {name: self._engine.get(k, name, parameter=False) for name in self._engine.names(k, parameters=False)}

    def send(self, agent: int, data: bytes) -> bool:
        """A packet of the app channel (at most 30 bytes); False: the app's queue of ten is full."""
        if len(data) > 30:
            raise ConfigError("app channel", len(data), "at most 30 bytes")
        k = self._index(agent)
        return not self._on[k] or self._engine.app_channel(k, self.now_ns, data)

    def transmit(self, data: bytes, port: int = 0) -> None:
        """A foreign radio on the channel sends a packet (at most 60 bytes) now, whatever else is on the air."""
        packet = PeerPacket(0, bytes((port,)) + data, self.now_ns)
        self._start_sending(packet, self.settings.agents + 2, self.now_ns)

    def set_loss(self, loss: float) -> None:
        """From now on receivers lose another share of frames."""
        self.air.set_loss(loss)

    # Orders of the ground, by a vehicle's id; m, s. False: the firmware refuses.
    def arm(self, agent: int, arm: bool = True) -> bool:
        """Arm or disarm."""
        return self._then_update(agent, self.motion.firmware[self._index(agent)].supervisor.request_arming(arm))

    def take_off(self, agent: int, height: float, duration: float) -> bool:
        """High-level take-off."""
        error = self._change_height(self._index(agent), _TAKE_OFF, height, duration, 0.0, True)
        return self._then_update(agent, not error)

    def land(self, agent: int, height: float, duration: float) -> bool:
        """High-level landing."""
        self.motion.firmware[self._index(agent)].notify_stop()
        return self._then_update(agent, not self._change_height(agent - 1, _LAND, height, duration, 0.0, True))

    def go_to(self, agent: int, x: float, y: float, z: float, duration: float) -> bool:
        """High-level flight to a place."""
        return self._then_update(agent, not self._go_to(self._index(agent), (x, y, z), 0.0, duration, False))

    def emergency(self, agent: int) -> None:
        """Emergency stop: latches until it is switched off and on."""
        self.motion.firmware[self._index(agent)].supervisor.stop("emergency stop")

    def _then_update(self, agent: int, done: bool) -> bool:
        self.update_app(agent - 1)
        return done
