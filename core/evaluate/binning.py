"""Under what conditions rides were: bins of distance, weather, speed, season, time of day, car and driver."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from core.batch import Floats
from core.evaluate.ride_filter import CLUSTERS, assign_distance_clusters
from core.stats.scores import Codes

TEMPERATURES: Final = tuple(range(-30, 41, 5))
"""Ends of the bins of outside temperature; the lower end belongs to a bin, the first and last bin are open. [°C]"""
SPEEDS: Final = (10, 15, 20, 25, 30, 40, 50, 70, 100)
"""The same of a ride's average speed. [km/h]"""
WINDS: Final = (5, 10, 15, 20, 30, 40)
"""The same of the wind's mean speed, whatever its direction. [km/h]"""
HOURS_PER_BIN: Final = 3
"""Width of a bin of the time of day. [h]"""
DEGREES_PER_HOUR: Final = 15.0
"""By which the sun goes round. [degree]"""


class Binning(NamedTuple):
    """Bins of one property of rides.

    Parameters
    ----------
    codes : (n,) int64
        Bin of each ride, -1 where it is not known.
    labels : tuple of str
        Of the bins, in their order.
    """

    codes: Codes
    labels: tuple[str, ...]


def bin_rides(rides: pd.DataFrame) -> dict[str, Binning]:
    """Return the bins of each property of rides that the table tells, by the property's name.

    Parameters
    ----------
    rides : DataFrame
        Of the ride table.

    Returns
    -------
    dict of str to Condition
        Keys of `BINNERS`, in their order, without those of which nothing is known.
    """
    made = {name: make(rides) for name, make in BINNERS.items()}
    return {name: found for name, found in made.items() if np.any(found.codes >= 0)}


def compute_local_hour(start_s: Floats, longitude_deg: Floats) -> Floats:
    """Return the hour of the day by the sun's zone, as tables know no time zone: UTC + longitude / 15°, rounded. [h]

    Examples
    --------
    >>> compute_local_hour(np.array([1516017600.0]), np.array([-73.6])).tolist()  # 12:00 UTC in Montreal
    [7.0]
    """
    hour: Floats = (start_s / 3600.0 + np.round(longitude_deg / DEGREES_PER_HOUR)) % 24.0
    return hour


def bin_values(values: Floats, ends: Sequence[int]) -> Binning:
    """Return bins between ends; the first and last bin are open.

    Examples
    --------
    >>> bin_values(np.array([3.0, 5.0, np.nan, 99.0]), (5, 10))
    Binning(codes=array([ 0,  1, -1,  2]), labels=('below 5', '5 to 10', 'from 10'))
    """
    inner = [f"{low} to {high}" for low, high in pairwise(ends)]
    codes = np.searchsorted(np.array(ends, dtype=np.float64), values, side="right")
    codes = np.where(np.isfinite(values), codes, -1).astype(np.int64)
    return Binning(codes, (f"below {ends[0]}", *inner, f"from {ends[-1]}"))


def _distance(rides: pd.DataFrame) -> Binning:
    return Binning(assign_distance_clusters(_numbers(rides, "distance_km")), CLUSTERS)


def _season(rides: pd.DataFrame) -> Binning:
    winter = _numbers(rides, "winter")
    return Binning(np.where(np.isnan(winter), -1, 1 - (winter > 0.0)).astype(np.int64), ("winter", "summer"))


def _hour(rides: pd.DataFrame) -> Binning:
    hour = compute_local_hour(_numbers(rides, "start_s"), _numbers(rides, "longitude_start_deg"))
    codes = np.where(np.isfinite(hour), np.nan_to_num(hour) // HOURS_PER_BIN, -1).astype(np.int64)
    return Binning(codes, tuple(f"{h} to {h + HOURS_PER_BIN}" for h in range(0, 24, HOURS_PER_BIN)))


def _named(column: str) -> Callable[[pd.DataFrame], Binning]:
    """Return what makes a bin of each name in a column."""

    def make(rides: pd.DataFrame) -> Binning:
        if column not in rides:
            return Binning(np.full(len(rides), -1, np.int64), ())
        names = sorted(str(name) for name in rides[column].dropna().unique())
        return Binning(pd.Categorical(rides[column], categories=names).codes.astype(np.int64), tuple(names))

    return make


def _binned(column: str, ends: Sequence[int]) -> Callable[[pd.DataFrame], Binning]:
    """Return what makes bins of the numbers in a column."""
    return lambda rides: bin_values(_numbers(rides, column), ends)


def _numbers(rides: pd.DataFrame, column: str) -> Floats:
    """Return a column of numbers, NaN where it is not there."""
    if column not in rides:
        return np.full(len(rides), np.nan)
    return rides[column].to_numpy(np.float64)


BINNERS: Final[Mapping[str, Callable[[pd.DataFrame], Binning]]] = MappingProxyType(
    {
        "distance": _distance,
        "temperature": _binned("ambient_c", TEMPERATURES),
        "speed": _binned("average_speed_kmh", SPEEDS),
        "season": _season,
        "time of day": _hour,
        "wind": _binned("wind_speed_kmh", WINDS),
        "vehicle model": _named("vehicle_model"),
        "vehicle": _named("vehicle_id"),
        "driver": _named("driver_id"),
    }
)
"""What makes the bins of each property."""
