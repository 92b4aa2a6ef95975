"""Settings of all tests: no property depends on the machine's speed, and CI looks at the same examples each time."""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

settings.register_profile(
    "dtsa",
    deadline=None,
    derandomize=bool(os.environ.get("CI")),
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],  # says something about the machine only
)
settings.load_profile("dtsa")
