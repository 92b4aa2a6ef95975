"""All Crazyflies of a swarm: connects them, watches over them, and lands them. Without ROS."""

from __future__ import annotations

import fcntl
import hashlib
import math
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.scenario import make_scenario

from .addresses import WATCHDOG_HZ, check_budget, parse_address
from .link import SIMULATED_RADIO, require_cflib
from .onboard import OnboardSetup, app_orders, app_parameters, key_of
from .safety import Action, RequiredAction, SafetyMonitor
from .settings import SwarmSettings
from .state import OFF, WATCHED, State, VehicleState
from .vehicle import CrazyflieVehicle

TICK_S = 0.02
STALLED_S = 0.5  # between two ticks: the process stood still, and has not received the heartbeats that came meanwhile
GROUNDED_S = 5.0  # s of silence after which a lost vehicle is on the ground: the firmware has seen to that


def own_addresses(robots: Iterable[tuple[str, str]]) -> ExitStack:
    """Lock the addresses (name, URI) of Crazyflies among the processes of a machine, until what it returns is closed.

    A Crazyflie belongs to one bridge at a time: two that send to it would both believe to be alone.

    :raises ConfigError: another bridge has one of them.
    """
    directory = Path(tempfile.gettempdir()) / f"dtsa-crazyflies-{os.getuid()}"
    directory.mkdir(mode=0o700, exist_ok=True)
    with ExitStack() as files:
        for name, uri in robots:
            air = os.environ.get(SIMULATED_RADIO, "") if uri.startswith("radio://") else ""  # one of several
            digest = hashlib.sha256((air + parse_address(uri).link).encode()).hexdigest()
            file = files.enter_context((directory / digest).open("w"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise ConfigError(f"robots.{name}.uri", uri, "a Crazyflie that no other bridge here uses") from None
        return files.pop_all()


class Bridge:
    """The swarm. Its own thread applies the safety rules 50 times a second.

    :param on_state: called with a vehicle, its new state, and when that was measured (s, monotonic), by the link.
    :raises ConfigError: cflib is missing, or the radios cannot carry the swarm.
    """

    def __init__(
        self, settings: SwarmSettings, log: Callable[[str, str], None],
        on_state: Callable[[CrazyflieVehicle, VehicleState, float], None] | None = None,
    ) -> None:  # fmt: skip
        self.settings = settings
        station = settings.station
        for line in settings.describe():
            log("info", line)
        check_budget(settings.loads, force=station.force_budget)
        require_cflib()
        self._owned = own_addresses((robot.name, robot.uri) for robot in settings.robots)
        self._log = log
        caches = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        cache = Path(station.toc_cache or caches / "dtsa/crazyflie").expanduser()
        cache.mkdir(parents=True, exist_ok=True)
        self.vehicles = {r.name: CrazyflieVehicle(r, station, cache, log, on_state) for r in settings.robots}
        if (swarm := settings.swarm) is not None:
            self._prepare_apps(swarm)
        from .drivers import DongleSet  # needs cflib

        self.radios = DongleSet(((r.name, r.address) for r in settings.robots), log)
        self.monitor = SafetyMonitor(station.safety)
        self.heartbeat: float | None = None  # s, monotonic: the ground station's last; its silence stops the swarm
        self.ends = False  # it brings all down by itself: heartbeats, or their silence, do not count any more
        self._failing: dict[Callable[..., Any], str] = {}  # parts of the rules: why
        self._closing = threading.Event()
        self._guard = threading.Thread(target=self._run_rules, name="safety", daemon=True)
        self._guard.start()

    def connect(self, stop: object = False) -> list[str]:
        """Connect all in parallel and wait, until `stop` is true; the names of those that are not connected."""
        for thread in [vehicle.connect() for vehicle in self.vehicles.values()]:
            while thread.is_alive() and not stop:
                thread.join(0.1)
        return [v.name for v in self.vehicles.values() if v.state in OFF]

    def _prepare_apps(self, swarm: SwarmConfig) -> None:
        scenario, station = make_scenario(swarm), self.settings.station
        values = app_parameters(swarm, scenario, station.room_origin_in_world[2])
        orders = app_orders(swarm, scenario, key_of(swarm))
        for vehicle in self.vehicles.values():
            own = {name: vehicle.robot.firmware_params.get(name, value) for name, value in values.items()}
            vehicle.link.board = OnboardSetup(own, orders, station.on_board.polls_hz)

    def start_agents(self) -> str:
        """Start the agents on board of those that are connected, all at once; why some do not start, or ""."""
        vehicles = [v for v in self.vehicles.values() if v.link.connected and v.link.board is not None]
        with ThreadPoolExecutor(max(1, len(vehicles))) as pool:
            problems = pool.map(lambda vehicle: vehicle.link.start_agent(), vehicles)
            return "; ".join(f"{v.name}: {text}" for v, text in zip(vehicles, problems, strict=True) if text)

    def reconnect(self, name: str) -> str:
        """Connect one again that is lost, disconnected or stopped; why not, or an empty text. Does not wait."""
        vehicle = self.vehicles[name]
        with vehicle.lock:
            state, age = vehicle.state, vehicle.log_age(time.monotonic())
            if state == State.LOST and age < GROUNDED_S:
                wait = f"wait until it was silent for {GROUNDED_S:g} s (now {age:.1f} s)"
                return f"{name} may still be in the air: {wait}"
            if state not in (State.LOST, State.DISCONNECTED, State.EMERGENCY):
                return f"{name} is {state.name.lower()}"
            vehicle.connect(rejoin=True)
        return ""

    def order_each(self, names: Iterable[str], order: Callable[[CrazyflieVehicle], str | None]) -> tuple[bool, str]:
        """Give an order to several; success and why not for those that refused.

        With more than one name, those that are not there are skipped: one missing drone must not ground the swarm.
        """
        vehicles = [self.vehicles[name] for name in names]
        absent = [v for v in vehicles if len(vehicles) > 1 and v.state in (*OFF, State.EMERGENCY, State.LOST)]
        given = [v for v in vehicles if v not in absent]
        refused = [problem for v in given if (problem := order(v))]
        text = "; ".join([*(f"{v.name} skipped: {v.state_text}" for v in absent), *refused])
        if text:
            self._log("warn", text)
        return len(given) > 0 and not refused, text

    def why_no_takeoff(self) -> str:
        """Why the swarm may not take off; empty if it may."""
        needed = self.settings.station.min_connected
        usable = sum(v.state in (State.READY, *WATCHED) for v in self.vehicles.values())
        return f"{usable} Crazyflies are usable, min_connected is {needed}" if usable < needed else ""

    def land_all(self, reason: str) -> None:
        for vehicle in self.vehicles.values():
            if vehicle.state in (State.ARMED, State.FLYING):
                vehicle.land(reason)

    def stop_all(self, reason: str) -> None:
        self._log("error", f"EMERGENCY STOP of all: {reason}")
        self.radios.stop_all()
        for vehicle in self.vehicles.values():
            vehicle.stop(reason)

    def _run_rules(self) -> None:
        keep_alive, vehicles, awake, last = 0.0, self.vehicles.values(), -math.inf, time.monotonic()
        while not self._closing.wait(TICK_S):
            now = time.monotonic()
            awake, last = now if now - last > STALLED_S else awake, now
            if now >= keep_alive:
                keep_alive = now + 1.0 / WATCHDOG_HZ - TICK_S
                for vehicle in vehicles:
                    self._attempt(vehicle.feed_watchdog, now)
            states = [self._attempt(vehicle.watched_state, now) for vehicle in vehicles]
            heartbeat = None if self.ends else self.heartbeat
            age = None if heartbeat is None else now - max(heartbeat, awake)
            for required in self._attempt(self.monitor.check, now, list(filter(None, states)), age) or ():
                self._attempt(self._carry_out, required, now)
            for vehicle in vehicles:
                self._attempt(vehicle.tick, now)

    def _attempt(self, act: Callable[..., Any], *arguments: Any) -> Any:
        """Do a part of the rules; if it fails, say so once: the other rules, and those of other vehicles, go on."""
        try:
            done = act(*arguments)
        except Exception as error:
            text = f"safety: {type(error).__name__}: {error}"
            if self._failing.get(act) != text:
                self._failing[act] = text
                self._log("error", text)
            return None
        self._failing.pop(act, None)
        return done

    def _carry_out(self, required: RequiredAction, now: float) -> None:
        action, reason = required.action, required.reason
        level = "warn" if action in (Action.WARN, Action.HOLD) else "error"
        self._log(level, f"{required.name or 'all'}: {required.rule}: {reason}: {action.value}")
        if action is Action.STOP_ALL:
            self.stop_all(reason)
            return
        vehicle = self.vehicles[required.name]
        if action is Action.WARN:
            vehicle.action = reason
        elif action is Action.HOLD:
            vehicle.hold_place(reason, stale=True, until_seen=required.rule == "positions")
        elif action is Action.LAND:
            vehicle.land(reason)
        elif action is Action.LOST:
            vehicle.declare_lost(reason, now)
        else:
            vehicle.stop(reason)

    def names_in_air(self, now: float) -> list[str]:
        """Names of those whose link must not be closed now."""
        return [
            v.name
            for v in self.vehicles.values()
            if v.state in WATCHED or (v.state == State.LOST and v.log_age(now) < GROUNDED_S and v.link.connected)
        ]

    def wait_landed(self, stop: Callable[[], bool]) -> list[str]:
        """Wait until all stand, `stop` is true, or the station's time is over; the names of those that still fly."""
        end = time.monotonic() + self.settings.station.landing_timeout_s
        while True:
            now = time.monotonic()
            flying = self.names_in_air(now)
            for name in flying:  # armed on the ground: nothing to wait for but the lock of the motors
                vehicle = self.vehicles[name]
                if vehicle.state == State.ARMED:
                    vehicle.arm(False)
            if not flying or now > end or stop():
                return flying
            time.sleep(TICK_S)

    def close(self) -> None:
        """Close all links in parallel. One that flies is stopped first: a closed link would let it fall anyway."""
        flying = self.names_in_air(time.monotonic())
        for name in flying:
            self.vehicles[name].stop("the bridge ends")
        self._closing.set()
        self._guard.join(1.0)
        guarded = [v.name for v in self.vehicles.values() if v.guarded]
        if guarded:
            why = "locked by the emergency watchdog within 1 s: restart before flying again"
            self._log("info", f"{', '.join(guarded)}: {why}")
        with ThreadPoolExecutor(len(self.vehicles)) as pool:
            list(pool.map(lambda vehicle: vehicle.link.close(), self.vehicles.values()))
        self.radios.close()
        self._owned.close()
