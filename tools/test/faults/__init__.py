"""Faults, and how the system reacts to them: each row is made to happen to real processes.

``FAULTS`` has all rows in the order of the page ``docs/evidence/robustness.md``, whose table is made from them.
"""

from __future__ import annotations

from .row import FAULTS, Fault  # isort: skip
from . import processes  # isort: skip
from . import graph  # isort: skip
from . import by_hand  # isort: skip
from . import storage

__all__ = ["FAULTS", "Fault", "by_hand", "graph", "processes", "storage"]
