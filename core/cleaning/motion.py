"""Speed, distance and heading from the sensors, causally, including tunnels and gaps.

Distance is the integral of the accepted speed. Two witnesses check it: the odometer, and the chord between two fixes,
which is a lower limit of the length of any path. Where the speed had a hole (a tunnel, a gap, a rejected value), a
witness may show more distance than the speed has since the witness was last read. That shortfall is then added once.

A fix that is farther away than the car can have driven since the last one is held back until the next fix confirms it.
A single spike is therefore never driven, while the far end of a tunnel is. Where the speed is missing, the last one is
held for at most 20 periods, or 3.5 periods where a witness is available. The distance of a car that never sends a speed
is measured between fixes that are at least 20 m apart, otherwise by its odometer.

A reported speed is averaged as far as the noise of the car asks, see `socast.core.cleaning.speed_noise`, because an
average over some seconds hides much of the energy of speeding up and braking. A moving average of a fixed length
applies to speeds between fixes, and for some samples beside an implausible change in a step, which may be a hole in
which the last speed was held. The distance is that of the speed as reported.

Where a distance was bridged or held, its work is done over the time distance / speed and not over the step. The
acceleration accounts for the kinetic energy of the smoothed speed: over a ride, inertia adds up to the difference of
its ends. On an ordinary row it equals the change of the smoothed speed over the step.
"""

from math import atan2, isnan, nan
from typing import Any, Final

from socast.core.cleaning.elevation import climb_step
from socast.core.cleaning.quality import Quality
from socast.core.cleaning.slow_steps import HOLE, compare_ends, find_farthest_fix
from socast.core.cleaning.speed_noise import (
    SPEED_NOISY,
    average_adaptively,
    find_leap_limit,
    hold_leap,
    is_powered,
    is_still,
    observe_noise,
)
from socast.core.cleaning.speed_witness import count_distance, weigh_speed
from socast.core.cleaning.sphere import compute_chord, find_way, wrap_angle
from socast.core.columns import KMH
from socast.core.compiled_cache import njit

RING: Final = 8
"""Longest moving average of the speed. [samples]"""
FIELDS: Final = (
    "latitude",  # last accepted fix [rad]
    "longitude",
    "fix_age",  # time since that fix [s]
    "fix_distance",  # distance counted since then [m]
    "fix_hole",  # 1 if the speed had a hole since then
    "fix_still",  # time since then for which the speed was zero [s]
    "fix_live",  # 1 if the fix had moved before it was accepted, 0 for the first one after silence
    "pending_latitude",  # a fix that is not confirmed yet [rad]
    "pending_longitude",
    "pending_age",  # time since it was received [s]
    "heading",  # [rad]
    "heading_latitude",  # fix from which the next heading is measured [rad]
    "heading_longitude",
    "heading_age",  # time since the last heading [s]
    "odometer",  # last accepted reading [m]
    "odometer_distance",  # distance counted since it last changed [m]
    "odometer_age",  # time since then [s]
    "odometer_hole",  # 1 if the speed had a hole since then
    "odometer_ticks",  # number of changes so far
    "speed",  # last accepted speed as reported, NaN in a hole [m/s]
    "speed_age",  # time since a speed was last accepted [s]
    "smooth",  # last smoothed speed [m/s]
    "rough",  # number of samples for which speeds are averaged, because one of the last ones is rough
    "acceleration",  # over the last step, NaN where the speed at one of its ends is unknown [m/s^2]
    "last_run",  # distance at the mean speed of the last step [m], 0 where the same is unknown
    "last_travel",  # time of that step, 0 there [s]
    "last_rise",  # change of half the square of the speed in it, 0 there [m^2/s^2]
    "place",  # next place in the ring below
    ("ring", RING),  # accepted speeds of the last samples, NaN where there was none [m/s]
    "has_speed",  # 1 once the car has sent a speed
    "has_fix",  # 1 once the car has sent a fix
    "standing",  # 1 while the car stands
    "cruise",  # mean speed of the last minute of driving [m/s]
)

SPEED_REJECTED: Final = int(Quality.SPEED_REJECTED)
SPEED_MISSING: Final = int(Quality.SPEED_MISSING)
POSITION_MISSING: Final = int(Quality.POSITION_MISSING)
POSITION_JUMP: Final = int(Quality.POSITION_JUMP)
POSITION_FROZEN: Final = int(Quality.POSITION_FROZEN)
BRIDGED: Final = int(Quality.BRIDGED)

NEAR: Final = 5.0
"""Distance below which two fixes are the same place. [m]"""
WANDER: Final = 20.0
"""The same where only the fixes show how far the car moves. [m]"""
SLACK: Final = 50.0
"""Largest error of the distance of two fixes. [m]"""
TURN: Final = 15.0
"""Shortest base over which a heading is measured. [m]"""
BLIND: Final = 200.0
"""Largest distance by which fixes lag behind the wheels. [m]"""
NULL_ISLAND: Final = 1e-4
"""Half-width of the square around 0/0 in which a fix is not valid. [rad]"""
LONGEST_HOLD: Final = 20.0
"""Longest time for which a speed is held or interpolated. [periods]"""
AUTOMATIC: Final = 0
"""Setting of the moving average by which it is as long as the noise of the car asks."""
ROUGH_WINDOW: Final = 3
"""Least number of samples in the moving average of rough speeds: between two fixes, or beside an implausible change."""
HARDEST: Final = 6.0
"""Change of the speed that drivers hardly exceed, except in an emergency; GPS shows more at a tunnel. [m/s^2]"""
SPREAD_PER_CHANGE: Final = 0.2**0.5
"""Standard deviation of the acceleration within a step over the change of its mean since the step before. [1]

The braking energy of a real car, recorded at 10 Hz, is 97 to 104 % of the truth with it, for samples every 1 to 3 s in
summer and in winter, and 87 to 97 % for samples every 5 s. Without it, samples every 3 s show 87 to 92 %. Chosen on the
31 drives of this BMW i3 at samples every 3 s: Steinstraeter et al., DOI 10.21227/6jr9-5235.
"""
CRAWL: Final = 0.5
"""Speed below which the car stands. [m/s]"""
MOVING: Final = 1.5
"""Speed above which the car moves. [m/s]"""
LONGEST_BRIDGE: Final = 86_400.0
"""Longest time for which an odometer bridges a hole. A faulty clock would otherwise allow any distance. [s]"""
COMPRESSED: Final = 1.5
"""Ratio of the speed of a bridge to the limit from which its logger lost time; less is noise of fixes. [1]"""
CRUISE_TIME: Final = 60.0
"""Time over which the speed before a tunnel is averaged. [s]"""
BRIDGING: Final = 20 * KMH
"""Least speed that is assumed for a bridged distance. [m/s]"""


@njit(cache=False)
def update_heading(state: Any, row: Any, dt: float) -> float:
    """Update the heading by the fix of a row if it was accepted; return the rate of turn. [rad/s]"""
    state.heading_age += dt
    if isnan(state.heading_latitude):
        state.heading_latitude, state.heading_longitude = state.latitude, state.longitude
        return 0.0
    if state.fix_age > 0.0 or not find_way(state.heading_latitude, state.heading_longitude, row) >= TURN:
        return 0.0
    latitude, longitude = state.latitude, state.longitude
    east = wrap_angle(longitude - state.heading_longitude) * row.cos_latitude
    heading = atan2(east, latitude - state.heading_latitude)
    turn = wrap_angle(heading - state.heading)
    rate = turn / state.heading_age if state.heading_age > 0.0 else 0.0
    state.heading = heading
    state.heading_latitude, state.heading_longitude = latitude, longitude
    state.heading_age = 0.0
    return 0.0 if isnan(rate) else rate


@njit(cache=False)
def accept_fix(state: Any, latitude: float, longitude: float, distance: float, limit: float) -> tuple[float, float]:
    """Accept a fix; return the distance that the speed has missed [m] and the speed between the fixes [m/s]."""
    shortfall = distance - state.fix_distance
    blind = (
        state.fix_live == 1.0 and shortfall > BLIND and state.fix_still > 0.5 * state.fix_age
    )  # a GPS speed in a tunnel
    if state.fix_hole == 0.0 and not blind:
        shortfall = 0.0
    derived = distance / state.fix_age if state.fix_age > 0.0 else nan
    state.latitude, state.longitude = latitude, longitude
    state.fix_age = state.fix_distance = state.fix_hole = state.fix_still = 0.0
    state.fix_live = 1.0
    state.pending_latitude = nan
    return (max(0.0, shortfall) if distance <= limit else 0.0), derived


@njit(cache=False)
def is_confirmed(state: Any, latitude: float, longitude: float, dt: float, step: float, settings: Any) -> bool:
    """Return whether a distant fix agrees with a pending one; otherwise it becomes the pending one."""
    state.pending_age += dt
    if not isnan(state.pending_latitude):
        apart = compute_chord(state.pending_latitude, state.pending_longitude, latitude, longitude)
        if apart <= settings.speed_limit * max(state.pending_age, step) + SLACK:
            return True
    state.pending_latitude, state.pending_longitude, state.pending_age = latitude, longitude, 0.0
    return False


@njit(cache=False)
def evaluate_fix(state: Any, row: Any, dt: float, settings: Any) -> tuple[float, float]:
    """Check a fix, accept or hold it back, and set its quality bits.

    Returns
    -------
    derived : float
        Speed between the fixes, NaN where unknown. [m/s]
    """
    latitude, longitude = row.raw_latitude, row.raw_longitude
    if isnan(latitude) or isnan(longitude) or (abs(latitude) < NULL_ISLAND and abs(longitude) < NULL_ISLAND):
        row.quality += POSITION_MISSING if state.has_fix == 1.0 or not isnan(latitude) else 0
        return 0.0, nan
    state.has_fix = 1.0
    if isnan(state.latitude):
        state.latitude, state.longitude = latitude, longitude
        state.fix_age = state.fix_distance = state.fix_hole = state.fix_still = 0.0
        return 0.0, nan
    step = max(dt, settings.period)
    distance = find_way(state.latitude, state.longitude, row)
    if distance < (NEAR if state.fix_hole == 0.0 else WANDER):
        state.pending_latitude = nan
        frozen = latitude == state.latitude and longitude == state.longitude and state.smooth > MOVING
        row.quality += POSITION_FROZEN if frozen else 0
        return 0.0, (0.0 if state.fix_age > 2.0 * settings.period else nan)
    row.quality += POSITION_JUMP if distance > settings.speed_limit * step + SLACK else 0
    state.leapt = 1.0 if distance > find_farthest_fix(state, row, dt, settings) + SLACK else 0.0
    if state.leapt == 1.0 and not is_confirmed(state, latitude, longitude, dt, step, settings):
        return 0.0, nan
    return accept_fix(state, latitude, longitude, distance, settings.tunnel_limit)


@njit(cache=False)
def find_odometer_shortfall(state: Any, odometer: float, most: float) -> float:
    """Return the distance by the odometer beyond that of the speed. [m]"""
    if isnan(odometer) or odometer == state.odometer:
        return 0.0
    driven = odometer - state.odometer
    counts = state.odometer_hole == 1.0 and state.odometer_ticks >= 1.0 and 0.0 < driven <= most
    shortfall = driven - state.odometer_distance if counts else 0.0
    state.odometer = odometer
    state.odometer_ticks += 1.0
    state.odometer_distance = state.odometer_hole = state.odometer_age = 0.0
    return max(0.0, shortfall) if shortfall > SLACK else 0.0


@njit(cache=False)
def smooth_speed(state: Any, speed: float, window: int, restart: bool) -> float:
    """Return the moving average of the last accepted speeds. [m/s]"""
    ring = state.ring
    if restart:
        ring[:] = nan
    place = int(state.place)
    ring[place % RING] = speed
    state.place += 1.0
    total = 0.0
    count = 0
    for i in range(window):
        before = ring[(place - i) % RING]
        if not isnan(before):
            total += before
            count += 1
    return total / count


@njit(cache=False)
def update_smooth_speed(state: Any, row: Any, speed: float, dt: float, restart: bool, settings: Any) -> None:
    """Update the smoothed speed by an accepted one, averaged as its noise or the settings ask."""
    if not restart and state.place > 0.0 and abs(speed - state.smooth) > HARDEST * dt + 4.0 * state.noise:
        state.rough = ROUGH_WINDOW
    window = max(1, settings.window)
    if state.rough > 0.0:
        window = max(window, ROUGH_WINDOW)
        state.rough -= 1.0
    state.smooth = smooth_speed(state, speed, int(window), restart)
    state.speed_age = 0.0
    if settings.window != AUTOMATIC or isnan(row.raw_speed) or state.speed_stuck == 1.0:  # between fixes
        return
    observe_noise(state, speed, dt, restart)
    if state.noise > 0.0 and window == 1:
        state.smooth, count = average_adaptively(state.ring, int(state.place) - 1, RING, state.noise)
        row.quality += SPEED_NOISY if count > 1 else 0


@njit(cache=False)
def find_bridge_speed(state: Any, row: Any, age: float, settings: Any) -> float:
    """Return the speed at which a bridged distance was driven, in a time of `age`. [m/s]

    Some loggers lose the time of a tunnel. A distance that no car drives in its time was driven at the mean speed of
    the last minute; the time that the logger did not see is kept.
    """
    speed = row.distance / age
    if speed > COMPRESSED * settings.speed_limit:
        speed = max(state.cruise, row.speed)
        row.unseen = row.distance / min(settings.speed_limit, max(BRIDGING, speed)) - age
    return float(min(settings.speed_limit, max(BRIDGING, speed)))


@njit(cache=False)
def find_hole(state: Any, settings: Any) -> float:
    """Return the longest step that is not a hole in the speed; a logger without a period is silent at one speed. [s]"""
    return HOLE * settings.period if state.has_period == 1.0 else 1.5 * state.period


@njit(cache=False)
def integrate_speed(
    state: Any, speed: float, dt: float, fixed: bool, witnessed: bool, gap: bool, settings: Any
) -> float:
    """Return the distance of a step from the speed alone, and note a hole in the speed. [m]

    A missing speed is replaced by the last one, for a shorter time where fix or odometer will show the distance.
    """
    state.speed_age += dt
    if isnan(speed) or gap:
        state.fix_hole = state.odometer_hole = 1.0
    if gap and witnessed:
        distance = 0.0
    elif isnan(speed):
        held = not fixed and state.speed_age <= (HOLE if witnessed else LONGEST_HOLD) * settings.period
        distance = state.smooth * dt if held else 0.0
    else:
        distance = (speed if isnan(state.speed) else 0.5 * (state.speed + speed)) * min(dt, settings.gap_time)
    state.fix_distance += distance
    state.odometer_distance += distance
    return distance


@njit(cache=False)
def join_last_step(state: Any, row: Any, run: float, rise: float, known: bool) -> None:
    """Fill in speed and acceleration over this step and the last one, or over this step where the last is unknown."""
    if not known:
        state.last_run = state.last_travel = state.last_rise = 0.0
    both, time = run + state.last_run, row.travel + state.last_travel
    row.wide_speed = both / time if time > 0.0 else row.speed
    row.wide_acceleration = (rise + state.last_rise) / both if both > 0.0 else 0.0
    if known:
        state.last_run, state.last_travel, state.last_rise = run, row.travel, rise


@njit(cache=False)
def accept_speed(state: Any, row: Any, settings: Any) -> float:
    """Return the reported speed, NaN where it is rejected or missing. [m/s]"""
    reported = row.raw_speed * (state.speed_scale if state.speed_scale > 0.0 else 1.0)
    if reported > settings.speed_limit:
        row.quality += SPEED_REJECTED
        return nan
    if not isnan(reported):
        state.has_speed = 1.0
    elif state.has_speed == 1.0:
        row.quality += SPEED_MISSING
    return float(reported)


@njit(cache=False)
def find_leap(state: Any, row: Any, speed: float, dt: float) -> float:
    """Return the change of speed beyond which a sample is held back, smaller where two fixes contradict it. [m/s]

    They contradict where the last speed explains their distance, and the mean of both speeds by far does not.
    """
    limit = find_leap_limit(max(dt, state.period) if state.has_period == 1.0 else dt)
    change = speed - state.speed
    if change > limit and is_powered(state, row, speed, dt):
        return change
    if abs(change) * dt > 2.0 * SLACK and abs(change) < limit and state.fix_age == 0.0 and not isnan(row.raw_latitude):
        chord = find_way(state.latitude, state.longitude, row)
        if abs(chord - state.speed * dt) < 0.2 * abs(change) * dt:
            return 0.5 * abs(change)
    return limit


@njit(cache=False)
def repair_speed(state: Any, row: Any, speed: float, dt: float, longest: float) -> tuple[float, float]:
    """Return an accepted speed without noise at standstill and without spikes, and distance that spikes cost. [m]"""
    if state.noise > 0.0 and is_still(state, speed):
        speed = 0.0
    speed, missed, bits = hold_leap(state, speed, dt, find_leap(state, row, speed, dt), longest)
    row.quality += bits
    return speed, missed


@njit(cache=False)
def add_held_distance(state: Any, held: float) -> float:
    """Count the distance of speeds that were held back, negative where they had too much; return it. [m]"""
    state.fix_distance += held
    state.odometer_distance += held
    return held


@njit(cache=False)
def add_shortfalls(state: Any, row: Any, dt: float, missed: float, since_missed: float, settings: Any) -> Any:
    """Return the distance that the speed did not show, that by the odometer in it, its time, and the speed by fixes."""
    age = max(state.fix_age, dt)
    shortfall, derived = evaluate_fix(state, row, dt, settings)
    state.odometer_distance += shortfall
    since = state.odometer_age
    most = settings.speed_limit * min(since, LONGEST_BRIDGE) + settings.tunnel_limit
    owed = find_odometer_shortfall(state, row.raw_odometer, most)
    if owed > 0.0:
        state.fix_distance += owed
        age = since if isnan(state.latitude) else max(age, since)
    if missed > 0.0:
        age = max(age, since_missed)
    return shortfall + owed + missed, owed, age, derived


@njit(cache=False)
def find_spread(state: Any, row: Any, known: bool) -> None:
    """Fill in the spread of the acceleration within a step, and keep the acceleration.

    A row whose speed is held back shows no acceleration. That which confirms it has those of both steps.
    """
    if known and not isnan(state.leap):
        return
    if known and not isnan(state.leap_after):
        row.acceleration_spread, state.acceleration = state.leap_bend, state.leap_after
        return
    change = row.acceleration - state.acceleration
    row.acceleration_spread = SPREAD_PER_CHANGE * abs(change) if known and not isnan(change) else 0.0
    state.acceleration = row.acceleration if known else nan


@njit(cache=False)
def finish_motion(state: Any, row: Any, before: float, dt: float, known: bool) -> None:
    """Fill in the accelerations of a step from its speeds, its distance and its time."""
    if known and row.speed > MOVING:
        state.cruise += (row.speed - state.cruise) * min(1.0, dt / CRUISE_TIME)
    run = row.speed * row.travel
    rise = 0.5 * (state.smooth * state.smooth - before * before)
    row.acceleration = rise / run if run > 0.0 else 0.0
    join_last_step(state, row, run, rise, known)
    count_distance(state, row)
    find_spread(state, row, known)


@njit(cache=False)
def move_car(state: Any, row: Any, dt: float, settings: Any) -> None:
    """Advance the motion of the car by a sample; fill in the columns of motion and the climb."""
    hole = find_hole(state, settings)
    gap = dt > hole
    since_missed = state.missed_time + dt
    speed, missed, row.disputed = weigh_speed(state, row, accept_speed(state, row, settings), dt, gap, settings)
    speed, held = repair_speed(state, row, speed, dt, hole)
    state.fix_age += dt
    state.odometer_age += dt
    fixed = not (isnan(row.raw_latitude) or isnan(state.latitude))
    distance = integrate_speed(state, speed, dt, fixed, fixed or not isnan(state.odometer), gap, settings)
    distance += add_held_distance(state, max(-distance, held))
    shortfall, owed, age, derived = add_shortfalls(state, row, dt, missed, since_missed, settings)
    if isnan(speed) and derived <= settings.speed_limit:
        speed = derived
        state.rough = ROUGH_WINDOW
    row.turn_rate = 0.0 if isnan(state.latitude) else update_heading(state, row, dt)
    before = state.smooth
    if not isnan(speed):
        update_smooth_speed(state, row, speed, dt, gap or state.speed_age > hole, settings)
    known = not (isnan(speed) or isnan(state.speed) or gap or shortfall > 0.0)
    if gap and dt <= 1.5 * state.period:
        shortfall = compare_ends(state, row, 0.5 * (speed + state.speed) * dt, distance, shortfall)
    state.speed = speed
    row.speed = 0.5 * (before + state.smooth)
    row.distance = distance + shortfall
    row.travel = dt
    if shortfall > 0.0 and (state.has_speed == 1.0 or gap or owed > 0.0 or shortfall > settings.speed_limit * dt):
        row.quality += 0 if gap and dt <= 1.5 * state.period else BRIDGED  # the step of a slow logger is no bridge
        row.speed = find_bridge_speed(state, row, max(age, settings.period), settings)
        row.travel = row.distance / row.speed
    elif isnan(speed):
        row.travel = row.distance / row.speed if row.speed > 0.0 else 0.0
    elif derived > 0.0 and state.has_speed == 0.0:
        row.travel = age if age <= hole else min(age, row.distance / row.speed)
    finish_motion(state, row, before, dt, known)
    if not isnan(state.pending_latitude):
        row.map_elevation = nan
    climb_step(state, row, dt, settings)
