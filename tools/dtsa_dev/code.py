"""The digest of all code that a measurement of this package depends on."""

from __future__ import annotations

from pathlib import Path

from dtsa_bench.experiments.batch.code import code_digest

_HERE = Path(__file__).resolve().parent
_MESSAGES = _HERE.parents[1] / "src" / "dtsa_msgs"


def developers_digest() -> str:
    """A digest of the project's code, of this package, and of the messages' definitions."""
    own = [path for path in _HERE.rglob("*") if path.suffix in (".py", ".c", ".h")]
    own += [path for path in _MESSAGES.rglob("*") if path.suffix in (".msg", ".srv")]
    return code_digest(own=tuple(sorted(own)))
