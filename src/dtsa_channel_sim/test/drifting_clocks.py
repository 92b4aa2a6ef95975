"""Times of clocks that drift, and how slots are kept together all the same, for tests."""

from __future__ import annotations

from dtsa_channel_sim import AgentClock

_PPB = 1_000_000_000


def to_local(clock: AgentClock, channel_ns: int) -> int:
    """What a clock shows at a time of the channel's clock, both in ns."""
    return channel_ns + clock.offset_ns + channel_ns * clock.drift_ppb // _PPB


def to_channel(clock: AgentClock, local_ns: int) -> int:
    """The first ns of the channel's time at which a clock shows a local time, or has passed it."""
    # to_local(c) >= l  <=>  c (1e9 + drift) >= (l - offset) 1e9, because floor(x) >= n <=> x >= n.
    return -(-(local_ns - clock.offset_ns) * _PPB // (_PPB + clock.drift_ppb))
