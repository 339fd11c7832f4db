"""Elevation and climb of a car, causally: combine its fixes with a map, smooth over distance, and take out the noise.

Where a map knows the ground under the fix of a car, both are combined by a Kalman filter. Loggers have an offset of
some metres to each other and up to 100 m to a map: ellipsoid instead of geoid, or an uncalibrated barometer. The
offset of the car is therefore the state of the filter; it drifts as a random walk. With ground m of variance V on the
map, offset o of variance P and a fix z of variance R, the innovation is e = z - o - m with variance S = P + R + V. Then

    elevation = m + V / S e,  variance V - V^2 / S;    o + P / S e,  variance P - P^2 / S.

Outside the map the elevation is z - o, so that a car that leaves the map climbs nothing. A fix that is more than
`GATE` standard deviations off has no effect, and makes the offset less certain, so that another offset is accepted
after a few fixes. A car that has never been on a map has its fixes alone. At its first fix on a map, the elevation so
far is shifted by the offset, so that the change of reference is no climb.

A fix from which the road would be steeper than any is not used. The slope is measured from a fix at least `BASE` back,
so that many small steps make no cliff. Where fixes stay at another level over that distance, or come after a silence,
the reference of the receiver has changed: the elevation follows, and the change is no climb. It is one, though, where
the elevation had been the same to the last digit over a distance in which a road leads there: some receivers hold it.

The elevation is smoothed over distance, so that a standing car climbs nothing. It then passes a backlash (a play
operator, Brokate and Sprekels, Hysteresis and Phase Transitions, Springer 1996, DOI 10.1007/978-1-4612-4048-8), so that
noise of a few metres makes no hills. Smoothing length L and slack suit fixes alone; they are reduced in proportion to
the standard deviation of the elevation, as the steady gain of a Kalman filter of a random walk asks (Muth, JASA 55
(1960) 299, DOI 10.1080/01621459.1960.10482064). The cost: hills of wavelength l keep 1 / sqrt(1 + (2 pi L / l)^2) of
their height (for L of 80 m, 99 % for 3.6 km and 89 % for 1 km), and each turn of the slope loses at most twice the
slack. The climb that the filter has not passed on when a ride ends is missing from the ride.
"""

from math import isnan, nan, sqrt
from typing import Any, Final

from socast.core.cleaning.quality import Quality
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "elevation",  # smoothed [m]
    "level",  # after the backlash [m]
    "elevation_offset",  # of the car's fixes to the map [m]
    "offset_variance",  # NaN until the car has been on a map [m^2]
    "base_height",  # fix from which slopes are measured [m]
    "base_run",  # distance since then [m]
    "base_held",  # distance before it over which the fixes had its height to the last digit [m]
    "steep_height",  # first of the fixes that were too steep, NaN without one [m]
    "steep_run",  # distance since then [m]
    "steep_held",  # 1 if the elevation before them was held for long enough to climb to them
    "held_height",  # last fix [m]
    "held_run",  # distance since the fixes have this height to the last digit [m]
)
UNKNOWN_AT_FIRST: Final = ("elevation", "level", "offset_variance", "base_height", "steep_height", "held_height")
"""Fields of a new lane that are NaN."""
SLOPE_REJECTED: Final = int(Quality.SLOPE_REJECTED)

STEEPEST: Final = 0.3
"""Steepest slope of a road over `BASE`. [1]

Baldwin Street, Dunedin, the steepest street (Guinness World Records, 2020), has 35 % at one place and 20 % on average
over its 350 m; the passes of the Alps have up to 30 % over some hundred metres.
"""
BASE: Final = 150.0
"""Distance over which a slope is measured. [m]"""
SURE: Final = 15.0
"""Difference of two fixes on level road that is no slope: three times the error of a poor receiver. [m]"""

SUSTAINED: Final = 0.12
"""Steepest slope over the distance for which a receiver may hold its elevation. [1]

The Zoncolan, one of the steepest passes, has 12 % over 10 km."""
LONGEST_HELD: Final = 1500.0
"""Longest distance for which a receiver holds its elevation; over a longer one, the road is level. [m]

That of a Twizy holds it for up to 900 m (RSK Twizy data set, DOI 10.3390/su14169993)."""
SILENCE: Final = 60.0
"""Step after which a fix at another level tells of a drive that was not logged, or of another reference. [s]"""

FIX_SD: Final = 2.0
"""Standard deviation of fixes for which the defaults of `elevation_length` and `elevation_slack` were chosen. [m]"""
FIX_VARIANCE: Final = FIX_SD * FIX_SD
"""Variance of a fix, without the offset of its logger. [m^2]"""
FIRST_OFFSET_VARIANCE: Final = 100.0**2
"""Variance of an unknown offset: the geoid lies up to 107 m off the ellipsoid (EGM96, NASA/TP-1998-206861). [m^2]"""
OFFSET_DRIFT: Final = 1.0 / 600.0
"""Growth of the variance of an offset: 1 m in ten minutes, the time over which satellites change. [m^2/s]"""
GATE: Final = 5.0
"""Deviation beyond which a fix is not used. [standard deviations]"""
DOUBT: Final = 0.01
"""Share of the square of such a deviation that is added to the variance of the offset. [1]"""


ROAD: Final = 0
STEEP: Final = 1
STILL_STEEP: Final = 2
NEW_LEVEL: Final = 3
LATE_ROAD: Final = 4
"""Whether a road leads to a fix, it is the first of a level to which none does, a later one, or that level lasts; then
it is another reference, or the road led there while the receiver held its elevation."""


@njit(cache=False)
def combine_elevation(state: Any, row: Any, dt: float) -> tuple[float, float]:
    """Return the elevation by fix and map [m], NaN where unknown, and its standard deviation over that of a fix [1]."""
    fix = row.raw_elevation
    if not isnan(state.offset_variance):
        state.offset_variance = min(FIRST_OFFSET_VARIANCE, state.offset_variance + OFFSET_DRIFT * dt)
    if isnan(row.map_elevation):
        return (fix if isnan(state.offset_variance) else fix - state.elevation_offset), 1.0
    variance = row.map_variance
    if isnan(state.offset_variance):
        refer_to_map(state, row)
    if isnan(fix):
        return row.map_elevation, sqrt(variance / FIX_VARIANCE)
    innovation = fix - state.elevation_offset - row.map_elevation
    spread = state.offset_variance + FIX_VARIANCE + variance
    if innovation * innovation > GATE * GATE * spread:
        state.offset_variance += DOUBT * innovation * innovation
        return row.map_elevation, sqrt(variance / FIX_VARIANCE)
    gain = state.offset_variance / spread
    state.elevation_offset += gain * innovation
    state.offset_variance -= gain * state.offset_variance
    share = variance / spread
    return row.map_elevation + share * innovation, sqrt((variance - share * variance) / FIX_VARIANCE)


@njit(cache=False)
def refer_to_map(state: Any, row: Any) -> None:
    """Estimate the unknown offset of a car, and subtract it from its elevation so far.

    The estimate rests on the fix, or on the elevation so far where there is no fix or they contradict each other.
    """
    state.offset_variance = FIRST_OFFSET_VARIANCE
    reported = state.elevation
    if isnan(reported) or abs(row.raw_elevation - reported) <= GATE * FIX_SD:
        reported = row.raw_elevation
    if not isnan(reported):
        state.elevation_offset = reported - row.map_elevation
        state.elevation -= state.elevation_offset
        state.level -= state.elevation_offset


@njit(cache=False)
def climb_step(state: Any, row: Any, dt: float, settings: Any) -> None:
    """Fill in the climb of a row whose distance is known, and the readings that tables smooth."""
    row.elevation_fix, row.ground, row.ground_variance = row.raw_elevation, row.map_elevation, row.map_variance
    check_slope(state, row, dt)
    elevation, spread = combine_elevation(state, row, dt)
    row.climb = update_climb(state, elevation, spread, row.distance, settings)


@njit(cache=False)
def weigh_slope(state: Any, fix: float) -> tuple[int, float]:
    """Return whether a road leads to a fix [m], and for a new level its height above the base [m]."""
    if isnan(state.base_height):
        state.base_height, state.base_run, state.base_held = fix, 0.0, 0.0
    rise, outcome = fix - state.base_height, ROAD
    if fix != state.held_height:
        state.held_height, state.held_run = fix, 0.0
    if not isnan(state.steep_height) and abs(fix - state.steep_height) <= STEEPEST * state.steep_run + SURE:
        if state.steep_run < BASE:
            return STILL_STEEP, 0.0
        outcome = LATE_ROAD if state.steep_held == 1.0 else NEW_LEVEL
    elif abs(rise) > STEEPEST * state.base_run + SURE:
        state.steep_height, state.steep_run = fix, 0.0
        held = state.base_held + state.base_run
        state.steep_held = 1.0 if held < LONGEST_HELD and abs(rise) <= SUSTAINED * held + SURE else 0.0
        return STEEP, 0.0
    state.steep_height = nan
    if outcome != ROAD or state.base_run >= BASE:
        state.base_height, state.base_run, state.base_held = fix, 0.0, state.held_run
    return outcome, rise


@njit(cache=False)
def check_slope(state: Any, row: Any, dt: float) -> None:
    """Reject the fix of a row to which no road leads; shift the elevation to a new level."""
    state.base_run += row.distance
    state.steep_run += row.distance
    state.held_run += row.distance
    if isnan(row.raw_elevation):
        return
    change = row.raw_elevation - state.held_height
    if dt > SILENCE and abs(change) > STEEPEST * row.distance + SURE:
        outcome, rise = NEW_LEVEL, change
        state.base_height = state.held_height = row.raw_elevation
        state.base_run = state.base_held = state.held_run = 0.0
        state.steep_height = nan
    else:
        outcome, rise = weigh_slope(state, row.raw_elevation)
    if outcome in (STEEP, STILL_STEEP):
        row.raw_elevation = nan
        row.quality = float(int(row.quality) | SLOPE_REJECTED)
    elif outcome == NEW_LEVEL and isnan(state.offset_variance):
        state.elevation += rise
        state.level += rise


@njit(cache=False)
def update_climb(state: Any, elevation: float, spread: float, distance: float, settings: Any) -> float:
    """Return the climb of the step after smoothing and backlash, negative downhill. [m]"""
    if isnan(elevation):
        return 0.0
    if isnan(state.elevation):
        state.elevation = state.level = elevation
        return 0.0
    if distance > 0.0:
        state.elevation += distance / (settings.elevation_length * spread + distance) * (elevation - state.elevation)
    above = state.elevation - state.level
    slack = settings.elevation_slack * spread
    risen = max(0.0, above - slack) + min(0.0, above + slack)
    state.level += risen
    return risen
