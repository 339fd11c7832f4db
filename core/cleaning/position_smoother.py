"""Speed, distance and heading of whole rides of cars that never send a speed, from the fixes on both sides of a sample.

filterpy's Kalman filter runs over the fixes of a ride, and its Rauch-Tung-Striebel smoother runs back (AIAA J. 3 (1965)
1445, DOI 10.2514/3.3166). The matrices are those of the compiled filter in `socast.core.cleaning.position_filter`,
which also states the noise of each fix, and where the car stands: there a velocity of zero is measured as well. The
smoothed path between two rows is the cubic curve through their positions with their velocities, and its length is the
distance. Between fixes that are far apart in time, curves are longer than roads, so that it is the chord. Speed and
acceleration follow from the path, so that distance, speed and kinetic energy agree.

A hole without fixes is bridged in the same way, and marked. Fixes that no car can have connected, as after a leap,
divide a ride into parts; what lies between them keeps its causal motion. The odometer is a witness: where a ride has
many of its steps, the distances are scaled so that their sum is within one step. A ride whose sum is far from the
causal one keeps the causal motion.

filterpy is imported when the first ride of such a car is smoothed, because its import takes two seconds.
"""

from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.cleaning import motion
from socast.core.cleaning.clean_columns import Clean
from socast.core.cleaning.elevation_smoother import LONGEST_PIECE, number_rows
from socast.core.cleaning.position_filter import (
    FIRST_SPEED,
    GATE,
    LEAST_NOISE,
    LEAST_SCATTER,
    SPARSE,
    STILL_SPEED,
    find_acceleration_variance,
)
from socast.core.cleaning.quality import Quality
from socast.core.columns import EARTH_RADIUS

FASTEST: Final = 85.0
"""Speed beyond which two fixes belong to two parts: more than the highest speed limit that may be set. [m/s]"""
LONGEST_CURVE: Final = 6.0
"""Longest step on which the path is a curve; on a longer one it is straight, since speeds do not last so long. [s]"""
SURGE: Final = 1.2
"""Largest ratio of the speed at the end of such a straight step to the mean speeds on both sides. [1]"""
TRAIL: Final = 5.0
"""Time after the last fix for which the car goes on as it did. [s]"""
HOLE: Final = 12.0
"""Least time between two fixes that is a hole in a quick sequence of fixes, and over which the path is straight. [s]"""
HOLE_STEPS: Final = 3.5
"""The same in median times between fixes."""
OFF: Final = 1.0
"""Distance from the place of a stop beyond which a fix at its end belongs to the drive. [standard deviations]"""
HOLDS: Final = 1.5
"""Ratio of the time between new fixes to that between rows from which the receiver holds its fixes. [1]"""
PASSES: Final = 2
"""Number of times that the place and the ends of a stop are found."""
MOST_CHANGE: Final = 0.25
"""Largest change of the distance of a ride; beyond it something is wrong with the fixes. [1]"""
LEAST_CHANGE: Final = 200.0
"""Change of the distance that is accepted in any ride. [m]"""
MANY_STEPS: Final = 20.0
"""Number of its steps from which an odometer measures a ride."""
TURNING: Final = 1.0
"""Least speed at which the path has a direction. [m/s]"""
OF_FIX: Final = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
"""Measurement of the state (north, its rate, east, its rate) by a fix."""
OF_REST: Final = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Measurement by standstill."""


def smooth_motion(clean: Clean, longest: int = LONGEST_PIECE) -> Clean:
    """Return cleaned rows with the motion of rides of cars without a speed estimated from both sides.

    Parameters
    ----------
    longest : int
        Number of rows of a piece; a ride with more rows is smoothed piece by piece. [rows]

    Returns
    -------
    Clean
        The rows with other columns of motion where `fix_sd` is known; all other rows as they were.
    """
    rows = np.flatnonzero((clean.ride >= 0) & ~np.isnan(clean.fix_sd))
    if len(rows) == 0:
        return clean
    columns = {name: getattr(clean, name).copy() for name in CHANGED}
    clean = clean._replace(**columns)
    order = rows[np.lexsort((rows, clean.ride[rows], clean.lane[rows]))]
    is_first = (np.diff(clean.lane[order], prepend=-1) != 0) | (np.diff(clean.ride[order], prepend=-1) != 0)
    is_first |= number_rows(np.cumsum(is_first)) % longest == 0
    for ride in np.split(order, np.flatnonzero(is_first)[1:]):
        _smooth_ride(clean, ride)
    return clean


CHANGED: Final = (
    *("quality", "travel", "distance", "speed", "acceleration", "acceleration_spread", "wide_speed"),
    *("wide_acceleration", "heading", "turn_rate", "stop", "stopped"),
)
"""Columns of `Clean` that are replaced."""


def _smooth_ride(clean: Clean, ride: Ints) -> None:
    """Replace the motion in the rows of one ride."""
    dt = clean.dt[ride]
    north, east = _find_places(clean.latitude[ride], clean.longitude[ride])
    is_new = np.r_[True, (np.diff(north) != 0.0) | (np.diff(east) != 0.0)]
    time = np.cumsum(dt)
    is_lost, is_fix = _find_losses(time, north, east, is_new)
    still = _find_stands(clean, ride, north, east) & ~is_lost
    path = np.full((len(ride), 4), np.nan)
    fixes = np.flatnonzero(is_new)
    way = np.hypot(np.diff(north[fixes]), np.diff(east[fixes]))
    leaps = np.flatnonzero(way > FASTEST * np.diff(time[fixes]) + motion.SLACK)
    begins = fixes[np.r_[0, leaps + 1]]
    measured = np.flatnonzero(is_fix | still)
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(ride)], strict=True):
        latest = measured[measured < end][-1]
        span = slice(begin, min(end, int(np.searchsorted(time, time[latest] + TRAIL, side="right"))))
        noise = np.maximum(clean.fix_sd[ride][span], LEAST_NOISE)
        path[span] = smooth_path(dt[span], north[span], east[span], noise, is_fix[span], still[span])
    _fill_motion(clean, ride, time, path, still, is_fix)


def _find_places(latitude: Floats, longitude: Floats) -> tuple[Floats, Floats]:
    """Return places in metres north and east of the first one."""
    east = (longitude - longitude[0] + np.pi) % (2.0 * np.pi) - np.pi
    middle = 0.5 * (latitude + latitude[0])
    return EARTH_RADIUS * (latitude - latitude[0]), EARTH_RADIUS * np.cos(middle) * east


def _find_losses(
    time: Floats, north: Floats, east: Floats, is_new: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the rows without reception, and the rows whose fix is a measurement.

    A fix that stays the same until one follows that no car can have reached from rest is none. Otherwise it shows that
    the car stands, unless the receiver holds its fixes for several rows.
    """
    fixes = np.append(np.flatnonzero(is_new), len(time))
    is_lost = np.zeros(len(time), np.bool_)
    for begin, end in zip(fixes[:-1].tolist(), fixes[1:].tolist(), strict=True):
        if begin + 1 < end < len(time):
            lag = time[end] - time[end - 1]
            way = np.hypot(north[end] - north[end - 1], east[end] - east[end - 1])
            is_lost[begin + 1 : end] = way > 0.5 * motion.HARDEST * lag * lag + motion.SLACK
    steps = np.diff(time)
    holds = len(fixes) > 2 and np.median(np.diff(time[fixes[:-1]])) > HOLDS * np.median(steps[steps > 0.0])
    return is_lost, is_new if holds else ~is_lost


def _find_stands(clean: Clean, ride: Ints, north: Floats, east: Floats) -> NDArray[np.bool_]:
    """Return where the car stands.

    The causal filter notes the ends of a stop late: fixes at its ends that lie beyond the scatter belong to the drive.
    """
    stopped = clean.stopped[ride] == 1.0
    still = np.zeros(len(ride), np.bool_)
    edges = np.flatnonzero(np.diff(np.r_[False, stopped, False].astype(np.int8)))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        first, last = begin, end
        for _ in range(PASSES):
            inside = slice(first, last)
            off = np.hypot(north - np.median(north[inside]), east - np.median(east[inside]))
            scatter = max(LEAST_SCATTER, float(np.median(clean.fix_sd[ride[inside]])), float(np.median(off[inside])))
            near = begin + np.flatnonzero(off[begin:end] <= OFF * scatter)
            first, last = int(near[0]), int(near[-1]) + 1
        still[first:last] = True
    return still


def smooth_path(
    dt: Floats,
    north: Floats,
    east: Floats,
    noise: Floats,
    is_new: NDArray[np.bool_],
    still: NDArray[np.bool_],
) -> Floats:
    """Return position and velocity at the rows of a path, smoothed from both sides."""
    kalman, noise_of_rest = make_filter(north[0], east[0], noise[0]), STILL_SPEED**2 * np.eye(2)
    steps = [describe_motion(step) for step in dt.tolist()]
    means, covariances = np.empty((len(dt), 4)), np.empty((len(dt), 4, 4))
    for i, (transition, process) in enumerate(steps):
        if i > 0:
            kalman.predict(F=transition, Q=process)
        if is_new[i] and i > 0:
            take_fix_softly(kalman, np.array([north[i], east[i]]), noise[i] ** 2)
        if still[i]:
            kalman.update(np.zeros(2), R=noise_of_rest, H=OF_REST)
        means[i], covariances[i] = kalman.x, kalman.P
    smoothed: Floats = kalman.rts_smoother(means, covariances, *map(list, zip(*steps, strict=True)))[0]
    return smoothed


def make_filter(north: float, east: float, noise: float) -> Any:
    """Return filterpy's filter at a first fix with that standard deviation on each axis. [m]"""
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415 - its import takes two seconds

    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.x = np.array([north, 0.0, east, 0.0])
    kalman.P = np.diag([noise**2, FIRST_SPEED**2] * 2)
    return kalman


@lru_cache(maxsize=1000)
def describe_motion(dt: float) -> tuple[Floats, Floats]:
    """Return the transition and the process noise of a step. [s]"""
    from filterpy.common import Q_discrete_white_noise  # noqa: PLC0415 - as above

    if dt <= 0.0:
        return np.eye(4), np.zeros((4, 4))
    transition = np.kron(np.eye(2), np.array([[1.0, dt], [0.0, 1.0]]))
    return transition, Q_discrete_white_noise(2, dt, find_acceleration_variance.py_func(dt), block_size=2)


def take_fix_softly(kalman: Any, fix: Floats, variance: float) -> None:
    """Update a filter by a fix [m]; one beyond the gate counts as if it stood at the gate."""
    miss = fix - OF_FIX @ kalman.x
    total = kalman.P[0, 0] + variance
    excess = float(miss @ miss) / GATE**2 - total
    kalman.update(fix, R=(variance + max(0.0, excess)) * np.eye(2), H=OF_FIX)


def _fill_motion(
    clean: Clean, ride: Ints, time: Floats, path: Floats, still: NDArray[np.bool_], is_fix: NDArray[np.bool_]
) -> None:
    """Fill in the columns of motion by a smoothed path, where it is known at both ends of a step."""
    dt = clean.dt[ride]
    rates = np.where(still[:, None], 0.0, path[:, 1::2])
    speed = np.hypot(rates[:, 0], rates[:, 1])
    known = np.r_[False, ~np.isnan(speed[1:]) & ~np.isnan(speed[:-1])] & (dt > 0.0)
    at = np.flatnonzero(known)
    distance = np.zeros(len(ride))
    distance[at] = find_lengths(dt[at], np.diff(path[:, ::2], axis=0)[at - 1], rates[at - 1], rates[at])
    distance[at[still[at] & still[at - 1]]] = 0.0
    _straighten(distance, speed, time, path, np.flatnonzero(is_fix | still), still)
    speed = _limit_surges(speed, distance, dt)
    scale, by_odometer = _find_scale(clean.odometer[ride], distance)
    causal, whole = clean.distance[ride][at].sum(), scale * distance[at].sum()
    if abs(whole - causal) > max(MOST_CHANGE * causal, LEAST_CHANGE):
        return
    distance, speed = scale * distance, scale * speed
    rows, before = ride[at], speed[at - 1]
    mean = distance[at] / dt[at]
    rise = 0.5 * (speed[at] ** 2 - before**2)
    clean.distance[rows], clean.speed[rows], clean.travel[rows] = distance[at], mean, dt[at]
    clean.acceleration[rows] = np.divide(rise, distance[at], out=np.zeros(len(at)), where=distance[at] > 0.0)
    _fill_neighbours(clean, rows, rise, np.r_[False, np.diff(at) == 1])
    heading = np.where(speed[at] > TURNING, np.arctan2(rates[at, 1], rates[at, 0]), np.nan)
    turn = (np.diff(heading, prepend=np.nan) + np.pi) % (2.0 * np.pi) - np.pi
    clean.turn_rate[rows] = np.where(np.isnan(turn), 0.0, turn / dt[at])
    clean.heading[rows] = np.where(np.isnan(heading), clean.heading[rows], heading)
    _fill_stops(clean, ride, speed, known)
    _mark_holes(clean, ride, time, is_fix | still, known, by_odometer)


def find_lengths(dt: Floats, way: Floats, before: Floats, after: Floats) -> Floats:
    """Return the lengths of curves with the velocities `before` and `after` at their ends, by Simpson's rule. [m]"""
    middle = 1.5 * way / dt[:, None] - 0.25 * (before + after)
    curve = dt / 6.0 * sum(k * np.hypot(v[:, 0], v[:, 1]) for k, v in ((1.0, before), (4.0, middle), (1.0, after)))
    chord = np.hypot(way[:, 0], way[:, 1])
    return np.where(dt > LONGEST_CURVE, chord, curve)


def _straighten(
    distance: Floats, speed: Floats, time: Floats, path: Floats, measured: Ints, still: NDArray[np.bool_]
) -> None:
    """Shorten the curves between two fixes of a moving car that are a long time apart to their chords, in place."""
    for begin, end in zip(measured[:-1].tolist(), measured[1:].tolist(), strict=True):
        if end - begin < 2 or time[end] - time[begin] <= HOLE or still[begin] or still[end]:
            continue
        rows, along = slice(begin + 1, end + 1), float(distance[begin + 1 : end + 1].sum())
        chord = float(np.hypot(*(path[end, ::2] - path[begin, ::2])))
        if along > chord:
            distance[rows] *= chord / along
            speed[begin + 1 : end] *= chord / along


def _limit_surges(speed: Floats, distance: Floats, dt: Floats) -> Floats:
    """Return speeds limited by the mean speeds of the steps on both sides, where one of them is long. [m/s]"""
    mean = np.divide(distance, dt, out=np.zeros(len(dt)), where=dt > 0.0)
    most = SURGE * np.maximum(mean, np.r_[mean[1:], mean[-1]])
    is_long = np.maximum(dt, np.r_[dt[1:], dt[-1]]) > LONGEST_CURVE
    return np.where(is_long, np.fmin(speed, most), speed)


def _find_scale(odometer: Floats, distance: Floats) -> tuple[float, bool]:
    """Return the factor by which distances agree with the odometer within a step [1], and whether it measures them."""
    changes = np.flatnonzero(np.diff(odometer) > 0.0) + 1
    if len(changes) < 2 or np.isnan(odometer[changes[0] :]).any() or (np.diff(odometer[changes[0] :]) < 0.0).any():
        return 1.0, False
    step = float(np.diff(odometer)[changes - 1].min())
    driven = float(odometer[changes[-1]] - odometer[changes[0]])
    along = float(distance[changes[0] + 1 : changes[-1] + 1].sum())
    if driven < MANY_STEPS * step or along <= 0.0:
        return 1.0, False
    return min(max(along, driven - step), driven + step) / along, True


def _fill_neighbours(clean: Clean, rows: Ints, rise: Floats, follows: NDArray[np.bool_]) -> None:
    """Fill in what depends on the step before, where a row follows another one whose motion is smoothed."""
    if not len(rows):
        return
    run, travel = clean.distance[rows], clean.travel[rows]
    last = np.r_[0, np.arange(len(rows) - 1)]
    both, time = run + run[last] * follows, travel + travel[last] * follows
    risen = rise + rise[last] * follows
    clean.wide_speed[rows] = both / time
    clean.wide_acceleration[rows] = np.divide(risen, both, out=np.zeros(len(rows)), where=both > 0.0)
    change = np.abs(np.diff(clean.acceleration[rows], prepend=0.0)) * follows
    clean.acceleration_spread[rows] = motion.SPREAD_PER_CHANGE * change


def _fill_stops(clean: Clean, ride: Ints, speed: Floats, known: NDArray[np.bool_]) -> None:
    """Fill in standstill and the beginnings of stops, with hysteresis between two speeds."""
    stands = bool(clean.stopped[ride[0]])
    for i, value in enumerate(speed.tolist()):
        if known[i]:
            begins = value < motion.CRAWL and not stands
            stands = value < motion.CRAWL or (stands and value <= motion.MOVING)
            clean.stop[ride[i]], clean.stopped[ride[i]] = begins, stands
        else:
            stands = bool(clean.stopped[ride[i]])


def _mark_holes(
    clean: Clean, ride: Ints, time: Floats, measured: NDArray[np.bool_], known: NDArray[np.bool_], by_odometer: bool
) -> None:
    """Mark the rows of long times without a fix as bridged."""
    at = np.flatnonzero(measured)
    if len(at) < 2:
        return
    gaps = np.diff(time[at])
    least = max(HOLE, HOLE_STEPS * float(np.median(gaps)))
    holes = np.flatnonzero(gaps > (least if by_odometer else min(least, SPARSE)))
    for begin, end in zip(at[holes].tolist(), at[holes + 1].tolist(), strict=True):
        rows = ride[begin + 1 : end + 1][known[begin + 1 : end + 1]]
        clean.quality[rows] |= int(Quality.BRIDGED)
