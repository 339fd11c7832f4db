"""Follow when a car charges within its shift: the charge on arrival, and the charge with which it departs.

A charge is one from the first report that the car charges until it has driven on, however often the report is
interrupted. Of a car that is silent while it charges, the charge begins when it falls silent, and is known by a reading
that has risen.
"""

from math import isnan, nan
from typing import Any, Final

from numba import njit

SHORTEST_CHARGE: Final = 60.0
"""A shorter charging is ignored. [s]"""
DEPARTURE_DISTANCE: Final = 300.0
"""Distance from which the consumption of a shift counts, and by which a car departs after a charge. [m]"""
LEAST_RISE: Final = 0.03
"""Rise of the reading over a silence from which the car has charged meanwhile. [1]"""


@njit(cache=False)
def forget_charges(state: Any) -> None:
    """Forget the charges of the shift before."""
    state.connected = state.arrived = state.arrival_soc = nan
    state.unplugged = state.unplugged_distance = state.charged_soc = nan


@njit(cache=False)
def update_charge_stop(state: Any, event: Any, was_charging: float, silent: bool, passed: float) -> None:
    """Update when the car came to charge and left, before the reading of an event applies."""
    departed = state.distance - state.unplugged_distance > DEPARTURE_DISTANCE
    before = event.time - passed if silent else event.time
    charged = event.time - event.since_charge  # the last time, NaN for never
    if state.charging == 1.0 and was_charging == 0.0 and (isnan(state.unplugged) or departed):
        state.connected = before
    if state.charging == 1.0 or was_charging == 1.0:
        confirm_charge(state, charged)
    if state.charging == 0.0 and was_charging == 1.0:
        end_charge(state, event.time)
    if state.charging == 0.0 and silent and event.soc - state.last_soc > LEAST_RISE:
        state.connected = before
        confirm_charge(state, event.time)
        end_charge(state, event.time)
    if not isnan(state.unplugged) and not departed and not isnan(event.soc):
        state.charged_soc = event.soc


@njit(cache=False)
def confirm_charge(state: Any, time: float) -> None:
    """Record the present charge once it has lasted; an interrupted one continues."""
    if state.distance > DEPARTURE_DISTANCE and time - state.connected >= SHORTEST_CHARGE:
        if state.arrived != state.connected:
            state.arrived, state.arrival_soc, state.charged_soc = state.connected, state.last_soc, nan
        state.unplugged = state.unplugged_distance = nan


@njit(cache=False)
def end_charge(state: Any, time: float) -> None:
    """Record the end of the present charge, if it has lasted."""
    if state.arrived == state.connected:
        state.unplugged, state.unplugged_distance = time, state.distance
