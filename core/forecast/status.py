"""The newest of every vehicle, for a screen."""

from collections.abc import Sequence
from math import isnan
from typing import NamedTuple

import numpy as np

from core.batch import Floats
from core.forecast.messages import counted, known
from core.totals.accumulator import Totals
from core.totals.context import RunContext
from core.totals.tables import measured_energy


class VehicleStatus(NamedTuple):
    """The newest of a vehicle, for a screen.

    `shadows_kwh` is what each shadow predicts of the ride in progress; `end_pct` mean, 5th and 95th percentile of the
    charge at the shift's end [%], and `risk` that of ending below the reserve [1]; None where they are not known.
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


def statuses(
    running: Totals,
    ride_names: Sequence[str | None],
    context: RunContext,
    predicted: Sequence[Floats],
    ends: Floats,
) -> list[VehicleStatus]:
    """Return one status a row of running totals.

    Parameters
    ----------
    running : Totals
        Of n rides in progress.
    ride_names : sequence of n (str or None)
    context : RunContext
    predicted : sequence of (n,) float
        By each model, the first first. [kWh]
    ends : (n, 4) float
        Charge at the shift's end: mean, 5th and 95th percentile; and the risk of ending below the reserve. [1]
    """
    names, cars = context.vehicle_ids, context.cars
    riding = running.ride >= 0
    own, *shadows = (np.where(riding, energy, np.nan).tolist() for energy in predicted)
    measured = np.where(riding, measured_energy(running, cars)[0], np.nan).tolist()
    counts = counted(running)
    time, soc = running.at_last("time").tolist(), (running.at_last("soc") * 100.0).tolist()
    distance = np.where(riding, running.amount("distance") * 1e-3, 0.0).tolist()
    mean, low, high, risk = ends.T.tolist()
    return [
        VehicleStatus(
            names[lane],
            cars.name(int(cars.of_lane[lane])),
            ride_names[i],
            time[i],
            soc[i],
            distance[i],
            own[i],
            measured[i],
            {cause: values[i] for cause, values in counts.items()},
            tuple(shadow[i] for shadow in shadows),
            None if isnan(low[i]) else (100.0 * mean[i], 100.0 * low[i], 100.0 * high[i]),
            known(risk[i]),
        )
        for i, lane in enumerate(running.lane.tolist())
    ]
