"""The firmware's supervisor: may the motors run, and what happens when things go wrong.

States, timeouts and the order of rules are those of the Crazyflie's firmware from 2025.02 on (supervisor.c,
supervisor_state_machine.c).
Times are arguments in seconds.
"""

from __future__ import annotations

from collections.abc import Callable

NOT_READY = "pre-flight checks not passed"
CHECKED = "pre-flight checks passed"
READY = "ready to fly"
FLYING = "flying"
LANDED = "landed"
LEVEL_OUT = "level out"
LOCKED = "locked"
CRASHED = "crashed"

MOTORS_ALLOWED = frozenset({READY, FLYING, LANDED, LEVEL_OUT})  # "can fly"

LEVEL_OUT_S = 0.5  # age of the setpoint at which a flying Crazyflie levels out
SHUTDOWN_S = 2.0  # ... and at which it stops its motors, for good
FLYING_HYSTERESIS_S = 2.0  # low thrust for that long: not flying any more
EMERGENCY_WATCHDOG_S = 1.0
PREFLIGHT_TIMEOUT_S = 30.0  # armed, but not taken off
LANDING_TIMEOUT_S = 3.0  # landed: disarmed after that long


class FirmwareSupervisor:
    """State machine of one Crazyflie; `auto_arming`: a 2.1 or 2.1+, a 2.1 brushless or a Bolt waits to be armed."""

    def __init__(self, report: Callable[..., None], *, auto_arming: bool = False) -> None:
        self._report = report
        self.auto_arming = auto_arming
        self.state = CHECKED
        self.armed = auto_arming
        self.tumbled = False
        self.refuse_arming = False
        self.crashed = False  # until recovery is requested
        self.emergency = ""  # why an emergency stop is in force; latches until a reboot
        self._watchdog: float | None = None  # time of the last watchdog packet
        self._thrust: float | None = None  # time of the last thrust
        self._since = 0.0  # time of the last change of state

    @property
    def motors_allowed(self) -> bool:
        """True while setpoints reach the motors."""
        return self.state in MOTORS_ALLOWED

    @property
    def flying(self) -> bool:
        """What the firmware calls flying: thrust now or less than two seconds ago."""
        return self.state in (FLYING, LEVEL_OUT)

    def request_arming(self, arm: bool) -> bool:
        """Arm or disarm; False when the firmware refuses."""
        if arm != self.armed:
            if arm and (self.state != CHECKED or self.refuse_arming):
                self._report("arming refused", state=self.state)
                return False
            self.armed = arm
            self._report("armed" if arm else "disarmed")
        return True

    def request_recovery(self) -> bool:
        """Leave the crashed state once the Crazyflie stands upright."""
        if self.crashed and not self.tumbled:
            self.crashed = False
            self._report("recovered")
        return not self.crashed

    def stop(self, reason: str) -> None:
        """Emergency stop: latches until a reboot."""
        if not self.emergency:
            self.emergency = reason

    def watchdog(self, t: float) -> None:
        """A packet of the emergency stop watchdog came."""
        self._watchdog = t

    def update(self, t: float, *, setpoint_age: float, thrust: bool) -> None:
        """One step; `setpoint_age`: s, of any source; `thrust`: the motors turn faster than idle."""
        if thrust:
            self._thrust = t
        if self._watchdog is not None and t >= self._watchdog + EMERGENCY_WATCHDOG_S:
            self.stop("emergency watchdog")
        in_air = self._thrust is not None and t - self._thrust < FLYING_HYSTERESIS_S
        state = self._next(t, setpoint_age, in_air)
        if state != self.state:
            self._enter(state, t)

    def _next(self, t: float, age: float, in_air: bool) -> str:
        """The next state; the first rule that holds counts. States that last for one step only are left out."""
        state, late = self.state, age > SHUTDOWN_S
        if state == NOT_READY:
            return LOCKED if self.emergency else state if self.tumbled else CHECKED
        if state == CHECKED:
            return LOCKED if self.emergency else NOT_READY if self.tumbled else READY if self.armed else state
        if state == READY:
            if self.emergency:
                return LOCKED
            if self.tumbled or not self.armed or t - self._since > PREFLIGHT_TIMEOUT_S:
                return NOT_READY
            return FLYING if in_air else state
        if state == FLYING:
            if late or self.emergency:
                return LOCKED
            if self.tumbled:
                return CRASHED
            if not self.armed:
                return NOT_READY
            if age > LEVEL_OUT_S:
                return LEVEL_OUT
            return state if in_air else LANDED
        if state == LEVEL_OUT:
            if late or self.tumbled or self.emergency:
                return LOCKED
            return state if age > LEVEL_OUT_S else FLYING
        if state == LANDED:  # not even an emergency stop counts here; it does once the motors are off
            if not self.armed or t - self._since > LANDING_TIMEOUT_S:
                return NOT_READY
            return FLYING if in_air else state
        if state == CRASHED:
            if not self.crashed and not self.tumbled:
                return NOT_READY
            return LOCKED if self.emergency else state
        return state

    def _enter(self, state: str, t: float) -> None:
        before, self.state, self._since = self.state, state, t
        details = {}
        if state == CRASHED:
            self.crashed, details["reason"] = True, "tumbled"
        elif state == LOCKED:
            details["reason"] = self.emergency or ("tumbled" if self.tumbled else "setpoints ceased")
        self._report("state", state=state, before=before, **details)
        if state not in MOTORS_ALLOWED and self.armed:
            self.armed = False
            self._report("disarmed")
        if self.auto_arming and state == CHECKED:
            self.request_arming(True)

    def info(self, *, planner_active: bool, trajectory_finished: bool) -> int:
        """The bit field `supervisor.info`."""
        bits, flags = 0, (  # from the lowest bit on
            self.state == CHECKED and not self.refuse_arming, self.armed, self.auto_arming, self.motors_allowed,
            self.flying, self.tumbled, self.state == LOCKED, self.crashed, planner_active, trajectory_finished,
        )  # fmt: skip
        for flag in reversed(flags):
            bits = bits << 1 | flag
        return bits
