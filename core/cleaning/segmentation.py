"""Where rides and windows begin and end, and when a forecast is due, causally.

Where a logger names its rides, these names are used, from the first name on. Otherwise a ride begins when the car
moves, and ends when the car has stood for `stop_time` or charges. The last `stop_time` of standing is part of the ride,
both in what is measured and in what is predicted.

Every ride also ends when the car has been silent for longer than `gap_time`, and when dispatch sends its `end`. After
an `end`, the samples that still name the ride are outside rides. Without names, the next ride begins once the car has
stood, or dispatch has sent a `start`.

A window closes at the first sample at which it is at least `window_time` long and its measured energy is known. That
is any sample where voltage and current are measured, otherwise one at which the quantised state of charge has changed.
"""

from math import isnan, nan
from typing import Any, Final

import numpy as np

from socast.core.batch import NO_RIDE
from socast.core.compiled_cache import njit

FIELDS: Final = (
    "rides",  # number of rides begun so far
    "riding",  # 1 during a ride
    "code",  # code of the ride's name, NO_RIDE where it has none
    "names",  # 1 once the logger has named a ride
    "ended",  # code of the ride that dispatch has ended while the car reports it, NO_RIDE for none
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

NAMELESS: Final = -2.0
"""Code in `ended` of a ride without a name."""
UNKNOWN_NAME: Final = -3.0
"""Code of a ride that dispatch names, and no car so far."""
RIDE_EVENT: Final = np.dtype(
    [
        ("row", "i8"),  # number of rows of the batch before it
        ("lane", "i8"),
        ("place", "i8"),  # place among the messages of the batch
        ("code", "f8"),  # code of the ride's name, `UNKNOWN_NAME` without one
        ("time", "f8"),  # when the ride begins or ends [s]
        ("ends", "f8"),  # 1 for an `end`, 0 for a `start`, 2 where the fleet shows that the car is silent
    ]
)
"""A `start` or `end` of a ride, from dispatch, or its end by silence."""
SILENCE: Final = (0.0, 0.0, 2.0)
"""Code, time and `ends` of an end by silence, for a cleaner that does not clean all cars of the fleet."""
NO_RIDE_EVENTS: Final = np.empty(0, RIDE_EVENT)
"""No message of dispatch."""
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
def take_ride_event(state: Any, event: Any) -> bool:
    """Take a `start` or `end` of a ride from dispatch; return whether it ends the ride in progress.

    A ride without a name is ended by an `end` that is later than its beginning.
    """
    if event.ends == 0.0:
        if state.ended in (event.code, NAMELESS):
            state.ended = NO_RIDE
        return False
    if state.riding == 0.0:
        return False
    if event.ends == 2.0:
        finish_ride(state, 0.0)
        return True
    nameless = state.code == NO_RIDE
    is_other = event.time < state.time - state.elapsed if nameless else event.code != state.code
    if is_other:
        return False
    state.ended = NAMELESS if nameless else state.code
    finish_ride(state, 0.0)
    return True


@njit(cache=False)
def follow_ride_name(state: Any, code: float, dt: float, settings: Any) -> bool:
    """Follow the ride that the logger names; return whether a ride begins."""
    state.names = 1.0
    has_ended = code == state.ended
    if code == NO_RIDE or has_ended:
        state.ended = code
        finish_ride(state, dt)
        return False
    state.ended = NO_RIDE
    if state.riding == 1.0 and code == state.code and dt <= settings.gap_time:
        return False
    finish_ride(state, dt)
    start_ride(state, code)
    return True


@njit(cache=False)
def segment_by_motion(state: Any, dt: float, moving: bool, charging: bool, settings: Any) -> bool:
    """End rides at stops, charging and gaps; return whether a ride begins."""
    state.stand = 0.0 if moving else state.stand + dt
    if not moving:
        state.ended = NO_RIDE
    if state.riding == 1.0 and (charging or dt > settings.gap_time or state.stand >= settings.stop_time):
        finish_ride(state, dt)
    if state.riding == 1.0 or charging or not moving or state.ended == NAMELESS:
        return False
    start_ride(state, NO_RIDE)
    return True


@njit(cache=False)
def update_ride(state: Any, code: float, dt: float, moving: bool, charging: bool, settings: Any) -> bool:
    """Return whether a ride begins with this sample, and advance the clocks of ride and idle period."""
    state.idle += dt
    state.since_charge = 0.0 if charging else state.since_charge + dt
    state.elapsed += dt
    if code != NO_RIDE or state.names == 1.0:
        return follow_ride_name(state, code, dt, settings)
    return segment_by_motion(state, dt, moving, charging, settings)


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


UNKNOWN_AT_FIRST: Final = {
    **dict.fromkeys(("idle", "since_charge", "parked", "forecast_soc"), nan),
    **dict.fromkeys(("code", "ended"), NO_RIDE),
}
"""Fields of a new lane that are not zero."""
