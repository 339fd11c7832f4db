"""Speed, distance and heading of a car that never sends a speed, causally, by its fixes and its odometer.

`socast.core.cleaning.position_filter` follows the fixes, and the odometer is the second witness. Over the changes of
the odometer, the distance by the fixes is compared with that of the odometer. A shortfall beyond a change and the error
of fixes is added once, and an excess beyond both is taken from what follows. Where the fixes show more than twice the
smallest change while the odometer stays, and the car is still near the place of its last change, they drift and count
nothing.

A row without a new fix covers no distance. The distance of a fix is driven over the time distance / speed and not over
its step, as a bridged one is in `socast.core.cleaning.motion`.
"""

from math import atan2, hypot, isnan, nan
from typing import Any, Final

from socast.core.cleaning import motion, position_filter
from socast.core.cleaning.elevation import climb_step
from socast.core.cleaning.quality import Quality
from socast.core.cleaning.speed_witness import count_distance
from socast.core.cleaning.sphere import compute_chord, wrap_angle
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "odometer_step",  # smallest change of the odometer, 0 before the second [m]
    "odometer_shortfall",  # distance by the odometer less that by the fixes, over all changes [m]
    "odometer_driven",  # recent distance by the odometer while fixes had no hole [m]
    "odometer_followed",  # and by the fixes [m]
    "odometer_latitude",  # place of its last change [rad]
    "odometer_longitude",
)

POSITION_DRIFT: Final = int(Quality.POSITION_DRIFT)
DRIFT: Final = 2.0 * position_filter.LEAST_SCATTER
"""Distance of a fix from the place of a parked car that is marked as drift. [m]"""
NEAR_STEPS: Final = 5.0
"""Distance from the last change of the odometer up to which fixes may drift. [changes]"""
NEAR_CHANGE: Final = 500.0
"""The same for an odometer with small changes. Beyond both, the odometer is stuck. [m]"""
FEW_TICKS: Final = 2.0
"""Number of changes from which the odometer is a witness."""
UNIT_DISTANCE: Final = 5_000.0
"""Distance over which odometer and fixes are compared. [m]"""
MOST_MISSING: Final = 0.25
"""Largest share that fixes without a hole miss of the distance; beyond it, the odometer has another unit. [1]"""


@njit(cache=False)
def has_only_fixes(state: Any, row: Any) -> bool:
    """Return whether a car has sent fixes and never a speed."""
    return state.has_speed == 0.0 and isnan(row.raw_speed) and (state.has_fix == 1.0 or not isnan(row.raw_latitude))


@njit(cache=False)
def weigh_odometer(state: Any, row: Any, distance: float, settings: Any) -> tuple[float, float]:
    """Return how much of a distance by fixes counts, and the distance that they have missed by the odometer. [m]"""
    odometer = row.raw_odometer
    state.odometer_distance += distance
    if isnan(odometer):
        return distance, 0.0
    if isnan(state.odometer) or odometer < state.odometer:
        begin_odometer(state, odometer)
        state.odometer_shortfall = state.odometer_ticks = 0.0
        return distance, 0.0
    if odometer == state.odometer:
        most = 2.0 * state.odometer_step + motion.SLACK
        if state.odometer_step == 0.0 or state.odometer_distance <= most or not is_near_change(state):
            return distance, 0.0
        if distance > 0.0:
            row.quality = float(int(row.quality) | POSITION_DRIFT)
        state.odometer_distance -= distance
        return 0.0, 0.0
    missing = compare_change(state, odometer - state.odometer, settings)
    row.ticked = 0.0 if isnan(state.tick_distance) else odometer - state.odometer
    state.tick_read = 1.0
    state.odometer_ticks += 1.0
    begin_odometer(state, odometer)
    return distance, missing


@njit(cache=False)
def compare_change(state: Any, driven: float, settings: Any) -> float:
    """Return the distance that fixes have missed, over a change of the odometer and those before. [m]"""
    counted, since = state.odometer_distance, min(state.odometer_age, motion.LONGEST_BRIDGE)
    if driven > settings.speed_limit * since + settings.tunnel_limit or state.odometer_ticks < 1.0:
        return 0.0
    state.odometer_step = driven if state.odometer_step == 0.0 else min(driven, state.odometer_step)
    most = state.odometer_step + motion.SLACK
    total = state.odometer_shortfall + driven - counted
    if state.odometer_hole == 0.0:
        keep = max(0.0, 1.0 - driven / UNIT_DISTANCE)
        state.odometer_driven = keep * state.odometer_driven + driven
        state.odometer_followed = keep * state.odometer_followed + counted
    excess = abs(state.odometer_driven - state.odometer_followed)
    if excess > MOST_MISSING * state.odometer_driven + state.odometer_step:  # it has another unit
        state.odometer_shortfall = max(-most, min(most, total))
        return 0.0
    if total > most:
        state.odometer_shortfall = 0.0
        return float(total)
    state.odometer_shortfall = total
    if total < -most:  # which takes effect in the distance up to the next change
        state.path_owed = max(state.path_owed, -total - most)
    return 0.0


@njit(cache=False)
def begin_odometer(state: Any, odometer: float) -> None:
    """Count the distance from a change of the odometer on."""
    state.odometer = odometer
    state.odometer_distance = state.odometer_hole = state.odometer_age = 0.0
    state.odometer_latitude, state.odometer_longitude = state.latitude, state.longitude


@njit(cache=False)
def is_near_change(state: Any) -> bool:
    """Return whether the car is near the place at which its odometer changed last."""
    way = compute_chord(state.odometer_latitude, state.odometer_longitude, state.latitude, state.longitude)
    return not way > max(NEAR_CHANGE, NEAR_STEPS * state.odometer_step)


@njit(cache=False)
def mark_fix(state: Any, row: Any, become: int, distance: float, step: float, settings: Any) -> None:
    """Set the quality bits of a fix, and take its place where it is believed."""
    if become == position_filter.MISSING:
        row.quality += motion.POSITION_MISSING if state.has_fix == 1.0 or not isnan(row.raw_latitude) else 0
        state.odometer_hole = 1.0
        return
    if become == position_filter.REPEATED:
        row.quality += motion.POSITION_FROZEN if state.smooth > motion.MOVING else 0
        return
    is_jump = become == position_filter.FAR or distance > settings.speed_limit * step + motion.SLACK
    row.quality += motion.POSITION_JUMP if is_jump else 0
    if become == position_filter.FAR or not isnan(state.home_latitude):
        row.raw_elevation = row.map_elevation = nan
        state.odometer_hole = 1.0
        return
    if become in (position_filter.BRIDGED_PATH, position_filter.RETURNED):
        state.odometer_hole = 1.0
    state.has_fix = 1.0
    if become != position_filter.HELD:
        state.latitude, state.longitude = row.raw_latitude, row.raw_longitude
    off_north = state.path_fix_north - state.path_mean_north
    off_east = state.path_fix_east - state.path_mean_east
    row.quality += POSITION_DRIFT if state.path_still == 1.0 and hypot(off_north, off_east) > DRIFT else 0


@njit(cache=False)
def update_course(state: Any, dt: float) -> float:
    """Update the heading by the velocity of the filter; return the rate of turn. [rad/s]"""
    state.heading_age += dt
    north, east = state.path_to_north, state.path_to_east
    least = max(motion.MOVING, position_filter.SLOW * state.path_sd)
    if state.path_still == 1.0 or state.path_lag > 0.0 or north * north + east * east < least * least:
        return 0.0
    heading = atan2(east, north)
    age = max(state.heading_age, dt)
    rate = wrap_angle(heading - state.heading) / age if age > 0.0 else 0.0
    state.heading, state.heading_age = heading, 0.0
    return 0.0 if isnan(rate) else rate


@njit(cache=False)
def move_by_fixes(state: Any, row: Any, dt: float, settings: Any) -> None:
    """Advance the motion of a car without a speed by a sample; fill in the columns of motion and the climb."""
    state.odometer_age += dt
    age = state.path_age + dt
    hole = motion.find_hole(state, settings)
    distance, become = position_filter.follow_fixes(state, row, dt, settings)
    mark_fix(state, row, become, distance, max(dt, settings.period), settings)
    distance, missing = weigh_odometer(state, row, distance, settings)
    if missing > 0.0 and become in (position_filter.MISSING, position_filter.FAR, position_filter.REPEATED):
        state.path_owed += missing
    row.turn_rate = update_course(state, dt)
    before = state.smooth
    is_new = become not in (position_filter.MISSING, position_filter.FAR, position_filter.HELD)
    if is_new:
        state.smooth = min(state.path_speed, settings.speed_limit)
        state.fix_age = state.path_age
    row.speed = 0.5 * (before + state.smooth)
    row.distance = distance + missing
    is_bridge = become in (position_filter.BRIDGED_PATH, position_filter.RETURNED) or missing > 0.0
    if is_bridge and row.distance > 0.0:
        row.quality += 0 if dt > hole and dt <= 1.5 * state.period else motion.BRIDGED
        row.speed = max(motion.BRIDGING, row.speed, row.distance / max(age, settings.period))
    elif row.distance > 0.0 and age > position_filter.SPARSE and state.odometer_ticks < FEW_TICKS:
        row.quality += motion.BRIDGED
    elif row.distance > 0.0 and row.speed * age < 0.5 * row.distance:  # it leaves the place where it stood
        row.speed = row.distance / max(age, settings.period)
    row.speed = min(settings.speed_limit, row.speed)
    rise = 0.5 * (state.smooth * state.smooth - before * before)
    row.travel = dt if row.distance == 0.0 and rise != 0.0 else 0.0
    if row.distance > 0.0 and row.speed > 0.0:
        row.travel = row.distance / row.speed
    run = row.speed * row.travel
    row.acceleration = rise / run if run > 0.0 else 0.0
    motion.join_last_step(state, row, run, rise, False)
    row.acceleration_spread, state.acceleration = 0.0, nan
    row.fix_sd = state.path_noise**0.5
    count_distance(state, row)
    climb_step(state, row, dt, settings)
