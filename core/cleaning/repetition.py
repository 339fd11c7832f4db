"""Recognise a row that repeats the fix or the content of the row before it in its lane."""

from math import isnan
from typing import Any, Final

from numba import njit

FIELDS: Final = (
    *(f"last_{name}" for name in ("latitude", "longitude", "speed", "current", "soc")),  # of the last row, as reported
    *(f"fix_{name}" for name in ("latitude", "longitude", "elevation")),  # of the last accepted row, as reported
)


@njit(cache=False)
def repeats_fix(state: Any, row: Any) -> bool:
    """Return whether a row repeats the position and elevation of the last accepted row.

    A receiver without reception, as in a tunnel, reports its last fix again.
    """
    same = row.raw_latitude == state.fix_latitude and row.raw_longitude == state.fix_longitude
    return same and row.raw_elevation == state.fix_elevation


@njit(cache=False)
def repeats_content(state: Any, row: Any) -> bool:
    """Return whether a row has the content of the row before it in its lane, and keep its content."""
    same = state.samples > 0.0
    same &= row.raw_latitude == state.last_latitude or (isnan(row.raw_latitude) and isnan(state.last_latitude))
    same &= row.raw_longitude == state.last_longitude or (isnan(row.raw_longitude) and isnan(state.last_longitude))
    same &= row.raw_speed == state.last_speed or (isnan(row.raw_speed) and isnan(state.last_speed))
    same &= row.raw_current == state.last_current or (isnan(row.raw_current) and isnan(state.last_current))
    same &= row.raw_soc == state.last_soc or (isnan(row.raw_soc) and isnan(state.last_soc))
    state.last_latitude, state.last_longitude, state.last_speed = row.raw_latitude, row.raw_longitude, row.raw_speed
    state.last_current, state.last_soc = row.raw_current, row.raw_soc
    return same
