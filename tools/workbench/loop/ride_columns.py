"""Columns of rides and windows that the pages show, in units of everyday life, and filters on them."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple
from urllib.parse import unquote

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.diagnose.slices.predicates import list_conditions
from socast.core.errors import SettingsError
from socast.core.evaluate.binning import compute_local_hour
from socast.core.evaluate.compare import ride_wind

Mask = NDArray[np.bool_]
WHERE: Final = "where"
"""Name of the filter by a slice that a diagnosis found."""


class ShownColumn(NamedTuple):
    """Describe a column.

    Parameters
    ----------
    key : str
        Name in the table.
    label : str
        Name for a person.
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
CATEGORIES: Final = (
    ShownColumn("vehicle_id", "Car", ""),
    ShownColumn("driver_id", "Driver", ""),
    ShownColumn("date", "Day", ""),
    ShownColumn("vehicle_model", "Kind of car", ""),
    ShownColumn("energy_source", "Measured by", ""),
)


def list_columns(table: pd.DataFrame) -> list[tuple[ShownColumn, Any]]:
    """Return the columns that a table has, with their values in the unit that is shown.

    Parameters
    ----------
    table : (n, columns) DataFrame
        Rides, or windows with the columns of their rides.

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
            known.append((column, values))
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


def select_by_filter(rides: pd.DataFrame, text: str, extra: Sequence[tuple[ShownColumn, Any]] = ()) -> Mask:
    """Return the rides that a filter keeps, (n,).

    Parameters
    ----------
    rides : (n, columns) DataFrame
        Rides.
    text : str
        Conditions separated by `;`: `ambient_c:-10..0` for a range with its ends, either of which may be left out,
        `vehicle_id:taxi-1|taxi-2` for names, and `where:colder than -5 °C|wind above 20 km/h` for the conditions of a
        slice. Names are percent-encoded.
    extra : sequence of (ShownColumn, (n,) array)
        Further columns.

    Raises
    ------
    SettingsError
        If a condition is not understood.
    """
    kept = np.ones(len(rides), np.bool_)
    columns = {column.key: (column, values) for column, values in (*list_columns(rides), *extra)}
    for part in filter(None, text.split(";")):
        key, _, value = part.partition(":")
        if key == WHERE:
            kept &= _select_slice(rides, [unquote(words) for words in value.split("|")])
        elif key not in columns:
            raise SettingsError(f"filter {key!r}: no such column; choose from {', '.join(columns)}")
        elif columns[key][0].unit:
            low, high = _parse_range(part, value)
            kept &= (columns[key][1] >= low) & (columns[key][1] <= high)
        else:
            kept &= np.isin(columns[key][1], [unquote(name) for name in value.split("|")])
    return kept


def _parse_range(part: str, value: str) -> tuple[float, float]:
    """Return the ends of a range."""
    low, dots, high = value.partition("..")
    try:
        ends = float(low or "-inf"), float(high or "inf")
    except ValueError:
        dots = ""
    if not dots:
        raise SettingsError(f"filter {part!r}: not a range; write it as ambient_c:-10..0")
    return ends


def _select_slice(rides: pd.DataFrame, words: Sequence[str]) -> Mask:
    """Return the rides for which all conditions of a slice hold."""
    conditions, masks = list_conditions(rides)
    place = {condition.words: i for i, condition in enumerate(conditions)}
    if unknown := [each for each in words if each not in place]:
        raise SettingsError(f"filter {WHERE}: {unknown[0]!r} is no condition of these rides; choose a slice again")
    return np.asarray(np.logical_and.reduce(masks[[place[each] for each in words]], axis=0), dtype=np.bool_)
