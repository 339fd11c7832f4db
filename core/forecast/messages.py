"""Build the published forecasts from rows of running totals."""

from collections import Counter
from collections.abc import Sequence
from itertools import repeat
from math import isnan
from typing import Final

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from socast.core.batch import Floats
from socast.core.cleaning.quality import CAUSES, FORECAST_CAUSES, Quality
from socast.core.forecast.forecast_rows import ForecastRows
from socast.core.forecast.plausibility import find_implausible
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.totals.measured_energy import measure_energy
from socast.core.wire.messages import Forecast, Interval, Message, NextCharge, QualityCounts

_COUNTED: Final = {
    name: [CAUSES.index(flag.name.lower()) for flag in Quality if flag in bits and flag.name]
    for name, bits in FORECAST_CAUSES.items()
}


def none_if_nan(value: float) -> float | None:
    """Return the value, None for NaN: unknown values are published as null."""
    return None if isnan(value) else value


def count_quality(totals: Totals) -> dict[str, list[int]]:
    """Return the quality counts of a forecast, by name; each is a list over the rows of the totals."""
    return {
        name: sum(totals.quality[:, place] for place in places).astype(np.int64).tolist()  # type: ignore[union-attr]
        for name, places in _COUNTED.items()
    }


def build_forecasts(
    running: Totals,
    rows: ForecastRows,
    ride_names: Sequence[str | None],
    context: RunContext,
    prefix: str,
    implausible: Counter[str],
) -> list[Message]:
    """Return one message per row of running totals that is plausible, under `{prefix}fleet/{vehicle}/forecast`.

    The receipt time is the event time of the sample behind the forecast. Outside of rides there is no energy, and
    unknown values are null.
    """
    names = context.vehicle_ids
    riding = running.ride >= 0
    predicted = np.where(riding, rows.predicted, np.nan)
    measured = np.where(riding, measure_energy(running, context.cars).energy, np.nan)
    withheld = find_implausible(running, rows, predicted, measured, context.cars)
    implausible.update(cause for cause in withheld if cause)
    soc_end = _list_intervals(100.0 * rows.end_soc, 100.0 * rows.end_soc_p05, 100.0 * rows.end_soc_p95)
    lanes, time = running.lane.tolist(), running.at_last("time").tolist()
    vehicle_ids = [names[lane] for lane in lanes]
    forecasts = map(
        Forecast,  # its fields in their order; NaN is encoded as null
        vehicle_ids,
        time,
        [name if is_riding else None for name, is_riding in zip(ride_names, riding.tolist(), strict=True)],
        repeat(context.model_label),
        np.where(riding, running.amount("distance") * 1e-3, 0.0).tolist(),
        np.where(riding, running.amount("duration"), 0.0).tolist(),
        predicted.tolist(),
        measured.tolist(),
        (100.0 * rows.soc).tolist(),
        (100.0 * rows.soc_sd).tolist(),
        _list_intervals(rows.range_km, rows.range_km_p05, rows.range_km_p95),
        soc_end,
        rows.risk.tolist(),
        map(QualityCounts, *count_quality(running).values()),
        _list_charges(rows),
        rows.end.tolist(),
    )
    encode = msgspec.json.Encoder().encode
    new = tuple.__new__  # half the time of Message()
    return [
        new(Message, (f"{prefix}fleet/{vehicle_id}/forecast", encode(forecast), int(time_s * 1e9)))
        for vehicle_id, time_s, forecast, cause in zip(vehicle_ids, time, forecasts, withheld, strict=True)
        if cause is None
    ]


def _list_charges(rows: ForecastRows) -> list[NextCharge | UnsetType]:
    """Return the forecasts of the next planned charges, UNSET where none is ahead."""
    if np.isnan(rows.charge_soc).all():
        return [UNSET] * len(rows.charge_soc)
    intervals = _list_intervals(100.0 * rows.charge_soc, 100.0 * rows.charge_soc_p05, 100.0 * rows.charge_soc_p95)
    parts = zip(rows.charge_time.tolist(), intervals, rows.charge_risk.tolist(), strict=True)
    return [UNSET if soc is None else NextCharge(when, soc, none_if_nan(risk)) for when, soc, risk in parts]


def _list_intervals(mean: Floats, low: Floats, high: Floats) -> list[Interval | None]:
    """Return intervals, None where the quantity is unknown."""
    unknown = np.isnan(mean) | np.isnan(low) | np.isnan(high)
    if unknown.all():
        return [None] * len(mean)
    intervals: list[Interval | None] = list(map(Interval, mean.tolist(), low.tolist(), high.tolist()))
    for at in np.flatnonzero(unknown).tolist():
        intervals[at] = None
    return intervals
