"""Whether the car stands: by its speed, and not by a receiver that is blind or by fixes that have gone elsewhere."""

from math import isnan, nan
from typing import Any, Final

from socast.core.cleaning import motion
from socast.core.cleaning.sphere import find_way
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "lost_at_speed",  # 1 where the last fix came at speed, and no speed has been reported since
    "blind",  # 1 where a standstill is that of a receiver in a tunnel
    "stood",  # time for which the car has stood [s]
    "stood_latitude",  # fix at which that began [rad], NaN without one
    "stood_longitude",
)
UNKNOWN_AT_FIRST: Final = ("stood_latitude", "stood_longitude")
"""Fields of a new lane that are NaN."""

LOST_SPEED: Final = 8.0
"""Speed at which no car is about to park. [m/s]"""
DRIVING_POWER: Final = 10_000.0
"""Power that a car takes only while it drives; heaters take 7 kW at most. [W]"""
ELSEWHERE: Final = 150.0
"""Distance of a fix from that at which the car stopped by which it does not stand; parked receivers drift less. [m]"""


@njit(cache=False)
def is_blind(state: Any, row: Any) -> bool:
    """Return whether a standstill is that of a receiver in a tunnel, and not of the car.

    Either fix and speed were lost at once, at speed, and the fix is missing or held since; or it is missing, and the
    car takes power as only a driving car does.
    """
    is_missing = isnan(row.raw_latitude)
    is_held = row.raw_latitude == state.fix_latitude and row.raw_longitude == state.fix_longitude
    if row.raw_speed > motion.CRAWL or not (is_missing or is_held):
        speed = state.smooth if isnan(row.raw_speed) else row.raw_speed
        state.lost_at_speed = 1.0 if speed > LOST_SPEED and not (is_missing or is_held) else 0.0
        return False
    drives = is_missing and state.has_fix == 1.0 and row.raw_voltage * row.raw_current > DRIVING_POWER
    return bool(state.lost_at_speed == 1.0 or drives)


@njit(cache=False)
def observe_stand(state: Any, row: Any, dt: float, settings: Any) -> None:
    """Count the time for which the car stands; it has not stood if it is elsewhere by its fixes."""
    if dt > settings.gap_time:
        state.stood_latitude = nan
    stood = not isnan(state.stood_latitude)
    left = stood and find_way(state.stood_latitude, state.stood_longitude, row) > ELSEWHERE
    if left and state.riding == 1.0:
        state.blind = 1.0
    if left or state.standing == 0.0 or state.blind == 1.0:
        state.stood, state.stood_latitude = 0.0, nan
        return
    state.stood += dt
    if isnan(state.stood_latitude):
        state.stood_latitude, state.stood_longitude = row.raw_latitude, row.raw_longitude


@njit(cache=False)
def begins_stop(state: Any) -> bool:
    """Return whether a stop begins with this sample, with hysteresis between two speeds."""
    if state.smooth > motion.MOVING or state.leap > motion.MOVING:  # a start that is held back has begun
        state.standing = 0.0
    elif state.smooth < motion.CRAWL and state.standing == 0.0:
        state.standing = 1.0
        return True
    return False
