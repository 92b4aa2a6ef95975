"""The way down of one Crazyflie: beside those below it; and blindly, without a link or without an estimate.

The vehicle decides when it lands; here is how. The vehicle's lock protects all of it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from dtsa_agent.crazyflie.links.delivery import GO_TO, LAND
from dtsa_agent.crazyflie.motion.controls import NOWHERE, Controls
from dtsa_agent.crazyflie.motion.paths import landing_s, shortest_s, too_short
from dtsa_agent.crazyflie.safety.landing_places import MOVE_MPS, Descent
from dtsa_agent.crazyflie.settings.config import StationSettings
from dtsa_agent.crazyflie.state.conversions import Vector, place_text, yaw_of

from .known_state import KnownState

BLIND_REPEAT_S = 0.5  # s, a landing that is ordered blindly is ordered this often
BLIND_REPEATS = 3
BLIND_LAND_S = 2.0
SINK_MPS = 0.3  # of a vehicle that does not know where it is
SINK_MORE_S = 1.5  # s: it sinks that much longer than its last known height takes
ASK_AGAIN_S = 0.1  # one that waits to land asks as often whether it may
ARRIVES_S = 0.3  # after the end of its path aside
SHORTEST_S = 0.5  # s, of that path


class Landing:
    """Landings of one Crazyflie.

    :param name: its name.
    :param station: the ground station's settings.
    :param known: where it is. :param controls: what it is told to fly.
    :param log: called with a level (info, warn, error) and a line.
    :param descent: what it does now that it is at rest: called with the height (m) at which it stops, and since when it
        lands (s, monotonic).
    """

    def __init__(
        self,
        name: str,
        station: StationSettings,
        known: KnownState,
        controls: Controls,
        log: Callable[[str, str], None],
        descent: Callable[[float, float], Descent],
    ) -> None:
        self._name, self._station, self._known, self._controls = name, station, known, controls
        self._log, self._descent = log, descent
        self._blind: list[float] = []  # s, monotonic: when to repeat a landing that may not have been heard
        self._since = 0.0  # s, monotonic, when the landing was ordered
        self._obstacle = ""  # what keeps it from sinking
        self._next: tuple[float, Callable[[], None]] | None = None  # when it goes on (s, monotonic), and how

    def heard(self) -> None:
        """The vehicle is heard: nothing is repeated blindly."""
        self._blind.clear()

    def cancel(self) -> None:
        """Something else is flown."""
        self._next = None

    # -- beside those below -----------------------------------------------------------------------------------------
    def begin(self) -> None:
        """A landing is ordered."""
        self._since, self._obstacle = time.monotonic(), ""

    def takes_longer(self, height: float, duration: float) -> str:
        """Why a landing takes longer than it should; empty if it does not.

        :param height: m above the floor. :param duration: s; 0: any.
        """
        way = self._known.height - height
        seconds = landing_s(way, duration, self._station)
        if not 0.0 < duration < seconds:
            return ""
        why = too_short(duration, way, self._station.max_speed_mps)
        return f"{self._name}: landing takes {seconds:.2f} s: {why}"

    def come_down(self, height: float = 0.0, duration: float = 0.0) -> None:
        """Sink, but onto nobody: who has somebody below it first moves aside, or waits.

        :param height: m above the floor. :param duration: s; 0: at the station's landing speed.
        """
        descent, last = self._descent(height, self._since), self._known.last
        if last is None or not (descent.wait or descent.aside):
            if descent.why:
                self._log("error", f"{self._name}: lands straight down: {descent.why}")
            self.sink(height, duration)
            return
        place = descent.aside or last.position
        way = math.dist(place, last.position)
        seconds = max(SHORTEST_S, way / MOVE_MPS, shortest_s(way, self._station.max_speed_mps))
        if descent.aside or descent.why != self._obstacle:
            does = f"moves aside to {place_text(place)} (world) first" if descent.aside else "waits"
            self._log("warn", f"{self._name}: {descent.why}: {does}")
        now = time.monotonic()
        if descent.aside or not self._obstacle:
            yaw = yaw_of(last.orientation)
            self._controls.fly(
                GO_TO, lambda cf: cf.high_level_commander.go_to(*place, yaw, seconds), math.inf, now
            )  # fmt: skip
        self._obstacle = descent.why
        self._next = (
            now + (seconds + ARRIVES_S if descent.aside else ASK_AGAIN_S),
            (lambda: self.come_down(height, duration)),
        )

    def go_on(self, now: float, *, landing: bool) -> None:
        """Ask again whether it may sink, when it is time.

        :param now: s, monotonic. :param landing: whether it still lands.
        """
        if self._next is not None and now >= self._next[0]:
            (_, action), self._next = self._next, None
            if landing:
                action()

    def sink(self, height: float = 0.0, duration: float = 0.0) -> None:
        """Straight down; parameters as of `come_down`."""
        self._next = None
        seconds = landing_s(self._known.height - height, duration, self._station)
        self._land(height, seconds, time.monotonic())

    def _land(self, height: float, seconds: float, now: float) -> None:
        self._controls.fly(
            LAND, lambda cf: cf.high_level_commander.land(height, seconds, yaw=None), math.inf, now
        )  # fmt: skip

    # -- blindly ----------------------------------------------------------------------------------------------------
    def steer_blindly(self, velocity: Vector, until: float) -> None:
        """Stream a velocity (m/s, world), whatever the estimate says, until a time (s, monotonic)."""
        self._next = None
        self._controls.steer_blindly(velocity, until, time.monotonic())

    def stand_blindly(self) -> None:
        """Zero velocity."""
        self.steer_blindly(NOWHERE, math.inf)

    def sink_blindly(self) -> None:
        """Sink by velocity alone for as long as the last known height takes, and some more."""
        now = time.monotonic()
        seconds = self._known.sinking_height(now) / SINK_MPS + SINK_MORE_S
        self.steer_blindly((0.0, 0.0, -SINK_MPS), now + seconds)

    def repeat_blindly(self, now: float) -> None:
        """Nothing is heard of it: the landing is ordered some more times.

        :param now: s, monotonic.
        """
        self._blind = [now + BLIND_REPEAT_S * (i + 1) for i in range(BLIND_REPEATS)]

    def repeat(self, now: float) -> None:
        """Order it once more, when it is time.

        :param now: s, monotonic.
        """
        if self._blind and now >= self._blind[0]:
            self._blind.pop(0)
            self._controls.streaming = True  # it must end a stream that the firmware may still follow
            self._land(0.0, landing_s(self._known.height, BLIND_LAND_S, self._station), now)
