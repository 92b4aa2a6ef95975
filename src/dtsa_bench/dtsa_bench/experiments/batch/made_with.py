"""What a measurement was made with: commit, cores, Python, date."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

_SOURCES = str(Path(__file__).resolve().parent)
_OURS = ":(top)src/dtsa_bench/dtsa_bench/__init__.py"


def made_with() -> dict[str, Any]:
    """The commit of the checkout, and whether the tree differs from it; date, cores and Python."""
    ours = _git("ls-files", "--error-unmatch", _OURS)  # an installation may lie in somebody else's repository
    commit = _git("rev-parse", "HEAD") if ours else ""
    return {
        "commit": commit or "unknown",
        "tree_changed": bool(_git("status", "--porcelain", "--untracked-files=no")) if commit else None,
        "date": time.strftime("%Y-%m-%dT%H:%MZ", time.gmtime()),
        "cores": len(os.sched_getaffinity(0)),
        "python": ".".join(map(str, sys.version_info[:3])),
    }


def _git(*words: str) -> str:
    try:
        done = subprocess.run(["git", "-C", _SOURCES, *words], capture_output=True, text=True, timeout=30, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
