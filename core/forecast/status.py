"""Build the status of every vehicle, its newest values, for display."""

from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.forecast.messages import RideSoFar, fill_forecasts
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.wire.live_fields import list_live_fields
from socast.core.wire.messages import Forecast


class VehicleStatus(NamedTuple):
    """Hold the newest values of a vehicle, for display.

    Parameters
    ----------
    forecast : Forecast
        The newest forecast, with the ride in progress up to the newest sample.
    vehicle_model : str or None
        Key of its vehicle model, None where unknown.
    soc_pct : float
        State of charge as the car reports it. [%]
    shadows_kwh : tuple of float
        Energy of the ride in progress as each shadow model predicts it. [kWh]
    """

    forecast: Forecast
    vehicle_model: str | None
    soc_pct: float
    shadows_kwh: tuple[float, ...] = ()


def build_statuses(
    running: Totals,
    ride_names: Sequence[str | None],
    context: RunContext,
    predicted: Sequence[Floats],
    newest: NDArray[np.void],
) -> list[VehicleStatus]:
    """Return one status per row of running totals, sorted by the names of the vehicles.

    Units: predicted [kWh].

    Parameters
    ----------
    newest : (n,) NEWEST_FORECAST
    """
    cars, ride = context.cars, RideSoFar.create(running, predicted[0], context)
    columns = {name: newest[name] for name in newest.dtype.names or ()}
    forecasts = map(_replace_nan, fill_forecasts(running, columns, ride, ride_names, context))
    models = [cars.name(kind) for kind in cars.of_lane[running.lane].tolist()]
    soc = (running.at_last("soc") * 100.0).tolist()
    shadows = np.column_stack([np.where(ride.is_riding, each, np.nan) for each in (running.lane, *predicted[1:])])
    statuses = map(VehicleStatus, forecasts, models, soc, (tuple(row[1:]) for row in shadows.tolist()))
    return sorted(statuses, key=lambda status: status.forecast.vehicle_id)


def _replace_nan(forecast: Forecast) -> Forecast:
    """Return a forecast with None for its unknown numbers."""
    for field in list_live_fields(Forecast):
        if isinstance(value := getattr(forecast, field.name), float) and isnan(value):
            setattr(forecast, field.name, None)
    return forecast
