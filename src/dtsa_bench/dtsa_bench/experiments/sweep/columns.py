"""Names of a sweep's results, which no axis may have."""

from __future__ import annotations

#: Results of one run as columns, in this order; ``slots_...`` are shares of ``slots`` in the summary.
VALUES = (
    "min_distance_m", "efficiency_mean", "completion_time_s", "flight_time_s", "age_mean_slots",
    "age_max_slots", "age_mean_ms", "age_max_ms", "waking_age_mean_slots", "waking_age_max_slots",
    "waking_age_mean_ms", "waking_age_max_ms", "wakings", "wakings_unheard", "first_heard_median_slots",
    "first_heard_95_slots", "first_heard_max_slots", "frames_per_s", "bytes_per_s", "channel_load",
    "estimate_error_mean_m", "estimate_error_max_m", "slots_total", "slots_success", "slots_collision", "slots_idle",
    "agreement_share", "equal_tables_share", "first_divergence_slot", "wall_time_s",
)  # fmt: skip
COMMON = ("seed", "status", "reason", "collided")
GROUP = ("runs", "timed_out", "left_out", "crashed", "wasted_share")
RESERVED = frozenset(("key", "cell", "summary", *COMMON, *VALUES, *GROUP))
