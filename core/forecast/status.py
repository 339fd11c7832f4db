"""Build the status of every vehicle, its newest values, for display."""

from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.forecast.messages import count_quality, none_if_nan
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.totals.measured_energy import measure_energy


class VehicleStatus(NamedTuple):
    """Hold the newest values of a vehicle, for display.

    Parameters
    ----------
    vehicle_model : str or None
        Key of its vehicle model, None where unknown.
    ride_id : str or None
        Name that the logger gave to the ride in progress, None without one.
    time_s : float
        Unix time of the newest sample. [s]
    soc_pct : float
        State of charge as the car reports it. [%]
    ride_distance_km : float
        Distance of the ride in progress, 0 between rides. [km]
    predicted_kwh, measured_kwh : float
        Energy of the ride in progress, NaN where unknown. [kWh]
    quality : dict of str to int
        Number of samples of the ride in progress by quality cause.
    shadows_kwh : tuple of float
        Energy of the ride in progress as each shadow model predicts it. [kWh]
    end_pct : tuple of (float, float, float), optional
        Mean, 5th and 95th percentile of the charge at the end of the shift, None where unknown. [%]
    risk : float, optional
        Probability of ending below the reserve, None where unknown. [1]
    """

    vehicle_id: str
    vehicle_model: str | None
    ride_id: str | None
    time_s: float
    soc_pct: float
    ride_distance_km: float
    predicted_kwh: float
    measured_kwh: float
    quality: dict[str, int]
    shadows_kwh: tuple[float, ...] = ()
    end_pct: tuple[float, float, float] | None = None
    risk: float | None = None


def build_statuses(
    running: Totals,
    ride_names: Sequence[str | None],
    context: RunContext,
    predicted: Sequence[Floats],
    ends: NDArray[np.void],
) -> list[VehicleStatus]:
    """Return one status per row of running totals.

    Units: predicted [kWh].
    """
    names, cars = context.vehicle_ids, context.cars
    riding = running.ride >= 0
    by_first, *by_shadows = (np.where(riding, energy, np.nan).tolist() for energy in predicted)
    measured = np.where(riding, measure_energy(running, cars).energy, np.nan).tolist()
    counts = count_quality(running)
    time, soc = running.at_last("time").tolist(), (running.at_last("soc") * 100.0).tolist()
    distance = np.where(riding, running.amount("distance") * 1e-3, 0.0).tolist()
    mean, low, high, risk = (ends[name].tolist() for name in ("mean", "p05", "p95", "risk"))
    return [
        VehicleStatus(
            vehicle_id=names[lane],
            vehicle_model=cars.name(int(cars.of_lane[lane])),
            ride_id=ride_names[i],
            time_s=time[i],
            soc_pct=soc[i],
            ride_distance_km=distance[i],
            predicted_kwh=by_first[i],
            measured_kwh=measured[i],
            quality={cause: values[i] for cause, values in counts.items()},
            shadows_kwh=tuple(shadow[i] for shadow in by_shadows),
            end_pct=None if isnan(low[i]) else (100.0 * mean[i], 100.0 * low[i], 100.0 * high[i]),
            risk=none_if_nan(risk[i]),
        )
        for i, lane in enumerate(running.lane.tolist())
    ]
