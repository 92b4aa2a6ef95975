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

# The next state; the first rule that holds counts. States that last for one step only are left out. Not even an
# emergency stop counts for one that has landed; it does once the motors are off.
_NEXT: dict[str, tuple[tuple[str, str], ...]] = {
    NOT_READY: (("emergency", LOCKED), ("upright", CHECKED)),
    CHECKED: (("emergency", LOCKED), ("tumbled", NOT_READY), ("armed", READY)),
    READY: (
        ("emergency", LOCKED), ("tumbled", NOT_READY), ("disarmed", NOT_READY), ("never took off", NOT_READY),
        ("in the air", FLYING),
    ),
    FLYING: (
        ("no setpoint", LOCKED), ("emergency", LOCKED), ("tumbled", CRASHED), ("disarmed", NOT_READY),
        ("old setpoint", LEVEL_OUT), ("on the floor", LANDED),
    ),
    LEVEL_OUT: (("no setpoint", LOCKED), ("tumbled", LOCKED), ("emergency", LOCKED), ("new setpoint", FLYING)),
    LANDED: (("disarmed", NOT_READY), ("stood long", NOT_READY), ("in the air", FLYING)),
    CRASHED: (("recovered", NOT_READY), ("emergency", LOCKED)),
}  # fmt: skip


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
        holds = {
            "emergency": bool(self.emergency),
            "tumbled": self.tumbled,
            "upright": not self.tumbled,
            "recovered": not self.crashed and not self.tumbled,
            "armed": self.armed,
            "disarmed": not self.armed,
            "in the air": in_air,
            "on the floor": not in_air,
            "new setpoint": age <= LEVEL_OUT_S,
            "old setpoint": age > LEVEL_OUT_S,
            "no setpoint": age > SHUTDOWN_S,
            "never took off": t - self._since > PREFLIGHT_TIMEOUT_S,
            "stood long": t - self._since > LANDING_TIMEOUT_S,
        }
        return next((state for rule, state in _NEXT.get(self.state, ()) if holds[rule]), self.state)

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
        flags = (  # from the lowest bit on
            self.state == CHECKED and not self.refuse_arming, self.armed, self.auto_arming, self.motors_allowed,
            self.flying, self.tumbled, self.state == LOCKED, self.crashed, planner_active, trajectory_finished,
        )  # fmt: skip
        return sum(1 << bit for bit, flag in enumerate(flags) if flag)
