"""Bin rides by distance, weather, speed, season, time of day, vehicle and driver."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats, Ints
from socast.core.evaluate.ride_filter import CLUSTERS, assign_distance_clusters
from socast.core.fit.ride_blocks import get_numbers_if_present
from socast.core.stats.scores import Codes

TEMPERATURES: Final = tuple(range(-30, 41, 5))
"""Edges of the temperature bins. A bin includes its lower edge; the first and last bin are open. [°C]"""
SPEEDS: Final = (10, 15, 20, 25, 30, 40, 50, 70, 100)
"""Edges of the bins of average ride speed. [km/h]"""
SEASONS: Final = ("winter-tyre season (15 Dec to 15 Mar)", "rest of the year")
"""Labels of the seasons of Table 1 of the paper. They are those of the tyres, not of the weather."""
HOURS_PER_BIN: Final = 3
"""Width of a time-of-day bin. [h]"""
DEGREES_PER_HOUR: Final = 15.0
"""Longitude that the sun crosses in one hour. [degree/h]"""


class Binning(NamedTuple):
    """Define the bins of one property of rides.

    Parameters
    ----------
    codes : (n,) int64
        Bin of each ride; -1 where the property is unknown.
    """

    codes: Codes
    labels: tuple[str, ...]


def bin_rides(rides: pd.DataFrame) -> dict[str, Binning]:
    """Return the bins of every known property of rides; a property that no ride has is left out."""
    distance, ambient_c, speed, winter, start_s, longitude = (
        get_numbers_if_present(rides, name)
        for name in ("distance_km", "ambient_c", "average_speed_kmh", "winter", "start_s", "longitude_start_deg")
    )
    made = {
        "distance": Binning(assign_distance_clusters(distance), CLUSTERS),
        "temperature": bin_values(ambient_c, TEMPERATURES),
        "speed": bin_values(speed, SPEEDS),
        "season": bin_seasons(winter),
        "time of day": _bin_hours(compute_local_hour(start_s, longitude)),
        "vehicle model": bin_names(rides, "vehicle_model"),
        "vehicle": bin_names(rides, "vehicle_id"),
        "driver": bin_names(rides, "driver_id"),
    }
    return {name: bins for name, bins in made.items() if np.any(bins.codes >= 0)}


def list_bins(rides: pd.DataFrame) -> list[tuple[str, str, Ints]]:
    """Return property, label and rides of each bin of `bin_rides` that has a ride."""
    return [
        (name, labels[code], np.flatnonzero(codes == code))
        for name, (codes, labels) in bin_rides(rides).items()
        for code in np.unique(codes[codes >= 0]).tolist()
    ]


def compute_local_hour(start_s: Floats, longitude_deg: Floats) -> Floats:
    """Return the local hour of each time. [h]

    Units: returns [h].

    Notes
    -----
    Tables hold no time zone, so the hour follows from the sun: UTC + longitude / 15°, with the offset rounded to hours.

    Examples
    --------
    >>> compute_local_hour(np.array([1516017600.0]), np.array([-73.6])).tolist()  # 12:00 UTC in Montreal
    [7.0]
    """
    return np.asarray((start_s / 3600.0 + np.round(longitude_deg / DEGREES_PER_HOUR)) % 24.0)


def bin_values(values: Floats, ends: Sequence[int]) -> Binning:
    """Return the bins of values between edges; the first and last bin are open.

    Parameters
    ----------
    values : (n,) float
        Values to bin; NaN where unknown.

    Examples
    --------
    >>> bin_values(np.array([3.0, 5.0, np.nan, 99.0]), (5, 10))
    Binning(codes=array([ 0,  1, -1,  2]), labels=('below 5', '5 to 10', 'from 10'))
    """
    inner = [f"{low} to {high}" for low, high in pairwise(ends)]
    codes = np.searchsorted(np.array(ends, dtype=np.float64), values, side="right")
    codes = np.where(np.isfinite(values), codes, -1).astype(np.int64)
    return Binning(codes, (f"below {ends[0]}", *inner, f"from {ends[-1]}"))


def bin_seasons(winter: Floats) -> Binning:
    """Return the bins of `SEASONS`.

    Parameters
    ----------
    winter : (n,) float
        1 in the season of winter tyres, 0 outside it, NaN where unknown: Table 1 of the paper.

    Examples
    --------
    >>> bin_seasons(np.array([1.0, 0.0, np.nan])).codes.tolist()
    [0, 1, -1]
    """
    return Binning(np.where(np.isnan(winter), -1, 1 - (winter > 0.0)).astype(np.int64), SEASONS)


def _bin_hours(hour: Floats) -> Binning:
    """Return bins of the local hour."""
    codes = np.where(np.isfinite(hour), np.nan_to_num(hour) // HOURS_PER_BIN, -1).astype(np.int64)
    return Binning(codes, tuple(f"{h} to {h + HOURS_PER_BIN}" for h in range(0, 24, HOURS_PER_BIN)))


def bin_names(rides: pd.DataFrame, column: str, least: int = 1) -> Binning:
    """Return a bin for each name in a column that at least some number of rides have; none without the column."""
    if column not in rides:
        return Binning(np.full(len(rides), -1, np.int64), ())
    names = sorted(str(name) for name, count in rides[column].value_counts().items() if count >= least)
    codes = pd.Index(names, dtype=object).get_indexer(pd.Index(rides[column], dtype=object))
    return Binning(codes.astype(np.int64), tuple(names))
