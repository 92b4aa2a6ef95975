"""What a link over the air needs beyond cflib's: room before it sends, and a way past a packet that is stuck.

cflib's driver repeats a packet until it is acknowledged, and has room for one more. While a Crazyflie is out of reach,
or only its acknowledgements are, everything behind that packet waits; a sender is blocked, and after two seconds cflib
closes the link. After 100 missing acknowledgements it closes the link, too, unless told otherwise.

Checked against cflib 0.1.34, whose names beginning with an underscore are used here: the queues of the driver, of the
shared radio, and the bits of the safelink.

Upstream: crazyflie-lib-python, issue 63 (links that close after missing acknowledgements), and crazyflie-link-cpp,
issue 24 (set-points that are repeated although newer ones wait).
Delete when: cflib can send a set-point without repeating it, and tells a sender that there is no room.
"""

from __future__ import annotations

import array
import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

NEVER = -1  # cflib counts down to 0: it never arrives there
ROOM_S = 0.1  # a packet that the driver cannot take for that long is stuck
GAP_S = 0.2  # nothing acknowledged for that long
PAST_S = 0.5  # longest wait for a packet past the queue; the dongle has other Crazyflies to serve
UP, DOWN = 0x08, 0x04


def keep_links_open() -> None:
    """Let cflib keep links open, however many acknowledgements are missing. For all links that are opened later."""
    from cflib.crtp import radiodriver

    radiodriver.set_retries_before_disconnect(NEVER)


class Recorder:
    """Takes cflib's commands and keeps their packets instead of sending them."""

    def __init__(self, cf: Any) -> None:
        from cflib.crazyflie.commander import Commander
        from cflib.crazyflie.high_level_commander import HighLevelCommander
        from cflib.crazyflie.localization import Localization
        from cflib.crazyflie.supervisor import Supervisor

        self.packets: list[bytes] = []
        self.platform = cf.platform
        self.commander = Commander(self)
        self.high_level_commander = HighLevelCommander(self)
        self.supervisor = Supervisor(self)
        self.loc = Localization(self)

    def send_packet(self, packet: Any, *_: Any, **__: Any) -> None:
        self.packets.append(bytes((packet.header,)) + bytes(packet.data))

    def add_port_callback(self, *_: Any) -> None:
        pass


def packets_of(cf: Any, action: Callable[[Any], None]) -> list[bytes] | None:
    """The packets of an order; None if it does not consist of commands alone."""
    recorder = Recorder(cf)
    try:
        action(recorder)
    except AttributeError:  # parameters and logs need their answers
        return None
    return recorder.packets


class RadioPort:
    """The radio of one link, which the worker looks at before it sends."""

    def __init__(self, cf: Any) -> None:
        self._driver = cf.link
        self._instance: Any = None
        self._room_s = ROOM_S

    @classmethod
    def of(cls, cf: Any) -> RadioPort | None:
        """The radio of a link; None: it goes by another way."""
        from cflib.crtp.radiodriver import RadioDriver

        return cls(cf) if isinstance(cf.link, RadioDriver) else None

    def limit(self, polls_hz: float) -> None:
        """From now on at most so many packets a second go to the Crazyflie."""
        thread = self._driver._thread
        if thread is not None:
            thread.rate_limit = polls_hz  # it sleeps for that long after each acknowledgement
        self._room_s = ROOM_S + 2.0 / polls_hz

    @property
    def has_room(self) -> bool:
        """Whether the driver can take a packet; waits for a while."""
        return self.wait_for_room(self._room_s)

    def wait_for_room(self, seconds: float) -> bool:
        """Wait until the driver can take a packet; False when it still cannot after so many seconds."""
        waiting: queue.Queue[Any] = self._driver.out_queue
        with waiting.not_full:
            there = waiting.not_full.wait_for(lambda: waiting._qsize() < waiting.maxsize, seconds)
            if there:  # the room is not taken here: a thread of cflib's that waits for it would sleep on, for 2 s
                waiting.not_full.notify()
            return there

    def send(self, cf: Any, packets: Sequence[bytes]) -> bool:
        """Send packets one after the other; False when there was no room for one: the rest was sent past it."""
        from cflib.crtp.crtpstack import CRTPPacket

        for number, packet in enumerate(packets):
            if not self.has_room:
                self.send_past(packets[number:])
                return False
            cf.send_packet(CRTPPacket(packet[0], packet[1:]))
        return True

    def send_past(self, packets: Sequence[bytes]) -> bool:
        """Send packets before those that wait; whether one of them was acknowledged.

        With safelink a packet counts only with the bit that the Crazyflie expects, which is known to nobody while
        acknowledgements are missing: each packet is sent with both, one after the other. The last one leaves the bit
        as if the packet that is stuck had arrived, so that its repetitions do not count. What waits behind it is
        older than these packets, and is forgotten: a streamed command would take the controls back.
        """
        thread = self._driver._thread
        if thread is None:
            return False
        with contextlib.suppress(queue.Empty):
            self._driver.out_queue.get_nowait()
        instance = self._opened()
        acknowledged = False
        for packet in packets:
            copies = [packet]
            if thread._has_safelink:
                rest = packet[0] & 0xF3 | (DOWN if thread._curr_down else 0)
                bits = (0, UP) if thread._curr_up else (UP, 0)
                copies = [bytes((rest | bit,)) + packet[1:] for bit in bits]
            acknowledged |= _send_together(instance, copies)
        return acknowledged

    def _opened(self) -> Any:
        if self._instance is None:
            from cflib.crtp.radiodriver import RadioManager

            number, channel, rate, address, _ = self._driver.parse_uri(self._driver.uri)
            self._instance = RadioManager.open(number)
            self._instance.set_channel(channel)
            self._instance.set_data_rate(rate)
            self._instance.set_address(address)
        return self._instance

    def close(self) -> None:
        """The link ends."""
        if self._instance is not None:
            self._instance.close()
            self._instance = None


def _send_together(instance: Any, packets: Sequence[bytes]) -> bool:
    """Send packets through a shared radio with nobody's packet between them; whether one was acknowledged."""
    from cflib.crtp.radiodriver import _RadioCommands

    for packet in packets:
        data = array.array("B", packet)
        command = (instance._channel, instance._address, instance._datarate, data)
        instance._cmd_queue.put((instance._instance_id, _RadioCommands.SEND_PACKET, command))
    end = time.monotonic() + PAST_S
    acknowledged = False
    for _ in packets:
        try:
            answer = instance._rsp_queue.get(timeout=max(0.0, end - time.monotonic()))
        except queue.Empty:
            break
        acknowledged |= bool(answer and answer.ack)
    return acknowledged


class Heard:
    """When something was last acknowledged, and how old the log is that comes.

    After a gap the Crazyflie delivers what it logged meanwhile: packets that come are not always new. Their time stamps
    tell, as the smallest delay that was ever seen is that of a packet without a wait. Times (`now`) are s, monotonic.
    """

    DRIFT = 1e-4  # of the Crazyflie's clock against ours, at most
    RESTARTED_S = 5.0  # a stamp that is so far off is that of a Crazyflie that was switched on again

    def __init__(self) -> None:
        self.since = -math.inf  # s, monotonic, when a gap ended
        self.logged = -math.inf  # s, monotonic, when a log packet came
        self._acknowledged = -math.inf
        self._offset: float | None = None
        self._last = 0.0
        self._lock = threading.Lock()

    def age(self, now: float) -> float:
        """Seconds since something was acknowledged, or came over another way than the air; infinite before that."""
        return now - self._acknowledged

    def acknowledge(self, now: float) -> bool:
        """Something was acknowledged, or came; whether that ends a gap."""
        gap = self.age(now) > GAP_S
        if gap:
            self.since = now
        self._acknowledged = now
        return gap

    def sampled(self, stamp_ms: int, now: float) -> float:
        """When the values of a log packet that has come now were taken; its time stamp is of the Crazyflie's clock."""
        with self._lock:
            self.logged = now
            stamp = stamp_ms / 1000
            offset = now - stamp
            if self._offset is None or abs(offset - self._offset) > self.RESTARTED_S:
                self._offset = offset
            else:
                self._offset = min(offset, self._offset + self.DRIFT * (now - self._last))
            self._last = now
            return min(now, stamp + self._offset)
