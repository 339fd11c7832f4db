"""Elevation and climb of whole rides, estimated from the fixes on both sides of each sample.

`socast.core.cleaning.elevation_filter` runs over each ride with the roughness of the terrain, and the standard
deviation and correlation time of the errors of fixes, that have the greatest likelihood, under a prior that matters for
short rides only.

Fixes to which no road leads are not used, as in `socast.core.cleaning.elevation`.

On a map, the offset of the fixes of a ride is the median of their differences from the map. Its variance is added to
that of the map.
"""

from math import isnan, nan
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.cleaning import elevation, elevation_filter
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.clock import SIGMA
from socast.core.cleaning.elevation import (
    BASE,
    LATE_ROAD,
    LONGEST_HELD,
    NEW_LEVEL,
    STEEP,
    STILL_STEEP,
    SURE,
    weigh_slope,
)
from socast.core.cleaning.elevation_filter import (
    ESTIMATE,
    RideSteps,
    describe_step,
    filter_ride,
    smooth_back,
)
from socast.core.compiled_cache import njit, watch_sources

LONGEST_PIECE: Final = 50_000
"""Number of rows of a ride after which its elevation is estimated anew; 42 h at a sample every 3 s."""
ROUNDING: Final = 0.3
"""Least standard deviation of a fix: that of a height in whole metres, 1 / sqrt(12). [m]"""
INDEPENDENT: Final = 5.0
"""Number of successive differences of fix and map that count as one, because their errors are correlated."""

ROUGHNESS: Final = 1e-6
"""Usual roughness: over 100 m, the slope changes by 1 %. [1/m]"""
CORRELATION_TIME: Final = 5.0
"""Usual correlation time of the error of a fix. [s]"""
ROUGHNESS_STEP: Final = 10.0**0.5
SD_STEP: Final = 2.0**0.5
TIME_STEP: Final = 2.0
"""Ratios of two neighbouring values on the grids over which the likelihood is maximised. [1]"""
ROUGHNESS_SPREAD: Final = 2.0
SD_SPREAD: Final = 2.0
TIME_SPREAD: Final = 1.5
"""Standard deviations of the prior, in steps of the grids."""
SLOPE: Final = np.dtype([(name, "f8") for name in elevation.FIELDS if name.startswith(("base_", "steep_", "held_"))])
"""State of `weigh_slope`."""
MOST_STEPS: Final = 8
"""Largest number of steps from the usual value on each grid."""
SWEEPS: Final = 3
"""Largest number of passes over the three parameters."""


def smooth_elevation(clean: Clean, longest: int = LONGEST_PIECE) -> Clean:
    """Return cleaned rows with the elevation and climb of rides estimated from both sides.

    Parameters
    ----------
    longest : int
        Number of rows of a piece; a ride with more rows is estimated piece by piece. [rows]

    Returns
    -------
    Clean
        The rows with other `elevation` and `climb`; idle periods, and rides without a fix or map, keep theirs.
    """
    order, steps, edges = cut_rides(clean, longest)
    elevation, climb = clean.elevation.copy(), clean.climb.copy()
    heights, climbs = elevation[order], climb[order]
    smooth_rides(steps, edges, heights, climbs)
    elevation[order], climb[order] = heights, climbs
    return clean._replace(elevation=elevation, climb=climb)


def cut_rides(clean: Clean, longest: int = LONGEST_PIECE) -> tuple[Ints, Floats, Ints]:
    """Return the places of the rows of rides, car by car, the steps to them, (5, n), and the edges of the pieces."""
    riding = np.flatnonzero(clean.ride >= 0)
    order = riding[np.argsort(clean.lane[riding], kind="stable")]
    lane, ride = clean.lane[order], clean.ride[order]
    is_first = (np.diff(lane, prepend=-1) != 0) | (np.diff(ride, prepend=-1) != 0)
    begins = np.flatnonzero(is_first | (number_rows(np.cumsum(is_first)) % longest == 0))
    columns = clean.distance, clean.dt, clean.elevation_fix, clean.ground, clean.ground_variance
    return order, np.stack([column[order] for column in columns]), np.append(begins, len(order))


def number_rows(group: Ints) -> Ints:
    """Return the number of each row among the rows of its group, from 0 on.

    Examples
    --------
    >>> number_rows(np.array([4, 4, 2, 4, 2])).tolist()
    [0, 1, 0, 2, 1]
    """
    order = np.argsort(group, kind="stable")
    ordered = group[order]
    first = np.searchsorted(ordered, ordered)
    number = np.empty(len(group), np.int64)
    number[order] = np.arange(len(group)) - first
    return number


def smooth_ride(steps: RideSteps, noise: tuple[float, float, float]) -> NDArray[np.void]:
    """Return the smoothed estimate at each row of a ride.

    Parameters
    ----------
    noise : (roughness, sd, correlation_time)
        Roughness of the terrain [1/m]; standard deviation [m] and correlation time [s] of the error of a fix.
    """
    predicted, updated = np.zeros((2, len(steps.fix)), ESTIMATE)
    begins = np.zeros(len(steps.fix), np.bool_)
    filter_ride(steps, noise, predicted, updated, begins)
    smooth_back(steps.distance, begins, predicted, updated)
    return updated


@njit(cache=True)
def smooth_rides(steps: Any, edges: Any, heights: Any, climbs: Any) -> None:
    """Replace heights and climbs of all rides with a fix or a map by their smoothed values."""
    for i in range(len(edges) - 1):
        begin, end = edges[i], edges[i + 1]
        if np.isnan(steps[2, begin:end]).all() and np.isnan(steps[3, begin:end]).all():
            continue
        ride = prepare_ride(steps, begin, end)
        distance, noise = ride.distance, find_noise(ride)
        predicted, updated = np.zeros(end - begin, ESTIMATE), np.zeros(end - begin, ESTIMATE)
        begins = np.zeros(end - begin, np.bool_)
        filter_ride(ride, noise, predicted, updated, begins)
        smooth_back(distance, begins, predicted, updated)
        for j in range(end - begin):
            heights[begin + j] = updated[j].height
            if begins[j]:  # the step before it is not estimated; the slope of the road returns to level both ways
                climbs[begin + j] = describe_step(distance[j])[0] * updated[j].slope
            else:
                climbs[begin + j] = updated[j].height - updated[j - 1].height


@njit(cache=True)
def prepare_ride(steps: Any, begin: int, end: int) -> Any:
    """Return the `RideSteps` of some of the rows of `cut_rides`, with fixes less their offset to the map."""
    distance, time, ground = steps[0, begin:end], steps[1, begin:end], steps[3, begin:end]
    offset, variance = find_offset(steps[2, begin:end], ground)
    fix = reject_slopes(distance, steps[2, begin:end])
    return RideSteps(distance, time, fix - offset, ground, steps[4, begin:end] + variance)


@njit(cache=True)
def reject_slopes(distance: Any, fix: Any) -> Any:
    """Return fixes [m] without those to which no road leads, unless their level lasts, and without held ones."""
    slope, kept, first, held_from = np.zeros(1, SLOPE)[0], fix.copy(), 0, 0
    slope.base_height = slope.steep_height = slope.held_height = nan
    for i in range(len(fix)):
        slope.base_run += distance[i]
        slope.steep_run += distance[i]
        slope.held_run += distance[i]
        if isnan(fix[i]):
            continue
        if fix[i] != slope.held_height:
            if BASE < slope.held_run < LONGEST_HELD and abs(fix[i] - slope.held_height) > SURE:
                kept[held_from + 1 : i] = nan
            held_from = i
        outcome = weigh_slope(slope, fix[i])[0]
        if outcome == STEEP:
            first = i
        if outcome in (STEEP, STILL_STEEP):
            kept[i] = nan
        elif outcome in (NEW_LEVEL, LATE_ROAD):
            kept[first:i] = fix[first:i]
    return kept


@njit(cache=True)
def find_offset(fix: Any, ground: Any) -> tuple[float, float]:
    """Return the offset of the fixes of a ride to the map [m] and its variance [m^2], 0 and 0 where they never meet."""
    differences = (fix - ground)[~np.isnan(fix - ground)]
    if len(differences) == 0:
        return 0.0, 0.0
    offset = np.median(differences)
    spread = SIGMA * np.median(np.abs(differences - offset))
    return offset, spread * spread / (1.0 + len(differences) / INDEPENDENT)


@njit(cache=True)
def find_noise(ride: Any) -> tuple[float, float, float]:
    """Return roughness, standard deviation and correlation time of the greatest likelihood times prior.

    The search follows one parameter after the other, in steps from the usual values.
    """
    nowhere, begins = np.zeros(0, ESTIMATE), np.zeros(0, np.bool_)
    sd = find_difference(ride.fix)
    place = np.zeros(3)
    best = compute_prior_cost(place)
    best += filter_ride(ride, make_noise(place, sd), nowhere, nowhere, begins)
    for _ in range(SWEEPS):
        before = best
        for axis in range(3):
            for direction in (-1.0, 1.0):
                while abs(place[axis]) < MOST_STEPS:
                    place[axis] += direction
                    cost = compute_prior_cost(place)
                    cost += filter_ride(ride, make_noise(place, sd), nowhere, nowhere, begins)
                    if cost >= best:
                        place[axis] -= direction
                        break
                    best = cost
        if best == before:
            break
    return make_noise(place, sd)


@njit(cache=True)
def make_noise(place: Any, sd: float) -> tuple[float, float, float]:
    """Return roughness, standard deviation and correlation time at a place in the grids."""
    return (
        ROUGHNESS * ROUGHNESS_STEP ** place[0],
        max(ROUNDING, sd * SD_STEP ** place[1]),
        CORRELATION_TIME * TIME_STEP ** place[2],
    )


@njit(cache=True)
def compute_prior_cost(place: Any) -> float:
    """Return minus twice the logarithm of the prior at a place in the grids. [1]"""
    return (place[0] / ROUGHNESS_SPREAD) ** 2 + (place[1] / SD_SPREAD) ** 2 + (place[2] / TIME_SPREAD) ** 2


@njit(cache=True)
def find_difference(fix: Any) -> float:
    """Return the median difference of neighbouring fixes, at least `ROUNDING`. [m]"""
    last, differences, count = nan, np.zeros(len(fix)), 0
    for value in fix:
        if isnan(value):
            continue
        if not isnan(last):
            differences[count] = abs(value - last)
            count += 1
        last = value
    return max(ROUNDING, np.median(differences[:count])) if count > 0 else ROUNDING


for _function in (smooth_rides, prepare_ride, find_noise, reject_slopes):
    watch_sources(_function, elevation_filter, elevation)
