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
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError

from .addresses import LinkError
from .commands import Setpoint
from .onboard import START, OnboardSetup, send_order
from .positions import SettlingCheck
from .settings import RobotSettings
from .state import LOG_VARIABLES, Vector, VehicleState, decode_log

SIMULATED_RADIO = "DTSA_SIMULATED_RADIO"  # environment: socket of simulated Crazyradios, for simulation only
FIRST_ANSWER_S = 2.0  # over the air nothing else shows that no Crazyflie is there
AUDIBLE_S = 0.25  # something came or was acknowledged within that time: it can be heard
CLOSED_PORT_S = 10.0  # simulated Crazyflies that are started at the same time take so long to listen
PAUSE_S = (0.1, 0.5)  # first and longest pause before a closed port is asked again
LOG_ORDER_S = 0.4  # nothing logged for that long, though it can be heard: the log is ordered anew
REFUSED = f"[Errno {errno.ECONNREFUSED}]"  # in a driver's words: the port is closed
VARIANCES = ("kalman.varPX", "kalman.varPY", "kalman.varPZ")
PLACE = ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
INITIAL = ("kalman.initialX", "kalman.initialY", "kalman.initialZ")
VARIANCE_MS = 50
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


class LogClock:
    """How old the values of a log packet are: after a gap the Crazyflie delivers what it logged meanwhile.

    The smallest delay that was ever seen is that of a packet without a wait. Times (`now`) are s, monotonic.
    """

    MAX_DRIFT = 1e-4  # of the Crazyflie's clock against ours, at most
    RESTARTED_S = 5.0  # a stamp that is so far off is that of a Crazyflie that was switched on again

    def __init__(self) -> None:
        self.last = -math.inf  # s, monotonic, when a log packet came
        self._offset: float | None = None

    def sampled(self, stamp_ms: int, now: float) -> float:
        """Return when the values of a packet that has come now were taken; its time stamp is the Crazyflie's."""
        offset = now - stamp_ms / 1000
        if self._offset is None or abs(offset - self._offset) > self.RESTARTED_S:
            self._offset = offset
        else:
            self._offset = min(offset, self._offset + self.MAX_DRIFT * (now - self.last))
        self.last = now
        return min(now, stamp_ms / 1000 + self._offset)


class CrazyflieLink:
    """One Crazyflie's connection and log.

    :param cache: folder for the tables of variables.
    :param on_state: called with each decoded log packet and when it was logged (s, monotonic), in a thread of cflib's.
    :param on_broken: called with a reason when the connection ends by itself, in a thread of cflib's.
    :param on_answer: called with the first byte of a high-level order and the firmware's answer, in such a thread.
    :param settling: makes what decides when the estimator has settled.
    :param measured_place: where motion capture sees the Crazyflie (m, world); None: not at all.
    """

    def __init__(
        self, robot: RobotSettings, cache: Path, on_state: Callable[[VehicleState, float], None],
        on_broken: Callable[[str], None], on_answer: Callable[[int, int], None],
        settling: Callable[[], SettlingCheck], measured_place: Callable[[], Vector | None],
    ) -> None:  # fmt: skip
        self.robot = robot
        self.connected = False
        self.sent = self.received = 0  # packets, and log packets
        self.acknowledged = -math.inf  # s, monotonic: when anything last came, or was acknowledged
        self.firmware: tuple[int, str] | None = None  # version of its protocol, and revision; None: never connected
        self.board: OnboardSetup | None = None  # what the app on board is told; None: there is none
        self.guarded = False  # the firmware's emergency watchdog wants to be fed as soon as it can be
        self.setpoints: deque[tuple[float, float]] = deque(maxlen=500)  # when sent (s, monotonic), s since it came
        self._cache, self._settling, self._measured_place = cache, settling, measured_place
        self._on_state, self._on_broken, self._on_answer = on_state, on_broken, on_answer
        self._closed = False
        self._cf: Any = None
        self.driver: Any = None  # over a radio ours, which knows its quality (0 to 1) and rssi (-dBm)
        self._settled, self._failure = threading.Event(), ""  # of the present attempt to connect
        self._stamp = 0.0  # s, monotonic, of the last streamed command
        self._log_clock, self._logged = LogClock(), threading.Event()
        self._audible_since = self._log_ordered = -math.inf  # s, monotonic
        self._log_order_s = LOG_ORDER_S
        self._log_block: Any = None

    # -- what goes out ----------------------------------------------------------------------------------------------
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

    def order(self, action: Send, cf: Any = None) -> None:
        """Give an order, if there is a connection. Emergency stops go before everything that waits."""
        if (cf := cf or self.crazyflie) is not None:
            try:
                action(cf)
            except Exception as error:  # cflib's, of a link that has just ended
                self._on_broken(f"could not send: {error}")

    def send_position(self, send: Send) -> None:
        """Send where motion capture sees it, while it connects, too: the estimator settles by that."""
        if (cf := self._cf) is not None and cf.is_connected():
            self.order(send, cf)

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

    # -- connection -------------------------------------------------------------------------------------------------
    def connect(self) -> str:
        """Connect, in the calling thread; why it failed, or an empty text."""
        attempts, attempt, reason = self.robot.connect_attempts, 1, "the link has been closed"
        pause, longest = PAUSE_S
        patience = time.monotonic() + min(CLOSED_PORT_S, self.robot.connect_timeout_s)
        while attempt <= attempts and not self._closed:
            try:
                self._connect()
                return ""
            except LinkError as error:  # noqa: PERF203
                reason = f"attempt {attempt} of {attempts}: {error}"
                self._drop()
                # A closed port says so at once: that is no attempt as long as it may be about to be opened.
                closed = REFUSED in reason and time.monotonic() < patience
                attempt += not closed
                if closed:
                    time.sleep(pause)
                    pause = min(2 * pause, longest)
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
        for name, value in self.robot.firmware_params.items():
            try:
                cf.param.set_value(name, value)
            except (KeyError, AttributeError) as error:  # noqa: PERF203
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
        from cflib.crazyflie.log import LogConfig

        check, settled, timeout = self._settling(), threading.Event(), self.robot.estimator_timeout_s
        problem = "the firmware logs nothing about it"

        def sample(stamp: int, values: dict[str, float], block: Any) -> None:
            nonlocal problem
            x, y, z = (values[name] for name in PLACE)
            problem = check.find_problem((x, y, z), max(values[name] for name in VARIANCES), self._measured_place())
            if not problem:
                settled.set()

        if (place := self._measured_place()) is not None:  # the filter begins where it is seen, not metres away
            for name, value in zip(INITIAL, place, strict=True):
                cf.param.set_value(name, value)
        cf.param.set_value("kalman.resetEstimation", 1)
        time.sleep(RESET_S)
        cf.param.set_value("kalman.resetEstimation", 0)
        block = LogConfig("variance", VARIANCE_MS)
        for name in (*VARIANCES, *PLACE):
            block.add_variable(name, "float")
        block.data_received_cb.add_callback(sample)
        try:
            cf.log.add_config(block)
        except KeyError:
            return  # another estimator than the Kalman filter: nothing to wait for
        block.start()
        settled.wait(timeout)
        block.delete()
        if not settled.is_set():
            raise LinkError(f"the estimator did not settle within {timeout:g} s: {problem}")

    def start_agent(self) -> str:
        """Start the agent on board, in the calling thread; why it does not start, or an empty text.

        From then on the bridge asks seldom: its packets take air from the agents.
        """
        cf, board = self.crazyflie, self.board
        if cf is None or board is None:
            return "not connected"
        try:
            send_order(cf, START)
        except LinkError as error:
            return str(error)
        if self.driver is not None:
            self.driver.limit(board.polls_hz)
            # An order takes some packets of each way, and the log comes seldom.
            self._log_order_s = LOG_ORDER_S + 1.0 / self.robot.log_rate_hz + 5.0 / board.polls_hz
        return ""

    # -- log --------------------------------------------------------------------------------------------------------
    def _begin_log(self, cf: Any) -> None:
        from cflib.crazyflie.log import LogConfig

        block = LogConfig("state", max(10, round(1000 / self.robot.log_rate_hz / 10) * 10))
        for name in LOG_VARIABLES:
            block.add_variable(name)

        def receive(stamp: int, values: dict[str, float], config: Any) -> None:
            self.received += 1
            self._on_state(decode_log(values), self._log_clock.sampled(stamp, time.monotonic()))
            self._logged.set()

        block.data_received_cb.add_callback(receive)
        try:
            cf.log.add_config(block)
        except KeyError as error:
            raise LinkError(f"the firmware does not log {error}: update it") from error
        block.start()
        self._log_block = block

    def order_log(self, now: float) -> None:
        """Order the log anew, if it can be heard now (s, monotonic): the firmware ends it in a gap of a second."""
        last = max(self._log_clock.last, self._audible_since, self._log_ordered)
        if now - self.acknowledged > AUDIBLE_S or now - last < self._log_order_s:
            return
        self._log_ordered = now

        def order(cf: Any) -> None:
            self._log_block.delete()
            with contextlib.suppress(ValueError):
                cf.log.log_blocks.remove(self._log_block)
            self._begin_log(cf)

        self.order(order)

    # -- end --------------------------------------------------------------------------------------------------------
    def _drop(self) -> None:
        self.connected = False
        cf, self._cf = self._cf, None
        if cf is not None:
            with contextlib.suppress(Exception):  # whatever state it is in, we are done with it
                cf.close_link()
        self.driver, self.acknowledged = None, -math.inf

    def close(self) -> None:
        """Close the connection. Never in flight."""
        self._closed, self._failure = True, "the link has been closed"
        self._settled.set()
        self._drop()
