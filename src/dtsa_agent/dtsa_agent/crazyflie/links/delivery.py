"""High-level orders that have to arrive: sent again until the firmware has answered. Without ROS and without links."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

TAKEOFF, LAND, GO_TO, TRAJECTORY = "take-off", "landing", "go_to", "trajectory"
KINDS = {7: TAKEOFF, 8: LAND, 4: GO_TO, 12: GO_TO, 13: TRAJECTORY}  # by the first byte of the firmware's packets
ACCEPTED = (0, 1)  # 1: it takes off or lands already
REPEAT_S = 0.15
BUSY = 4  # a take-off is ordered so often while the supervisor lets no motor run: 3 s after a landing it goes through a
# state in which none may, also where the vehicle arms itself again at once
ENDS = 2  # the end of a stream of setpoints is not answered: it is sent this often again

Send = Callable[[Any], None]


@dataclass(slots=True)
class _Order:
    kind: str
    send: Send
    end: Send | None  # ends the stream of setpoints before it; None: there was none
    next: float  # s, monotonic, when to send again
    ends: int
    answered: bool = False
    busy: int = 0  # answers that the supervisor lets no motor run


class Delivery:
    """The last high-level order to one Crazyflie, and whether it is known to have arrived."""

    def __init__(self) -> None:
        self._order: _Order | None = None

    def begin(self, kind: str, send: Send, end: Send | None, now: float) -> None:
        """An order was sent; it replaces the one before.

        :param kind: `TAKEOFF`, `LAND`, `GO_TO` or `TRAJECTORY`.
        :param send: sends it once more, all of it.
        :param end: ends a stream of setpoints; None: there was none.
        :param now: s, monotonic.
        """
        self._order = _Order(kind, send, end, now + REPEAT_S, ENDS if end else 0)

    def cancel(self) -> None:
        """The order does not count any more."""
        self._order = None

    @property
    def landing(self) -> bool:
        """Whether the firmware has said that it lands."""
        return self._order is not None and self._order.kind == LAND and self._order.answered

    def answered(self, code: int, result: int) -> str:
        """The firmware has answered a high-level order; why it refuses, or an empty text.

        :param code: the order's first byte.
        :param result: 0, or the number of an error.
        """
        order = self._order
        if order is None or KINDS.get(code) != order.kind or order.answered:
            return ""
        if result in ACCEPTED:
            order.answered = True
            return ""
        if order.kind == TAKEOFF and result == errno.EBUSY:
            order.busy += 1
            if order.busy < BUSY:
                return ""  # `due` sends it again
        self._order = None  # it would refuse it again
        return f"the firmware refuses the {order.kind} (error {result})"

    def due(self, now: float) -> Send | None:
        """What has to be sent now, if anything.

        :param now: s, monotonic.
        """
        order = self._order
        if order is None or now < order.next:
            return None
        order.next = now + REPEAT_S
        if not order.answered:
            return order.send
        if order.ends > 0:
            order.ends -= 1
            return order.end
        return None
