"""Writes the table of faults into a document: ``python -m dtsa_dev.soak.faults docs/evidence/faults.md``."""

from __future__ import annotations

import sys
from pathlib import Path

from . import rewritten

path = Path(sys.argv[1])
path.write_text(rewritten(path.read_text(encoding="utf-8")), encoding="utf-8")
