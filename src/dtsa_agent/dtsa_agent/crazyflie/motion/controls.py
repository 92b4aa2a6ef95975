"""What a Crazyflie's firmware is told to fly: a stream of commands, a path, or a velocity that needs no place.

The vehicle decides what is flown; here is how it is said so that the motors keep turning. The vehicle's lock protects
all of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from dtsa_agent.crazyflie.links.delivery import Delivery
from dtsa_agent.crazyflie.links.link import Link
from dtsa_agent.crazyflie.state.conversions import Setpoint, Vector, velocity_world

# A landing is planned as if from rest, and a path to a place swings out by metres if it begins at high speed: before a
# landing and before holding a place the vehicle is first braked by streamed setpoints of zero velocity.
SLOW_MPS = 0.25
BRAKE_LIMIT_S = 1.5
DOWN_M = 0.04  # m: it stands, by motion capture
NOWHERE: Vector = (0.0, 0.0, 0.0)


def end_of_stream(cf: Any) -> None:
    """Tell the firmware that the stream of setpoints is over."""
    cf.commander.send_notify_setpoint_stop()


class Controls:
    """The present stream, path or braking of one Crazyflie.

    :param link: sends.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self.delivery = Delivery()
        self.streaming = False  # the firmware follows streamed commands, not the high-level commander
        self.held = False  # the stream of commands broke off and the place is being held
        self._command_time = -math.inf  # s, of the last streamed command
        self.guard_until = 0.0  # s: a take-off or go-to is flown to its end before streamed commands count again
        self._brake: tuple[float, Callable[[], None]] | None = None  # until when to brake (s), and what comes then
        self._blind: tuple[Vector, float] | None = None  # velocity that needs no place, and until when (s)

    def reset(self) -> None:
        """A new connection."""
        self.streaming = self.held = False
        self._command_time = -math.inf
        self._blind = None
        self.delivery.cancel()

    def stop(self) -> None:
        """Nothing is flown any more."""
        self._brake = self._blind = None
        self.delivery.cancel()

    def command_age(self, now: float) -> float:
        """Seconds since the last streamed command; infinite before the first one.

        :param now: s, monotonic.
        """
        return now - self._command_time

    def led_for(self, now: float) -> float | None:
        """Seconds since the last of the streamed commands that lead it, or did until they broke off; None: none do.

        :param now: s, monotonic.
        """
        if not (self.streaming or self.held) or self._command_time == -math.inf:
            return None
        return now - self._command_time

    # -- streams and paths ------------------------------------------------------------------------------------------
    def stream(self, setpoint: Setpoint) -> None:
        """A streamed command: it is in charge now."""
        self._command_time = setpoint.stamp
        self.delivery.cancel()
        self.streaming, self.held, self._brake = True, False, None
        self._link.outbox.put_setpoint(setpoint)

    def fly(self, kind: str, action: Callable[[Any], None], duration: float, now: float, *, again: bool = True) -> None:
        """An order to the high-level commander, and only then the end of the stream of setpoints.

        The other way round the high-level commander would have nothing to fly for a moment, and would stop the motors.

        :param kind: `TAKEOFF`, `LAND`, `GO_TO` or `TRAJECTORY`.
        :param action: gives it.
        :param duration: s, for which streamed commands do not count.
        :param now: s, monotonic.
        :param again: the order may be given more than once: it is, until the firmware has answered.
        """
        streaming, self.streaming, self.held = self.streaming, False, False
        self.guard_until = now + duration
        self._brake = None

        def run(cf: Any) -> None:
            action(cf)
            if streaming:
                end_of_stream(cf)
                if again:
                    action(cf)

        self._link.order(run)
        self.delivery.cancel()
        if again:
            self.delivery.begin(kind, run, end_of_stream if streaming else None, now)

    # -- braking ----------------------------------------------------------------------------------------------------
    def brake_then(self, action: Callable[[], None], speed: float, now: float) -> None:
        """Slow down, then do something.

        :param speed: m/s. :param now: s, monotonic.
        """
        self.delivery.cancel()
        self._brake = (now + BRAKE_LIMIT_S, action)
        self.slow_down(speed, now)

    def slow_down(self, speed: float, now: float) -> None:
        """Go on braking, if it brakes.

        :param speed: m/s. :param now: s, monotonic.
        """
        if self._brake is None:
            return
        end, action = self._brake
        if speed < SLOW_MPS or now > end:
            self._brake = None
            action()
        else:
            self.streaming = True
            self._link.outbox.put_setpoint(velocity_world(NOWHERE, 0.0, now))

    # -- without a place --------------------------------------------------------------------------------------------
    @property
    def blind(self) -> bool:
        """Whether it is steered without a place."""
        return self._blind is not None

    @property
    def sinks_blindly(self) -> bool:
        """Whether it sinks without a place."""
        return self._blind is not None and self._blind[0][2] < 0.0

    def see_again(self) -> None:
        """Places count again."""
        self._blind = None

    def steer_blindly(self, velocity: Vector, until: float, now: float) -> None:
        """Stream a velocity, whatever the estimate says, and nothing else.

        :param velocity: m/s, world. :param until: s, monotonic: then the motors stop. :param now: s, monotonic.
        """
        self._brake, self._blind = None, (velocity, until)
        self.held, self.streaming = False, True
        self.delivery.cancel()
        self._link.outbox.put_setpoint(velocity_world(velocity, 0.0, now))

    def go_on_blindly(self, in_air: bool, seen: Vector | None, now: float) -> None:
        """The next packet of a stream that needs no place; the motors stop once the vehicle must be down.

        :param in_air: whether it still flies. :param seen: m, world, where motion capture sees it. :param now: s.
        """
        if self._blind is None:
            return
        velocity, until = self._blind
        if not in_air:
            self._blind = None
        elif self.sinks_blindly and (now > until or (seen is not None and seen[2] < DOWN_M)):
            self._blind, self.streaming = None, False
            self._link.order(end_of_stream)  # with nothing to fly the end of the stream stops the motors
        else:
            self._link.outbox.put_setpoint(velocity_world(velocity, 0.0, now))
