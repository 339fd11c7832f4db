"""Where rides and windows begin and end, and when a forecast is due, causally.

Where a logger names its rides, these names are used. Otherwise a ride begins when the car moves. It ends when the car
has stood for `stop_time`, charges, or has been silent for `gap_time`. The last `stop_time` of standing is part of the
ride, both in what is measured and in what is predicted.

A window closes at the first sample at which it is at least `window_time` long and its measured energy is known. That
is any sample where voltage and current are measured, otherwise one at which the quantised state of charge has changed.
"""

from math import isnan, nan
from typing import Any, Final

from numba import njit

from core.batch import NO_RIDE, RIDE_UNKNOWN

FIELDS: Final = (
    "rides",  # number of rides begun so far
    "riding",  # 1 during a ride
    "code",  # code of the ride's name, NO_RIDE where it has none
    "names",  # 1 once the logger has sent a ride name or null
    "elapsed",  # time since the ride began [s]
    "idle",  # time since the last ride ended [s]
    "parked",  # time between the last ride and this one [s]
    "since_charge",  # time since the car last charged [s]
    "stand",  # time for which the car has stood [s]
    "windows",  # number of windows begun so far
    "window_age",  # duration of the open window [s]
    "window_full",  # 1 once the open window may close
    "since_forecast",  # time since a forecast was due [s]
    "forecast_soc",  # state of charge then [1]
)

MATERIAL_SOC: Final = 0.01
"""Change of the state of charge at which a forecast is due at once. [1]"""
PARKED_FACTOR: Final = 4.0
"""Ratio of the time between two forecasts of a parked car to that of a car on a ride. [1]"""


@njit(cache=False)
def start_ride(state: Any, code: float) -> None:
    """Begin a ride."""
    state.rides += 1.0
    state.riding = 1.0
    state.code = code
    state.elapsed = 0.0
    state.parked = state.idle
    state.stand = 0.0
    state.windows += 1.0
    state.window_age = state.window_full = 0.0


@njit(cache=False)
def finish_ride(state: Any, dt: float) -> None:
    """End the ride in progress, if there is one; the step since its last sample is idle time."""
    if state.riding == 1.0:
        state.riding = 0.0
        state.idle = dt
        state.code = NO_RIDE


@njit(cache=False)
def follow_ride_name(state: Any, code: float, dt: float) -> bool:
    """Follow the ride that the logger names; return whether a ride begins."""
    state.names = 1.0
    if code == NO_RIDE:
        finish_ride(state, dt)
        return False
    if state.riding == 1.0 and code == state.code:
        return False
    finish_ride(state, dt)
    start_ride(state, code)
    return True


@njit(cache=False)
def segment_by_motion(state: Any, dt: float, moving: bool, charging: bool, settings: Any) -> bool:
    """End rides at stops, charging and gaps; return whether a ride begins."""
    state.stand = 0.0 if moving else state.stand + dt
    if state.riding == 1.0 and (charging or dt > settings.gap_time or state.stand >= settings.stop_time):
        finish_ride(state, dt)
    if state.riding == 1.0 or charging or not moving:
        return False
    start_ride(state, NO_RIDE)
    return True


@njit(cache=False)
def update_ride(state: Any, code: float, dt: float, moving: bool, charging: bool, settings: Any) -> bool:
    """Return whether a ride begins with this sample, and advance the clocks of ride and idle period."""
    state.idle += dt
    state.since_charge = 0.0 if charging else state.since_charge + dt
    state.elapsed += dt
    if code != RIDE_UNKNOWN:
        return follow_ride_name(state, code, dt)
    return False if state.names == 1.0 else segment_by_motion(state, dt, moving, charging, settings)


@njit(cache=False)
def update_window(state: Any, dt: float, begins: bool, closable: bool, settings: Any) -> None:
    """Extend the open window by a step, and open the next one if it is full."""
    if begins:
        return
    if state.window_full == 1.0:
        state.windows += 1.0
        state.window_age = state.window_full = 0.0
    state.window_age += dt
    if state.window_age >= settings.window_time and closable:
        state.window_full = 1.0


@njit(cache=False)
def is_forecast_due(state: Any, soc: float, dt: float, begins: bool, settings: Any) -> bool:
    """Return whether a forecast is due: a ride begins, the charge has changed, or enough event time has passed."""
    state.since_forecast += dt
    wait = settings.forecast_time if state.riding == 1.0 else PARKED_FACTOR * settings.forecast_time
    moved = abs(soc - state.forecast_soc) >= MATERIAL_SOC or (isnan(state.forecast_soc) and not isnan(soc))
    if not (begins or moved or state.since_forecast >= wait):
        return False
    state.since_forecast = 0.0
    state.forecast_soc = soc
    return True


UNKNOWN_AT_FIRST: Final = {"idle": nan, "since_charge": nan, "parked": nan, "forecast_soc": nan, "code": NO_RIDE}
"""Fields of a new lane that are not zero."""
