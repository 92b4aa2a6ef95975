"""The installed executables: what they need is imported when they start, so that a missing package can be named."""

from __future__ import annotations

from dtsa_bench.missing import say_missing


def recorded_channel() -> int:
    """``ros2 run dtsa_bench recorded_channel``."""
    try:
        from dtsa_bench.fly.recorded_channel import main
    except ImportError as error:
        return say_missing("recorded_channel", error)
    return main()


def fake_crazyflie() -> int:
    """``ros2 run dtsa_bench fake_crazyflie``."""
    try:
        from dtsa_bench.fake_crazyflie.cli import main
    except ImportError as error:
        return say_missing("fake_crazyflie", error)
    return main()
