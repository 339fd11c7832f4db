"""Define the conditions on rides that describe a slice in words.

Each condition is one comparison of one column: temperature, distance, speed, climb, stops, weather, parking time,
battery, occupants, season, hour, date, or the name of a vehicle model, a vehicle or a driver. Thresholds are quantiles
of the rides, rounded to common numbers. A condition does not hold where its column is unknown.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.fit.ride_blocks import get_names, get_numbers

Masks = NDArray[np.bool_]

QUANTILES: Final = np.linspace(0.04, 0.96, 24)
"""Quantiles of the rides that are candidates for thresholds."""
ENOUGH: Final = 4
"""Number of thresholds of a column from which on no finer step is tried."""
MOST_DATES: Final = 16
"""Maximum number of dates at which a period may begin."""
FEWEST: Final = 8
"""Least number of rides for which a condition must hold, and for which it must not hold."""
HOURS: Final = (3, 6, 12)
"""Lengths of the periods of the day, each beginning at a multiple of three hours. [h]"""

SEASONS: Final = (("winter", "in the winter-tyre season"), ("summer", "outside the winter-tyre season"))
"""Columns of the seasons, 15 December to 15 March and the rest of the year, and their conditions in words."""
VAGUE: Final = 1.5
"""Effort of a condition on a season, a date or the battery temperature, because the weather says more than these."""


class RideCondition(NamedTuple):
    """Hold a condition that is true for some rides.

    Parameters
    ----------
    kind : str
        Column and direction of the comparison; a second condition of the same kind is redundant.
    effort : float
        Number of conditions for which it counts: a season or a date says less than the temperature that comes with it.
        [1]
    """

    words: str
    kind: str
    effort: float = 1.0


class ConditionScale(NamedTuple):
    """Describe how conditions on a column are written.

    Parameters
    ----------
    below, above : str
        Templates for values below a threshold, and for values from the threshold on.
    steps : tuple of float
        Steps of which thresholds are multiples, coarsest first; one of them is chosen. [unit of the words]
    at : tuple of float
        Thresholds where equal steps are not suitable. [unit of the words]
    size : float
        Size of the unit of the words in units of the column.
    effort : float
        Effort of each condition, see `RideCondition`. [1]
    """

    column: str
    below: str
    above: str
    steps: tuple[float, ...] = ()
    at: tuple[float, ...] = ()
    size: float = 1.0
    effort: float = 1.0


CONDITION_SCALES: Final = (
    ConditionScale("ambient_c", "colder than {} °C", "warmer than {} °C", (5.0, 2.0, 1.0)),
    ConditionScale("distance_km", "shorter than {} km", "longer than {} km", (5.0, 2.0, 1.0, 0.5)),
    ConditionScale("average_speed_kmh", "slower than {} km/h", "faster than {} km/h", (10.0, 5.0, 2.0)),
    ConditionScale("gained_m", "gaining less than {} m", "gaining more than {} m", (100.0, 50.0, 20.0, 10.0)),
    ConditionScale("lost_m", "losing less than {} m", "losing more than {} m", (100.0, 50.0, 20.0, 10.0)),
    ConditionScale("stops", "fewer than {} stops", "{} stops or more", (10.0, 5.0, 2.0, 1.0)),
    ConditionScale("wind_speed_kmh", "wind below {} km/h", "wind above {} km/h", (10.0, 5.0, 2.0)),
    ConditionScale(
        "precipitation_mm_h",
        "rain or snow below {} mm/h",
        "rain or snow above {} mm/h",
        at=(0.1, 0.2, 0.5, 1.0, 2.0, 5.0),
    ),
    ConditionScale(
        "parked_s",
        "parked for less than {} h before",
        "parked for more than {} h before",
        at=(0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0, 24.0),
        size=3600.0,
    ),
    ConditionScale("soc_start_pct", "battery below {} % at the start", "battery above {} % at the start", (10.0, 5.0)),
    ConditionScale(
        "battery_temperature_c",
        "battery colder than {} °C",
        "battery warmer than {} °C",
        (5.0, 2.0, 1.0),
        effort=VAGUE,
    ),
    ConditionScale("occupants", "fewer than {} people aboard", "{} people aboard or more", (1.0,)),
)
NAMES: Final = (
    ("vehicle_id", "vehicle"),
    ("vehicle_model", "vehicle model"),
    ("driver_id", "driver"),
)
"""Columns of names, and the title before a name that has no letters."""


def list_conditions(rides: pd.DataFrame, *, dated: bool = True) -> tuple[list[RideCondition], Masks]:
    """Return the conditions that are true for some rides and false for others.

    Parameters
    ----------
    dated : bool
        Whether the dates are known; conditions on season, hour and date are omitted if they are invented.

    Returns
    -------
    list of c RideCondition
        Conditions on names, then on physical columns, then on times. Of conditions that hold for the same rides, only
        the first is returned.
    """
    conditions: list[RideCondition] = []
    masks: list[NDArray[np.bool_]] = []
    seen: set[bytes] = set()
    for condition, mask in _all(rides, dated=dated):
        key = np.packbits(mask).tobytes()
        if FEWEST <= np.count_nonzero(mask) <= len(mask) - FEWEST and key not in seen:
            seen.add(key)
            conditions.append(condition)
            masks.append(mask)
    return conditions, np.array(masks, dtype=np.bool_).reshape(len(conditions), len(rides))


def read_start_s(rides: pd.DataFrame) -> Floats:
    """Return the Unix time at which each ride began, (n,) float. [s]"""
    return _numbers(rides, "start_s")


def read_dates(rides: pd.DataFrame) -> NDArray[np.str_]:
    """Return the UTC date of each ride, (n,) str, ISO; empty where it is unknown."""
    if "date" in rides:
        return np.array(get_names(rides, "date"), dtype=np.str_)
    began = read_start_s(rides)
    known = np.isfinite(began)
    dates = np.full(len(rides), "", dtype="<U10")
    dates[known] = [datetime.fromtimestamp(time, UTC).date().isoformat() for time in began[known].tolist()]
    return dates


def _all(rides: pd.DataFrame, *, dated: bool) -> Iterator[tuple[RideCondition, NDArray[np.bool_]]]:
    """Yield every possible condition on rides, also those that hold for all or for none."""
    for column, title in NAMES:
        yield from _named(np.array(get_names(rides, column), dtype=np.str_), column, title)
    for scale in CONDITION_SCALES:
        if scale.column in rides:
            yield from _compared(_numbers(rides, scale.column) / scale.size, scale)
    if not dated:
        return
    for column, words in SEASONS:
        if column in rides:
            yield RideCondition(words, "season", VAGUE), _numbers(rides, column) > 0.5
    yield from _hours(rides)
    yield from _periods(read_dates(rides))


def _named(column: NDArray[np.str_], kind: str, title: str) -> Iterator[tuple[RideCondition, NDArray[np.bool_]]]:
    """Yield one condition for each name that is frequent enough."""
    names, code, rides = np.unique(column, return_inverse=True, return_counts=True)
    for i, (name, count) in enumerate(zip(names.tolist(), rides.tolist(), strict=True)):
        if name and count >= FEWEST:
            words = name if any(letter.isalpha() for letter in name) else f"{title} {name}"
            yield RideCondition(words, kind), code == i


def _compared(values: Floats, scale: ConditionScale) -> Iterator[tuple[RideCondition, NDArray[np.bool_]]]:
    """Yield the conditions on both sides of each threshold of a column."""
    for threshold in choose_thresholds(values, scale):
        text = f"{threshold:g}"
        yield RideCondition(scale.below.format(text), f"{scale.column} <", scale.effort), values < threshold
        yield RideCondition(scale.above.format(text), f"{scale.column} >", scale.effort), values >= threshold


def choose_thresholds(values: Floats, scale: ConditionScale) -> list[float]:
    """Return round numbers that divide values into two parts, ascending.

    Examples
    --------
    >>> choose_thresholds(np.linspace(-12.0, 24.0, 100), CONDITION_SCALES[0])
    [-10.0, -5.0, 0.0, 5.0, 10.0, 15.0, 20.0]
    >>> choose_thresholds(np.linspace(18.2, 24.1, 100), CONDITION_SCALES[0])
    [19.0, 20.0, 21.0, 22.0, 23.0, 24.0]
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return []
    low, high = float(known.min()), float(known.max())
    if scale.at:
        return [at for at in scale.at if low < at <= high]
    quantiles = np.quantile(known, QUANTILES)
    thresholds: list[float] = []
    for step in scale.steps:
        round_ones = np.unique(np.round(quantiles / step)) * step
        thresholds = [float(at) + 0.0 for at in round_ones if low < at <= high]
        if len(thresholds) >= ENOUGH:
            break
    return thresholds


def _hours(rides: pd.DataFrame) -> Iterator[tuple[RideCondition, NDArray[np.bool_]]]:
    """Yield periods of the day by local mean solar time at the start, or by UTC where the position is unknown."""
    longitude = np.nan_to_num(_numbers(rides, "longitude_start_deg"))
    hour = (read_start_s(rides) / 3600.0 + longitude / 15.0) % 24.0
    for length in HOURS:
        for first in range(0, 24, 3):
            words = f"between {first} and {(first + length) % 24} h"
            yield RideCondition(words, "hour"), (hour - first) % 24.0 < length


def _periods(day: NDArray[np.str_]) -> Iterator[tuple[RideCondition, NDArray[np.bool_]]]:
    """Yield the periods before and since a date, for every date or for dates that divide the rides evenly."""
    known = np.sort(day[day != ""])
    dates = np.unique(known)
    if len(dates) > MOST_DATES:
        dates = np.unique(known[(np.linspace(0.0, 1.0, MOST_DATES + 2)[1:-1] * len(known)).astype(np.int64)])
    for date in dates.tolist():
        yield RideCondition(f"before {date}", "date <", VAGUE), (day < date) & (day != "")
        yield RideCondition(f"since {date}", "date >", VAGUE), day >= date


def _numbers(rides: pd.DataFrame, column: str) -> Floats:
    """Return a column as (n,) float, NaN where it is unknown or absent."""
    return get_numbers(rides, column) if column in rides else np.full(len(rides), np.nan)
