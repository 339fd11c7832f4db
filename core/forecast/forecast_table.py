"""The table of forecasts: one row per forecast message, one column per field, with nested fields joined by a dot."""

from collections.abc import Iterable
from typing import Any, Final

import msgspec
import pandas as pd

from socast.core.wire.messages import Forecast, Interval, Message, NextCharge, QualityCounts

KEY_END: Final = "/forecast"
_NESTED: Final[dict[str, type[msgspec.Struct]]] = {
    "range_km": Interval,
    "soc_end_of_shift_pct": Interval,
    "quality": QualityCounts,
    "next_charge": NextCharge,
    "next_charge.soc_pct": Interval,
}


def _list_columns(struct: type[msgspec.Struct], before: str = "") -> list[str]:
    columns: list[str] = []
    for name in struct.__struct_fields__:
        nested = _NESTED.get(before + name)
        columns += _list_columns(nested, f"{before}{name}.") if nested else [before + name]
    return columns


FORECAST_COLUMNS: Final = tuple(_list_columns(Forecast))
"""Columns that each table of forecasts has."""


def is_forecast(message: Message) -> bool:
    """Return whether a message is a forecast."""
    return message.key.endswith(KEY_END)


def tabulate_forecasts(messages: Iterable[Message]) -> pd.DataFrame:
    """Return the forecasts among messages as a table.

    Returns
    -------
    (n, columns) DataFrame
        `FORECAST_COLUMNS`, and those of fields that this version does not know. A value that is absent or null is NaN.
    """
    payloads: list[dict[str, Any]] = [msgspec.json.decode(each.payload) for each in messages if is_forecast(each)]
    table = pd.json_normalize(payloads)
    further = [name for name in table.columns if name not in FORECAST_COLUMNS and name not in _NESTED]
    return table.reindex(columns=[*FORECAST_COLUMNS, *further])
