"""Build the status of every vehicle, its newest values, for display."""

from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.forecast.messages import RideSoFar, fill_forecasts
from socast.core.forecast.outlook import OVERTIME
from socast.core.forecast.soc_filter import SHIFT_GAP
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.wire.live_fields import list_live_fields
from socast.core.wire.messages import Forecast


class VehicleStatus(NamedTuple):
    """Hold the newest values of a vehicle, for display.

    Parameters
    ----------
    forecast : The newest forecast, with the ride in progress up to the newest sample.
    vehicle_model : Key of its vehicle model, None where unknown.
    soc_pct : State of charge as the car reports it. [%]
    shadows_kwh : Energy of the ride in progress as each shadow model predicts it. [kWh]
    is_shift_over : Whether the shift is over, see `find_ended_shifts`; the forecast then has no values of its rest.
    """

    forecast: Forecast
    vehicle_model: str | None
    soc_pct: float
    shadows_kwh: tuple[float, ...] = ()
    is_shift_over: bool = False


def find_ended_shifts(time: Floats, silence: Floats, end: Floats, riding: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which shifts are over: those of cars long silent, and of cars between rides past overtime, (n,).

    Units: time [s] of the newest sample, silence [s] since, end [s] by the newest forecast, NaN where unknown.

    Examples
    --------
    >>> find_ended_shifts(np.full(3, 8e4), np.array([0.0, 900.0, 9e3]), np.array([79e3, 79e3, 9e4]), np.zeros(3, bool))
    array([False,  True,  True])
    """
    return (silence > SHIFT_GAP) | (~riding & (time + silence > end + OVERTIME))


def build_statuses(
    running: Totals,
    ride_names: Sequence[str | None],
    context: RunContext,
    predicted: Sequence[Floats],
    newest: NDArray[np.void],
    silence: Floats,
) -> list[VehicleStatus]:
    """Return one status per row of running totals, sorted by the names of the vehicles.

    Units: predicted [kWh], silence [s]; `newest` is (n,) NEWEST_FORECAST.
    """
    cars, ride = context.cars, RideSoFar.create(running, predicted[0], context)
    over = find_ended_shifts(running.at_last("time"), silence, newest["shift_end_s"], ride.is_riding).tolist()
    forecasts = map(_replace_unknown, fill_forecasts(running, newest, ride, ride_names, context), over)
    models = [cars.name(kind) for kind in cars.of_lane[running.lane].tolist()]
    soc = (running.at_last("soc") * 100.0).tolist()
    shadows = np.column_stack([np.where(ride.is_riding, each, np.nan) for each in (running.lane, *predicted[1:])])
    statuses = map(VehicleStatus, forecasts, models, soc, (tuple(row[1:]) for row in shadows.tolist()), over)
    return sorted(statuses, key=lambda status: status.forecast.vehicle_id)


def _replace_unknown(forecast: Forecast, is_over: bool) -> Forecast:
    """Return a forecast with None for its unknown numbers, and for those of a shift that is over."""
    for field in list_live_fields(Forecast):
        value = getattr(forecast, field.name)
        if (is_over and field.display.of_shift) or (isinstance(value, float) and isnan(value)):
            setattr(forecast, field.name, None)
    return forecast
