"""Filters of rides by the columns that the pages show."""

from collections.abc import Sequence
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.diagnose.shown_columns import ShownColumn, list_columns
from socast.core.diagnose.slices.predicates import list_conditions
from socast.core.errors import SettingsError

Mask = NDArray[np.bool_]
WHERE: Final = "where"
"""Name of the filter by a slice that a diagnosis found."""


def select_by_filter(rides: pd.DataFrame, text: str, extra: Sequence[tuple[ShownColumn, Any]] = ()) -> Mask:
    """Return the rides that a filter keeps, (n,).

    Parameters
    ----------
    text : str
        Conditions separated by `;`: `ambient_c:-10..0` for a range with its ends, either of which may be left out,
        `vehicle_id:taxi-1|taxi-2` for names, and `where:colder than -5 °C|wind above 20 km/h` for the conditions of a
        slice. Names are percent-encoded.
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
