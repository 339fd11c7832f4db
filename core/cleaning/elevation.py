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

The elevation is smoothed over distance, so that a standing car climbs nothing. It then passes a backlash (a play
operator, Brokate and Sprekels, Hysteresis and Phase Transitions, Springer 1996, DOI 10.1007/978-1-4612-4048-8), so that
noise of a few metres makes no hills. Smoothing length L and slack suit fixes alone; they are reduced in proportion to
the standard deviation of the elevation, as the steady gain of a Kalman filter of a random walk asks (Muth, JASA 55
(1960) 299, DOI 10.1080/01621459.1960.10482064). The cost: hills of wavelength l keep 1 / sqrt(1 + (2 pi L / l)^2) of
their height (for L of 80 m, 99 % for 3.6 km and 89 % for 1 km), and each turn of the slope loses at most twice the
slack. The climb that the filter has not passed on when a ride ends is missing from the ride.
"""

from math import isnan, sqrt
from typing import Any, Final

from numba import njit

FIELDS: Final = (
    "elevation",  # smoothed [m]
    "level",  # after the backlash [m]
    "elevation_offset",  # of the car's fixes to the map [m]
    "offset_variance",  # NaN until the car has been on a map [m^2]
)

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
    elevation, spread = combine_elevation(state, row, dt)
    row.climb = update_climb(state, elevation, spread, row.distance, settings)
    row.elevation_fix, row.ground, row.ground_variance = row.raw_elevation, row.map_elevation, row.map_variance


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
