"""The live page: the report's scene, strip and charts, with what a run under way adds."""

from __future__ import annotations

import html
import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench.pages.report.page import PALETTE

_JS, _CSS, _TEXT = "text/javascript", "text/css", "text/plain"
_REPORT, _VIEW = "dtsa_bench.pages.report", "dtsa_bench.pages.view"


@dataclass(frozen=True, slots=True)
class Asset:
    """A file of the page."""

    package: str  # with a directory `assets`
    kind: str  # media type


_SCRIPTS = ("core.js", "plot.js", "scene.js", "slots.js", "player.js")  # as in the report
_MODULES = ("three.module.min.js", "bodies.js", "run.js", "panels.js", "crazyflies.js", "view.js")
ASSETS = {
    **{name: Asset(_REPORT, _JS) for name in _SCRIPTS},
    **{name: Asset(_VIEW, _JS) for name in _MODULES},
    "style.css": Asset(_REPORT, _CSS),
    "view.css": Asset(_VIEW, _CSS),
    "three.LICENSE": Asset(_VIEW, _TEXT),
}


@cache
def asset_of(name: str) -> bytes:
    """A file of the page.

    :param name: one of ``ASSETS``.
    """
    return (files(ASSETS[name].package) / "assets" / name).read_bytes()


def page_html(control: bool) -> str:
    """The page.

    :param control: whether it may order something.
    """
    data: dict[str, Any] = {"runs": [], "palette": PALETTE, "reasons": dict(REASON_TEXTS), "control": control}
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    scripts = "\n".join(f'<script src="{html.escape(name)}"></script>' for name in _SCRIPTS)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>DTSA, live</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="style.css">
<link rel="stylesheet" href="view.css">
</head>
<body class="view">
<noscript><p class="note">This page draws itself with JavaScript; please allow it.</p></noscript>
<div id="report"></div>
<script type="application/json" id="data">{text}</script>
{scripts}
<script type="module" src="view.js"></script>
</body>
</html>
"""
