"""Where rides begin and end, and the windows inside them, causally.

A logger that names its rides is believed. For one that never does, a ride begins when the car moves and ends when it
has stood for `stop_time`, charges, or has been silent for `gap_time`; its last `stop_time` of standing is part of it,
in what is measured and in what is predicted alike.

A window is closed by the first sample at which it is at least `window_time` long and the measured energy is known:
at any sample where voltage and current are measured, else where the quantised state of charge has just changed.
"""

from math import isnan, nan
from typing import Any, Final

from numba import njit

from core.batch import NO_RIDE, RIDE_UNKNOWN

FIELDS: Final = (
    "rides",  # rides begun so far
    "riding",
    "code",  # of the ride's name, NO_RIDE where it has none
    "names",  # 1 once the logger has spoken of rides
    "elapsed",  # since the ride began [s]
    "idle",  # since the last ride ended [s]
    "parked",  # before this ride [s]
    "since_charge",  # [s]
    "stand",  # standing time so far [s]
    "windows",  # windows begun so far
    "window_age",
    "window_full",
    "since_forecast",  # [s]
    "forecast_soc",
)

MATERIAL_SOC: Final = 0.01  # a change of the state of charge that is worth a forecast at once
PARKED_RARER: Final = 4.0  # a parked car is reported this much more rarely


@njit(cache=False)
def start(s: Any, code: float) -> None:
    """Begin a ride."""
    s.rides += 1.0
    s.riding = 1.0
    s.code = code
    s.elapsed = 0.0
    s.parked = s.idle
    s.stand = 0.0
    s.windows += 1.0
    s.window_age = s.window_full = 0.0


@njit(cache=False)
def finish(s: Any, dt: float) -> None:
    """End the ride in progress, if there is one; the step since its last sample is rest."""
    if s.riding == 1.0:
        s.riding = 0.0
        s.idle = dt
        s.code = NO_RIDE


@njit(cache=False)
def by_name(s: Any, code: float, dt: float) -> bool:
    """Follow the ride that the logger names; return whether one begins."""
    s.names = 1.0
    if code == NO_RIDE:
        finish(s, dt)
        return False
    if s.riding == 1.0 and code == s.code:
        return False
    finish(s, dt)
    start(s, code)
    return True


@njit(cache=False)
def by_motion(s: Any, dt: float, moving: bool, charging: bool, x: Any) -> bool:
    """Cut rides at stops, charging and gaps; return whether one begins."""
    s.stand = 0.0 if moving else s.stand + dt
    if s.riding == 1.0 and (charging or dt > x.gap_time or s.stand >= x.stop_time):
        finish(s, dt)
    if s.riding == 1.0 or charging or not moving:
        return False
    start(s, NO_RIDE)
    return True


@njit(cache=False)
def segment(s: Any, code: float, dt: float, moving: bool, charging: bool, x: Any) -> bool:
    """Say whether a ride begins with this sample, and keep the clocks of ride and rest."""
    s.idle += dt
    s.since_charge = 0.0 if charging else s.since_charge + dt
    s.elapsed += dt
    if code != RIDE_UNKNOWN:
        return by_name(s, code, dt)
    return False if s.names == 1.0 else by_motion(s, dt, moving, charging, x)


@njit(cache=False)
def window(s: Any, dt: float, begins: bool, closable: bool, x: Any) -> None:
    """Open the next window where the last one is full."""
    if begins:
        return
    if s.window_full == 1.0:
        s.windows += 1.0
        s.window_age = s.window_full = 0.0
    s.window_age += dt
    if s.window_age >= x.window_time and closable:
        s.window_full = 1.0


@njit(cache=False)
def forecast_due(s: Any, soc: float, dt: float, begins: bool, x: Any) -> bool:
    """Say whether this sample calls for a forecast, by event time and by what is material."""
    s.since_forecast += dt
    wait = x.forecast_time if s.riding == 1.0 else PARKED_RARER * x.forecast_time
    moved = abs(soc - s.forecast_soc) >= MATERIAL_SOC or (isnan(s.forecast_soc) and not isnan(soc))
    if not (begins or moved or s.since_forecast >= wait):
        return False
    s.since_forecast = 0.0
    s.forecast_soc = soc
    return True


UNKNOWN_AT_FIRST: Final = {"idle": nan, "since_charge": nan, "parked": nan, "forecast_soc": nan, "code": NO_RIDE}
"""State that does not begin at zero."""
