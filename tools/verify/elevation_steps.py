"""Compare the compiled smoother of the elevation with filterpy's, segment by segment of each ride.

Which readings are used, where a segment begins and where a slope is forgotten is no part of a linear filter: filterpy
takes these decisions of the compiled filter, and makes everything else of the distances and readings alone.
"""

from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Lanes
from socast.core.cleaning import elevation, elevation_filter
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.elevation_filter import (
    ESTIMATE,
    LENGTH,
    STEEP,
    RideSteps,
    filter_ride,
    smooth_back,
)
from socast.core.cleaning.elevation_smoother import cut_rides, find_noise, prepare_ride, smooth_elevation
from socast.core.compiled_cache import njit, watch_sources
from socast.tools.verify.differences import Tallies, measure_differences
from socast.tools.verify.elevation_witness import Decisions, smooth_with_filterpy

NO_ELEVATION: Final = "ride without elevation"
"""Cause for which the rows of a ride are passed over."""
FORGOTTEN: Final = 0.5 * STEEP**2
"""Excess of the variance of a slope over its prediction, from which the slope was forgotten. [1]"""


@njit(cache=True)
def _filter(ride: Any, noise: tuple[float, float, float], predicted: Any, updated: Any, begins: Any) -> None:
    """Call `filter_ride`, which the cache keeps only as a part of another function."""
    filter_ride(ride, noise, predicted, updated, begins)


@njit(cache=True)
def _smooth(distance: Any, begins: Any, predicted: Any, updated: Any) -> None:
    """Call `smooth_back`, which the cache keeps only as a part of another function."""
    smooth_back(distance, begins, predicted, updated)


for _function in (_filter, _smooth):
    watch_sources(_function, elevation_filter, elevation)


class ElevationSteps:
    """Compare the rows of all rides while tables smooth their elevation."""

    def __init__(self, lanes: Lanes) -> None:
        self.tallies, self._lanes = Tallies(), lanes

    def smooth_elevation(self, clean: Clean, longest: int) -> Clean:
        """Compare the smoothed elevation of rides, and return it as `smooth_elevation` does."""
        order, steps, edges = cut_rides(clean, longest)
        for begin, end in pairwise(edges.tolist()):
            if end > begin:
                self._compare(self._lanes.names[int(clean.lane[order[begin]])], prepare_ride(steps, begin, end))
        return smooth_elevation(clean, longest)

    def _compare(self, car: str, ride: RideSteps) -> None:
        """Compare the smoothed rows of a ride."""
        tally = self.tallies[car]
        if np.isnan(ride.fix).all() and np.isnan(ride.ground).all():
            tally.passed_over[NO_ELEVATION] += len(ride.fix)
            return
        tally.add(compare_ride(ride, find_noise(ride)), len(ride.fix))


def compare_ride(ride: RideSteps, noise: tuple[float, float, float]) -> tuple[float, float]:
    """Return the largest differences of the smoothed means and covariances of a ride, segment by segment."""
    predicted, updated = np.zeros((2, len(ride.fix)), ESTIMATE)
    begins = np.zeros(len(ride.fix), np.bool_)
    _filter(ride, noise, predicted, updated, begins)
    decided = find_decisions(ride, noise[0], predicted, updated, begins)
    _smooth(ride.distance, begins, predicted, updated)
    differences = []
    for begin, end in pairwise([*np.flatnonzero(begins).tolist(), len(begins)]):
        rows = slice(begin, end)
        exact = smooth_with_filterpy(RideSteps(*(column[rows] for column in ride)), noise, decided.select(rows))
        differences.append(measure_differences(*get_estimates(updated[rows]), *exact))
    return max(mean for mean, _ in differences), max(covariance for _, covariance in differences)


def get_estimates(rows: NDArray[np.void]) -> tuple[Floats, Floats]:
    """Return height and slope, (n, 2), and their covariances, (n, 2, 2), of rows of `ESTIMATE`."""
    variances = [rows[name] for name in ("var_height", "covariance", "covariance", "var_slope")]
    return np.stack([rows["height"], rows["slope"]], axis=-1), np.stack(variances, axis=-1).reshape(-1, 2, 2)


def find_decisions(ride: RideSteps, roughness: float, predicted: Any, updated: Any, begins: Any) -> Decisions:
    """Return what the compiled filter decided at the rows of a ride, by its estimates before and after each row."""
    is_used = updated["used"] > predicted["used"]
    fix = (updated["last_fix"] == ride.fix) & (updated["since_fix"] == 0.0) & (updated["time_since_fix"] == 0.0)
    ground = (updated["last_ground"] == ride.ground) & (updated["since_ground"] == 0.0)
    stays = (predicted["since_ground"] == 0.0) & ~np.isnan(predicted["last_ground"])
    share = np.exp(-2.0 * ride.distance / LENGTH)
    expected = share * np.roll(updated["var_slope"], 1) + 0.5 * roughness * LENGTH * (1.0 - share)
    is_forgotten = ~begins & (predicted["var_slope"] - expected > FORGOTTEN)
    distance = np.minimum(predicted["since_fix"], predicted["since_ground"])
    return Decisions(is_used & fix, is_used & ground & ~stays, np.where(is_forgotten, distance, np.nan))
