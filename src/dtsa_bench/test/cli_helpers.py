"""A command line that is refused, in tests."""

from __future__ import annotations

import pytest

from dtsa_bench.commands import cli


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The error of a command line that ends with code 2 and one line."""
    try:
        code = cli.main(words)
    except SystemExit as stopped:
        code = stopped.code  # type: ignore[assignment]
    text = capsys.readouterr().err
    assert code == 2
    assert text.count("\n") == 1
    return text
