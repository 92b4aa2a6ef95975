"""A summary for people."""

from __future__ import annotations


def describe(summary: dict[str, object]) -> str:
    """A summary in a few lines.

    :param summary: plain values by key.
    """
    lines = []
    for key, value in summary.items():
        if isinstance(value, dict):
            value = ", ".join(f"{count} {name}" for name, count in value.items())
        elif isinstance(value, float):
            value = f"{value:.6g}"
        elif isinstance(value, list):
            value = " and ".join(str(item) for item in value)
        lines.append(f"{key.replace('_', ' '):25}{'-' if value is None else value}\n")
    return "".join(lines)
