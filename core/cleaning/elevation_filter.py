"""Kalman filter and smoother of the elevation along one ride, compiled.

The filter runs forward over the distance of a ride, and a Rauch-Tung-Striebel smoother runs back (AIAA J. 3 (1965)
1445, DOI 10.2514/3.3166). filterpy's filter and smoother are the reference in the tests and in `socast verify`; this
compiled code serves whole fleets.

The state has the height of the road and its slope. White noise drives the slope, which returns to level over `LENGTH`;
the density of the noise is the roughness of the terrain. A car that stands covers no distance: its state does not
change, and all its fixes measure one height. A bridged tunnel is one long step.

A fix is the height plus an error. The errors of two fixes that lie the time t apart have the correlation
r = exp(-t / T). The filter therefore measures z - r z', where z' is the fix before, because the error of that
difference is white (Bryson and Henrikson, J. Spacecraft 5 (1968) 662, DOI 10.2514/3.29327). The slope between both must
be that of now, so that fixes more than `LENGTH` apart count as unrelated.

Where a map knows the ground, its elevation is a second reading, with the variance that the map states. Its error is
correlated over the distance `GROUND_LENGTH` in the same way, so that many fixes over one node of a coarse map count as
one reading of that node.

Readings that contradict the others are not used. Where several in succession do, there are two cases. If a road could
be so steep, or a map knows the ground, the slope has changed, and becomes unknown there. Else the reference of the
fixes has changed, and a new segment begins. Segments are smoothed apart, and the change of reference between them is no
climb. A segment with fewer fixes than contradict it is none, and its fixes are not used.
"""

from math import exp, expm1, inf, isnan, log, nan
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.cleaning.elevation import STEEPEST
from socast.core.compiled_cache import njit

LENGTH: Final = 300.0
"""Length over which the slope of a road returns to level. [m]

Chosen on simulated fleets: from 250 m to 1,000 km the error of the climb changes by 4 %, but a longer length loses
up to 3 % of the gained height.
"""
STEEP: Final = 0.05
"""Standard deviation of the slope before the first fix: most roads have less than 10 %. [1]"""
FAR: Final = 100.0
"""Standard deviation of the height before the first fix, about that fix. [m]"""
GATE: Final = 6.0
"""Largest difference between a fix and its prediction. [standard deviations]"""
MOST_REJECTED: Final = 3
"""Number of fixes in succession that may contradict the filter; one more, and it was wrong since the first."""
SURE: Final = 3.0
"""Difference beyond the steepest slope from which the reference of fixes has changed. [standard deviations]"""
GROUND_LENGTH: Final = 90.0
"""Distance over which the errors of a map lose correlation: that of nodes 3 arc seconds apart. [m]"""
MOVED: Final = 1.0
"""Distance below which the map says nothing new. [m]"""

ESTIMATE: Final = np.dtype(
    [
        *((name, "f8") for name in ("height", "slope", "var_height", "covariance", "var_slope")),
        *((name, "f8") for name in ("last_fix", "since_fix", "time_since_fix", "last_ground", "since_ground")),
        ("used", "f8"),  # rows of the segment with a reading that was used
    ]
)
"""Estimate of height [m] and slope [1], with their covariance matrix, and the last readings that were used [m]."""
UNUSED: Final = -1
NOTHING: Final = 0
USED: Final = 1
"""What became of the readings of a row."""


class RideSteps(NamedTuple):
    """Hold what the filter takes of a ride, n rows.

    Parameters
    ----------
    distance, time : (n,) float
        Distance [m] and duration [s] of the step to each row.
    fix : (n,) float
        Elevation, NaN where there is no new fix. [m]
    ground, ground_variance : (n,) float
        Elevation of the map [m], NaN where it is unknown, and variance of its error [m^2].
    """

    distance: Floats
    time: Floats
    fix: Floats
    ground: Floats
    ground_variance: Floats


@njit(cache=False)
def filter_ride(ride: Any, noise: tuple[float, float, float], predicted: Any, updated: Any, begins: Any) -> float:
    """Run the filter over a ride; return minus twice the logarithm of the likelihood, but for a constant.

    Parameters
    ----------
    predicted, updated : (n,) or (0,) of `ESTIMATE`
        Filled with the estimate before and after the fix of each row; where empty, only the likelihood is computed.

    Notes
    -----
    A reading that is not used costs as much as one at the gate, so that no noise gains by rejecting fixes or by
    beginning segments. On a map no segment begins.
    """
    estimates = np.zeros(2, ESTIMATE)
    now, saved = estimates[0], estimates[1]
    rejected, first_rejected, changed, cost = 0, 0, False, 0.0
    begin = wrong_before = i = 0
    while i < ride.distance.shape[0]:
        if i == begin:
            begin_segment(now)
            rejected = 0
        elif ride.distance[i] > 0.0:
            predict(now, ride.distance[i], noise[0])
        now.since_fix += ride.distance[i]
        now.since_ground += ride.distance[i]
        now.time_since_fix += ride.time[i]
        fix = ride.fix[i] if i >= wrong_before else nan
        if isnan(now.last_fix) and isnan(now.last_ground) and not (isnan(fix) and isnan(ride.ground[i])):
            now.height = fix if isnan(ride.ground[i]) else ride.ground[i]
            store_height(now.height, begin, i, predicted, updated)
        store(predicted, i, now)
        store(begins, i, i == begin)
        loss, outcome = take_row(now, fix, ride, i, noise, GATE)
        cost += loss
        if outcome == USED:
            rejected = 0
        elif outcome == UNUSED:
            if rejected == 0:
                estimates[1], first_rejected = now, i
                changed = isnan(ride.ground[i]) and is_beyond_road(now, ride.fix[i], noise[1])
            rejected += 1
            if rejected > MOST_REJECTED and changed and isnan(ride.ground[i]):  # the reference of the fixes
                wrong_before = first_rejected
                begin = i = first_rejected if now.used > MOST_REJECTED else begin
                continue
            if rejected > MOST_REJECTED:  # the slope
                i, estimates[0], rejected = first_rejected, saved, 0
                forget_slope(now, min(now.since_fix, now.since_ground))
                store(predicted, i, now)
                forget_stand(ride, i, now, predicted, updated)
                take_row(now, ride.fix[i], ride, i, noise, inf)
        store(updated, i, now)
        i += 1
    return cost


@njit(cache=False)
def forget_stand(ride: Any, i: int, now: Any, predicted: Any, updated: Any) -> None:
    """Store an estimate whose slope was forgotten at row `i` back to the step that led to where the car stands."""
    while i > 0 and ride.distance[i] <= 0.0 and now.since_fix > 0.0:
        i -= 1
        store(predicted, i, now)
        store(updated, i, now)


@njit(cache=False)
def store_height(height: float, begin: int, end: int, predicted: Any, updated: Any) -> None:
    """Let the rows of a segment before its first reading have the height of that reading. [m]"""
    if predicted.shape[0] > 0:
        for i in range(begin, end):
            predicted[i].height = updated[i].height = height


@njit(cache=False)
def store(column: Any, i: int, value: Any) -> None:
    """Set a row of a column, which may be empty."""
    if column.shape[0] > 0:
        column[i] = value


@njit(cache=False)
def take_row(
    now: Any, fix: float, ride: Any, i: int, noise: tuple[float, float, float], gate: float
) -> tuple[float, int]:
    """Update an estimate by the map and the fix of row `i`; return the cost of both and what became of them.

    A fix that contradicts counts as nothing where the map knows the ground.
    """
    _, sd, correlation_time = noise
    ground, cost, outcome = ride.ground[i], 0.0, NOTHING
    if not isnan(ground) and (isnan(now.last_ground) or now.since_ground >= MOVED):
        related = 0.0 if isnan(now.last_ground) else exp(-now.since_ground / GROUND_LENGTH)
        variance = ride.ground_variance[i]
        cost, used = take_reading(now, ground, now.last_ground, related, now.since_ground, variance, gate)
        outcome = USED if used else UNUSED
        if used:
            now.last_ground, now.since_ground = ground, 0.0
    if not isnan(fix):
        related = 0.0
        if now.time_since_fix > 0.0 and now.since_fix <= LENGTH and not isnan(now.last_fix):
            related = exp(-now.time_since_fix / correlation_time)
        loss, used = take_reading(now, fix, now.last_fix, related, now.since_fix, sd * sd, gate)
        cost += loss
        if used:
            now.last_fix, now.since_fix, now.time_since_fix, outcome = fix, 0.0, 0.0, USED
        elif isnan(ground):
            outcome = UNUSED
    if outcome == USED:
        now.used += 1.0
    return cost, outcome


@njit(cache=False)
def is_beyond_road(now: Any, fix: float, sd: float) -> bool:
    """Return whether no road from the last fix could be so steep as to reach a fix with an error of `sd` [m]."""
    return abs(fix - now.height) > STEEPEST * now.since_fix + SURE * sd


@njit(cache=False)
def take_reading(
    now: Any, reading: float, last: float, related: float, distance: float, variance: float, gate: float
) -> tuple[float, bool]:
    """Update an estimate by a reading of the height, unless they contradict each other.

    Units: variance [m^2], gate [standard deviations].
    """
    value = reading - related * last if related > 0.0 else reading
    variance *= 1.0 - related * related
    misfit, total = compare(now, value, 1.0 - related, related * distance, variance)
    if misfit > gate * gate:
        return gate * gate + log(total), False
    update(now, value, 1.0 - related, related * distance, variance)
    return misfit + log(total), True


@njit(cache=False)
def begin_segment(now: Any) -> None:
    """Forget all that is known of the road, before the first fix of a segment."""
    now.height = now.slope = now.covariance = 0.0
    now.var_height, now.var_slope = FAR * FAR, STEEP * STEEP
    now.last_fix = now.last_ground = nan
    now.since_fix = now.time_since_fix = now.since_ground = now.used = 0.0


@njit(cache=False)
def forget_slope(now: Any, distance: float) -> None:
    """Let the slope be unknown, over a distance back from the present place. [m]

    Over a tunnel that is longer than slopes last, the slope at its end says nothing of the height gained in it.
    """
    now.var_height += STEEP * STEEP * distance * distance
    now.covariance += exp(-distance / LENGTH) * STEEP * STEEP * distance
    now.var_slope += STEEP * STEEP


@njit(cache=False)
def describe_step(distance: float) -> tuple[float, float]:
    """Return the height that a step gains per unit of slope [m], and the share of the slope that remains [1]."""
    lost = -expm1(-distance / LENGTH)
    return LENGTH * lost, 1.0 - lost


@njit(cache=False)
def predict(now: Any, distance: float, roughness: float) -> None:
    """Advance an estimate by a step of the given distance. [m]"""
    run, keep = describe_step(distance)
    now.height += run * now.slope
    now.slope *= keep
    now.var_height += 2.0 * run * now.covariance + run * run * now.var_slope
    now.covariance = keep * (now.covariance + run * now.var_slope)
    now.var_slope *= keep * keep
    ratio, lost, variance = distance / LENGTH, run / LENGTH, 0.5 * roughness * LENGTH
    now.var_height += variance * LENGTH**2 * (2.0 * (ratio - lost) - lost * lost)
    now.covariance += variance * LENGTH * lost * lost
    now.var_slope += variance * lost * (2.0 - lost)


@njit(cache=False)
def compare(now: Any, value: float, of_height: float, of_slope: float, variance: float) -> tuple[float, float]:
    """Return the squared normalised difference of a measurement and its prediction, and the variance of that."""
    total = of_height * of_height * now.var_height + 2.0 * of_height * of_slope * now.covariance
    total += of_slope * of_slope * now.var_slope + variance
    difference = value - of_height * now.height - of_slope * now.slope
    return difference * difference / total, total


@njit(cache=False)
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


@njit(cache=False)
def smooth_back(distance: Any, begins: Any, predicted: Any, updated: Any) -> None:
    """Replace the estimates after each fix by those from all fixes of its segment.

    Over a stand the state does not change, so that its rows have the estimate of the row after it, unless the slope was
    forgotten there.
    """
    for i in range(distance.shape[0] - 2, -1, -1):
        if begins[i + 1]:
            continue
        after, ahead, now = updated[i + 1], predicted[i + 1], updated[i]
        if distance[i + 1] <= 0.0 and ahead.var_slope == now.var_slope:
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
