"""A causal Kalman filter of position and velocity from the fixes of a car, compiled.

The state is position and velocity in metres north and east of an origin nearby. White noise drives the velocity (Li and
Jilkov, IEEE Trans. AES 39 (2003) 1333, DOI 10.1109/TAES.2003.1261132, section III). Both axes have the same covariance
matrix, so that three numbers hold it. `socast.core.cleaning.position_smoother` has the same matrices, built with
filterpy.

*Noise of fixes.* The difference of a fix and the line between its neighbours is noise and acceleration. Across the
course only curves accelerate. Two differences in succession have the covariance -R from white noise of variance R, and
a positive one from a curve. The mean of their negative products across the course therefore estimates R.

*Standstill.* Two hypotheses compete. By one the car drives as the filter says, by the other it stands at the mean of
its fixes since it stopped, and the fixes scatter about that. A car begins to stand where its speed and its last step
are within their noise. It drives again where the filter has predicted the last fixes clearly better than the mean has,
and has left the mean by more than the scatter. The scatter is learned from those fixes that the mean predicts as well.

*Distance.* The distance of a step is the way of the estimate. The square of its length exceeds that of the true way by
the variance across it (Rice, BSTJ 24 (1945) 46, DOI 10.1002/j.1538-7305.1945.tb00453.x), which is subtracted. A way
that is hardly longer than its noise counts along the course alone, with its sign. While a car stands no distance
counts; when it leaves, the way from where the count stopped.

*Far fixes.* A fix farther away than the car can have driven is held until the next one is near it. The way there counts
nothing, because nothing can have driven it. For some minutes the former place is kept: where fixes return to its reach,
the distance from there is added that has not been counted since.
"""

from math import cos, hypot, isnan, nan, sqrt
from typing import Any, Final

from socast.core.cleaning.motion import NULL_ISLAND, SLACK
from socast.core.cleaning.slow_steps import HOLE
from socast.core.cleaning.sphere import compute_chord, wrap_angle
from socast.core.columns import EARTH_RADIUS
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "path_latitude",  # origin of the plane [rad], NaN before the first fix
    "path_longitude",
    "path_scale",  # cosine of its latitude
    "path_north",  # estimate of the position [m]
    "path_east",
    "path_to_north",  # and of the velocity [m/s]
    "path_to_east",
    "path_pp",  # its covariance for each axis [m^2], [m^2/s], [m^2/s^2]
    "path_pv",
    "path_vv",
    "path_lag",  # time since that estimate [s]
    "path_noise",  # variance of the white error of a fix [m^2]
    "path_age",  # time since the last new fix [s]
    "path_hold",  # time for which the receiver holds a fix while the car drives [s]
    "path_fix_north",  # last new fix [m]
    "path_fix_east",
    "path_step",  # time from the fix before to the last one [s], 0 if unknown
    "path_step_north",  # and the way between them [m]
    "path_step_east",
    "path_rest_north",  # difference of the fix before and the line between its neighbours [m]
    "path_rest_east",
    "path_rest_share",  # weight of the last fix in that line, 0 if unknown
    "path_still",  # 1 while the car stands by its fixes
    "path_mean_north",  # mean of the fixes since then [m]
    "path_mean_east",
    "path_mean_count",  # and their number
    "path_scatter",  # variance of the fixes about that mean [m^2]
    "path_wander",  # variance of the velocity by the filter while the car stands [m^2/s^2]
    "path_miss_still",  # recent squared errors of the mean, and of the filter, as prediction [m^2]
    "path_miss_moving",
    "path_odd",  # number of fixes in succession that contradict the filter
    "path_from_north",  # place up to which the distance is counted, while the car stands [m]
    "path_from_east",
    "path_away",  # length of the path since a fix was beyond the scatter there, 0 without one [m]
    "path_owed",  # distance that was counted too much, or before the fix [m]
    "far_latitude",  # a fix out of reach that is not confirmed [rad]
    "far_longitude",
    "far_age",  # time since it was received [s]
    "home_latitude",  # place before a leap out of reach [rad]
    "home_longitude",
    "home_age",  # time since the last fix there [s]
    "home_distance",  # distance counted since then [m]
    "path_distance",  # length of the path since the first fix [m]
    "path_speed",  # speed by the fixes [m/s]
    "path_sd",  # standard deviation of each component of the velocity [m/s]
)
UNKNOWN_AT_FIRST: Final = ("path_latitude", "path_longitude", "far_latitude", "home_latitude")
"""Fields of a new lane that are NaN."""

ACCELERATION: Final = 0.7
"""Standard deviation of the acceleration within a step. [m/s^2]

Chosen on simulated town drives: 1 loses less at corners (1 % of the distance for fixes of 15 m), 0.5 has less noise of
kinetic energy."""
PERSISTENCE: Final = 4.0
"""Time for which an acceleration lasts; over longer steps accelerations average out. [s]"""
FIRST_SPEED: Final = 10.0
"""Standard deviation of each component of the velocity before the second fix. [m/s]"""
STILL_SPEED: Final = 0.3
"""The same of a car that stands. [m/s]"""
FIRST_NOISE: Final = 4.0
"""Standard deviation of a fix before it is estimated; receivers have 3 to 15 m. [m]"""
LEAST_NOISE: Final = 1.0
"""Least standard deviation of a fix: that of a position in hundred-thousandths of a degree, and the map. [m]"""
MOST_NOISE: Final = 100.0
"""Largest. [m]"""
NOISE_MEMORY: Final = 20.0
"""Number of fixes over which the noise is averaged."""
NOISE_STEP: Final = 15.0
"""Longest step of which the noise is estimated; over a longer one accelerations change their sign. [s]"""
SAME: Final = 1e-3
"""Distance below which a receiver has repeated its fix. [m]"""
ORIGIN_MOVES: Final = 5_000.0
"""Distance from the origin at which it is moved; the plane is then wrong by 1e-3. [m]"""
GATE: Final = 5.0
"""Largest difference of a fix and its prediction. [standard deviations]"""
MOST_ODD: Final = 2
"""Number of fixes in succession that may contradict the filter; one more, and it begins anew."""
SLOW: Final = 2.0
"""Speed below which the car may stand. [standard deviations]"""
LEAST_SCATTER: Final = 3.0
"""Least standard deviation of the fixes of a parked car. [m]"""
MOST_SCATTER: Final = 40.0
"""Largest. [m]"""
MEAN_TIME: Final = 100.0
"""Time over which the place of a parked car is averaged: errors of receivers change in some minutes. [s]"""
LEAVING: Final = 3.5
"""Way from the place of a parked car with which it drives. [standard deviations]"""
NO_WORSE: Final = 1.3
"""The same ratio, up to which the fixes are scatter. [1]"""
QUICKLY: Final = 0.25
"""Weight of a fix that raises the scatter. [1]"""
FASTER: Final = 3.0
"""Speed with which it drives. [standard deviations of the velocity while it stood]"""
WANDER_TIME: Final = 10.0
"""Time over which that is averaged. [s]"""
BETTER: Final = 2.5
"""Ratio of the squared errors of prediction, standing over driving, with which it drives. [1]"""
MEMORY: Final = 0.6
"""Share of such a sum that the next fix keeps. [1]"""
SCATTERED: Final = 4.0
"""Squared distance of a fix from that place that belongs to the scatter. [variances]"""
LEAP: Final = 100.0
"""Way from the place of a parked car that is no scatter, unless it has been learned. [m]"""
LEAP_SCATTER: Final = 6.0
"""The same in standard deviations of the scatter."""
CLEAR: Final = 3.0
"""Length of a step whose direction is that of the car. [standard deviations]"""
SPARSE: Final = 20.0
"""Time between two fixes above which the distance is not known to 3 %, unless by an odometer. [s]"""
HOME_TIME: Final = 600.0
"""Time for which the place before a leap is kept. [s]"""

STAYS: Final = 0
AWAY: Final = 1
LEAVES: Final = 2
"""Whether a fix of a car that stands belongs to the scatter there, is beyond it, or shows that the car drives."""
MISSING: Final = 0
REPEATED: Final = 1
HELD: Final = 2
FOLLOWED: Final = 3
BRIDGED_PATH: Final = 4
RETURNED: Final = 5
FAR: Final = 6
"""What became of a fix.

`FOLLOWED` is used by the filter, and `HELD` contradicts it. `BRIDGED_PATH` follows a hole. `FAR` is out of reach, and
`RETURNED` is again within the reach of the place before.
"""


@njit(cache=False)
def find_acceleration_variance(dt: float) -> float:
    """Return the variance of the mean acceleration of a step. [m^2/s^4]"""
    return ACCELERATION * ACCELERATION * min(1.0, PERSISTENCE / dt)


@njit(cache=False)
def predict_path(state: Any, dt: float) -> None:
    """Advance the estimate by a time of constant velocity and unknown acceleration. [s]"""
    variance = find_acceleration_variance(dt)
    state.path_north += dt * state.path_to_north
    state.path_east += dt * state.path_to_east
    state.path_pp += dt * (2.0 * state.path_pv + dt * state.path_vv) + 0.25 * variance * dt**4
    state.path_pv += dt * state.path_vv + 0.5 * variance * dt**3
    state.path_vv += variance * dt * dt
    state.path_lag = 0.0


@njit(cache=False)
def update_path(state: Any, north: float, east: float, variance: float) -> None:
    """Update the estimate by a fix with an error of that variance on each axis. [m], [m^2]"""
    total = state.path_pp + variance
    of_position, of_velocity = state.path_pp / total, state.path_pv / total
    miss_north, miss_east = north - state.path_north, east - state.path_east
    state.path_north += of_position * miss_north
    state.path_east += of_position * miss_east
    state.path_to_north += of_velocity * miss_north
    state.path_to_east += of_velocity * miss_east
    state.path_vv -= of_velocity * state.path_pv
    state.path_pv -= of_position * state.path_pv
    state.path_pp -= of_position * state.path_pp


@njit(cache=False)
def restart_path(state: Any, north: float, east: float) -> None:
    """Begin the estimate anew at a fix. [m]"""
    state.path_north, state.path_east = north, east
    state.path_to_north = state.path_to_east = state.path_pv = 0.0
    state.path_pp, state.path_vv = state.path_noise, FIRST_SPEED * FIRST_SPEED
    state.path_step = state.path_rest_share = state.path_lag = state.path_odd = 0.0
    state.path_still = 0.0


@njit(cache=False)
def place_path(state: Any, latitude: float, longitude: float) -> None:
    """Begin the path at a fix, which becomes the origin. [rad]"""
    if state.path_noise == 0.0:
        state.path_noise = FIRST_NOISE * FIRST_NOISE
    state.path_latitude, state.path_longitude, state.path_scale = latitude, longitude, cos(latitude)
    state.path_fix_north = state.path_fix_east = state.path_age = 0.0
    restart_path(state, 0.0, 0.0)
    stop_path(state)


@njit(cache=False)
def move_origin(state: Any, latitude: float, longitude: float, north: float, east: float) -> None:
    """Move the origin to a fix, whose place in the plane is given. [rad], [m]"""
    state.path_latitude, state.path_longitude, state.path_scale = latitude, longitude, cos(latitude)
    state.path_north -= north
    state.path_east -= east
    state.path_fix_north -= north
    state.path_fix_east -= east
    state.path_mean_north -= north
    state.path_mean_east -= east
    state.path_from_north -= north
    state.path_from_east -= east


@njit(cache=False)
def update_noise(state: Any, north: float, east: float, dt: float) -> None:
    """Estimate the noise of fixes by a new one, `dt` after the last one. [m], [s]"""
    to_north, to_east = north - state.path_fix_north, east - state.path_fix_east
    before = state.path_step
    if before > 0.0 and before <= NOISE_STEP and dt <= NOISE_STEP:
        share = before / (before + dt)
        rest_north = (1.0 - share) * state.path_step_north - share * to_north
        rest_east = (1.0 - share) * state.path_step_east - share * to_east
        if state.path_rest_share > 0.0:
            chord_north, chord_east = state.path_step_north + to_north, state.path_step_east + to_east
            square = max(SAME, chord_north * chord_north + chord_east * chord_east)
            across = (rest_north * chord_east - rest_east * chord_north) / square
            across *= state.path_rest_north * chord_east - state.path_rest_east * chord_north
            variance = max(0.0, -across) / (state.path_rest_share + 1.0 - share)
            variance = min(variance, 8.0 * state.path_noise + 25.0)
            noise = state.path_noise + (variance - state.path_noise) / NOISE_MEMORY
            state.path_noise = min(max(noise, LEAST_NOISE * LEAST_NOISE), MOST_NOISE * MOST_NOISE)
        state.path_rest_north, state.path_rest_east, state.path_rest_share = rest_north, rest_east, share
    else:
        state.path_rest_share = 0.0
    state.path_step, state.path_step_north, state.path_step_east = dt, to_north, to_east


@njit(cache=False)
def stop_path(state: Any) -> None:
    """Let the car stand at the estimate."""
    state.path_still, state.path_mean_count = 1.0, 1.0
    state.path_mean_north, state.path_mean_east = state.path_north, state.path_east
    state.path_from_north, state.path_from_east = state.path_north, state.path_east
    state.path_scatter = max(state.path_noise, LEAST_SCATTER * LEAST_SCATTER)
    state.path_miss_still = state.path_miss_moving = state.path_wander = 0.0
    state.path_away = 0.0
    state.path_speed = 0.0


@njit(cache=False)
def stay_path(state: Any, north: float, east: float, dt: float, missed: float) -> int:
    """Take a fix of a car that stands, after the filter has used it; return `STAYS`, `AWAY` or `LEAVES`.

    Units: missed [m^2].
    """
    off_north, off_east = north - state.path_mean_north, east - state.path_mean_east
    off = off_north * off_north + off_east * off_east
    state.path_miss_still = MEMORY * state.path_miss_still + off
    state.path_miss_moving = MEMORY * state.path_miss_moving + missed
    gone_north, gone_east = state.path_north - state.path_mean_north, state.path_east - state.path_mean_east
    gone = gone_north * gone_north + gone_east * gone_east
    square = state.path_to_north * state.path_to_north + state.path_to_east * state.path_to_east
    spread = state.path_pp + max(0.0, state.path_scatter - state.path_noise)
    is_better = state.path_miss_still > BETTER * state.path_miss_moving
    if is_better and gone > LEAVING * LEAVING * spread and square > FASTER * FASTER * state.path_wander:
        return LEAVES
    if off > max(LEAP * LEAP, LEAP_SCATTER * LEAP_SCATTER * state.path_scatter):
        return LEAVES
    near = off <= SCATTERED * state.path_scatter
    if near or state.path_miss_still <= NO_WORSE * state.path_miss_moving:
        gain = min(1.0, dt / MEAN_TIME)
        if near:
            state.path_mean_count += 1.0
            gain = max(1.0 / state.path_mean_count, gain)
        state.path_mean_north += gain * off_north
        state.path_mean_east += gain * off_east
        excess = 0.5 * off - state.path_scatter
        scatter = state.path_scatter + (QUICKLY if excess > 0.0 else gain) * excess
        state.path_scatter = min(max(scatter, LEAST_SCATTER * LEAST_SCATTER), MOST_SCATTER * MOST_SCATTER)
        state.path_wander += min(QUICKLY, dt / WANDER_TIME) * (0.5 * square - state.path_wander)
    return STAYS if near else AWAY


@njit(cache=False)
def count_path(state: Any, distance: float) -> float:
    """Return a distance less what was counted too much, and add it to the path. [m]"""
    owed = distance - state.path_owed
    state.path_owed = max(0.0, -owed)
    counted = max(0.0, owed)
    state.path_distance += counted
    state.home_distance += counted
    return counted


@njit(cache=False)
def follow_fix(state: Any, north: float, east: float, dt: float) -> tuple[float, int]:
    """Take a new fix within reach, `dt` after the last one; return the distance [m] and what became of the fix."""
    noise, lag = state.path_noise, state.path_lag
    from_north, from_east = state.path_north, state.path_east
    to_north, to_east, slow = state.path_to_north, state.path_to_east, state.path_vv
    predict_path(state, lag)
    miss_north, miss_east = north - state.path_north, east - state.path_east
    missed, total = miss_north * miss_north + miss_east * miss_east, state.path_pp + noise
    odd = missed > GATE * GATE * total
    if odd and state.path_still == 0.0:
        state.path_odd += 1.0
        if state.path_odd <= MOST_ODD:
            return 0.0, HELD
        restart_path(state, north, east)
        state.path_to_north = (north - state.path_fix_north) / dt
        state.path_to_east = (east - state.path_fix_east) / dt
        return hypot(north - from_north, east - from_east), FOLLOWED
    state.path_odd = 0.0
    gain = state.path_pp / total
    held = (1.0 - gain) * lag
    across = gain * gain * (noise + min(noise, state.path_pp)) + held * held * slow
    update_path(state, north, east, noise)
    speed = hypot(state.path_to_north, state.path_to_east)
    moved_north, moved_east = state.path_north - from_north, state.path_east - from_east
    if state.path_still == 1.0:
        stays = stay_path(state, north, east, dt, missed)
        if stays == LEAVES and odd:
            restart_path(state, north, east)
        gone = hypot(state.path_north - state.path_from_north, state.path_east - state.path_from_east)
        if state.path_away > 0.0:
            gone = max(gone, state.path_away + hypot(moved_north, moved_east))
        state.path_away = 0.0 if stays == STAYS else gone
        if stays != LEAVES:
            return 0.0, FOLLOWED
        state.path_still = 0.0
        return gone, FOLLOWED
    moved = moved_north * moved_north + moved_east * moved_east
    course = hypot(to_north, to_east)
    if moved > CLEAR * CLEAR * across or course == 0.0:
        along = sqrt(max(0.0, moved - across))
    else:
        along = (moved_north * to_north + moved_east * to_east) / course
    step = hypot(north - state.path_fix_north, east - state.path_fix_east)
    if speed * speed < SLOW * SLOW * state.path_vv and step < 3.0 * sqrt(2.0 * noise) + 0.5 * dt:
        stop_path(state)
    return along, FOLLOWED


@njit(cache=False)
def follow_fixes(state: Any, row: Any, dt: float, settings: Any) -> tuple[float, int]:
    """Advance the path by a row; return the distance that its fix adds [m] and what became of the fix."""
    latitude, longitude = row.raw_latitude, row.raw_longitude
    state.path_age += dt
    state.path_lag += dt
    state.far_age += dt
    state.home_age += dt
    if state.home_age > HOME_TIME:
        state.home_latitude = nan
    if isnan(latitude) or isnan(longitude) or (abs(latitude) < NULL_ISLAND and abs(longitude) < NULL_ISLAND):
        return 0.0, MISSING
    if isnan(state.path_latitude):
        place_path(state, latitude, longitude)
        return 0.0, FOLLOWED
    north = EARTH_RADIUS * (latitude - state.path_latitude)
    east = EARTH_RADIUS * state.path_scale * wrap_angle(longitude - state.path_longitude)
    way = hypot(north - state.path_fix_north, east - state.path_fix_east)
    step = max(dt, settings.period)
    patience = max(2.0 * step, 1.5 * state.path_hold)
    if way < SAME:
        if state.path_age > patience:
            rest_path(state, north, east)
        return 0.0, REPEATED
    if way > settings.speed_limit * max(state.path_age, step) + SLACK:
        return leap(state, latitude, longitude, step, settings.speed_limit)
    state.far_latitude = nan
    distance, become = take_fix(state, north, east, way, patience)
    state.path_fix_north, state.path_fix_east, state.path_age = north, east, 0.0
    if abs(north) > ORIGIN_MOVES or abs(east) > ORIGIN_MOVES:
        move_origin(state, latitude, longitude, north, east)
    return count_path(state, distance), become


@njit(cache=False)
def rest_path(state: Any, north: float, east: float) -> None:
    """Let the car stand at a fix that is repeated. [m]"""
    if state.path_still == 0.0:
        stop_path(state)
        state.path_mean_north, state.path_mean_east = north, east
    state.path_north, state.path_east = north, east
    state.path_to_north = state.path_to_east = state.path_pv = state.path_lag = 0.0
    state.path_pp, state.path_vv = min(state.path_pp, state.path_noise), STILL_SPEED * STILL_SPEED


@njit(cache=False)
def take_fix(state: Any, north: float, east: float, way: float, patience: float) -> tuple[float, int]:
    """Take a new fix within reach; return the distance that it adds [m] and what became of it."""
    age = state.path_age
    if age > HOLE * patience or (state.path_still == 1.0 and age > patience and way > LEAP):
        was_still = state.path_still == 1.0
        from_north = state.path_from_north if was_still else state.path_north
        from_east = state.path_from_east if was_still else state.path_east
        restart_path(state, north, east)
        state.path_to_north, state.path_to_east = (north - from_north) / age, (east - from_east) / age
        way = hypot(north - from_north, east - from_east)
        state.path_speed = way / age
        distance, become = max(0.0, way - state.path_owed), BRIDGED_PATH
        state.path_owed = 0.0
    else:
        course = hypot(state.path_to_north, state.path_to_east)
        if state.path_still == 0.0 and way > max(0.5 * course, 2.0) * age:
            state.path_hold = max(age, 0.9 * state.path_hold)
        state.path_lag = max(state.path_lag, min(age, state.path_hold))
        update_noise(state, north, east, age)
        distance, become = follow_fix(state, north, east, age)
        if state.path_still == 0.0:
            state.path_speed = hypot(state.path_to_north, state.path_to_east)
    state.path_sd = sqrt(state.path_vv)
    return distance, become


@njit(cache=False)
def leap(state: Any, latitude: float, longitude: float, step: float, limit: float) -> tuple[float, int]:
    """Take a fix out of reach; return the distance that it adds [m] and what became of it."""
    if not isnan(state.home_latitude):
        way = compute_chord(state.home_latitude, state.home_longitude, latitude, longitude)
        if way <= limit * max(state.home_age, step) + SLACK:
            missing = max(0.0, way - state.home_distance)
            state.home_latitude = state.far_latitude = nan
            place_path(state, latitude, longitude)
            return count_path(state, missing), RETURNED
    if not isnan(state.far_latitude):
        way = compute_chord(state.far_latitude, state.far_longitude, latitude, longitude)
        if way <= limit * max(state.far_age, step) + SLACK:
            if isnan(state.home_latitude):
                state.home_latitude = state.path_latitude + state.path_fix_north / EARTH_RADIUS
                state.home_longitude = state.path_longitude + state.path_fix_east / EARTH_RADIUS / state.path_scale
                state.home_age, state.home_distance = state.path_age, 0.0
            state.far_latitude = nan
            place_path(state, latitude, longitude)
            return 0.0, FAR
    state.far_latitude, state.far_longitude, state.far_age = latitude, longitude, 0.0
    return 0.0, FAR
