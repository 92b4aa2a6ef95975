"""Orders to a firmware's high-level commander: how long they take, and whether they have arrived.

The firmware flies polynomials of degree 7 from rest to rest, whatever the duration. If it is too short, the vehicle
lags behind its path, and a landing stops the motors at the end of the path, wherever the vehicle is. So durations that
no vehicle can keep are refused, and a landing takes longer. Times (`now`) are s, monotonic.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Any

from .link import Send
from .settings import GroundStationSettings

PEAK = 35 / 16  # largest over mean speed of such a polynomial, at its middle
SHORTEST_S = 0.1  # of any path, however short
MIN_LAND_S = 1.0
TAKEOFF, LAND, GO_TO = "take-off", "landing", "go_to"
KINDS = {7: TAKEOFF, 8: LAND, 4: GO_TO, 12: GO_TO}  # by the first byte of the firmware's packets
ACCEPTED = (0, 1)  # 1: it takes off or lands already
REPEAT_S = 0.15
BUSY = 4  # a take-off is ordered so often while the supervisor lets no motor run: 3 s after a landing it goes through a
# state in which none may, also where the vehicle arms itself again at once
ENDS = 2  # the end of a stream of setpoints is not answered: it is sent this often again


def shortest_s(distance: float, limit: float) -> float:
    """Shortest duration (s) of a path (m) from rest to rest with a largest speed of `limit` (m/s)."""
    return max(SHORTEST_S, PEAK * abs(distance) / limit)


def too_short(duration: float, distance: float, limit: float) -> str:
    """Why a duration (s) is too short for a distance (m) at a largest speed of `limit` (m/s); empty if it is not."""
    needed = shortest_s(distance, limit)
    if duration >= needed:
        return ""
    allowed = f"at least {needed:.2f} s (station.max_speed_mps is {limit:g})"
    return f"duration {duration:.2f} s is too short for {abs(distance):.2f} m: {allowed}"


def landing_s(distance: float, wanted: float, station: GroundStationSettings) -> float:
    """Duration (s) of a landing over a distance (m): as wanted (0: at the station's speed), or longer if too short."""
    seconds = wanted if wanted > 0.0 else max(MIN_LAND_S, abs(distance) / station.land_speed_mps)
    return max(seconds, shortest_s(distance, station.max_speed_mps))


def end_of_stream(cf: Any) -> None:
    """Tell the firmware that the stream of setpoints is over."""
    cf.commander.send_notify_setpoint_stop()


@dataclass(slots=True)
class RepeatedOrder:
    """An order that was sent, and is sent again until the firmware has answered."""

    kind: str
    send: Send
    end: Send | None  # ends the stream of setpoints before it; None: there was none
    next: float  # s, monotonic, when to send again
    ends: int = ENDS
    answered: bool = False
    busy: int = 0  # answers that the supervisor lets no motor run

    def note_answer(self, code: int, result: int) -> str:
        """Take an answer to an order (its first byte), 0 or an errno; why this one is refused for good, or ""."""
        if KINDS.get(code) != self.kind or self.answered:
            return ""
        self.answered = result in ACCEPTED
        busy = self.kind == TAKEOFF and result == errno.EBUSY
        self.busy += busy
        return "" if self.answered or (busy and self.busy < BUSY) else f"refuses the {self.kind} (error {result})"

    def due(self, now: float) -> Send | None:
        """Return what has to be sent now, if anything."""
        if now < self.next:
            return None
        self.next = now + REPEAT_S
        if not self.answered:
            return self.send
        self.ends -= 1
        return self.end if self.ends >= 0 else None
