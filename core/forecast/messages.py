"""Forecasts from running totals."""

from collections.abc import Sequence
from math import isnan
from typing import Final

import numpy as np

from core.batch import Floats
from core.cleaning.quality import CAUSES, FORECAST_CAUSES, Quality
from core.forecast.engine import Rows
from core.totals.accumulator import Totals
from core.totals.context import RunContext
from core.totals.tables import measured_energy
from core.wire.messages import Forecast, Interval, Message, QualityCounts, encode

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


def forecasts(
    running: Totals,
    rows: Rows,
    ride_names: Sequence[str | None],
    context: RunContext,
    prefix: str,
) -> list[Message]:
    """Return one message a row of running totals, under `{prefix}fleet/{vehicle}/forecast`.

    The time of receipt is the event time of the sample that the forecast rests on. Outside of rides there is no energy,
    and what nobody knows yet is null.
    """
    names, version = context.vehicle_ids, context.model_label
    riding = running.ride >= 0
    predicted = np.where(riding, rows.predicted, np.nan).tolist()
    measured = np.where(riding, measured_energy(running, context.cars)[0], np.nan).tolist()
    counts = [QualityCounts(*row) for row in zip(*counted(running).values(), strict=True)]
    told = (("soc", 100.0), ("soc_sd", 100.0), ("risk", 1.0))
    soc, soc_sd, risk = ((scale * rows.at(name)).tolist() for name, scale in told)
    reach = _intervals(*(rows.at(name) for name in ("range", "range_p05", "range_p95")))
    end = _intervals(*(100.0 * rows.at(name) for name in ("mean", "p05", "p95")))
    time = running.at_last("time").tolist()
    distance = np.where(riding, running.amount("distance") * 1e-3, 0.0).tolist()
    duration = np.where(riding, running.amount("duration"), 0.0).tolist()
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
            range_km=reach[i],
            soc_end_of_shift_pct=end[i],
            reserve_risk=known(risk[i]),
            quality=counts[i],
        )
        out.append(Message(f"{prefix}fleet/{names[lane]}/forecast", encode(forecast), int(time[i] * 1e9)))
    return out


def _intervals(mean: Floats, low: Floats, high: Floats) -> list[Interval | None]:
    """Return intervals, None where the quantity is not known."""
    rows = zip(mean.tolist(), low.tolist(), high.tolist(), strict=True)
    return [None if isnan(m) or isnan(a) or isnan(b) else Interval(m, a, b) for m, a, b in rows]
