"""The link to one Crazyflie over cflib: how it is opened, what goes out, and the log that comes in.

Whatever goes out is one call of cflib's public interface; the drivers (`drivers`) take each packet at once, so any
thread may send. cflib's threads deliver what comes in.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import logging
import math
import os
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError

from .addresses import LinkError
from .commands import Setpoint
from .onboard import START, OnboardSetup, send_order
from .positions import PoseTracker
from .settings import RobotSettings
from .state import LOG_VARIABLES, Vector, VehicleState, decode_log

SIMULATED_RADIO = "DTSA_SIMULATED_RADIO"  # environment: socket of simulated Crazyradios, for simulation only
FIRST_ANSWER_S = 2.0  # over the air nothing else shows that no Crazyflie is there
AUDIBLE_S = 0.25  # something came or was acknowledged within that time: it can be heard
CLOSED_PORT_S = 10.0  # simulated Crazyflies that are started at the same time take so long to listen
PAUSE_S = 0.2  # before a closed port is asked again
LOG_ORDER_S = 0.4  # nothing logged for that long, though it can be heard: the log is ordered anew
REFUSED = f"[Errno {errno.ECONNREFUSED}]"  # in a driver's words: the port is closed
VARIANCES = ("kalman.varPX", "kalman.varPY", "kalman.varPZ")
PLACE = ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
INITIAL = ("kalman.initialX", "kalman.initialY", "kalman.initialZ")
VARIANCE_MS = 50
MAX_DRIFT = 1e-4  # of the Crazyflie's clock against ours, at most
RESTARTED_S = 5.0  # a stamp that is so far off is that of a Crazyflie that was switched on again
RESET_S = 0.1  # the firmware's tasks have seen the parameter by then
INTEGERS = "bBhHiIqQ"  # formats of `struct`

Send = Callable[[Any], None]  # gives an order to cflib's `Crazyflie`


def require_cflib() -> None:
    """Load cflib's drivers, once; ConfigError: cflib is not installed; the text says how to get it."""
    if importlib.util.find_spec("cflib") is None:
        allowed = "an installed cflib: tools/dtsa setup --extra cflib, or pip install cflib==0.1.34"
        raise ConfigError("cflib", "not installed", allowed)
    with warnings.catch_warnings():  # cflib shows all DeprecationWarnings, those of other packages too
        import cflib.crtp

    if path := os.environ.get(SIMULATED_RADIO):
        from dtsa_agent.air.crazyradio_simulated import replace_real_dongles

        replace_real_dongles(Path(path))
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers(enable_serial_driver=True)
    # Its own warnings are about what the bridge reports by itself, in terms of the swarm.
    for name in ("cflib", "cflib.crazyflie", "cflib.crtp"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="The supervisor subsystem requires CRTP", category=UserWarning)


class CrazyflieLink:
    """One Crazyflie's connection and log.

    cflib's threads call `on_state` with each decoded log packet and when it was logged (s, monotonic), `on_broken` with
    a reason when the link ends by itself, and `on_answer` with the first byte of a high-level order and its answer.

    :param cache: folder for the tables of variables.
    :param tracker: knows where motion capture sees the Crazyflie.
    """

    def __init__(
        self, robot: RobotSettings, cache: Path, tracker: PoseTracker, on_state: Callable[[VehicleState, float], None],
        on_broken: Callable[[str], None], on_answer: Callable[[int, int], None],
    ) -> None:  # fmt: skip
        self.robot = robot
        self.connected = False
        self.sent = self.received = 0  # packets, and log packets
        self.acknowledged = -math.inf  # s, monotonic: when anything last came, or was acknowledged
        self.firmware: tuple[int, str] | None = None  # version of its protocol, and revision; None: never connected
        self.board: OnboardSetup | None = None  # what the app on board is told; None: there is none
        self.driver: Any = None  # over a radio ours, which knows its quality (0 to 1) and rssi (-dBm)
        self.guarded = False  # the firmware's emergency watchdog wants to be fed as soon as it can be
        self.setpoints: deque[tuple[float, float]] = deque(maxlen=500)  # when sent (s, monotonic), s since it came
        self._cache, self._tracker = cache, tracker
        self._on_state, self._on_broken, self._on_answer = on_state, on_broken, on_answer
        self._closed = False
        self._cf: Any = None
        self._settled, self._failure = threading.Event(), ""  # of the present attempt to connect
        self._stamp = 0.0  # s, monotonic, of the last streamed command
        self._logged, self._log_time = threading.Event(), -math.inf  # when a log packet came, s, monotonic
        self._log_delay = math.inf  # s, from the Crazyflie's clock to ours, of a packet without a wait
        self._audible_since = self._log_ordered = -math.inf  # s, monotonic
        self._log_order_s = LOG_ORDER_S
        self._log_block: Any = None

    @property
    def crazyflie(self) -> Any:
        """The connected `Crazyflie` of cflib; None: there is none."""
        return self._cf if self.connected else None

    def stream(self, setpoint: Setpoint) -> None:
        """Send a set-point; a newer one replaces it as long as it waits."""
        if (cf := self.crazyflie) is not None:
            self._stamp = setpoint.stamp
            getattr(cf.commander, f"send_{setpoint.kind}_setpoint")(*setpoint.arguments)
            if self.driver is None:
                self._count_setpoint()

    def _count_setpoint(self) -> None:
        now = time.monotonic()
        self.setpoints.append((now, now - self._stamp))

    def order(self, action: Send, *, connecting: bool = False) -> None:
        """Give an order, if there is a connection, or one that is `connecting` and has come so far as to take it.

        Emergency stops go before everything that waits.
        """
        cf = self._cf if connecting else self.crazyflie
        if cf is not None and (not connecting or cf.is_connected()):
            try:
                action(cf)
            except Exception as error:  # cflib's, of a link that has just ended
                self._on_broken(f"could not send: {error}")

    @property
    def can_set(self) -> bool:
        """Whether parameters can be set now: it is connected, and their values are known."""
        cf = self.crazyflie
        return cf is not None and bool(cf.param.is_updated)

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter that exists to a value that it can have; does not wait."""
        if self.can_set:  # else cflib would keep this thread waiting
            with contextlib.suppress(KeyError, AttributeError):  # the link has just ended
                self._cf.param.set_value(name, value)

    def parameters(self) -> dict[str, tuple[Any, float]]:
        """Return the firmware's parameters by `group.name`: cflib's entry in its table, and the value as last read."""
        found: dict[str, tuple[Any, float]] = {}
        if (cf := self.crazyflie) is None:
            return found
        param = cf.param
        for group, values in param.values.copy().items():
            for name, text in values.copy().items():
                element, full_name = param.toc.toc[group][name], f"{group}.{name}"
                read = int(text) if element.pytype[-1] in INTEGERS else float(text)
                # A value that was set after connecting is newer than cflib's copy.
                found[full_name] = element, self.robot.firmware_params.get(full_name, read)
        return found

    def connect(self) -> str:
        """Connect, in the calling thread; why it failed, or an empty text."""
        attempts, attempt, reason = self.robot.connect_attempts, 1, "the link has been closed"
        patience = time.monotonic() + min(CLOSED_PORT_S, self.robot.connect_timeout_s)
        while attempt <= attempts and not self._closed:
            try:
                self._connect()
                return ""
            except LinkError as error:
                reason = f"attempt {attempt} of {attempts}: {error}"
            self._drop()
            # A closed port says so at once: that is no attempt as long as it may be about to be opened.
            closed = REFUSED in reason and time.monotonic() < patience
            attempt += not closed
            time.sleep(PAUSE_S if closed else 0.0)
        return reason

    def _connect(self) -> None:
        """Connect once; LinkError: it did not work."""
        from cflib.crazyflie import Crazyflie

        self._drop()
        limit = self.robot.connect_timeout_s
        deadline = time.monotonic() + limit
        cf = self._cf = Crazyflie(rw_cache=str(self._cache))
        self._watch(cf)
        cf.open_link(self.robot.uri)
        if hasattr(cf.link, "on_acknowledged"):  # one of our drivers
            self.driver = cf.link
            cf.link.on_acknowledged, cf.link.on_setpoint_sent = self._acknowledge, self._count_setpoint
        settled = self._settled.wait(min(FIRST_ANSWER_S, limit))
        if self.robot.address.radio and not settled and self.acknowledged == -math.inf:
            raise LinkError(f"no answer on the air within {FIRST_ANSWER_S:g} s")
        if not self._settled.wait(max(0.0, deadline - time.monotonic())):
            raise LinkError(f"no answer within {limit:g} s")
        if self._failure:
            raise LinkError(self._failure)
        if self.robot.address.radio:
            cf.link_statistics.stop()  # its pings take air; elsewhere they tell that the Crazyflie is there
        try:
            for name, value in self.robot.firmware_params.items():
                cf.param.set_value(name, value)
        except (KeyError, AttributeError) as error:
            raise LinkError(f"firmware parameter {name}: {error}") from error
        if self.board is not None:
            self.board.prepare(cf)
        if self.robot.reset_estimator:
            self._reset_estimator(cf)
        known = {"modified": 0} | cf.param.values.get("firmware", {})
        revision = f"{int(known['revision0']):08x}" if "revision0" in known else "unknown"
        modified = " modified" if int(known["modified"]) else ""
        self.firmware = int(cf.platform.get_protocol_version()), revision + modified
        self._logged.clear()
        self._begin_log(cf)
        if not self._logged.wait(max(2.0, deadline - time.monotonic())):
            raise LinkError("no log packets")
        self.connected = True

    def _watch(self, cf: Any) -> None:
        """Take note of all that cflib says about a connection, from its threads."""
        from cflib.crtp.crtpstack import CRTPPort

        self._settled.clear()
        self._failure = ""

        def broken(uri: str, message: str) -> None:
            if self._cf is not cf:
                return  # of an earlier attempt
            reason = message.partition("\n\n")[0].replace("\n", " ")
            self._failure = self._failure or reason
            self._settled.set()
            if self.connected:
                self.connected = False
                self._on_broken(f"link broken: {reason}")

        def sent(packet: Any) -> None:
            self.sent += 1

        def received(packet: Any) -> None:
            if self.driver is None:
                self._acknowledge()

        def answered(packet: Any) -> None:
            if len(packet.data) > 3:
                self._on_answer(packet.data[0], packet.data[3])

        cf.fully_connected.add_callback(lambda uri: self._settled.set())
        cf.connection_failed.add_callback(broken)
        cf.connection_lost.add_callback(broken)
        cf.packet_sent.add_callback(sent)
        cf.packet_received.add_callback(received)
        cf.add_port_callback(CRTPPort.SETPOINT_HL, answered)

    def _acknowledge(self) -> None:
        """Something came, or was acknowledged; at the end of a silence the firmware's watchdog has little time left."""
        silent, self.acknowledged = time.monotonic() - self.acknowledged > AUDIBLE_S, time.monotonic()
        if silent:
            self._audible_since = self.acknowledged
            if self.guarded:
                self.order(lambda cf: cf.supervisor.send_emergency_stop_watchdog())

    def _reset_estimator(self, cf: Any) -> None:
        """Restart the Kalman filter, and wait until it knows where it stands; positions are sent meanwhile.

        :raises LinkError: it does not settle in time, and why.
        """
        settled, timeout, places = threading.Event(), self.robot.estimator_timeout_s, list[Vector]()
        problem = "the firmware logs nothing about it"

        def sample(stamp_ms: int, values: dict[str, float], block: Any) -> None:
            nonlocal problem
            x, y, z, *variances = (values[name] for name in (*PLACE, *VARIANCES))
            places.append((x, y, z))
            limit = self.robot.estimator_variance_m2
            problem = self._tracker.why_not_settled(places, max(variances), limit, time.monotonic())
            if not problem:
                settled.set()

        place = self._tracker.measured_position(time.monotonic())
        for name, value in zip(INITIAL, place or (), strict=False):  # the filter begins where it is seen
            cf.param.set_value(name, value)
        cf.param.set_value("kalman.resetEstimation", 1)
        time.sleep(RESET_S)
        cf.param.set_value("kalman.resetEstimation", 0)
        try:
            block = _log(cf, "variance", VARIANCE_MS, (*VARIANCES, *PLACE), sample, "float")
        except KeyError:
            return  # another estimator than the Kalman filter: nothing to wait for
        settled.wait(timeout)
        block.delete()
        if not settled.is_set():
            raise LinkError(f"the estimator did not settle within {timeout:g} s: {problem}")

    def start_agent(self) -> str:
        """Start the agent on board, in the calling thread; why it does not start, or an empty text.

        From then on the bridge asks seldom: its packets take air from the agents.
        """
        if (cf := self.crazyflie) is None or self.board is None:
            return "not connected"
        try:
            send_order(cf, START)
        except LinkError as error:
            return str(error)
        if self.driver is not None:
            self.driver.limit(self.board.polls_hz)
            # An order takes some packets of each way, and the log comes seldom.
            self._log_order_s = LOG_ORDER_S + 1.0 / self.robot.log_rate_hz + 5.0 / self.board.polls_hz
        return ""

    def _begin_log(self, cf: Any) -> None:
        def receive(stamp_ms: int, values: dict[str, float], block: Any) -> None:
            self.received += 1
            self._on_state(decode_log(values), self._sampled(stamp_ms / 1000, time.monotonic()))
            self._logged.set()

        period_ms = max(10, round(1000 / self.robot.log_rate_hz / 10) * 10)
        try:
            self._log_block = _log(cf, "state", period_ms, LOG_VARIABLES, receive)
        except KeyError as error:
            raise LinkError(f"the firmware does not log {error}: update it") from error

    def _sampled(self, stamp: float, now: float) -> float:
        """Return when the values of a log packet were taken (s, monotonic); its time stamp (s) is the Crazyflie's.

        After a gap the Crazyflie delivers what it logged meanwhile: packets that come are not always new.
        """
        delay, passed = now - stamp, now - self._log_time
        restarted = abs(delay - self._log_delay) > RESTARTED_S
        self._log_delay = delay if restarted else min(delay, self._log_delay + MAX_DRIFT * passed)
        self._log_time = now
        return min(now, stamp + self._log_delay)

    def order_log(self, now: float) -> None:
        """Order the log anew, if it can be heard now (s, monotonic): the firmware ends it in a gap of a second."""
        last = max(self._log_time, self._audible_since, self._log_ordered)
        if now - self.acknowledged > AUDIBLE_S or now - last < self._log_order_s:
            return
        self._log_ordered = now

        def order(cf: Any) -> None:
            self._log_block.delete()
            with contextlib.suppress(ValueError):
                cf.log.log_blocks.remove(self._log_block)
            self._begin_log(cf)

        self.order(order)

    def _drop(self) -> None:
        self.connected = False
        cf, self._cf = self._cf, None
        if cf is not None:
            with contextlib.suppress(Exception):  # whatever state it is in, we are done with it
                cf.close_link()
        self.driver, self.acknowledged, self._log_delay = None, -math.inf, math.inf

    def close(self) -> None:
        """Close the connection. Never in flight."""
        self._closed, self._failure = True, "the link has been closed"
        self._settled.set()
        self._drop()


def _log(cf: Any, name: str, period_ms: int, variables: Iterable[str], receive: Callable[..., None], *kind: str) -> Any:
    """Begin a log block of cflib's; KeyError: the firmware has not all of these variables."""
    from cflib.crazyflie.log import LogConfig

    block = LogConfig(name, period_ms)
    for variable in variables:
        block.add_variable(variable, *kind)
    block.data_received_cb.add_callback(receive)
    cf.log.add_config(block)
    block.start()
    return block
