"""The smoother of the elevation by filterpy, the witness of `socast.core.cleaning.elevation_filter`."""

from functools import lru_cache
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.cleaning.elevation_filter import FAR, GROUND_LENGTH, LENGTH, STEEP, RideSteps


class Decisions(NamedTuple):
    """Say what the filter decided at each row of a segment.

    Parameters
    ----------
    fix, ground : (n,) bool
        Whether the fix and the reading of the map are used.
    forgotten : (n,) float
        Distance back over which the slope is unknown, NaN where it is not. [m]
    """

    fix: NDArray[np.bool_]
    ground: NDArray[np.bool_]
    forgotten: Floats

    def select(self, rows: slice) -> "Decisions":
        """Return the decisions at some rows."""
        return Decisions(self.fix[rows], self.ground[rows], self.forgotten[rows])


class LastReading:
    """Remember the last reading of a kind, and what the car has done since it."""

    def __init__(self) -> None:
        self.value, self.distance, self.time = np.nan, 0.0, 0.0

    def move(self, distance: float, time: float) -> None:
        """Count a step. [m, s]"""
        self.distance += distance
        self.time += time

    def take(self, kalman: Any, value: float, related: float, variance: float) -> None:
        """Update a filter by a reading whose error is related to that of the last one. [m^2]"""
        offset = related * self.value if related > 0.0 else 0.0
        seen = np.array([[1.0 - related, related * self.distance]])
        kalman.update(value - offset, variance * (1.0 - related**2), seen)
        self.value, self.distance, self.time = value, 0.0, 0.0


def smooth_with_filterpy(
    steps: RideSteps, noise: tuple[float, float, float], decided: Decisions | None = None
) -> tuple[Floats, Floats]:
    """Return the smoothed height and slope, (n, 2), and their covariances, (n, 2, 2), of one segment of a ride.

    Without `decided`, every fix is used and no map.
    """
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415 - its import takes a second

    roughness, sd, correlation_time = noise
    if decided is None:
        is_fix = ~np.isnan(steps.fix)
        decided = Decisions(is_fix, np.zeros_like(is_fix), np.full(len(is_fix), np.nan))
    stand = np.eye(2), np.zeros((2, 2))
    moves = [
        discretise(step, roughness) if i and step > 0.0 else stand for i, step in enumerate(steps.distance.tolist())
    ]
    for i in np.flatnonzero(~np.isnan(decided.forgotten)).tolist():
        moves[i] = moves[i][0], moves[i][1] + describe_unknown_slope(decided.forgotten[i])
    kalman = KalmanFilter(dim_x=2, dim_z=1)
    kalman.x = np.array([[_find_first(steps, decided)], [0.0]])
    kalman.P = np.diag([FAR**2, STEEP**2])
    fix, ground = LastReading(), LastReading()
    means, covariances = [], []
    for i, (transition, blur) in enumerate(moves):
        if i:
            kalman.predict(F=transition, Q=blur)
        for last in (fix, ground):
            last.move(steps.distance[i], steps.time[i])
        if decided.ground[i]:
            related = 0.0 if np.isnan(ground.value) else np.exp(-ground.distance / GROUND_LENGTH)
            ground.take(kalman, steps.ground[i], related, steps.ground_variance[i])
        if decided.fix[i]:
            is_near = not np.isnan(fix.value) and fix.time > 0.0 and fix.distance <= LENGTH
            fix.take(kalman, steps.fix[i], np.exp(-fix.time / correlation_time) if is_near else 0.0, sd**2)
        means.append(kalman.x.copy())
        covariances.append(kalman.P.copy())
    smoothed = kalman.rts_smoother(np.array(means), np.array(covariances), *map(list, zip(*moves, strict=True)))
    return smoothed[0][:, :, 0], smoothed[1]


@lru_cache(4096)
def discretise(distance: float, roughness: float) -> tuple[Floats, Floats]:
    """Return the transition matrix of a step [m], and its process noise, by the method of Van Loan.

    A long step is made of parts of at most `LENGTH`, because the method loses a digit for every 2.3 `LENGTH`.
    """
    from filterpy.common import van_loan_discretization  # noqa: PLC0415 - its import takes a second

    road, force = np.array([[0.0, 1.0], [0.0, -1.0 / LENGTH]]), np.array([[0.0], [np.sqrt(roughness)]])
    parts = ceil(distance / LENGTH)
    of_part, blur = van_loan_discretization(road, force, distance / parts)
    transition, noise = np.eye(2), np.zeros((2, 2))
    for _ in range(parts):
        transition, noise = of_part @ transition, of_part @ noise @ of_part.T + blur
    return transition, noise


def describe_unknown_slope(distance: float) -> Floats:
    """Return the covariance of height and slope that an unknown slope adds, over a distance back. [m]"""
    height_and_slope = np.exp(-distance / LENGTH) * distance
    return STEEP**2 * np.array([[distance**2, height_and_slope], [height_and_slope, 1.0]])


def _find_first(steps: RideSteps, decided: Decisions) -> float:
    """Return the first reading that is used, the map before the fix of the same row, and 0 without one. [m]"""
    rows = np.flatnonzero(decided.fix | decided.ground)
    if not len(rows):
        return 0.0
    return float(steps.ground[rows[0]] if decided.ground[rows[0]] else steps.fix[rows[0]])
