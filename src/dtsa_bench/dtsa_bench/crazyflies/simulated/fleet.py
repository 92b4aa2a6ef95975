"""A fleet of simulated Crazyflies: one process and one thread for all of them.

Each has a UDP port of its own, or all are reached by simulated radios.
"""

from __future__ import annotations

import contextlib
import json
import selectors
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.crazyflies.simulated.radio.side import RadioServer

from .fleet_config import HOST, FleetConfig
from .motion import TICK_S, FleetMotion
from .peer import CrtpPeer
from .process import NUMBERS, check_fault
from .truth import TruthLog

MAX_LAG_S = 0.5  # a machine that lags further behind skips time, and the record says so


@dataclass(slots=True)
class _Link:
    """Socket and link faults of one vehicle."""

    socket: socket.socket | None = None  # None: a radio's, or closed by a fault
    host: tuple[str, int] | None = None  # of the last datagram
    drop_up: float = 0.0
    drop_down: float = 0.0
    frozen: bool = False
    heal_at: float | None = None


class Fleet:
    """The fleet. `run()` flies it until `stop()` is called from anywhere; `shown` is called after each step.

    :raises ConfigError: a port is in use, or a file cannot be written.
    """

    def __init__(self, config: FleetConfig) -> None:
        self.config = config
        # epoll waits in whole milliseconds, which are long on the air.
        self._selector = selectors.SelectSelector() if config.radio.path is not None else selectors.DefaultSelector()
        self.radio: RadioServer | None = None
        self._links = [_Link() for _ in range(config.count)]
        self._loss = np.random.default_rng(np.random.SeedSequence(config.seed).spawn(3)[1])
        header = {
            "count": config.count, "uris": config.uris, "seed": config.seed, "protocol": config.protocol,
            "start": np.asarray(config.start).tolist(), "unix_time": time.time(),
        }  # fmt: skip
        try:
            self._open_sockets()
            self.truth = TruthLog(config.truth, header)
        except OSError as error:
            self.close()
            raise ConfigError("truth", str(config.truth), f"a file that can be written ({error.strerror})") from error
        except ConfigError:
            self.close()
            raise
        self.tick = 0
        self.motion = FleetMotion(config, self._report)
        self.vehicles, self.firmware, self.estimates = self.motion.vehicles, self.motion.firmware, self.motion.estimates
        self.peers = [
            CrtpPeer(f, e, config.protocol, k)
            for k, (f, e) in enumerate(zip(self.firmware, self.estimates, strict=True), 1)
        ]
        self._running = True
        self.shown: Callable[[], None] = lambda: None

    # -- life cycle -------------------------------------------------------------------------------------------------
    def _bind(self, port: int, serve: Callable[[], None]) -> socket.socket:
        sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sock.setblocking(False)
        try:
            sock.bind((HOST, port))
        except OSError as error:
            sock.close()
            raise ConfigError("port", port, f"a free UDP port ({error.strerror})") from error
        self._selector.register(sock, selectors.EVENT_READ, serve)
        return sock

    def _bind_link(self, index: int) -> None:
        self._links[index].socket = self._bind(self.config.base_port + index, partial(self._serve_link, index))

    def _open_sockets(self) -> None:
        if self.config.radio.path is not None:
            self.radio = RadioServer(self.config.radio, self._receive, self._passes)
            self.radio.listen(self._selector)
        else:
            for index in range(self.config.count):
                self._bind_link(index)
        if self.config.count:
            self._control = self._bind(self.config.control_port, self._serve_control)

    def close(self) -> None:
        """Release the ports and end the record."""
        if self.radio is not None:
            self.radio.close()
        for key in list((self._selector.get_map() or {}).values()):
            key.fileobj.close()  # type: ignore[union-attr]
        self._selector.close()
        if hasattr(self, "truth"):
            self.truth.close()

    def stop(self) -> None:
        """End `run()` soon. May be called from another thread or a signal handler."""
        self._running = False

    def run(self) -> None:
        """Fly in real time until `stop()`; then release everything."""
        origin = time.monotonic()
        try:
            while self._running:
                now = time.monotonic() - origin
                if now < (self.tick + 1) * TICK_S:
                    self._serve((self.tick + 1) * TICK_S - now)
                    continue
                if now - self.tick * TICK_S > MAX_LAG_S:
                    skipped = now - self.tick * TICK_S
                    origin += skipped
                    self.truth.event(self.time, 0, "machine too slow", skipped_s=round(skipped, 3))
                self.step()
                self.shown()
        finally:
            self.close()

    @property
    def time(self) -> float:
        """Seconds that the fleet has lived."""
        return self.tick * TICK_S

    # -- motion -----------------------------------------------------------------------------------------------------
    def step(self) -> None:
        """Fly for one tick of 10 ms and send what is due."""
        self.motion.step(self.time, self._tick)
        self.truth.positions(self.time, self.vehicles.position)
        self._send_logs()
        for k, link in enumerate(self._links):
            if link.heal_at is not None and self.time >= link.heal_at:
                self._apply("heal", k, {})

    def _tick(self) -> None:
        self.tick += 1

    def _report(self, index: int, name: str, **details: Any) -> None:
        self.truth.event(self.time, index + 1, name, **details)

    # -- links ------------------------------------------------------------------------------------------------------
    def _serve(self, timeout: float) -> None:
        for key, _ in self._selector.select(timeout if self.radio is None else self.radio.wait_s(timeout)):
            key.data()
        if self.radio is not None:
            self.radio.run()

    def _serve_link(self, index: int) -> None:
        link = self._links[index]
        while link.socket is not None:
            try:
                datagram, host = link.socket.recvfrom(256)
            except (BlockingIOError, ConnectionError):
                break
            if self._passes(index, True):
                link.host = host
                self._receive(index, datagram)

    def _passes(self, index: int, up: bool) -> bool:
        """Whether a packet passes the faults of a vehicle's link."""
        link = self._links[index]
        rate = link.drop_up if up else link.drop_down
        return not link.frozen and not (rate and self._loss.random() < rate)

    def _receive(self, index: int, packet: bytes, t: float = 0.0) -> None:
        reply = self.peers[index].receive(packet, self.time)
        if reply is not None:
            self._send(index, reply)

    def _send(self, index: int, packet: bytes) -> None:
        link = self._links[index]
        if self.radio is not None:
            self.radio.receivers[index].push(packet)
        elif link.socket is not None and link.host is not None and self._passes(index, False):
            # A host that has gone, or a full buffer: the packet is lost, as on the air.
            with contextlib.suppress(OSError):
                link.socket.sendto(packet, link.host)

    def _send_logs(self) -> None:
        for index, peer in enumerate(self.peers):
            has_host = self.radio is not None or self._links[index].host is not None
            packets = list(peer.log_packets(self.tick, self.time)) if peer.blocks and has_host else ()
            if packets and self.radio and not self.radio.receivers[index].connected(self.radio.now_ns() / 1e9):
                peer.blocks.clear()  # no host is there: the log ends
                continue
            for packet in packets:
                self._send(index, packet)

    # -- faults -----------------------------------------------------------------------------------------------------
    def _serve_control(self) -> None:
        try:
            data, host = self._control.recvfrom(2048)
        except (BlockingIOError, ConnectionError):
            return
        try:
            request = json.loads(data)
            if not isinstance(request, dict):
                raise ConfigError("request", request, "a JSON object")
            self.fault(request)
            answer: dict[str, Any] = {"ok": True, "t": self.time}
        except ConfigError as error:
            answer = {"ok": False, "field": error.field, "value": error.value, "allowed": error.allowed}
        except (ValueError, RecursionError):
            answer = {"ok": False, "field": "request", "value": data[:40].decode("ascii", "replace")}
            answer["allowed"] = "a JSON object"
        with contextlib.suppress(OSError):
            self._control.sendto(json.dumps(answer, default=str).encode(), host)

    def fault(self, request: dict[str, Any]) -> None:
        """Let vehicles fail (see `check_fault`); ConfigError: it is not understood."""
        name, indices = check_fault(request, self.config.count)
        for k in indices:
            self._apply(name, k, request)
            if "seconds" in request:
                self._links[k].heal_at = self.time + request["seconds"]

    def _apply(self, name: str, index: int, request: dict[str, Any]) -> None:
        link, firmware = self._links[index], self.firmware[index]
        supervisor = firmware.supervisor
        numbers = {key: value for key, value in request.items() if key in (*NUMBERS, "direction")}
        self._report(index, f"fault: {name}", **numbers)
        if name == "drop":
            rate, direction = request.get("rate", 1.0), request.get("direction", "both")
            link.drop_up = rate if direction in ("up", "both") else link.drop_up
            link.drop_down = rate if direction in ("down", "both") else link.drop_down
        elif name == "freeze" or (name == "close" and self.radio is not None):  # on the air nothing bounces
            link.frozen = True
        elif name == "close" and link.socket is not None:
            self._selector.unregister(link.socket)
            link.socket.close()
            link.socket = None
        elif name == "refuse_arming":
            supervisor.refuse_arming = True
        elif name == "tumble":
            supervisor.tumbled = True
        elif name == "estimate_jump":
            self.estimates[index].offset = (request.get("distance", 2.0), 0.0, 0.0)
        elif name == "estimate_freeze":
            self.estimates[index].frozen = True
        elif name == "battery":
            motors = supervisor.motors_allowed and supervisor.flying
            firmware.battery.force(request.get("voltage", 3.0), motors=motors)
        elif name == "unplug" and self.radio is not None:
            self.radio.unplug(request.get("dongle", 0))
        elif name in ("heal", "reboot"):
            self._heal(index)
            if name == "reboot":
                firmware.reset()
                self.peers[index].reset()
                if self.radio is not None:
                    self.radio.receivers[index].reset()

    def _heal(self, index: int) -> None:
        link, estimate, supervisor = self._links[index], self.estimates[index], self.firmware[index].supervisor
        link.drop_up, link.drop_down, link.frozen, link.heal_at = 0.0, 0.0, False, None
        estimate.offset, estimate.frozen = (0.0, 0.0, 0.0), False
        supervisor.refuse_arming = supervisor.tumbled = False
        if self.radio is not None:
            self.radio.plug_in()
        elif link.socket is None:
            self._bind_link(index)
