"""Forecasts from running totals."""

from collections.abc import Sequence
from math import isnan
from typing import Final

import numpy as np

from core.batch import Floats
from core.cars import Cars
from core.codec import Forecast, Message, QualityCounts, encode
from core.models import Model
from core.quality import CAUSES, FORECAST_CAUSES, Quality
from core.sums import Totals
from core.tables import measured_energy, model_columns

_COUNTED: Final = {
    name: [CAUSES.index(flag.name.lower()) for flag in Quality if flag in bits and flag.name]
    for name, bits in FORECAST_CAUSES.items()
}


def known(value: float) -> float | None:
    """Return the value, None for NaN: what is unknown travels as null."""
    return None if isnan(value) else value


def counted(totals: Totals) -> dict[str, list[int]]:
    """Return the counts that a forecast carries, a list over rows each."""
    return {
        name: sum(totals.quality[:, place] for place in places).astype(np.int64).tolist()  # type: ignore[union-attr]
        for name, places in _COUNTED.items()
    }


def energies(
    running: Totals, names: Sequence[str], cars: Cars, model: Model, effects: Sequence[str]
) -> tuple[Floats, Floats]:
    """Return predicted and measured energy of the rides in progress, NaN for a car that is on none. [kWh]"""
    riding = running.ride >= 0
    predicted = model.predict(model_columns(running, cars, effects, model.needs, names))
    return np.where(riding, predicted, np.nan), np.where(riding, measured_energy(running, cars)[0], np.nan)


def forecasts(
    running: Totals,
    names: Sequence[str],
    ride_names: Sequence[str | None],
    cars: Cars,
    model: Model,
    effects: Sequence[str],
    prefix: str,
) -> list[Message]:
    """Return one message a row of running totals, under `{prefix}fleet/{vehicle}/forecast`.

    The time of receipt is the event time of the sample that the forecast rests on. `range_km`, the end of the shift
    and the risk are null: nothing here knows their uncertainty.
    """
    if not len(running.lane):
        return []
    predicted, measured = (energy.tolist() for energy in energies(running, names, cars, model, effects))
    counts = [QualityCounts(*row) for row in zip(*counted(running).values(), strict=True)]
    soc = (running.at_last("soc") * 100.0).tolist()
    soc_sd = (running.at_last("soc_step") * (100.0 / np.sqrt(12.0))).tolist()
    time = running.at_last("time").tolist()
    distance = (running.amount("distance") * 1e-3).tolist()
    duration = running.amount("duration").tolist()
    riding = (running.ride >= 0).tolist()
    version = f"{model.name}/{model.version}"
    out = []
    for i, lane in enumerate(running.lane.tolist()):
        forecast = Forecast(
            vehicle_id=names[lane],
            time_s=time[i],
            ride_id=ride_names[i] if riding[i] else None,
            model=version,
            ride_distance_km=distance[i],
            ride_duration_s=duration[i],
            ride_energy_predicted_kwh=known(predicted[i]),
            ride_energy_measured_kwh=known(measured[i]),
            soc_pct=known(soc[i]),
            soc_sd_pct=known(soc_sd[i]),
            range_km=None,
            soc_end_of_shift_pct=None,
            reserve_risk=None,
            quality=counts[i],
        )
        out.append(Message(f"{prefix}fleet/{names[lane]}/forecast", encode(forecast), int(time[i] * 1e9)))
    return out
