"""The table of forecasts: one row per forecast message, one column per field, with nested fields joined by a dot."""

from collections.abc import Iterable
from typing import Any, Final, get_type_hints

import msgspec
import pandas as pd

from socast.core.wire.live_fields import find_struct
from socast.core.wire.messages import Forecast, Message

KEY_END: Final = "/forecast"


def _list_columns(struct: type[msgspec.Struct], before: str = "") -> list[str]:
    """Return the columns of a struct, those of a nested one after its name and a dot."""
    columns: list[str] = []
    for name, kind in get_type_hints(struct).items():
        nested = find_struct(kind)
        columns += _list_columns(nested, f"{before}{name}.") if nested else [before + name]
    return columns


FORECAST_COLUMNS: Final = tuple(_list_columns(Forecast))
"""Columns that each table of forecasts has."""
_NESTED: Final = {before for name in FORECAST_COLUMNS for before in (name.rpartition(".")[0], name.partition(".")[0])}


def is_forecast(message: Message) -> bool:
    """Return whether a message is a forecast."""
    return message.key.endswith(KEY_END)


def tabulate_forecasts(messages: Iterable[Message]) -> pd.DataFrame:
    """Return the forecasts among messages as a table; a value that is absent or null is NaN.

    It has `FORECAST_COLUMNS`, and those of fields that this version does not know.
    """
    payloads: list[dict[str, Any]] = [msgspec.json.decode(each.payload) for each in messages if is_forecast(each)]
    table = pd.json_normalize(payloads)
    further = [name for name in table.columns if name not in FORECAST_COLUMNS and name not in _NESTED]
    return table.reindex(columns=[*FORECAST_COLUMNS, *further])
