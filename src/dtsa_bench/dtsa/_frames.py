"""Data frames: pandas is loaded when the first one is made."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from dtsa_agent.core.errors import ConfigError

if TYPE_CHECKING:
    import pandas as pd


def data_frame(columns: Mapping[str, Any]) -> pd.DataFrame:
    """Columns of equal length as a data frame.

    :param columns: name -> values.
    :raises ConfigError: if pandas is not installed.
    """
    return _pandas().DataFrame(dict(columns))


def from_arrow(table: Any) -> pd.DataFrame:
    """An Arrow table as a data frame.

    :param table: `pyarrow.Table`.
    :raises ConfigError: if pandas is not installed.
    """
    _pandas()
    return table.to_pandas()


def _pandas() -> Any:
    try:
        import pandas
    except ImportError:
        allowed = "an installed pandas: tables are its data frames (pip install pandas)"
        raise ConfigError("pandas", None, allowed) from None
    return pandas
