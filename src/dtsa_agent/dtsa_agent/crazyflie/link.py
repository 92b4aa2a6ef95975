"""The link to one Crazyflie: the only module that talks to cflib.

Each link has one worker thread. It connects, and it alone sends: cflib's send can block for seconds under a lock, so
nothing else may wait for it. cflib's own threads only deliver log packets.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.config import RobotSettings
from dtsa_agent.crazyflie.errors import LinkError
from dtsa_agent.crazyflie.estimates import Settling
from dtsa_agent.crazyflie.estimator import settle
from dtsa_agent.crazyflie.mailbox import Mailbox, Order, Position
from dtsa_agent.crazyflie.units import LOG_VARIABLES, Setpoint, Vector, VehicleState, decode_log


def require_cflib() -> None:
    """Load cflib's drivers, once.

    :raises ConfigError: cflib is not installed; the text says how to get it.
    """
    if importlib.util.find_spec("cflib") is None:
        raise ConfigError(
            "cflib", "not installed", "an installed cflib: tools/dtsa setup --extra cflib, or pip install cflib==0.1.34"
        )
    import cflib.crtp

    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()
    # Its own warnings are about what the bridge reports by itself, in terms of the swarm.
    for name in ("cflib", "cflib.crazyflie", "cflib.crtp"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="The supervisor subsystem requires CRTP", category=UserWarning)


class Link:
    """One Crazyflie's connection, worker and log.

    :param robot: address and settings.
    :param cache: folder for the tables of variables.
    :param on_state: called with each decoded log packet and its time (s, monotonic), in a thread of cflib's.
    :param on_broken: called with a reason when the connection ends by itself, in a thread of cflib's.
    :param on_answer: called with the first byte of a high-level order and the firmware's answer, in such a thread.
    :param settling: decides when the estimator has settled.
    :param seen: where motion capture sees the Crazyflie (m, world); None: not at all.
    """

    def __init__(
        self,
        robot: RobotSettings,
        cache: Path,
        on_state: Callable[[VehicleState, float], None],
        on_broken: Callable[[str], None],
        on_answer: Callable[[int, int], None],
        settling: Settling,
        seen: Callable[[], Vector | None],
    ) -> None:
        self.robot = robot
        self.mailbox = Mailbox()
        self.connected = False
        self.sent = 0
        self.received = 0
        self.radio_quality: float | None = None  # 0..1, as the radio driver says
        self.rssi = 0  # -dBm, as the radio driver says
        self.latencies: deque[float] = deque(maxlen=500)  # s, from the arrival of a command to its packet
        self.send_times: deque[float] = deque(maxlen=200)  # s, monotonic, of the last streamed commands
        self._cache = cache
        self._on_state = on_state
        self._on_broken = on_broken
        self._on_answer = on_answer
        self._settling, self._seen = settling, seen
        self._cf: Any = None
        self._thread = threading.Thread(target=self._work, name=f"{robot.name}-worker", daemon=True)
        self._thread.start()

    # -- worker -----------------------------------------------------------------------------------------------------
    def _work(self) -> None:
        while (item := self.mailbox.get()) is not None:
            try:
                if isinstance(item, Setpoint):
                    self._send_setpoint(item)
                elif isinstance(item, Position):
                    if self._cf is not None and self.connected:
                        item.send(self._cf)
                else:
                    item()
            except Exception as error:  # noqa: PERF203 - one bad order must not end the worker
                self._on_broken(f"could not send: {error}")

    def _send_setpoint(self, setpoint: Setpoint) -> None:
        cf = self._cf
        if cf is None or not self.connected:
            return
        getattr(cf.commander, f"send_{setpoint.kind}_setpoint")(*setpoint.arguments)
        now = time.monotonic()
        self.latencies.append(now - setpoint.stamp)
        self.send_times.append(now)
        self.sent += 1

    def order(self, action: Callable[[Any], None], *, urgent: bool = False, background: bool = False) -> None:
        """Let the worker do something with the connected `Crazyflie` object.

        :param urgent: before everything that waits. :param background: without ending the stream of setpoints.
        """

        def run() -> None:
            if self._cf is not None and self.connected:
                action(self._cf)
                self.sent += 1

        self._post(run, urgent=urgent, background=background)

    def _post(self, order: Order, *, urgent: bool, background: bool) -> None:
        if background:
            self.mailbox.put_background(order)
        else:
            self.mailbox.put_order(order, urgent=urgent)

    # -- connection -------------------------------------------------------------------------------------------------
    def connect(self, done: Callable[[str], None]) -> None:
        """Connect in the worker; `done` is called with an empty text, or with why it failed."""

        def run() -> None:
            reason = ""
            for attempt in range(1, self.robot.connect_attempts + 1):
                try:
                    self._connect()
                    reason = ""
                    break
                except LinkError as error:
                    reason = f"attempt {attempt} of {self.robot.connect_attempts}: {error}"
                    self._drop()
            done(reason)

        self.mailbox.put_order(run, urgent=True)

    def _connect(self) -> None:
        from cflib.crazyflie import Crazyflie
        from cflib.crtp.crtpstack import CRTPPort

        self._drop()
        deadline = time.monotonic() + self.robot.connect_timeout_s
        settled = threading.Event()
        failure: list[str] = []
        cf = Crazyflie(rw_cache=str(self._cache))
        cf.fully_connected.add_callback(lambda uri: settled.set())

        def broken(uri: str, message: str) -> None:
            failure.append(message.partition("\n\n")[0].replace("\n", " "))
            settled.set()
            if self._cf is cf and self.connected:
                self.connected = False
                self._on_broken(f"link broken: {failure[-1]}")

        cf.connection_failed.add_callback(broken)
        cf.connection_lost.add_callback(broken)
        cf.add_port_callback(CRTPPort.SETPOINT_HL, self._answer)
        cf.link_statistics.link_quality_updated.add_callback(self._quality)
        cf.link_statistics.uplink_rssi_updated.add_callback(self._rssi)
        self._cf = cf
        cf.open_link(self.robot.uri)
        if not settled.wait(max(0.0, deadline - time.monotonic())):
            raise LinkError(f"no answer within {self.robot.connect_timeout_s:g} s")
        if failure:
            raise LinkError(failure[0])
        for name, value in self.robot.firmware_params.items():
            try:
                cf.param.set_value(name, value)
            except (KeyError, AttributeError) as error:  # noqa: PERF203
                raise LinkError(f"firmware parameter {name}: {error}") from error
        if self.robot.reset_estimator:
            settle(cf, self._settling, self._seen, self.mailbox.take_position, self.robot.estimator_timeout_s)
        self._start_log(cf, max(deadline, time.monotonic() + 2.0))
        self.connected = True

    def _answer(self, packet: Any) -> None:
        if len(packet.data) > 3:
            self._on_answer(packet.data[0], packet.data[3])

    def _quality(self, percent: float) -> None:
        self.radio_quality = percent / 100

    def _rssi(self, value: float) -> None:
        self.rssi = int(value)

    def _start_log(self, cf: Any, deadline: float) -> None:
        from cflib.crazyflie.log import LogConfig

        first = threading.Event()
        block = LogConfig("state", max(10, round(1000 / self.robot.log_rate_hz / 10) * 10))
        for name in LOG_VARIABLES:
            block.add_variable(name)

        def receive(stamp: int, values: dict[str, float], config: Any) -> None:
            self.received += 1
            self._on_state(decode_log(values), time.monotonic())
            if not first.is_set():
                first.set()

        block.data_received_cb.add_callback(receive)
        try:
            cf.log.add_config(block)
        except KeyError as error:
            raise LinkError(f"the firmware does not log {error}: update it") from error
        block.start()
        if not first.wait(max(0.0, deadline - time.monotonic())):
            raise LinkError("no log packets")

    def _drop(self) -> None:
        """Forget the connection. Sends a zero setpoint: only for one that does not fly."""
        self.connected = False
        cf, self._cf = self._cf, None
        if cf is not None:
            with contextlib.suppress(Exception):  # whatever state it is in, we are done with it
                cf.close_link()

    def close(self) -> None:
        """Close the connection and end the worker, after what waits in the mailbox. Never in flight."""
        self.mailbox.put_background(self._drop)
        self.mailbox.close()

    def join(self, timeout: float) -> bool:
        """Wait for the worker to end (s); False if it has not."""
        self._thread.join(timeout)
        return not self._thread.is_alive()
