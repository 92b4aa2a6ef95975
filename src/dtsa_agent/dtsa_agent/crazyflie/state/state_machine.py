"""The states of one Crazyflie, as the ground station sees it.

    disconnected --> connecting --> ready <--> armed --> flying --> landing --> ready
                                      |          |         |           |
                                      +----------+---------+-----------+--> lost       (silent for too long)
                                      +----------+---------+-----------+--> emergency  (motors stopped for good)

What the firmware's supervisor reports decides between ready, armed and flying; orders decide about landing. A Crazyflie
that arms itself (2.1, 2.1+) is ready until the ground station orders to arm it, and again once it has landed. `lost`
ends when the Crazyflie is heard again, `emergency` only with a new connection.
"""

from __future__ import annotations

import enum
from collections.abc import Callable

from dtsa_agent.core.errors import LocalProtocolError

CAN_BE_ARMED, IS_ARMED, AUTO_ARM, CAN_FLY, IS_FLYING = 1, 2, 4, 8, 16
IS_TUMBLED, IS_LOCKED, IS_CRASHED = 32, 64, 128
HL_ACTIVE = 256  # the high-level commander has something to fly


class State(enum.IntEnum):
    """State of one Crazyflie; the numbers are those of dtsa_msgs/Status."""

    DISCONNECTED = 0
    CONNECTING = 1
    READY = 2
    ARMED = 3
    FLYING = 4
    LANDING = 5
    EMERGENCY = 6
    LOST = 7


S = State
CONNECTED = frozenset({S.READY, S.ARMED, S.FLYING, S.LANDING, S.EMERGENCY})
IN_AIR = frozenset({S.FLYING, S.LANDING})
ALLOWED: dict[State, frozenset[State]] = {
    S.DISCONNECTED: frozenset({S.CONNECTING}),
    S.CONNECTING: frozenset({S.READY, S.ARMED, S.FLYING, S.DISCONNECTED, S.EMERGENCY}),
    S.READY: frozenset({S.ARMED, S.FLYING, S.LANDING, S.EMERGENCY, S.LOST, S.DISCONNECTED}),
    S.ARMED: frozenset({S.READY, S.FLYING, S.LANDING, S.EMERGENCY, S.LOST, S.DISCONNECTED}),
    S.FLYING: frozenset({S.READY, S.ARMED, S.LANDING, S.EMERGENCY, S.LOST}),
    S.LANDING: frozenset({S.READY, S.ARMED, S.FLYING, S.EMERGENCY, S.LOST}),
    S.EMERGENCY: frozenset({S.LOST, S.CONNECTING, S.DISCONNECTED}),
    S.LOST: frozenset({S.READY, S.ARMED, S.FLYING, S.LANDING, S.EMERGENCY, S.CONNECTING, S.DISCONNECTED}),
}


class StateMachine:
    """State of one Crazyflie, and why it is in it.

    :param changed: called with the state before, the state now and the reason.
    """

    def __init__(self, changed: Callable[[State, State, str], None]) -> None:
        self.state = S.DISCONNECTED
        self.reason = "not connected yet"
        self._changed = changed
        self.arms_itself = False  # the firmware says so
        self._wanted = False  # the ground station wants it armed: of one that arms itself nothing else can tell
        self._landing = False  # a landing was ordered and is not over
        self._stopped = False  # an emergency stop was sent

    def go(self, state: State, reason: str) -> None:
        """Enter a state.

        :raises LocalProtocolError: there is no way from the present state to that one.
        """
        if state == self.state:
            return
        if state not in ALLOWED[self.state]:
            raise LocalProtocolError(f"no way from {self.state.name} to {state.name}")
        before, self.state, self.reason = self.state, state, reason
        if state in (S.CONNECTING, S.DISCONNECTED):
            self._landing = self._stopped = self._wanted = False
        self._changed(before, state, reason)

    def arm(self, wanted: bool) -> None:
        """Arming or disarming was ordered."""
        self._wanted = wanted

    def takeoff(self, reason: str) -> None:
        """A take-off was ordered: an earlier landing is over."""
        self._landing = False
        if self.state == S.LANDING:
            self.go(S.FLYING, reason)
        self.reason = reason

    def land(self, reason: str) -> None:
        """A landing was ordered."""
        self._landing = True
        if self.state in (S.FLYING, S.ARMED, S.READY):
            self.go(S.LANDING, reason)

    def emergency(self, reason: str) -> None:
        """An emergency stop was ordered."""
        self._stopped = True
        if self.state not in (S.DISCONNECTED, S.CONNECTING):
            self.go(S.EMERGENCY, reason)

    def silent(self, reason: str) -> None:
        """Nothing was heard for too long, or the link broke."""
        if self.state in CONNECTED:
            self.go(S.LOST, reason)

    def observe(self, info: int) -> None:
        """The supervisor's bits in a log packet.

        :param info: the bits, as the firmware logs them.
        """
        if self.state in (S.DISCONNECTED, S.EMERGENCY):
            return
        for bit, reason in (
            (IS_LOCKED, "locked after an emergency stop"),
            (IS_TUMBLED, "tumbled"),
            (IS_CRASHED, "crashed"),
        ):
            if info & bit:
                self.go(S.EMERGENCY, reason)
                return
        if self._stopped:
            self.go(S.EMERGENCY, self.reason)
            return
        self.arms_itself = bool(info & AUTO_ARM)
        back = "heard again" if self.state == S.LOST else ""
        if info & IS_FLYING:
            if not self._landing:
                self.go(S.FLYING, back or "in the air")
            elif self.state != S.LANDING:
                self.go(S.LANDING, back or self.reason)
            return
        if self.state == S.LANDING or (self.state == S.LOST and self._landing):
            back = "landed"
        if self.state in IN_AIR or self._landing:
            self._wanted = False
        self._landing = False
        if self._wanted if self.arms_itself else info & IS_ARMED:
            self.go(S.ARMED, back or "armed")
        else:
            self.go(S.READY, back or "motors locked")
