"""Opens a page in the user's browser, where there is one to see it in."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path

_REMOTE = ("SSH_CONNECTION", "SSH_CLIENT", "SSH_TTY", "CI")


def somebody_looks(environment: Mapping[str, str], platform: str) -> bool:
    """Whether this process has a display of its user's: not over ssh, not in CI.

    :param environment: environment variables.
    :param platform: as `sys.platform`.
    """
    if any(environment.get(name) for name in _REMOTE):
        return False
    return platform == "darwin" or bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def open_page(path: Path, wanted: bool | None = None) -> bool:
    """Opens a page.

    :param path: the HTML file.
    :param wanted: True or False: the user has said so; None: where there is a display.
    :returns: whether a browser took it.
    """
    if not (somebody_looks(os.environ, sys.platform) if wanted is None else wanted):
        return False
    try:
        return webbrowser.open(path.resolve().as_uri())
    except webbrowser.Error:
        return False
