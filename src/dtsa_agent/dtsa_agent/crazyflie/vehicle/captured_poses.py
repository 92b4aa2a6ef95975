"""One Crazyflie and motion capture: what is believed goes to the vehicle, what is not stands in the log."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from dtsa_agent.crazyflie.links.outbox import Position
from dtsa_agent.crazyflie.positions.motion_capture import EXTPOSE, PositionSettings, Room, Seen, Tracker
from dtsa_agent.crazyflie.state.conversions import Quaternion, Vector

FRESH_S = 0.3  # a pose that is not older is where the vehicle is
COMPLAIN_S = 5.0  # a vehicle's refused poses stand in the log this often at most


class CapturedPoses:
    """Poses of one Crazyflie from motion capture.

    :param name: the Crazyflie's.
    :param settings: what is believed and sent.
    :param origin: m, where the Crazyflies' world sees the origin of `map`.
    :param room: m, map; None: no limits.
    :param log: called with a level and a line.
    """

    def __init__(
        self, name: str, settings: PositionSettings, origin: Vector, room: Room | None, log: Callable[[str, str], None]
    ) -> None:
        self.settings = settings
        self.tracker = Tracker(settings, origin, room)
        self._name, self._log = name, log
        self._complained = -math.inf

    def see(
        self, position: Vector, orientation: Quaternion, frame: str, stamp: float, now: float, *, flying: bool
    ) -> Position | None:
        """Take in a pose; what has to be sent to the Crazyflie, if anything. Parameters: see `Tracker.offer`."""
        tracker = self.tracker
        problem = tracker.offer(position, orientation, frame, stamp, now, flying=flying)
        if problem:
            if now - self._complained > COMPLAIN_S:
                self._complained = now
                self._log("warn", f"{self._name}: a pose of motion capture is refused: {problem}")
            return None
        assert tracker.last is not None
        return Position(self._packet(tracker.last)) if tracker.due(now) else None

    def _packet(self, seen: Seen) -> Callable[[Any], None]:
        x, y, z = seen.position

        def send(cf: Any) -> None:
            if self.settings.send == EXTPOSE and seen.orientation is not None:
                cf.loc.send_extpose((x, y, z), seen.orientation)
            else:
                cf.loc.send_extpos((x, y, z))
            self.tracker.was_sent(seen, time.time())

        return send

    def place(self, now: float) -> Vector | None:
        """Where the vehicle is (m, world); None: it is not seen, or not any more.

        :param now: s, monotonic.
        """
        last = self.tracker.last
        return None if last is None or now - last.time > FRESH_S else last.position

    def disagrees(self, believed: Vector, now: float) -> str:
        """Why a vehicle may not start that believes to be there (m, world); empty if it may.

        :param believed: (3,) m, world.
        :param now: s, monotonic.
        """
        seen = self.place(now)
        if seen is None:
            return f"is not seen by motion capture ({self.tracker.reason or 'no pose comes'})"
        away = math.dist(seen, believed)
        if away <= self.settings.agree_m:
            return ""
        return f"is seen {away:.2f} m from where it believes to be (limit {self.settings.agree_m:g} m): reconnect it"
