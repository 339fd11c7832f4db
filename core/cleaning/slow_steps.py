"""Steps of a slow logger: how far the car drove between two samples, by its fixes and by the speeds at both ends."""

from math import isnan
from typing import Any, Final

from socast.core.cleaning.sphere import find_way
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "leapt",  # 1 where a fix is further away than the car can have come
    "slow_ends",  # distance by speeds since the last accepted fix [m]
    "slow_way",  # distance that was counted since then [m]
    "origin_latitude",  # last fix before those that are further apart than speeds explain [rad], NaN without one
    "origin_longitude",
    "origin_ends",  # distance by speeds from there to the last accepted fix [m]
    "origin_excess",  # distance that was counted beyond that, where speeds do not explain it [m]
    "origin_fixes",  # number of fixes since then
)
UNKNOWN_AT_FIRST: Final = ("origin_latitude", "origin_longitude")
"""Fields of a new lane that are NaN."""

HOLE: Final = 3.5
"""Longest step that is not a hole. [periods]

A longer step is a hole for slow loggers too: odometer and fixes then show its distance better than two speeds do."""
WINDING: Final = 0.33
"""Share of the distance by two speeds beyond that by two fixes that a slow logger has driven. [1]

The road winds, so that fixes show too little: in a city 9 % for samples every 60 s, 3 % for every 15 s. Two speeds show
as much as the road on average, and twice as much or nothing now and then. Chosen on 114 drives of a Nissan Leaf
(arXiv:1905.02081), whose bias is within 1.3 % with it for 10 to 60 s."""
MOST_DRIVEN: Final = 1.5
"""Ratio of the distance of two fixes to that by speeds, or at the speed before, of a leap. [1]

Estimated, as is `UNSEEN_SPEED`: a car between two lights may be twice as fast as two samples show."""
UNSEEN_SPEED: Final = 10.0
"""Mean speed by which a car may be faster than that in the last step. [m/s]"""

BEYOND: Final = 1.15
BEYOND_SLACK: Final = 50.0
"""Distance of two fixes that two speeds do not explain: the one by them times the first, plus the second. [m]"""
MOST_JUMPS: Final = 5.0
"""Number of fixes in succession that may have jumped."""


@njit(cache=False)
def find_farthest_fix(state: Any, row: Any, dt: float, settings: Any) -> float:
    """Return the largest plausible distance from the last accepted fix, less where a slow logger has speeds. [m]"""
    step = max(dt, settings.period)
    farthest = settings.speed_limit * max(state.fix_age, step)
    is_slow = HOLE * settings.period < dt <= 1.5 * state.period
    if not is_slow or isnan(row.raw_speed) or isnan(state.speed) or state.speed_stuck == 1.0:
        return float(farthest)
    by_speeds = state.fix_distance + 0.5 * (row.raw_speed + state.speed) * dt
    driven = max(by_speeds, state.smooth * state.fix_age)
    return float(min(farthest, MOST_DRIVEN * driven + UNSEEN_SPEED * dt))


@njit(cache=False)
def compare_ends(state: Any, row: Any, by_ends: float, run: float, shortfall: float) -> float:
    """Compare the step of a slow logger with the speeds at its ends; return the distance that its fixes show. [m]

    Without a fix to believe, the speeds show it. Fixes cut off the bends of the road.
    """
    if isnan(by_ends) or not isnan(state.odometer):
        row.slow, row.slow_run = (0.0, 0.0) if isnan(by_ends) else (by_ends, run + shortfall)
        return shortfall
    if state.leapt == 1.0 and run == 0.0:
        shortfall = by_ends
        state.fix_distance += by_ends if state.fix_age > 0.0 else 0.0
    elif 0.0 < run + shortfall < by_ends:
        shortfall += WINDING * (by_ends - run - shortfall)
    row.slow, row.slow_run = by_ends, run + shortfall
    row.disputed += find_return(state, row, by_ends, run + shortfall)
    return shortfall


@njit(cache=False)
def find_return(state: Any, row: Any, by_ends: float, distance: float) -> float:
    """Return what the steps since an earlier fix have beyond their speeds if fixes between jumped away and back. [m]

    The speeds then explain the way from the earlier fix to this one, and neither the first step nor the last.
    """
    state.slow_ends += by_ends
    state.slow_way += distance
    if state.fix_age > 0.0:
        return 0.0
    excess = find_unexplained(state.slow_way, state.slow_ends)
    left = state.origin_excess > 0.0
    state.origin_ends += state.slow_ends
    state.origin_excess += excess
    state.origin_fixes += 1.0
    state.slow_ends = state.slow_way = 0.0
    way = find_way(state.origin_latitude, state.origin_longitude, row)
    returned = left and excess > 0.0 and find_unexplained(way, state.origin_ends) == 0.0
    jumped = state.origin_excess if returned else 0.0
    if returned or state.origin_excess == 0.0 or state.origin_fixes > MOST_JUMPS or isnan(way):
        state.origin_latitude, state.origin_longitude = row.raw_latitude, row.raw_longitude
        state.origin_ends = state.origin_excess = state.origin_fixes = 0.0
    return jumped


@njit(cache=False)
def find_unexplained(distance: float, by_ends: float) -> float:
    """Return the distance beyond that by speeds, 0 where these may explain it. [m]"""
    return distance - by_ends if distance > BEYOND * by_ends + BEYOND_SLACK else 0.0
