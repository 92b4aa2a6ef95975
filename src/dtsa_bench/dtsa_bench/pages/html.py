"""The shell that all pages share, and values as the JSON of a page holds them."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from itertools import pairwise
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import NDArray

from dtsa_bench.drawing import palette

BINS = 400  # steps of the charts over time
PALETTE = {
    "agents": palette.AGENT_COLOURS,
    "dashes": palette.DASHES,
    "shapes": palette.SHAPES,
    "hovering": palette.HOVERING,
    "series": palette.SERIES,
}
SCRIPTS = ("page.js", "core.js", "plot.js", "scene.js", "slots.js")  # of all pages that play a run


@cache
def asset(name: str) -> Markup:
    """The text of a script or style sheet, which stands in a page as it is."""
    return Markup((files(__package__) / "assets" / name).read_text(encoding="utf-8"))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("dtsa_bench.pages", "assets"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False, "default": str}
    environment.globals["asset"] = asset
    return environment


def render_page(
    kind: str, title: str, scripts: Sequence[str], data: Mapping[str, Any], *, styles: Sequence[str] = ("style.css",),
    served: bool = False, **values: Any,
) -> str:  # fmt: skip
    """Return a page; all values but those of `Markup` are text, whatever is in them.

    :param data: what its scripts read, as JSON types.
    :param served: whether scripts and styles have addresses of their own; else they stand in the page.
    """
    return (
        _environment().get_template("page.html")
        .render(kind=kind, title=title, scripts=scripts, data=data, styles=styles, served=served, **values)
    )  # fmt: skip


def flatten(config: Mapping[str, Any], section: str = "") -> list[list[Any]]:
    """Settings as rows of section, name and value."""
    rows: list[list[Any]] = []
    for name, value in config.items():
        if isinstance(value, Mapping) and not section:
            rows.extend(flatten(value, str(name)))
        elif isinstance(value, Mapping) and {"name", "sha256"} <= value.keys():  # a file, whose contents it is
            rows.append([section, str(name), f"{value['name']} ({str(value['sha256'])[:12]})"])
        else:
            rows.append([section, str(name), value])
    return rows


def reduce_bins(values: NDArray[Any], how: Any) -> NDArray[np.float64]:
    """(BINS or fewer,) from (T,): `how` applied to each of the bins; NaN where a bin holds nothing finite."""
    edges = np.linspace(0, len(values), min(BINS, len(values)) + 1).astype(int)
    parts = (values[first:end][np.isfinite(values[first:end])] for first, end in pairwise(edges))
    return np.array([how(part) if len(part) else math.nan for part in parts], np.float64)


def thin(values: NDArray[Any], digits: int = 4) -> list[float | None]:
    """Rounded numbers for JSON; None for what is not finite."""
    return [round(float(value), digits) if math.isfinite(value) else None for value in values]


def pack(values: NDArray[Any]) -> str:
    """The bytes of an array, base64, for the page's typed arrays."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
