"""Settings of all tests: property tests have no deadline for one example, and look at the same ones in each CI run."""

from __future__ import annotations

import os

from hypothesis import settings

settings.register_profile("dtsa", deadline=None, derandomize=bool(os.environ.get("CI")), print_blob=True)
settings.load_profile("dtsa")
