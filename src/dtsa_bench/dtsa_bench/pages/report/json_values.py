"""Arrays and settings as the JSON of a page holds them."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BINS = 400  # steps of the charts over time


def flatten(config: Mapping[str, Any], section: str = "") -> list[list[Any]]:
    """Settings as rows of section, name and value."""
    rows: list[list[Any]] = []
    for name, value in config.items():
        if isinstance(value, Mapping) and not section:
            rows.extend(flatten(value, str(name)))
        else:
            rows.append([section, str(name), _shown(value)])
    return rows


def _shown(value: Any) -> Any:
    """A setting's value; of a file whose contents it is, the name and the beginning of its hash."""
    if isinstance(value, Mapping) and {"name", "sha256"} <= value.keys():
        return f"{value['name']} ({str(value['sha256'])[:12]})"
    return value


def reduce_bins(values: NDArray[Any], how: Any) -> NDArray[np.float64]:
    """(BINS or fewer,) from (T,): `how` applied to each of the bins; NaN where a bin holds nothing finite."""
    count = min(BINS, len(values))
    edges = np.linspace(0, len(values), count + 1).astype(int)
    result = np.full(count, np.nan)
    for index in range(count):
        part = values[edges[index] : edges[index + 1]]
        part = part[np.isfinite(part)]
        if len(part):
            result[index] = how(part)
    return result


def thin(values: NDArray[Any], digits: int = 4) -> list[float | None]:
    """Rounded numbers for JSON; None for what is not finite."""
    return [round(float(value), digits) if math.isfinite(value) else None for value in values]


def pack(values: NDArray[Any]) -> str:
    """The bytes of an array, base64, for the page's typed arrays."""
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")
