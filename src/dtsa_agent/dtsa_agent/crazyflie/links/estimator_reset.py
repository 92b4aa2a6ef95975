"""Restarts the Kalman filter of a Crazyflie and waits until it knows where it stands."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from dtsa_agent.crazyflie.addresses import LinkError
from dtsa_agent.crazyflie.positions.estimates import Settling
from dtsa_agent.crazyflie.state.conversions import Vector

from .outbox import Position

VARIANCES = ("kalman.varPX", "kalman.varPY", "kalman.varPZ")
PLACE = ("stateEstimate.x", "stateEstimate.y", "stateEstimate.z")
INITIAL = ("kalman.initialX", "kalman.initialY", "kalman.initialZ")
PERIOD_MS = 50
POLL_S = 0.005
RESET_S = 0.1  # the firmware's tasks have seen the parameter by then


def settle(
    cf: Any,
    settling: Settling,
    seen: Callable[[], Vector | None],
    position: Callable[[], Position | None],
    timeout: float,
) -> None:
    """Restart the filter, feed it with positions, and wait (s, at most) until it has settled. In the link's worker.

    :param seen: where motion capture sees it, m, world.
    :param position: the latest position that waits to be sent.
    :raises LinkError: it does not settle in time, and why.
    """
    from cflib.crazyflie.log import LogConfig

    settled = threading.Event()

    def sample(stamp: int, values: dict[str, float], block: Any) -> None:
        x, y, z = (values[name] for name in PLACE)
        vx, vy, vz = (values[name] for name in VARIANCES)
        if settling.sample((x, y, z), (vx, vy, vz), seen()):
            settled.set()

    def feed(until: float) -> None:
        while time.monotonic() < until and not settled.wait(POLL_S):
            if (packet := position()) is not None:
                packet.send(cf)

    end = time.monotonic() + timeout
    place = seen()
    if place is not None:  # the filter begins where it is seen, not metres away
        for name, value in zip(INITIAL, place, strict=True):
            cf.param.set_value(name, value)
    cf.param.set_value("kalman.resetEstimation", 1)
    feed(time.monotonic() + RESET_S)
    cf.param.set_value("kalman.resetEstimation", 0)
    settling.restart()
    block = LogConfig("variance", PERIOD_MS)
    for name in (*VARIANCES, *PLACE):
        block.add_variable(name, "float")
    block.data_received_cb.add_callback(sample)
    try:
        cf.log.add_config(block)
    except KeyError:
        return  # another estimator than the Kalman filter: nothing to wait for
    block.start()
    feed(end)
    block.delete()
    if not settled.is_set():
        raise LinkError(f"the estimator did not settle within {timeout:g} s: {settling.problem}")
