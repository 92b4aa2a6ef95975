"""The link to one Crazyflie: with `radio_link`, `emergency_radio` and `onboard` all that talks to cflib.

Each link has one worker thread. It connects, and it alone sends: cflib's send can block for seconds under a lock, so
nothing else may wait for it. cflib's own threads only deliver log packets. A link that ends by itself is opened again,
again and again, until it is closed.
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
from dtsa_agent.crazyflie.addresses import LinkError
from dtsa_agent.crazyflie.onboard import BoardOrders
from dtsa_agent.crazyflie.positions.estimates import Settling
from dtsa_agent.crazyflie.settings import RobotSettings
from dtsa_agent.crazyflie.state.conversions import LOG_VARIABLES, Setpoint, Vector, VehicleState, decode_log

from .estimator_reset import settle
from .outbox import Order, Outbox, Position
from .radio_link import Heard, RadioPort, keep_links_open, packets_of

SIMULATED_RADIO = "DTSA_SIMULATED_RADIO"  # environment: socket of simulated Crazyradios, for simulation only
FIRST_ANSWER_S = 2.0  # over the air nothing else tells that nobody is there: the link stays open
STUCK_S = 0.25  # nothing acknowledged for that long, though cflib asks all the time
REOPEN_S = (0.1, 2.0)  # first and longest pause before a link that ended is opened again
REOPEN_TIMEOUT_S = 3.0  # for one such attempt
NOBODY_S = 10.0  # simulated Crazyflies that are started at the same time take so long to listen
LOG_ORDER_S = 0.4  # nothing logged for that long, though it can be heard: the log is ordered anew
IDLE_S = 0.01
REFUSED = f"[Errno {errno.ECONNREFUSED}]"  # in the words of a driver: nobody listens there


def require_cflib() -> None:
    """Load cflib's drivers, once.

    :raises ConfigError: cflib is not installed; the text says how to get it.
    """
    if importlib.util.find_spec("cflib") is None:
        raise ConfigError(
            "cflib",
            "not installed",
            "an installed cflib: tools/dtsa setup --extra cflib, or pip install cflib==0.1.34",
        )
    with warnings.catch_warnings():  # cflib shows all DeprecationWarnings, those of other packages too
        import cflib.crtp

    if path := os.environ.get(SIMULATED_RADIO):
        from dtsa_agent.air.crazyradio.simulated import replace_real_dongles

        replace_real_dongles(Path(path))
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()
    keep_links_open()
    from . import udp_link

    udp_link.install()
    # Its own warnings are about what the bridge reports by itself, in terms of the swarm.
    for name in ("cflib", "cflib.crazyflie", "cflib.crtp"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="The supervisor subsystem requires CRTP", category=UserWarning)


class _Command:
    """An order that consists of commands: it can be sent past a packet that is stuck."""

    def __init__(self, link: Link, action: Callable[[Any], None]) -> None:
        self.action = action
        self._link = link

    def __call__(self) -> None:
        self._link.run(self.action)


class _Opening:
    """How far a connection has come, as cflib's threads say."""

    def __init__(self) -> None:
        self.heard = threading.Event()  # the Crazyflie has answered at all
        self.settled = threading.Event()  # it is connected, or that has failed
        self.failure = ""  # why it has failed; empty: it has not


class Link:
    """One Crazyflie's connection, worker and log.

    :param cache: folder for the tables of variables.
    :param on_state: called with each decoded log packet and when it was logged (s, monotonic), in a thread of cflib's.
    :param on_broken: called with a reason when the connection ends by itself, in a thread of cflib's.
    :param on_answer: called with the first byte of a high-level order and the firmware's answer, in such a thread.
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
        self.outbox = Outbox()
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
        self.firmware: tuple[int, str] | None = None  # version of its protocol, and revision; None: never connected
        self._cf: Any = None
        self._radio: RadioPort | None = None
        self._heard = Heard()
        self._log_block: Any = None
        self._log_ordered = 0.0  # s, monotonic
        self._log_order_s = LOG_ORDER_S
        self._reopen = False
        self.board: BoardOrders | None = None  # what the app on board is told; None: there is none
        self.guarded = False  # the firmware's emergency watchdog wants to be fed as soon as it can be
        self.reopened = 0  # times that a link which had ended by itself was opened again
        self._thread = threading.Thread(target=self._work, name=f"{robot.name}-worker", daemon=True)
        self._thread.start()

    # -- worker -----------------------------------------------------------------------------------------------------
    def _work(self) -> None:
        while self.outbox.wait():
            try:
                if self.stuck:
                    self._send_past()
                    continue
                item = self.outbox.get()
                if isinstance(item, Setpoint):
                    self._send_setpoint(item)
                elif isinstance(item, Position):
                    self.run(item.send)
                elif item is not None:
                    item()
            except Exception as error:  # one bad order must not end the worker
                self._on_broken(f"could not send: {error}")

    @property
    def stuck(self) -> bool:
        """Whether a packet waits for its acknowledgement and keeps all others waiting; looks for a while."""
        radio = self._radio
        if radio is None or not self.connected:
            return False
        return self._heard.age(time.monotonic()) > STUCK_S or not radio.has_room

    def _send_past(self) -> None:
        """Nothing can be sent as usual: the next order goes past what waits, blindly. Streamed commands wait."""
        order, cf, radio = self.outbox.take_order(), self._cf, self._radio
        if isinstance(order, _Command) and cf is not None and radio is not None:
            radio.send_past(packets_of(cf, order.action) or [])
        elif order is not None:
            order()
        else:
            time.sleep(IDLE_S)

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

        self._post(_Command(self, action), urgent=urgent, background=background)

    def run(self, action: Callable[[Any], None]) -> None:
        """In the worker: do something with the connected `Crazyflie` object. Over the air no packet is waited for."""
        cf, radio = self._cf, self._radio
        if cf is None or not self.connected:
            return
        self.sent += 1
        packets = None if radio is None else packets_of(cf, action)
        if radio is None or packets is None:
            action(cf)
        else:
            radio.send(cf, packets)

    def _post(self, order: Order, *, urgent: bool, background: bool) -> None:
        if background:
            self.outbox.put_background(order)
        else:
            self.outbox.put_order(order, urgent=urgent)

    # -- connection -------------------------------------------------------------------------------------------------
    @property
    def crazyflie(self) -> Any:
        """The connected `Crazyflie` object; None: there is none."""
        return self._cf if self.connected else None

    def connect(self, done: Callable[[str], None]) -> None:
        """Connect in the worker; `done` is called with an empty text, or with why it failed."""

        def run() -> None:
            attempts, attempt, reason = self.robot.connect_attempts, 1, "the link has been closed"
            pause, longest = REOPEN_S
            patience = time.monotonic() + min(NOBODY_S, self.robot.connect_timeout_s)
            while attempt <= attempts and not self.outbox.closed:
                try:
                    self._connect()
                    reason = ""
                    break
                except LinkError as error:
                    reason = f"attempt {attempt} of {attempts}: {error}"
                    self._drop()
                    # A closed port says so at once: that is no attempt as long as it may be about to be opened.
                    nobody = REFUSED in reason and time.monotonic() < patience
                    attempt += not nobody
                    if nobody:
                        time.sleep(pause)
                        pause = min(2 * pause, longest / 4)
            done(reason)

        self._reopen = False
        self.outbox.put_order(run, urgent=True)

    def _open_again(self) -> None:
        """In the worker: the link has ended by itself; open it until it is open, closed, or connected anew."""
        pause, longest = REOPEN_S
        while self._reopen and not self.outbox.closed:
            try:
                self._connect(again=True)
            except LinkError:  # noqa: PERF203
                self._drop()
                time.sleep(pause)
                pause = min(2 * pause, longest)
            else:
                self._reopen = False
                self.reopened += 1

    def _connect(self, *, again: bool = False) -> None:
        """Connect; `again`: in flight perhaps, so nothing is set and the estimator is left alone.

        :raises LinkError: it did not work.
        """
        from cflib.crazyflie import Crazyflie

        self._drop()
        limit = min(self.robot.connect_timeout_s, REOPEN_TIMEOUT_S if again else math.inf)
        deadline = time.monotonic() + limit
        cf = Crazyflie(rw_cache=str(self._cache))
        opening = self._watch(cf, again)
        self._cf = cf
        cf.open_link(self.robot.uri)
        radio = RadioPort.of(cf)
        if radio is not None and not opening.heard.wait(FIRST_ANSWER_S) and not opening.failure:
            raise LinkError(f"no answer on the air within {FIRST_ANSWER_S:g} s")
        if not opening.settled.wait(max(0.0, deadline - time.monotonic())):
            raise LinkError(f"no answer within {limit:g} s")
        if opening.failure:
            raise LinkError(opening.failure)
        for name, value in self.robot.firmware_params.items() if not again else ():
            try:
                cf.param.set_value(name, value)
            except (KeyError, AttributeError) as error:  # noqa: PERF203
                raise LinkError(f"firmware parameter {name}: {error}") from error
        if self.board is not None and not again:
            self.board.prepare(cf)
        if self.robot.reset_estimator and not again:
            settle(cf, self._settling, self._seen, self.outbox.take_position, self.robot.estimator_timeout_s)
        self.firmware = _firmware(cf)
        self._start_log(cf, max(deadline, time.monotonic() + 2.0))
        if radio is not None:
            cf.link_statistics.latency.stop()  # its pings would wait behind a stuck packet, and have the link closed
        self._radio = radio
        if again and self.board is not None:
            self._spare_air()
        self.connected = True

    def start_agent(self, done: Callable[[str], None]) -> None:
        """Start the agent on board; `done` is called with an empty text, or with why it does not start.

        From then on the bridge asks seldom: its packets take air from the agents.
        """

        def start(cf: Any) -> None:
            assert self.board is not None
            try:
                self.board.start(cf)
            except LinkError as error:
                done(str(error))
            else:
                self._spare_air()
                done("")

        self.order(start, background=True)

    def _spare_air(self) -> None:
        if self._radio is not None and self.board is not None:
            self._radio.limit(self.board.polls_hz)
            # An order takes some packets of each way, and the log comes seldom.
            self._log_order_s = LOG_ORDER_S + 1.0 / self.robot.log_rate_hz + 5.0 / self.board.polls_hz

    def _watch(self, cf: Any, again: bool) -> _Opening:
        """Take note of all that cflib says about a connection, from its threads."""
        from cflib.crtp.crtpstack import CRTPPort

        opening = _Opening()

        def established(uri: str) -> None:
            opening.heard.set()
            if again and self.guarded:
                cf.supervisor.send_emergency_stop_watchdog()

        def broken(uri: str, message: str) -> None:
            reason = message.partition("\n\n")[0].replace("\n", " ")
            opening.failure = opening.failure or reason
            opening.settled.set()
            if self._cf is cf and self.connected:
                self.connected = False
                self._on_broken(f"link broken: {reason}")
                self._reopen = True
                self.outbox.put_order(self._open_again, urgent=True)

        (cf.connected if again else cf.fully_connected).add_callback(lambda uri: opening.settled.set())
        cf.link_established.add_callback(established)
        cf.connection_failed.add_callback(broken)
        cf.connection_lost.add_callback(broken)
        cf.add_port_callback(CRTPPort.SETPOINT_HL, self._answer)
        cf.packet_received.add_callback(lambda packet: self._reached(cf))
        cf.link_statistics.link_quality_updated.add_callback(self._quality)
        cf.link_statistics.uplink_rssi_updated.add_callback(self._rssi)
        return opening

    def _answer(self, packet: Any) -> None:
        if len(packet.data) > 3:
            self._on_answer(packet.data[0], packet.data[3])

    def _reached(self, cf: Any) -> None:
        """A packet came: with no acknowledgements that tells that the Crazyflie is there."""
        if self._cf is cf and self.connected and self._radio is None:
            self._acknowledged()

    def _quality(self, percent: float) -> None:
        self.radio_quality = percent / 100
        self._acknowledged()

    def _acknowledged(self) -> None:
        if self._heard.acknowledge(time.monotonic()) and self.guarded:  # its watchdog has not much time left
            self.order(lambda cf: cf.supervisor.send_emergency_stop_watchdog(), background=True)

    def _rssi(self, value: float) -> None:
        self.rssi = int(value)

    def _start_log(self, cf: Any, deadline: float) -> None:
        first = threading.Event()
        self._begin_log(cf, first.set)
        if not first.wait(max(0.0, deadline - time.monotonic())):
            raise LinkError("no log packets")

    def _begin_log(self, cf: Any, received: Callable[[], None]) -> None:
        """Order the log; `received` is called with each packet."""
        from cflib.crazyflie.log import LogConfig

        block = LogConfig("state", max(10, round(1000 / self.robot.log_rate_hz / 10) * 10))
        for name in LOG_VARIABLES:
            block.add_variable(name)

        def receive(stamp: int, values: dict[str, float], config: Any) -> None:
            self.received += 1
            self._on_state(decode_log(values), self._heard.sampled(stamp, time.monotonic()))
            received()

        block.data_received_cb.add_callback(receive)
        try:
            cf.log.add_config(block)
        except KeyError as error:
            raise LinkError(f"the firmware does not log {error}: update it") from error
        block.start()
        self._log_block = block

    def order_log(self, now: float) -> None:
        """Order the log anew, if it can be heard now (s, monotonic): the firmware ends it in a gap of a second."""
        heard = self._heard
        if heard.age(now) > STUCK_S or now - max(heard.logged, heard.since, self._log_ordered) < self._log_order_s:
            return
        self._log_ordered = now

        def order(cf: Any) -> None:
            self._log_block.delete()
            with contextlib.suppress(ValueError):
                cf.log.log_blocks.remove(self._log_block)
            self._begin_log(cf, lambda: None)

        self._post(lambda: self.run(order), urgent=False, background=True)

    def _drop(self) -> None:
        """Forget the connection. If there is one, a zero setpoint is sent: only for one that does not fly."""
        radio, self._radio = self._radio, None
        deaf = self._heard.age(time.monotonic()) > STUCK_S if radio is None else not radio.wait_for_room(0.0)
        silent = deaf or not self.connected
        self.connected = False
        cf, self._cf = self._cf, None
        if radio is not None:
            radio.close()
        if cf is not None:
            if silent and cf.link is not None:  # the setpoint would wait in vain, or meet one that flies
                link, cf.link = cf.link, None
                link.close()
            with contextlib.suppress(Exception):  # whatever state it is in, we are done with it
                cf.close_link()

    def close(self) -> None:
        """Close the connection and end the worker, after what waits in the outbox. Never in flight."""
        self.outbox.put_background(self._drop)
        self.outbox.close()

    def join(self, timeout: float) -> bool:
        """Wait for the worker to end (s); False if it has not."""
        self._thread.join(timeout)
        return not self._thread.is_alive()


def _firmware(cf: Any) -> tuple[int, str]:
    """Version of the protocol and revision of the firmware."""
    try:
        revision = f"{int(cf.param.get_value('firmware.revision0')):08x}"
        modified = int(cf.param.get_value("firmware.modified"))
    except (KeyError, AttributeError, TypeError, ValueError):
        return int(cf.platform.get_protocol_version()), "unknown"
    return int(cf.platform.get_protocol_version()), revision + (" modified" if modified else "")
