"""Columns of rides and windows along which residuals are shown, in units of everyday life."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.evaluate.binning import compute_local_hour
from socast.core.evaluate.compare import ride_wind


class ShownColumn(NamedTuple):
    """Describe a column.

    Parameters
    ----------
    unit : str
        Unit in which it is shown; empty for a category.
    size : float
        Size of this unit in the unit of the table.
    """

    key: str
    label: str
    unit: str
    size: float = 1.0


NUMBERS: Final = (
    ShownColumn("ambient_c", "Outside temperature", "°C"),
    ShownColumn("distance_km", "Distance", "km"),
    ShownColumn("average_speed_kmh", "Average speed", "km/h"),
    ShownColumn("headwind_kmh", "Headwind", "km/h"),
    ShownColumn("wind_speed_kmh", "Wind speed", "km/h"),
    ShownColumn("precipitation_mm_h", "Rain or snow", "mm/h"),
    ShownColumn("gained_m", "Climb", "m"),
    ShownColumn("lost_m", "Descent", "m"),
    ShownColumn("stops", "Stops", "stops"),
    ShownColumn("hour", "Local hour", "h"),
    ShownColumn("duration_s", "Duration", "min", 60.0),
    ShownColumn("elapsed_s", "Time since the start", "min", 60.0),
    ShownColumn("parked_s", "Parked before", "h", 3600.0),
    ShownColumn("soc_start_pct", "State of charge at the start", "%"),
    ShownColumn("battery_temperature_c", "Battery temperature", "°C"),
    ShownColumn("occupants", "People aboard", "people"),
    ShownColumn("odometer_km", "Odometer", "km"),
)
OF_WINDOW: Final[Mapping[str, str]] = MappingProxyType(
    {
        "distance_km": "Distance in the window",
        "duration_s": "Length of the window",
        "gained_m": "Climb in the window",
        "lost_m": "Descent in the window",
        "stops": "Stops in the window",
    }
)
"""Columns that hold amounts, and their labels in a table of windows."""
CATEGORIES: Final = (
    ShownColumn("vehicle_id", "Car", ""),
    ShownColumn("driver_id", "Driver", ""),
    ShownColumn("date", "Day", ""),
    ShownColumn("vehicle_model", "Kind of car", ""),
    ShownColumn("energy_source", "Measured by", ""),
)


def list_columns(table: pd.DataFrame) -> list[tuple[ShownColumn, Any]]:
    """Return the columns that a table has, with their values in the unit that is shown.

    Returns
    -------
    list of (ShownColumn, (n,) array)
        Numbers as float, categories as str with an empty text for what is unknown. Columns without any known value, or
        with a single one, are left out.
    """
    known: list[tuple[ShownColumn, Any]] = []
    for column in NUMBERS:
        values = read_numbers(table, column)
        if values is not None and len(np.unique(values[np.isfinite(values)])) > 1:
            label = OF_WINDOW.get(column.key, column.label) if "window" in table else column.label
            known.append((column._replace(label=label), values))
    for column in CATEGORIES:
        if column.key in table:
            names = table[column.key].astype(object).where(table[column.key].notna(), "").astype(str).to_numpy()
            if len(set(names) - {""}) > 1:
                known.append((column, names))
    return known


def read_numbers(table: pd.DataFrame, column: ShownColumn) -> Floats | None:
    """Return the values of a column of numbers in the unit that is shown, None if the table lacks it."""
    if column.key == "hour" and {"start_s", "longitude_start_deg"} <= set(table):
        longitude = np.nan_to_num(table["longitude_start_deg"].to_numpy(np.float64))
        return compute_local_hour(table["start_s"].to_numpy(np.float64), longitude)
    if column.key == "headwind_kmh" and "window" in table and set(ride_wind.COLUMNS) <= set(table):
        return ride_wind.compute_window_headwind(table)
    if column.key not in table:
        return None
    return np.asarray(table[column.key].to_numpy(np.float64) / column.size, dtype=np.float64)


def describe_column(column: ShownColumn) -> dict[str, Any]:
    """Return a column as a record."""
    return {"key": column.key, "label": column.label, "unit": column.unit, "number": bool(column.unit)}
