"""Name of the command line: `tools/dtsa` in a checkout, `dtsa` where it has been installed."""

from __future__ import annotations

import os


def program() -> str:
    """Words in front of a command that a message names; `tools/dtsa` says it in the environment."""
    return os.environ.get("DTSA_PROGRAM", "dtsa")
