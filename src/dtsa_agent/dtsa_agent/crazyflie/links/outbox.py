"""What one link's worker has to send: orders in sequence, of streamed commands and of positions only the latest."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dtsa_agent.crazyflie.state.conversions import Setpoint

Order = Callable[[], None]


@dataclass(frozen=True, slots=True)
class Position:
    """Where motion capture sees a Crazyflie."""

    send: Callable[[Any], None]  # tells the connected one


class Outbox:
    """Orders (all, in sequence), one setpoint and one position (the latest), in this order.

    An urgent order empties the box.
    """

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._orders: deque[Order] = deque()
        self._setpoint: Setpoint | None = None
        self._position: Position | None = None
        self._closed = False
        self.replaced = 0  # setpoints that were overtaken by a newer one before they were sent

    def put_setpoint(self, setpoint: Setpoint) -> None:
        """Replace the setpoint that waits, if any."""
        with self._condition:
            if self._setpoint is not None:
                self.replaced += 1
            self._setpoint = setpoint
            self._condition.notify()

    def put_position(self, position: Position) -> None:
        """Replace the position that waits, if any."""
        with self._condition:
            self._position = position
            self._condition.notify()

    def take_position(self) -> Position | None:
        """The position that waits, if any, for a worker that is busy with an order."""
        with self._condition:
            position, self._position = self._position, None
            return position

    def put_order(self, order: Order, *, urgent: bool = False) -> None:
        """Append an order, which ends the stream: the setpoint that waits (urgent: and all orders) is forgotten."""
        with self._condition:
            if urgent:
                self._orders.clear()
            self._setpoint = None
            self._orders.append(order)
            self._condition.notify()

    def put_background(self, order: Order) -> None:
        """Append an order that leaves the stream of setpoints alone."""
        with self._condition:
            self._orders.append(order)
            self._condition.notify()

    def get(self) -> Order | Setpoint | Position | None:
        """Wait for the next thing to send; None once the box is closed and empty."""
        with self._condition:
            while True:
                if self._orders:
                    return self._orders.popleft()
                if self._setpoint is not None:
                    setpoint, self._setpoint = self._setpoint, None
                    return setpoint
                if self._position is not None:
                    position, self._position = self._position, None
                    return position
                if self._closed:
                    return None
                self._condition.wait()

    def wait(self) -> bool:
        """Wait until there is something to send; False once the box is closed and empty."""
        with self._condition:
            while not (self._full or self._closed):
                self._condition.wait()
            return self._full

    @property
    def _full(self) -> bool:
        return bool(self._orders) or self._setpoint is not None or self._position is not None

    def take_order(self) -> Order | None:
        """The next order, if there is one; the setpoint stays."""
        with self._condition:
            return self._orders.popleft() if self._orders else None

    @property
    def closed(self) -> bool:
        """Whether nothing more will come."""
        return self._closed

    def close(self) -> None:
        """Nothing more will come."""
        with self._condition:
            self._closed = True
            self._condition.notify()
