"""Elevation and climb of whole rides, estimated from the fixes on both sides of each sample.

A Kalman filter runs forward over the distance of a ride, and a Rauch-Tung-Striebel smoother runs back (AIAA J. 3 (1965)
1445, DOI 10.2514/3.3166). filterpy's filter and smoother are the reference in the tests; this compiled code serves
whole fleets.

The state has the height of the road and its slope. White noise drives the slope, which returns to level over `LENGTH`;
the density of the noise is the roughness of the terrain. A car that stands covers no distance: its state does not
change, and all its fixes measure one height. A bridged tunnel is one long step.

A fix is the height plus an error. The errors of two fixes that lie the time t apart have the correlation
r = exp(-t / T). The filter therefore measures z - r z', where z' is the fix before, because the error of that
difference is white (Bryson and Henrikson, J. Spacecraft 5 (1968) 662, DOI 10.2514/3.29327).

Each ride has the roughness, the standard deviation and the correlation time of greatest likelihood, under a prior that
matters for short rides only. Fixes that contradict the others are not used. Where several in succession do, there are
two cases. If a road could be so steep, its slope has changed, and becomes unknown there. Else the reference of the
fixes has changed, and a new segment begins. Segments are smoothed apart, and the change of reference between them is no
climb. A segment with fewer fixes than contradict it is none, and its fixes are not used.
"""

from functools import cache
from math import exp, isnan, log, nan
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.batch import Floats
from core.cleaning.kernel import Clean

LENGTH: Final = 300.0
"""Length over which the slope of a road returns to level. [m]

Chosen on simulated fleets: from 250 m to 1,000 km the error of the climb changes by 4 %, but a longer length loses
up to 3 % of the gained height.
"""
STEEP: Final = 0.05
"""Standard deviation of the slope before the first fix: most roads have less than 10 %. [1]"""
FAR: Final = 100.0
"""Standard deviation of the height before the first fix, about that fix. [m]"""
ROUNDING: Final = 0.3
"""Least standard deviation of a fix: that of a height in whole metres, 1 / sqrt(12). [m]"""
GATE: Final = 6.0
"""Largest difference between a fix and its prediction. [standard deviations]"""
MOST_REJECTED: Final = 3
"""Number of fixes in succession that may contradict the filter; one more, and it was wrong from the first of them on."""
STEEPEST: Final = 0.35
"""Largest slope of a street: that of Baldwin Street, Dunedin. [1]"""
SURE: Final = 3.0
"""Difference beyond the steepest slope from which the reference of fixes has changed. [standard deviations]"""

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
MOST_STEPS: Final = 8
"""Largest number of steps from the usual value on each grid."""
SWEEPS: Final = 3
"""Largest number of passes over the three parameters."""

SHORT: Final = 1e-3
"""Ratio of a step to `LENGTH` below which the noise of the step is that of doubly integrated white noise. [1]"""

ESTIMATE: Final = np.dtype([(name, "f8") for name in ("height", "slope", "var_height", "covariance", "var_slope")])
"""Estimate of height [m] and slope [1], with their covariance matrix."""


@cache
def design_unit_noise() -> Floats:
    """Return the process noise of a step of 1 m, by noise of unit density: (2, 2) float."""
    from filterpy.common import Q_continuous_white_noise  # noqa: PLC0415 - it loads scipy.stats, half a second

    return np.asarray(Q_continuous_white_noise(2, dt=1.0, spectral_density=1.0), np.float64)


def smooth_elevation(clean: Clean) -> Clean:
    """Return cleaned rows with the elevation and climb of rides estimated from both sides.

    Parameters
    ----------
    clean : Clean
        n rows, which hold whole rides.

    Returns
    -------
    Clean
        The rows with other `elevation` and `climb`; idle periods, and rides without a fix, keep theirs.
    """
    riding = np.flatnonzero(clean.ride >= 0)
    order = riding[np.argsort(clean.lane[riding], kind="stable")]
    lane, ride = clean.lane[order], clean.ride[order]
    begins = np.flatnonzero((np.diff(lane, prepend=-1) != 0) | (np.diff(ride, prepend=-1) != 0))
    elevation, climb = clean.elevation.copy(), clean.climb.copy()
    heights, climbs = elevation[order], climb[order]
    steps = np.stack([clean.distance[order], clean.dt[order], clean.elevation_fix[order]])
    smooth_rides(steps, np.append(begins, len(order)), design_unit_noise(), heights, climbs)
    elevation[order], climb[order] = heights, climbs
    return clean._replace(elevation=elevation, climb=climb)


def smooth_ride(distance: Floats, time: Floats, fix: Floats, noise: tuple[float, float, float]) -> NDArray[np.void]:
    """Return the smoothed estimate at each row of a ride.

    Parameters
    ----------
    distance, time : (n,) float
        Distance [m] and duration [s] of the step to each row.
    fix : (n,) float
        Elevation, NaN where there is no new fix. [m]
    noise : (roughness, sd, correlation_time)
        Roughness of the terrain [1/m]; standard deviation [m] and correlation time [s] of the error of a fix.

    Returns
    -------
    (n,) of `ESTIMATE`
    """
    predicted, updated = np.zeros((2, len(fix)), ESTIMATE)
    begins = np.zeros(len(fix), np.bool_)
    filter_ride(distance, time, fix, noise, design_unit_noise(), predicted, updated, begins)
    smooth_back(distance, begins, predicted, updated)
    return updated


@njit(cache=True)
def smooth_rides(steps: Any, edges: Any, unit: Any, heights: Any, climbs: Any) -> None:
    """Replace heights and climbs of all rides with a fix by their smoothed values.

    Parameters
    ----------
    steps : (3, n) float
        Distance [m] and duration [s] of the step to each row, and the elevation of its fix [m].
    edges : (rides + 1,) int
        First row of each ride, and the number of rows.
    unit : (2, 2) float
        Process noise of a step of 1 m, see `design_unit_noise`.
    heights, climbs : (n,) float
        Changed in place. [m]
    """
    for i in range(len(edges) - 1):
        begin, end = edges[i], edges[i + 1]
        distance, time, fix = steps[0, begin:end], steps[1, begin:end], steps[2, begin:end]
        if np.isnan(fix).all():
            continue
        noise = find_noise(distance, time, fix, unit)
        predicted, updated = np.zeros(end - begin, ESTIMATE), np.zeros(end - begin, ESTIMATE)
        begins = np.zeros(end - begin, np.bool_)
        filter_ride(distance, time, fix, noise, unit, predicted, updated, begins)
        smooth_back(distance, begins, predicted, updated)
        for j in range(end - begin):
            heights[begin + j] = updated[j].height
            if begins[j]:  # the step before it is not estimated; the slope of the road returns to level both ways
                climbs[begin + j] = describe_step(distance[j])[0] * updated[j].slope
            else:
                climbs[begin + j] = updated[j].height - updated[j - 1].height


@njit(cache=True)
def find_noise(distance: Any, time: Any, fix: Any, unit: Any) -> tuple[float, float, float]:
    """Return roughness, standard deviation and correlation time of the greatest likelihood times prior.

    The search follows one parameter after the other, in steps from the usual values.
    """
    nowhere, begins = np.zeros(0, ESTIMATE), np.zeros(0, np.bool_)
    sd = find_difference(fix)
    place = np.zeros(3)
    best = compute_prior_cost(place)
    best += filter_ride(distance, time, fix, make_noise(place, sd), unit, nowhere, nowhere, begins)
    for _ in range(SWEEPS):
        before = best
        for axis in range(3):
            for direction in (-1.0, 1.0):
                while abs(place[axis]) < MOST_STEPS:
                    place[axis] += direction
                    cost = compute_prior_cost(place)
                    cost += filter_ride(distance, time, fix, make_noise(place, sd), unit, nowhere, nowhere, begins)
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


@njit(cache=True)
def filter_ride(
    distance: Any,
    time: Any,
    fix: Any,
    noise: tuple[float, float, float],
    unit: Any,
    predicted: Any,
    updated: Any,
    begins: Any,
) -> float:
    """Run the filter over a ride; return minus twice the logarithm of the likelihood, but for a constant.

    Parameters
    ----------
    distance, time : (n,) float
        Distance [m] and duration [s] of the step to each row.
    fix : (n,) float
        Elevation, NaN where there is no new fix. [m]
    noise : (roughness, sd, correlation_time)
        See `smooth_ride`.
    unit : (2, 2) float
        See `design_unit_noise`.
    predicted, updated : (n,) or (0,) of `ESTIMATE`
        Filled with the estimate before and after the fix of each row; where empty, only the likelihood is computed.
    begins : (n,) or (0,) bool
        Filled with whether a segment begins at each row.

    Notes
    -----
    A fix that is not used costs as much as one at the gate, so that no noise gains by rejecting fixes or by beginning
    segments.
    """
    roughness, sd, correlation_time = noise
    now = np.zeros(1, ESTIMATE)[0]
    last, since_distance, since_time = nan, 0.0, 0.0
    used, rejected, first_rejected, changed, cost = 0, 0, 0, False, 0.0
    begin = wrong_before = i = 0
    while i < distance.shape[0]:
        if i == begin:
            begin_segment(now)
            last, used, rejected = nan, 0, 0
        elif distance[i] > 0.0:
            predict(now, distance[i], roughness, unit)
        since_distance += distance[i]
        since_time += time[i]
        if predicted.shape[0] > 0:
            predicted[i], begins[i] = now, i == begin
        if i >= wrong_before and not isnan(fix[i]):
            if isnan(last):
                now.height = fix[i]
            related = exp(-since_time / correlation_time) if since_time > 0.0 and not isnan(last) else 0.0
            value = fix[i] - related * last if related > 0.0 else fix[i]
            variance = sd * sd * (1.0 - related * related)
            misfit, total = compare(now, value, 1.0 - related, related * since_distance, variance)
            cost += min(misfit, GATE * GATE) + log(total)
            if misfit > GATE * GATE:
                if rejected == 0:
                    first_rejected = i
                    changed = abs(fix[i] - now.height) > STEEPEST * since_distance + SURE * sd
                rejected += 1
                if rejected > MOST_REJECTED and changed:
                    wrong_before = first_rejected
                    if used > MOST_REJECTED:
                        begin = first_rejected
                    i = begin
                    continue
                if rejected > MOST_REJECTED:
                    forget_slope(now, since_distance)
                    if predicted.shape[0] > 0:
                        predicted[i] = now
                    rejected = 0
            else:
                rejected = 0
            if rejected == 0:
                update(now, value, 1.0 - related, related * since_distance, variance)
                last, since_distance, since_time, used = fix[i], 0.0, 0.0, used + 1
        if updated.shape[0] > 0:
            updated[i] = now
        i += 1
    return cost


@njit(cache=True)
def begin_segment(now: Any) -> None:
    """Forget all that is known of the road, before the first fix of a segment."""
    now.height = now.slope = now.covariance = 0.0
    now.var_height, now.var_slope = FAR * FAR, STEEP * STEEP


@njit(cache=True)
def forget_slope(now: Any, distance: float) -> None:
    """Let the slope be unknown, over a distance back from the present place. [m]"""
    now.var_height += STEEP * STEEP * distance * distance
    now.covariance += STEEP * STEEP * distance
    now.var_slope += STEEP * STEEP


@njit(cache=True)
def describe_step(distance: float) -> tuple[float, float]:
    """Return the height that a step gains per unit of slope [m], and the share of the slope that remains [1]."""
    keep = exp(-distance / LENGTH)
    return LENGTH * (1.0 - keep), keep


@njit(cache=True)
def predict(now: Any, distance: float, roughness: float, unit: Any) -> None:
    """Advance an estimate by a step of the given distance. [m]"""
    run, keep = describe_step(distance)
    now.height += run * now.slope
    now.slope *= keep
    now.var_height += 2.0 * run * now.covariance + run * run * now.var_slope
    now.covariance = keep * (now.covariance + run * now.var_slope)
    now.var_slope *= keep * keep
    ratio = distance / LENGTH
    if ratio < SHORT:
        now.var_height += roughness * unit[0, 0] * distance**3
        now.covariance += roughness * unit[0, 1] * distance**2
        now.var_slope += roughness * unit[1, 1] * distance
    else:
        variance = 0.5 * roughness * LENGTH
        now.var_height += variance * LENGTH**2 * (2.0 * ratio - 3.0 + 4.0 * keep - keep * keep)
        now.covariance += variance * LENGTH * (1.0 - keep) ** 2
        now.var_slope += variance * (1.0 - keep * keep)


@njit(cache=True)
def compare(now: Any, value: float, of_height: float, of_slope: float, variance: float) -> tuple[float, float]:
    """Return the squared normalised difference of a measurement and its prediction, and the variance of that."""
    total = of_height * of_height * now.var_height + 2.0 * of_height * of_slope * now.covariance
    total += of_slope * of_slope * now.var_slope + variance
    difference = value - of_height * now.height - of_slope * now.slope
    return difference * difference / total, total


@njit(cache=True)
def update(now: Any, value: float, of_height: float, of_slope: float, variance: float) -> None:
    """Update an estimate by a measurement of `of_height` times the height plus `of_slope` times the slope."""
    with_height = of_height * now.var_height + of_slope * now.covariance
    with_slope = of_height * now.covariance + of_slope * now.var_slope
    total = of_height * with_height + of_slope * with_slope + variance
    difference = value - of_height * now.height - of_slope * now.slope
    now.height += with_height / total * difference
    now.slope += with_slope / total * difference
    now.var_height -= with_height * with_height / total
    now.covariance -= with_height * with_slope / total
    now.var_slope -= with_slope * with_slope / total


@njit(cache=True)
def smooth_back(distance: Any, begins: Any, predicted: Any, updated: Any) -> None:
    """Replace the estimates after each fix by those from all fixes of its segment.

    Over a stand the state does not change, so that its rows have the estimate of the row after it.
    """
    for i in range(distance.shape[0] - 2, -1, -1):
        if begins[i + 1]:
            continue
        after, ahead, now = updated[i + 1], predicted[i + 1], updated[i]
        if distance[i + 1] <= 0.0:
            updated[i] = after
            continue
        run, keep = describe_step(distance[i + 1])
        with_height, with_slope = now.var_height + run * now.covariance, now.covariance + run * now.var_slope
        determinant = ahead.var_height * ahead.var_slope - ahead.covariance * ahead.covariance
        gain_hh = (with_height * ahead.var_slope - keep * now.covariance * ahead.covariance) / determinant
        gain_hs = (keep * now.covariance * ahead.var_height - with_height * ahead.covariance) / determinant
        gain_sh = (with_slope * ahead.var_slope - keep * now.var_slope * ahead.covariance) / determinant
        gain_ss = (keep * now.var_slope * ahead.var_height - with_slope * ahead.covariance) / determinant
        height, slope = after.height - ahead.height, after.slope - ahead.slope
        hh, hs = after.var_height - ahead.var_height, after.covariance - ahead.covariance
        ss = after.var_slope - ahead.var_slope
        now.height += gain_hh * height + gain_hs * slope
        now.slope += gain_sh * height + gain_ss * slope
        now.var_height += gain_hh * (gain_hh * hh + gain_hs * hs) + gain_hs * (gain_hh * hs + gain_hs * ss)
        now.covariance += gain_sh * (gain_hh * hh + gain_hs * hs) + gain_ss * (gain_hh * hs + gain_hs * ss)
        now.var_slope += gain_sh * (gain_sh * hh + gain_ss * hs) + gain_ss * (gain_sh * hs + gain_ss * ss)
