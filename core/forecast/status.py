"""Build the status of every vehicle, its newest values, for display."""

from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.forecast.messages import count_quality, none_if_nan
from socast.core.forecast.outlook import OVERTIME
from socast.core.forecast.soc_filter import SHIFT_GAP
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
        Mean, 5th and 95th percentile of the charge at the end of the shift, None where unknown or over. [%]
    risk : float, optional
        Probability of ending below the reserve, None where unknown, and once the shift is over. [1]
    is_shift_over : bool
        Whether the shift is over, see `find_ended_shifts`.
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
    is_shift_over: bool = False


def find_ended_shifts(time: Floats, silence: Floats, end: Floats, riding: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which shifts are over: those of cars long silent, and of cars between rides past overtime, (n,).

    Parameters
    ----------
    time, silence : (n,) float
        Time of the newest sample, and how long the car has been silent. [s]
    end : (n,) float
        End of the shift as its newest forecast has it, NaN where unknown. [s]

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
    ends: NDArray[np.void],
    silence: Floats,
) -> list[VehicleStatus]:
    """Return one status per row of running totals.

    Units: predicted [kWh], silence [s].
    """
    names, cars = context.vehicle_ids, context.cars
    riding = running.ride >= 0
    by_first, *by_shadows = (np.where(riding, energy, np.nan).tolist() for energy in predicted)
    measured = np.where(riding, measure_energy(running, cars).energy, np.nan).tolist()
    counts = count_quality(running)
    over = find_ended_shifts(running.at_last("time"), silence, ends["time"], riding)
    time, soc = running.at_last("time").tolist(), (running.at_last("soc") * 100.0).tolist()
    distance = np.where(riding, running.amount("distance") * 1e-3, 0.0).tolist()
    ahead = np.where(over, np.array(np.nan), [ends[name] for name in ("mean", "p05", "p95", "risk")])
    mean, low, high, risk = ahead.tolist()
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
            is_shift_over=bool(over[i]),
        )
        for i, lane in enumerate(running.lane.tolist())
    ]
