"""Crazyradios and UDP ports as links of cflib, by its public interface: drivers that the bridge brings along.

cflib's own driver over the air repeats one packet until it is acknowledged while all others wait behind it, closes the
link after 100 missing acknowledgements, and its thread dies with the dongle; over UDP a closed port ends the link. Here

- one thread a dongle serves its Crazyflies in turn, through `cflib.drivers.crazyradio.Crazyradio`;
- a mailbox a Crazyflie has all commands in sequence, the newest set-point, the newest position, and requests that want
  an answer (parameters, logs). Sending never waits. Commands come first; the others take turns;
- with safelink a bit tells a new packet from a repetition. A packet is repeated until it is acknowledged, set-points
  and positions only for a short while and as long as there is no newer one. While nothing is acknowledged, perhaps
  because only the acknowledgements are missing, commands are sent with either bit, one after the other: one counts;
- a link never ends by itself. A dongle that is pulled is named; once it is there again its links go on;
- set-points of port 3, of which `close_link` sends one, never leave.

Upstream: crazyflie-lib-python, issue 63 (links that close after missing acknowledgements), and crazyflie-link-cpp,
issue 24 (set-points that are repeated although newer ones wait).
Delete when: cflib's drivers keep the newest set-point only, outlive a silence and a dongle that is pulled.
"""

from __future__ import annotations

import contextlib
import math
import queue
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import cflib.crtp
from cflib.crtp.crtpdriver import CRTPDriver
from cflib.crtp.crtpstack import CRTPPacket
from cflib.crtp.exceptions import WrongUriType
from cflib.drivers.crazyradio import Crazyradio, get_serials

from .addresses import ANY, BITRATES, Address, parse_address

Report = Callable[[str, str], None]  # level and line
COMMAND, SETPOINT, POSITION, REQUEST, EMPTY = "command", "setpoint", "position", "request", "empty"
NULL = b"\xff"
SAFELINK, SAFELINK_TRIES = b"\xff\x05\x01", 10  # asks for the bits, and is answered by itself
HEADER, UP_BIT, DOWN_BIT = 0xF3, 0x08, 0x04
# By the supervisor's port, and by the localization's, where firmware before protocol version 12 has them.
EMERGENCY, WATCHDOG = (b"\x91\x03", b"\x61\x03"), (b"\x91\x04", b"\x61\x04")
END_OF_STREAM, HIGH_LEVEL, LEGACY_SETPOINT = 0x71, 0x80, 0x30
DEAF_S = 0.25  # nothing acknowledged for that long, though the dongle asks all the time
MOST = {COMMAND: 20, REQUEST: None, SETPOINT: 1, POSITION: 1}  # that wait: of some the newest alone
# What has waited longer comes unexpected, whether it was sent or not.
LIFE_S = {COMMAND: 1.0, REQUEST: math.inf, SETPOINT: DEAF_S, POSITION: DEAF_S, EMPTY: math.inf}
RELAXED_S, BUSY_POLLS = 0.01, 10  # pause between polls once so many in a row were answered with nothing
ABSENT_S, ABSENT_POLL_S = 1.0, 0.02  # pause between polls of one that has not answered for that long
REOPEN_S = 0.3  # between attempts to find a dongle that has gone
LATE_ANSWERS = 3  # a dongle that does not answer so often has gone
CLOSE_S = 0.3  # longest wait at the end for commands that have not been sent
BROADCAST = (0xFF, 0xE7, 0xE7, 0xE7, 0xE7)  # every Crazyflie listens to it, and acknowledges nothing
ROUNDS, PAUSE_S = 25, 0.02  # of an emergency stop by broadcast, and the time between two
FOREIGN_SHARE, FOREIGN_PACKETS = 0.25, 200  # so many packets repeated, of the last so many: another program sends


def kind_of(packet: bytes) -> str:
    header, first = packet[0] & HEADER, packet[1] if len(packet) > 1 else -1
    if header == 0x70:
        return SETPOINT
    if header == 0x60 or (header == 0x61 and first == 8):
        return POSITION
    return COMMAND if header in (END_OF_STREAM, HIGH_LEVEL, 0x91, 0x61, 0xD0) else REQUEST


class WaitingPacket(NamedTuple):
    """A packet that is to be sent, or to be acknowledged."""

    kind: str
    data: bytes
    since: float  # s, monotonic

    def has_expired(self, now: float) -> bool:
        """Whether it does not count any more; an emergency stop always does."""
        return now - self.since >= LIFE_S[self.kind] and not (self.kind == COMMAND and self.data[1:2] == b"\x03")


class Mailbox:
    """What one Crazyflie is to be sent, by kind. For any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.waiting: dict[str, deque[WaitingPacket]] = {kind: deque(maxlen=n) for kind, n in MOST.items()}
        self._turns = [SETPOINT, REQUEST, POSITION]

    def add(self, packet: bytes) -> None:
        """Add a packet; an order ends the stream of set-points, an emergency stop empties the box."""
        start, commands = bytes((packet[0] & HEADER, *packet[1:2])), self.waiting[COMMAND]
        with self._lock:
            if start in EMERGENCY:
                self.waiting[REQUEST].clear()
                for other in [entry for entry in commands if entry.data != packet]:
                    commands.remove(other)
            if start in EMERGENCY or start[0] in (END_OF_STREAM, HIGH_LEVEL):
                self.waiting[SETPOINT].clear()
            if start not in WATCHDOG or all(packet != waiting.data for waiting in commands):
                kind = kind_of(packet)
                self.waiting[kind].append(WaitingPacket(kind, packet, time.monotonic()))

    def pop(self, kind: str = "") -> WaitingPacket | None:
        """Return the next packet, of one kind or of any; None: there is none."""
        with self._lock:
            now = time.monotonic()
            for turn in [kind] if kind else [COMMAND, *self._turns]:
                while self.waiting[turn]:
                    packet = self.waiting[turn].popleft()
                    if not packet.has_expired(now):
                        if turn != COMMAND:
                            self._turns.remove(turn)
                            self._turns.append(turn)
                        return packet
        return None


class RadioDriver(CRTPDriver):  # type: ignore[misc]
    """One Crazyflie's link over a dongle. `due`, `exchange` and what they call belong to the dongle's thread."""

    def __init__(self, radios: DongleSet) -> None:
        super().__init__()
        self.quality, self.rssi = 1.0, 0  # 0 to 1, and -dBm
        self.on_acknowledged: Callable[[], None] = lambda: None  # anything has been acknowledged
        self.on_setpoint_sent: Callable[[], None] = lambda: None  # a set-point has been acknowledged
        self.mailbox = Mailbox()
        self._radios = radios
        self._dongle: DongleThread | None = None
        self._arrived: queue.Queue[Any] = queue.Queue()
        self._pending: WaitingPacket | None = None  # sent, and not acknowledged
        self._tries, self._safelink, self._up, self._down = 0, False, 0, 0
        self._last = self._least_s = 0.0  # s: when a packet last went (monotonic), and shortest time between two
        self._acknowledged = -math.inf  # s, monotonic
        self._empty_polls, self._established = 0, False
        self._scores: deque[int] = deque(maxlen=100)  # 10 less the repetitions of each packet

    def connect(self, uri: str, statistics: Any, error: Callable[[str], None] | None) -> None:
        """Open the link; raises an error while there is no such dongle."""
        if not uri.startswith("radio://"):
            raise WrongUriType("not a radio")
        self.address = parse_address(uri)
        self.node = tuple(bytes.fromhex(self.address.node))
        self.rate = tuple(BITRATES).index(self.address.rate)
        limit = uri.partition("rate_limit=")[2].partition("&")[0]
        if limit.isdigit() and int(limit):
            self.limit(float(limit))
        self._dongle = self._radios.dongle(self.address)
        self._dongle.add(self)

    def limit(self, polls_hz: float) -> None:
        """From now on send at most so many packets a second."""
        self._least_s = 1.0 / polls_hz

    def send_packet(self, pk: Any) -> bool:
        if pk.header & 0xF0 != LEGACY_SETPOINT and self._dongle is not None:
            self.mailbox.add(bytes((pk.header,)) + bytes(pk.data))
            self._dongle.wake()
        return True

    def receive_packet(self, wait: float = 0) -> Any:
        with contextlib.suppress(queue.Empty):
            return self._arrived.get(wait != 0, None if wait < 0 else wait)
        return None

    def close(self) -> None:
        dongle, self._dongle = self._dongle, None
        if dongle is not None:
            dongle.remove(self)
        self._arrived.put(None)  # wakes a thread that waits for a packet

    def due(self, now: float) -> float:
        """Return when the next packet goes (s, monotonic)."""
        pause, absent = self._least_s, now - self._acknowledged > ABSENT_S and self._tries >= SAFELINK_TRIES
        if absent and not self.mailbox.waiting[COMMAND]:
            pause = max(pause, ABSENT_POLL_S)
        elif self._pending is None and self._empty_polls > BUSY_POLLS and not any(self.mailbox.waiting.values()):
            pause = max(pause, RELAXED_S)
        return self._last + pause

    def exchange(self, radio: Any) -> bool | None:
        """Send the next packet and take the answer.

        :returns: whether it had to be repeated; None: the dongle has not answered.
        """
        now = self._last = time.monotonic()
        radio.set_channel(self.address.channel)
        radio.set_address(self.node)
        radio.set_data_rate(self.rate)
        greeting = not self._safelink and self._tries < SAFELINK_TRIES
        packet, both = (SAFELINK, False) if greeting else self._choose(now)
        self._tries += greeting
        answer = None
        for up in (1 - self._up, self._up) if both else (self._up,):
            bits = bytes((packet[0] & HEADER | up * UP_BIT | self._down * DOWN_BIT,)) if self._safelink else packet[:1]
            answer = radio.send_packet(bits + packet[1:])
            if answer is not None and answer.ack:
                self._answered(bytes(answer.data), answer.retry, greeting)
                return bool(answer.retry)
        return None if answer is None else False

    def _choose(self, now: float) -> tuple[bytes, bool]:
        """Return the packet to send, and whether with either bit."""
        box, pending, both = self.mailbox, self._pending, False
        if pending is None:
            pending = box.pop() or WaitingPacket(EMPTY, NULL, now)
        elif now - self._acknowledged > DEAF_S:
            if (command := box.pop(COMMAND)) is not None:
                if pending.kind == REQUEST:  # it may not have arrived
                    box.waiting[REQUEST].appendleft(pending)
                pending, both = command, True
            elif pending.kind in (SETPOINT, POSITION) or pending.has_expired(now):
                pending = WaitingPacket(EMPTY, NULL, now)
        elif pending.kind in (SETPOINT, POSITION):
            pending = box.pop(pending.kind) or pending
        self._pending = pending
        return pending.data, both

    def _answered(self, data: bytes, repeated: int, greeting: bool) -> None:
        self._scores.append(10 - repeated)
        self.quality = sum(self._scores) / len(self._scores) / 10
        kind, fresh = EMPTY, bool(data)
        if greeting:
            self._safelink, fresh = data == SAFELINK, False
            self.needs_resending = not self._safelink
        else:
            kind, self._pending = self._pending.kind if self._pending else EMPTY, None
            if self._safelink:
                fresh = fresh and data[0] & DOWN_BIT == self._down * DOWN_BIT
                self._up, self._down = 1 - self._up, 1 - self._down if fresh else self._down
        if kind == SETPOINT:
            self.on_setpoint_sent()
        self._acknowledged = time.monotonic()
        self.on_acknowledged()
        if not fresh:
            return
        nothing = data[0] & HEADER == HEADER
        self._empty_polls = self._empty_polls + (kind == EMPTY) if nothing else 0
        if nothing and data[1:2] == b"\x01" and len(data) > 2:
            self.rssi = data[2]
        if not nothing or not self._established:  # cflib wants one packet, whatever it is, to begin
            self._established = True
            self._arrived.put(CRTPPacket(data[0], list(data[1:])))


class DongleThread(threading.Thread):
    """A Crazyradio (number or serial), and the thread that serves its Crazyflies (names by link) in turn."""

    def __init__(self, radio: str, report: Report, names: dict[str, str]) -> None:
        super().__init__(name=f"radio {radio}", daemon=True)
        self.radio, self._report, self._names = radio, report, names
        self.foreign = False  # another radio sends on the channel, as it seems
        self._condition = threading.Condition()
        self._links: list[RadioDriver] = []
        self._stops: list[tuple[float, int, int]] = []  # when (s, monotonic), channel, rate of a stop of all
        self._closing = False
        self._late, self._serial = 0, ""
        self._repeated: deque[bool] = deque()
        self._device: Any = self._open()
        self.start()

    def _open(self) -> Any:
        serials = get_serials()
        if not self._serial:
            number = int(self.radio) if len(self.radio) < 10 else len(serials)
            self._serial = serials[number] if number < len(serials) else self.radio
        if self._serial not in serials:
            raise OSError(f"radio {self.radio} is not there")
        if serials.count(self._serial) > 1:  # old firmware: all have one serial number
            return Crazyradio(devid=int(self.radio))
        return Crazyradio(serial=self._serial)

    def add(self, link: RadioDriver) -> None:
        """Serve a link; raises an error while the dongle is not there."""
        if self._device is None:
            raise OSError(f"radio {self.radio} is not there")
        with self._condition:
            self._links.append(link)
            self._condition.notify()

    def remove(self, link: RadioDriver) -> None:
        """Serve a link no more, once its commands are sent or have waited for long enough."""
        end = time.monotonic() + CLOSE_S
        while self._device is not None and link.mailbox.waiting[COMMAND] and time.monotonic() < end:
            time.sleep(0.005)
        with self._condition:
            self._links.remove(link)
            self._condition.notify()

    def wake(self) -> None:
        with self._condition:
            self._condition.notify()

    def stop_channel(self, channel: int, rate: int) -> None:
        """Stop all Crazyflies on a channel, again and again; does not wait."""
        now = time.monotonic()
        with self._condition:
            self._stops = sorted([*self._stops, *((now + k * PAUSE_S, channel, rate) for k in range(ROUNDS))])
            self._condition.notify()

    def close(self) -> None:
        self._closing = True
        self.wake()
        self.join(2.0)

    def run(self) -> None:
        turn = 0
        while not self._closing or self._stops:
            if self._device is None and not self._find():
                if self._closing:
                    return
                time.sleep(REOPEN_S)
                continue
            with self._condition:
                now, links = time.monotonic(), self._links[turn:] + self._links[:turn]
                due = [link.due(now) for link in links]
                ready = next((link for link, when in zip(links, due, strict=True) if when <= now), None)
                stop = self._stops.pop(0) if self._stops and self._stops[0][0] <= now else None
                if ready is None and stop is None and (self._stops or not self._closing):
                    due += [when for when, _, _ in self._stops]
                    self._condition.wait(max(0.0, min(due) - now) if due else None)
                    continue
                turn = (self._links.index(ready) + 1) % len(self._links) if ready is not None else 0
            try:
                if stop is not None:
                    self._send_stop(*stop[1:])
                if ready is not None:
                    self._serve(ready)
            except Exception as error:  # USB's errors have no common base
                self._lose(str(error))
        with contextlib.suppress(Exception):
            self._device.close()

    def _serve(self, link: RadioDriver) -> None:
        repeated = link.exchange(self._device)
        self._late = self._late + 1 if repeated is None else 0
        if self._late and (self._late >= LATE_ANSWERS or self._serial not in get_serials()):
            raise OSError("no answer on USB")
        self._repeated.append(bool(repeated))
        if len(self._repeated) == FOREIGN_PACKETS:
            share, before = sum(self._repeated) / FOREIGN_PACKETS, self.foreign
            self._repeated.clear()
            self.foreign = share > FOREIGN_SHARE
            if self.foreign and not before:
                text = f"{share:.0%} of the packets on channel {link.address.channel} are repeated"
                self._report("warn", f"radio {self.radio}: {text}: does another transmitter use its channel?")

    def _send_stop(self, channel: int, rate: int) -> None:
        self._device.set_channel(channel)
        self._device.set_data_rate(rate)
        self._device.set_address(BROADCAST)
        self._device.set_ack_enable(False)
        for packet in EMERGENCY:
            self._device.handle.write(endpoint=1, data=bytes((packet[0] | 0x0C, packet[1])), timeout=100)
        self._device.set_ack_enable(True)

    def _lose(self, why: str) -> None:
        links = {link.address.link for link in self._links}
        served = ", ".join(name for link, name in self._names.items() if link in links)  # in the file's order
        gone = f"radio {self.radio} ({self._serial}) is gone ({why})"
        self._report("error", f"{gone}: {served or 'no vehicle'} out of reach")
        device, self._device = self._device, None
        with contextlib.suppress(Exception):
            device.close()

    def _find(self) -> bool:
        with contextlib.suppress(Exception):  # not there yet
            self._device, self._late = self._open(), 0
            self._report("info", f"radio {self.radio} ({self._serial}) is there again")
        return self._device is not None


class UdpDriver(CRTPDriver):  # type: ignore[misc]
    """A link over UDP, for simulated Crazyflies. It ends by errors only before something was heard over it."""

    def connect(self, uri: str, statistics: Any, error: Callable[[str], None] | None) -> None:
        if not uri.startswith("udp://"):
            raise WrongUriType("not UDP")
        address = parse_address(uri)
        self.needs_resending, self._error, self._heard = False, error, False
        self._socket: Any = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((address.host, address.port))

    def send_packet(self, pk: Any) -> bool:
        for last in (False, True) if pk.header & 0xF0 != LEGACY_SETPOINT else ():
            try:
                self._socket.send(bytes((pk.header,)) + bytes(pk.data))
                break
            except OSError as problem:  # perhaps the answer to an earlier packet: this one was not sent
                if last:
                    self._fail(problem)
        return True

    def receive_packet(self, wait: float = 0) -> Any:
        try:
            self._socket.settimeout(None if wait < 0 else wait)
            data = self._socket.recv(64)
        except (TimeoutError, BlockingIOError):
            return None
        except OSError as problem:  # a closed port: it may be opened again
            self._fail(problem)
            time.sleep(0.005)
            return None
        self._heard |= bool(data)
        return CRTPPacket(data[0], list(data[1:])) if data else None

    def _fail(self, problem: OSError) -> None:
        error, self._error = self._error, None
        if error is not None and not self._heard:
            error(str(problem))

    def close(self) -> None:
        self._error = None
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits for a packet
        self._socket.close()


class DongleSet:
    """The dongles of one bridge; cflib opens links by the drivers above until it is closed.

    The first dongle that no link uses is kept for emergency stops. Dongles that come and go are reported.
    """

    def __init__(self, robots: Iterable[tuple[str, Address]], report: Report) -> None:
        robots = list(robots)
        self._names = {address.link: name for name, address in robots}
        self._addresses = [address for _, address in robots if address.radio]
        self._report = report
        self.dongles: dict[str, DongleThread] = {}
        self._lock = threading.Lock()
        self._drivers: list[Any] = [partial(RadioDriver, self), UdpDriver]
        cflib.crtp.CLASSES[:0] = self._drivers
        self.spare = self._open_spare() if self._addresses else None

    def dongle(self, address: Address) -> DongleThread:
        """Return the dongle of an address; raises an error if it is not there."""
        radio = self._radio(address)
        with self._lock:
            if radio not in self.dongles:
                self.dongles[radio] = DongleThread(radio, self._report, self._names)
            return self.dongles[radio]

    def _radio(self, address: Address) -> str:
        """Return the dongle of an address; of links that name none: one a channel, as far as there are dongles."""
        if address.radio != ANY:
            return address.radio
        named = {a.channel: a.radio for a in reversed(self._addresses) if a.radio != ANY}
        channels = sorted({a.channel for a in self._addresses} - named.keys())
        free = [str(n) for n in range(len(get_serials())) if str(n) not in named.values()] or ["0"]
        return named.get(address.channel) or free[channels.index(address.channel) % len(free)]

    def _open_spare(self) -> DongleThread | None:
        used = {self._radio(address) for address in self._addresses}
        for number, serial in enumerate(get_serials()):
            if used & {str(number), serial}:
                continue
            try:
                spare = DongleThread(str(number), self._report, self._names)
            except Exception as error:  # in use by another program, or no right to use it
                self._report("warn", f"radio {number} cannot be used for emergency stops: {error}")
            else:
                self._report("info", f"radio {number} is kept for emergency stops")
                return spare
        self._report("warn", "no radio is left for emergency stops: they go by the radios of the links")
        return None

    def stop_all(self) -> None:
        """Stop all Crazyflies on the swarm's channels, by broadcast, again and again; does not wait."""
        for address in {(a.radio, a.channel, a.rate): a for a in self._addresses}.values():
            with contextlib.suppress(Exception):  # a dongle that is not there must not keep the others from it
                dongle = self.spare or self.dongle(address)
                dongle.stop_channel(address.channel, tuple(BITRATES).index(address.rate))

    def close(self) -> None:
        cflib.crtp.CLASSES[:] = [driver for driver in cflib.crtp.CLASSES if driver not in self._drivers]
        for dongle in (*self.dongles.values(), *([self.spare] if self.spare else [])):
            dongle.close()
