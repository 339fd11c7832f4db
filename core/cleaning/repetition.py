"""Compare a row with the rows before it in its lane: does it repeat their fix or content, and did the car drive on."""

from math import cos, isnan, sqrt
from typing import Any, Final

from socast.core.columns import EARTH_RADIUS
from socast.core.compiled_cache import njit

FIELDS: Final = (
    *(f"last_{name}" for name in ("latitude", "longitude", "speed", "current", "soc")),  # of the last row, as reported
    *(f"fix_{name}" for name in ("latitude", "longitude", "elevation", "speed")),  # of the last accepted row
)

LEAST_LEAP: Final = 60.0
"""Time that a stamp leaps ahead from which the question arises. [s]"""
STANDING: Final = 1.0
"""Reported speed below which a car stands. [m/s]"""
DRIVING: Final = 3.0
"""Reported speed above which a car certainly drives. [m/s]"""
SCATTER: Final = 100.0
"""Largest distance between two fixes of a car that has not moved. [m]"""


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


@njit(cache=False)
def keep_accepted(state: Any, row: Any) -> None:
    """Keep fix and speed of an accepted row."""
    state.fix_latitude, state.fix_longitude, state.fix_speed = row.raw_latitude, row.raw_longitude, row.raw_speed


@njit(cache=False)
def drove_on(state: Any, row: Any, period: float) -> float:
    """Return whether the car drove on since the last accepted row, as if one period had passed.

    Returns
    -------
    float
        1 where speed and fixes continue the drive, -1 where the car stands in both rows or is elsewhere, 0 where
        neither is known.
    """
    if not row.raw_stamp - state.time >= LEAST_LEAP:
        return 0.0
    before, now = state.fix_speed, row.raw_speed
    north = row.raw_latitude - state.fix_latitude
    east = (row.raw_longitude - state.fix_longitude) * cos(row.raw_latitude)
    apart = EARTH_RADIUS * sqrt(north * north + east * east)
    run = 0.5 * (before + now) * period
    if not (isnan(apart) or isnan(run)) and apart > 3.0 * run + SCATTER:
        return -1.0
    if before < STANDING and now < STANDING:
        return -1.0
    drives = before > DRIVING and now > DRIVING and 0.3 * run <= apart <= 3.0 * run
    return 1.0 if drives else 0.0
