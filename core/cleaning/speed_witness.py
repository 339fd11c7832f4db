"""Two witnesses of the speed, its odometer and its fixes, outvote a speed that is stuck or in another unit.

The way is divided into sections: between two fixes `SECTION` apart, and between two changes of the odometer. Over each
section, the witness shows a distance, and the speed shows another one. Their sums, in which older sections count less,
are compared.

*Stuck.* The speed shows less than half of the distance of a witness over some hundred metres, and no other witness
contradicts it. From then on the speed counts as missing, so that odometer and fixes show the distance, and what the
speed has missed before is added. It counts again once it agrees with the fixes, or the odometer.

*Another unit.* The ratio of both distances is that of two units, such as 1.609 for a speed in miles per hour. The speed
is then multiplied by it. Where a car has both witnesses, both must show the ratio; one alone cannot tell whether it is
itself the one in another unit.

A distance that the speed has shown too much cannot be taken back from rows before. It is disputed, as is all distance
while a single witness shows another unit; a ride with much of it is unfit for training.
"""

from math import isnan, log, nan
from typing import Any, Final

from socast.core.cleaning.quality import Quality
from socast.core.cleaning.sphere import find_way, wrap_angle
from socast.core.columns import EARTH_RADIUS
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "section_latitude",  # fix at which the open section began [rad], NaN without one
    "section_longitude",
    "section_age",  # time since then [s]
    "section_run",  # distance by the speed since then [m]
    "section_path",  # distance by fixes from sample to sample since then [m]
    "section_hole",  # 1 if the speed was unknown since then
    "section_distance",  # distance that was counted since then, NaN if not all of it belongs to the ride [m]
    "course_north",  # the last section [m], NaN without one
    "course_east",
    "frozen_run",  # distance by the speed since the fix last changed [m]
    "hold_time",  # time of driving from the last change of the fix to this one, or since [s]
    "refresh_time",  # running mean of that time at changes of the fix [s]
    "unsure_chord",  # distance by fixes since a silence, `SURE_OF_PLACE` once they agree with the speed [m]
    "fix_near",  # distance by fixes in the last sections, the older the less [m]
    "run_near",  # distance by the speed in them [m]
    "fix_far",  # the same with a longer memory
    "run_far",
    "straight_far",  # distance by fixes in sections of straight road, the older the less [m]
    "straight_run_far",  # distance by the speed in them [m]
    "odometer_far",  # distance by the odometer between its last changes, the older the less [m]
    "odometer_run_far",  # distance by the speed between them [m]
    "tick_reading",  # odometer when it last changed [m], NaN without one
    "tick",  # smallest change of the odometer so far [m], 0 if unknown
    "tick_run",  # distance by the speed since it last changed [m]
    "tick_chord",  # distance by fixes since then [m]
    "tick_distance",  # distance that was counted since then, NaN if not all of it belongs to the ride [m]
    "tick_read",  # 1 if it has changed with this sample
    "tick_hole",  # 1 if the speed was unknown since then
    "ticks",  # number of changes of the odometer so far
    "tick_missed",  # distance by the odometer beyond that of the speed, since both last agreed [m]
    "reported",  # last speed, as reported times `speed_scale` [m/s], NaN where unknown
    "missed",  # distance by fixes beyond that of the speed, since both last agreed [m]
    "missed_time",  # time since both last agreed [s]
    "agreed_latitude",  # fix up to which both last agreed [rad], NaN without one
    "agreed_longitude",
    "speed_stuck",  # 1 while the speed counts as missing because witnesses outvote it
    "speed_scale",  # factor by which the reported speed is multiplied, 0 for a factor of 1
)

SPEED_CONTRADICTED: Final = int(Quality.SPEED_CONTRADICTED)

SECTION: Final = 100.0
"""Distance of the fixes at the ends of a section. [m] Noise of 8 m adds less than 1 % to it."""
NEAR_MEMORY: Final = 300.0
"""Distance after which the weight of a section has decreased to 1/e, to recognise a stuck speed. [m]"""
FAR_MEMORY: Final = 10_000.0
"""The same to recognise a unit. [m]"""
LEAST_NEAR: Final = 250.0
"""Sum of such distances, and distance from where both last agreed, from which a speed may count as stuck. [m]"""
LEAST_FAR: Final = 1000.0
"""Sum of such distances from which a speed may be in another unit. [m]"""
STUCK: Final = 0.5
"""Ratio of the distance by the speed to that of a witness below which a speed is stuck. [1]"""
AGREES: Final = 0.25
"""Largest logarithm of a ratio of distances that agree again."""
SAME: Final = 0.04
"""Largest deviation of the logarithm of a ratio from that of two units."""
LONGEST_REFRESH: Final = 30.0
"""Longest time of driving for which a receiver may hold a fix before it counts as frozen. [s]

That of a Twizy holds each fix for 3 to 29 s (RSK Twizy data set, DOI 10.3390/su14169993)."""
REFRESH_MEMORY: Final = 20.0
"""Number of changes of the fix in its mean refresh time."""
PROMPT: Final = 6.0
PROMPT_STEPS: Final = 1.3
"""Longest mean refresh time of fixes that are new when they change: in seconds, and in steps. [s], [1]

A receiver that holds its fixes for longer reports them late, by a time that varies. Over 100 to 300 m, that changes
their distance by 10 %."""
SURE_OF_PLACE: Final = 500.0
"""Distance by fixes after a silence beyond which they are a witness although they never agreed with the speed. [m]"""
FACTORS: Final = (1.609344, 1 / 1.609344, 3.6, 1 / 3.6, 1.852, 1 / 1.852, 3.6 / 1.609344, 1.609344 / 3.6)
"""Ratios of the units of speed: km/h, mph, m/s and knots."""
LEAST_RUN: Final = 0.2
"""Least ratio of the distance by the speed to that of a witness that may be one of units. [1]"""
STEADY: Final = 0.12
"""Largest logarithm of the ratio of the last sections to that of all, of a speed in one unit."""
STRAIGHT: Final = 0.1
"""Largest tangent of the angle between two sections of a straight road. An arc over it is 0.1 % longer. [1]"""
CALIBRATED: Final = 5000.0
"""Distance by the odometer from which it calibrates the speed. [m]"""
LEAST_TICKS: Final = 40.0
"""The same in its smallest changes."""
LEAST_OFF: Final = 0.025
"""Smallest logarithm of a ratio that is calibrated; tyres and their wear explain as much."""
STRAIGHT_MEMORY: Final = 30_000.0
"""Distance of straight road after which the weight of a section has decreased to 1/e. [m]"""
CALIBRATED_STRAIGHT: Final = 10_000.0
"""Sum of such distances from which fixes calibrate the speed. [m]"""
LEAST_OFF_STRAIGHT: Final = 0.045
"""The same where fixes calibrate it. Real speeds show some percent more than fixes: 3.2 % for a Leaf, with a standard
deviation of 1.4 % between rides (VED, arXiv:1905.02081)."""
ALLOWED: Final = 0.3
"""Share by which the distance by the speed may differ from that of the fixes in a section. [1]"""
DENSE: Final = 10.5
"""Longest step between fixes that follow the bends of a road. [s]"""
MOST_OFF: Final = 0.15
"""Largest one: a larger one is no matter of calibration."""
CIRCLING: Final = 600.0
"""Distance by the speed within `SCATTER` of one place after which the speed is too high, or stuck while driving. [m]"""
SCATTER: Final = 50.0
"""Largest distance from that place. [m]"""
SLACK: Final = 50.0
"""Distance that fixes may leap, beyond what a car can have driven. [m]"""
TICKS: Final = 2.0
"""Number of its changes that an odometer must miss to support a speed of zero."""


@njit(cache=False)
def weigh_speed(state: Any, row: Any, speed: float, dt: float, gap: bool, settings: Any) -> tuple[float, float, float]:
    """Return the speed to use, NaN while witnesses outvote it, and what it has missed or shown too much so far.

    Parameters
    ----------
    speed : float
        Reported speed times `speed_scale`, NaN where unknown. [m/s]
    """
    advance_sections(state, row, speed, dt, gap)
    missed, disputed = close_section(state, row, dt, settings)
    more, too_much = take_odometer(state, row)
    missed, disputed = missed + more, disputed + too_much
    if missed > 0.0:  # it belongs to the sections before, too
        row.straight = row.straight_run = 0.0
    factor = find_unit(state) if state.section_age == 0.0 or state.tick_read == 1.0 else 1.0
    if factor != 1.0:
        state.speed_scale = factor * (state.speed_scale if state.speed_scale > 0.0 else 1.0)
        missed, disputed = missed + max(0.0, state.missed), disputed + max(0.0, -state.missed)
        speed *= factor
        state.reported, state.speed_stuck = speed, 0.0
        forget_sections(state)
    if state.speed_stuck == 1.0 and not isnan(speed):
        row.quality += SPEED_CONTRADICTED
        return nan, missed, disputed
    if state.speed_scale > 0.0 and not isnan(speed):
        row.quality += SPEED_CONTRADICTED
    return speed, missed, disputed


@njit(cache=False)
def advance_sections(state: Any, row: Any, speed: float, dt: float, gap: bool) -> None:
    """Extend the open sections by the distance of a step."""
    unknown = gap or isnan(speed) or isnan(state.reported)
    run = 0.0 if unknown else 0.5 * (speed + state.reported) * dt
    state.reported = speed
    is_same = row.raw_latitude == state.fix_latitude and row.raw_longitude == state.fix_longitude
    begun = 0.0 if state.frozen_run == 0.0 else state.hold_time
    state.hold_time = begun + (dt if run > 0.0 else 0.0)
    state.frozen_run = state.frozen_run + run if is_same else 0.0
    state.section_age += dt
    state.section_run += run
    state.tick_run += run
    state.missed_time += dt
    if unknown:
        state.section_hole = state.tick_hole = 1.0
    if gap:
        state.section_latitude, state.unsure_chord = nan, 0.0


@njit(cache=False)
def close_section(state: Any, row: Any, dt: float, settings: Any) -> tuple[float, float]:
    """Close a section at a fix that is far enough; return the distance that the speed missed or showed too much."""
    if isnan(row.raw_latitude) or isnan(row.raw_longitude) or is_frozen(state):
        return 0.0, 0.0
    if state.hold_time > 0.0:
        state.refresh_time += (min(state.hold_time, LONGEST_REFRESH) - state.refresh_time) / REFRESH_MEMORY
    chord = find_way(state.section_latitude, state.section_longitude, row)
    step = find_way(state.fix_latitude, state.fix_longitude, row)
    leaps = step > settings.speed_limit * max(dt, state.hold_time) + SLACK
    if leaps or not chord <= settings.speed_limit * state.section_age + SLACK:  # or no section is open
        open_section(state, row)
        if isnan(state.agreed_latitude):
            agree(state, row)
        return 0.0, 0.0
    circles = chord < SCATTER and state.section_run > CIRCLING and not has_odometer_moved(state)
    if chord < SECTION and not circles:
        state.section_path += step
        return 0.0, 0.0
    state.tick_chord += chord
    run, path, known = state.section_run, state.section_path + step, state.section_hole == 0.0
    within = 0.0 if isnan(state.section_distance) else 1.0
    sure = is_sure_of_place(state, chord, run)
    if sure:
        row.path = within * chord
    is_prompt = state.refresh_time < max(PROMPT, PROMPT_STEPS * dt)
    if follows_course(state, row) and sure and is_prompt:
        row.straight = within * chord
        take_straight(state, chord, run, known)
    open_section(state, row)
    if circles and known:
        state.missed, state.speed_stuck = 0.0, 1.0
        return 0.0, run - chord
    if not known:
        return 0.0, 0.0
    missed = compare_section(state, row, chord, run)
    contradicted = sure and max(dt, state.hold_time) < DENSE and state.speed_stuck == 0.0 and missed == 0.0
    return missed, (find_disputed(chord, path, run) if contradicted else 0.0)


@njit(cache=False)
def take_straight(state: Any, chord: float, run: float, known: bool) -> None:
    """Add a section of straight road to those of the car."""
    if known and state.speed_stuck == 0.0 and run > 0.0 and abs(log(chord / run)) < AGREES:
        keep = max(0.0, 1.0 - chord / STRAIGHT_MEMORY)
        state.straight_far = keep * state.straight_far + chord
        state.straight_run_far = keep * state.straight_run_far + run


@njit(cache=False)
def is_frozen(state: Any) -> bool:
    """Return whether the receiver holds its fix; if it is frozen, the way to where it wakes is no witness."""
    if state.frozen_run > SECTION and state.hold_time > LONGEST_REFRESH:
        state.section_latitude = nan
    return bool(state.frozen_run > 0.0)


@njit(cache=False)
def is_sure_of_place(state: Any, chord: float, run: float) -> bool:
    """Return whether the fixes have agreed with the speed since the last silence; the first ones may wander."""
    state.unsure_chord += chord
    if run > 0.0 and abs(log(chord / run)) < AGREES:
        state.unsure_chord = max(state.unsure_chord, SURE_OF_PLACE)
    return bool(state.unsure_chord >= SURE_OF_PLACE)


@njit(cache=False)
def find_disputed(chord: float, path: float, run: float) -> float:
    """Return by how much the distance by the speed is beyond what fixes allow in a section, if it clearly is. [m]"""
    low, high = (1.0 - ALLOWED) * chord - SCATTER, (1.0 + ALLOWED) * path + SCATTER
    return chord - run if run < low else run - path if run > high else 0.0


@njit(cache=False)
def follows_course(state: Any, row: Any) -> bool:
    """Return whether the section that ends at a fix continues the one before it without a bend, and keep its course."""
    north = (row.raw_latitude - state.section_latitude) * EARTH_RADIUS
    east = wrap_angle(row.raw_longitude - state.section_longitude) * EARTH_RADIUS * row.cos_latitude
    along = north * state.course_north + east * state.course_east
    across = north * state.course_east - east * state.course_north
    state.course_north, state.course_east = north, east
    return bool(along > 0.0 and abs(across) < STRAIGHT * along)


@njit(cache=False)
def compare_section(state: Any, row: Any, chord: float, run: float) -> float:
    """Compare the distances of a section; return what the speed has missed if it turns out to be stuck. [m]"""
    near, far = max(0.0, 1.0 - max(chord, run) / NEAR_MEMORY), max(0.0, 1.0 - max(chord, run) / FAR_MEMORY)
    state.fix_near, state.run_near = near * state.fix_near + chord, near * state.run_near + run
    state.fix_far, state.run_far = far * state.fix_far + chord, far * state.run_far + run
    if run > 0.0 and abs(log(chord / run)) < AGREES:
        agree(state, row)
        return 0.0
    state.missed += 0.0 if state.speed_stuck == 1.0 else chord - run
    away = find_way(state.agreed_latitude, state.agreed_longitude, row)
    supported = state.tick > 0.0 and state.tick_chord > TICKS * state.tick + LEAST_NEAR
    is_clear = away > LEAST_NEAR and state.fix_near > LEAST_NEAR and state.run_near < STUCK * state.fix_near
    if state.speed_stuck == 1.0 or supported or not is_clear:
        return 0.0
    state.speed_stuck = 1.0
    missed, state.missed = max(0.0, state.missed), 0.0
    return float(missed)


@njit(cache=False)
def open_section(state: Any, row: Any) -> None:
    """Begin a section at a fix."""
    state.section_latitude, state.section_longitude = row.raw_latitude, row.raw_longitude
    state.section_age = state.section_run = state.section_hole = state.section_path = 0.0


@njit(cache=False)
def count_distance(state: Any, row: Any) -> None:
    """Count the distance of a step beside that of its witnesses, and begin anew where they were read at its end."""
    section, tick = state.section_distance + row.distance, state.tick_distance + row.distance
    row.path_run = section if row.path > 0.0 else 0.0
    row.straight_run = section if row.straight > 0.0 else 0.0
    row.ticked_run = tick if row.ticked > 0.0 else 0.0
    state.section_distance = 0.0 if state.section_age == 0.0 else section
    state.tick_distance = 0.0 if state.tick_read == 1.0 else tick
    state.tick_read = 0.0


@njit(cache=False)
def agree(state: Any, row: Any) -> None:
    """Note that fixes and speed agree up to a fix."""
    state.missed = state.missed_time = 0.0
    state.agreed_latitude, state.agreed_longitude = row.raw_latitude, row.raw_longitude
    if state.speed_stuck == 1.0:
        state.speed_stuck = 0.0
        state.fix_far = state.run_far = state.odometer_far = state.odometer_run_far = 0.0


@njit(cache=False)
def has_odometer_moved(state: Any) -> bool:
    """Return whether the odometer has moved with the speed lately."""
    return bool(state.ticks > 1.0 and state.tick_run < 0.5 * CIRCLING)


@njit(cache=False)
def take_odometer(state: Any, row: Any) -> tuple[float, float]:
    """Compare the speed with the odometer; return the distance that the speed missed or showed too much."""
    odometer = row.raw_odometer
    if isnan(odometer):
        return 0.0, 0.0
    if odometer == state.tick_reading:
        return 0.0, find_excess(state)
    driven, run, known = odometer - state.tick_reading, state.tick_run, state.tick_hole == 0.0
    row.ticked = driven if driven > 0.0 and not isnan(state.tick_distance) else 0.0
    state.tick_reading, state.tick_read = odometer, 1.0
    state.tick_run = state.tick_chord = state.tick_hole = 0.0
    if not driven > 0.0:
        return 0.0, 0.0
    state.ticks += 1.0
    state.tick = driven if state.tick == 0.0 else min(state.tick, driven)
    return (compare_tick(state, driven, run) if known and state.ticks > 1.0 else 0.0), 0.0


@njit(cache=False)
def compare_tick(state: Any, driven: float, run: float) -> float:
    """Compare the distances between two changes of the odometer; return what a stuck speed has missed. [m]

    A speed of 0 while the odometer counts, as of a receiver in a tunnel, is no matter of its unit.
    """
    if run >= LEAST_RUN * driven:
        kept = max(0.0, 1.0 - driven / FAR_MEMORY)
        state.odometer_far = kept * state.odometer_far + driven
        state.odometer_run_far = kept * state.odometer_run_far + run
    if not isnan(state.section_latitude):  # the fixes decide
        return 0.0
    if run >= STUCK * driven:
        state.tick_missed = 0.0
        state.speed_stuck = state.speed_stuck if run > 2.0 * driven else 0.0
        return 0.0
    state.tick_missed += 0.0 if state.speed_stuck == 1.0 else driven - run
    if state.tick_missed < LEAST_NEAR:
        return 0.0
    missed, state.tick_missed = state.tick_missed, 0.0
    state.speed_stuck = 1.0
    return float(missed)


@njit(cache=False)
def find_excess(state: Any) -> float:
    """Return the distance that the speed shows although the odometer and the fixes stand still, if it is clear. [m]"""
    clear = state.tick > 0.0 and state.tick_run > TICKS * state.tick + CIRCLING
    if not clear or not isnan(state.section_latitude):
        return 0.0
    excess: float = state.tick_run
    state.tick_run, state.speed_stuck = 0.0, 1.0
    return excess


@njit(cache=False)
def find_unit(state: Any) -> float:
    """Return the ratio of two units of speed that the witnesses show, 1 where they show none."""
    if state.speed_stuck == 1.0 and state.run_near < LEAST_RUN * state.fix_near:
        return 1.0
    by_fixes = find_factor(state.fix_far, state.run_far)
    if state.fix_far > 0.0 and not is_steady(state):
        return 1.0
    by_odometer = find_factor(state.odometer_far, state.odometer_run_far)
    if by_fixes == by_odometer and by_fixes != 1.0:
        return by_fixes
    if isnan(state.tick_reading):
        return calibrate_by_fixes(state) if by_fixes == 1.0 else by_fixes if state.fix_far > 2.0 * LEAST_FAR else 1.0
    return calibrate(state)


@njit(cache=False)
def is_steady(state: Any) -> bool:
    """Return whether the last sections show the same ratio as all."""
    if state.run_near <= 0.0 or state.run_far <= 0.0:
        return False
    return bool(abs(log(state.fix_near / state.run_near * state.run_far / state.fix_far)) < STEADY)


@njit(cache=False)
def calibrate(state: Any) -> float:
    """Return the ratio that an odometer shows of a speed that is off by some percent, 1 where it agrees."""
    enough = state.odometer_far > max(CALIBRATED, LEAST_TICKS * state.tick) and state.odometer_run_far > 0.0
    if not enough:
        return 1.0
    ratio = state.odometer_far / state.odometer_run_far
    if not LEAST_OFF < abs(log(ratio)) < MOST_OFF:
        return 1.0
    has_fixes = state.fix_far > CALIBRATED and state.run_far > 0.0
    agrees = not has_fixes or abs(log(state.fix_far / state.run_far / ratio)) < LEAST_OFF
    return float(ratio) if agrees else 1.0


@njit(cache=False)
def calibrate_by_fixes(state: Any) -> float:
    """Return the ratio that fixes on straight roads show of a speed that is off by some percent, 1 where they agree."""
    if state.straight_far < CALIBRATED_STRAIGHT:
        return 1.0
    ratio = state.straight_far / state.straight_run_far
    return float(ratio) if LEAST_OFF_STRAIGHT < abs(log(ratio)) < MOST_OFF else 1.0


@njit(cache=False)
def find_factor(witnessed: float, run: float) -> float:
    """Return the ratio of two units that two distances show, 1 where they show none."""
    if witnessed < LEAST_FAR or run <= 0.0:
        return 1.0
    ratio = log(witnessed / run)
    for factor in FACTORS:
        if abs(ratio - log(factor)) < SAME:
            return factor
    return 1.0


@njit(cache=False)
def forget_sections(state: Any) -> None:
    """Forget the sums of both witnesses, after the scale of the speed has changed."""
    state.fix_near = state.run_near = state.fix_far = state.run_far = 0.0
    state.straight_far = state.straight_run_far = 0.0
    state.odometer_far = state.odometer_run_far = state.missed = state.tick_missed = state.missed_time = 0.0
    state.section_latitude = nan
    state.tick_hole = 1.0


UNKNOWN_AT_FIRST: Final = (
    *("section_latitude", "section_longitude", "agreed_latitude", "agreed_longitude"),
    *("tick_reading", "tick_distance", "section_distance", "reported", "course_north", "course_east"),
)
"""Fields of a new lane that are NaN."""
