"""The installed executables, and `python -m dtsa_bench COMMAND ...`.

What they need is imported when they start, so that a missing package can be named.
"""

from __future__ import annotations

import sys

from dtsa_agent.stop import leave_at_once
from dtsa_bench.commands.registry import report_missing_package


def dtsa() -> int:
    """``dtsa``, and ``python -m dtsa_bench``."""
    from dtsa_bench.commands.cli import main
    from dtsa_bench.commands.registry import INTERRUPTED

    code = main()
    if code == INTERRUPTED or "rclpy" in sys.modules:  # the middleware's own end may wait for locks of the dead
        leave_at_once(code)
    return code


def recorded_channel() -> int:
    """``ros2 run dtsa_bench recorded_channel``."""
    try:
        from dtsa_bench.flights.recorded_channel import main
    except ImportError as error:
        return report_missing_package("recorded_channel", error)
    return main()


def fake_crazyflie() -> int:
    """``ros2 run dtsa_bench fake_crazyflie``."""
    sys.argv.insert(1, "fake-crazyflie")
    return dtsa()


if __name__ == "__main__":
    sys.exit(dtsa())
