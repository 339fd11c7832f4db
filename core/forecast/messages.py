"""Build the published forecasts from rows of running totals."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import repeat
from math import isfinite
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.cleaning.quality import CAUSES, FORECAST_CAUSES, Quality
from socast.core.forecast.forecast_rows import PUBLISHED, Rows
from socast.core.forecast.plausibility import find_implausible
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.totals.measured_energy import measure_energy
from socast.core.wire.live_fields import list_interval_columns
from socast.core.wire.messages import Forecast, Interval, Message, NextCharge, QualityCounts

_COUNTED: Final = [
    [CAUSES.index(flag.name.lower()) for flag in Quality if flag in bits and flag.name]
    for bits in FORECAST_CAUSES.values()
]
"""Columns of the quality counts that each quality count of a forecast adds up."""


def none_if_unknown(value: float) -> float | None:
    """Return a number, None where it is not finite: unknown values are published as null."""
    return value if isfinite(value) else None


def build_forecasts(
    running: Totals,
    rows: Rows,
    ride_names: Sequence[str | None],
    context: RunContext,
    prefix: str,
    implausible: Counter[str],
) -> list[Message]:
    """Return one message per row of running totals that is plausible, under `{prefix}fleet/{vehicle}/forecast`.

    The receipt time is the event time of the sample behind the forecast.
    """
    ride = RideSoFar.create(running, rows["predicted"], context)
    withheld = find_implausible(running, rows, ride.predicted, ride.measured, context.cars)
    implausible.update(cause for cause in withheld if cause)
    forecasts = fill_forecasts(running, rows, ride, ride_names, context)
    encode = msgspec.json.Encoder().encode
    new = tuple.__new__  # half the time of Message()
    return [
        new(Message, (f"{prefix}fleet/{each.vehicle_id}/forecast", encode(each), int(each.time_s * 1e9)))
        for each, cause in zip(forecasts, withheld, strict=True)
        if cause is None
    ]


class RideSoFar(NamedTuple):
    """Hold the rides in progress of n cars, (n,) each: whether there is one, and its energies, else NaN. [kWh]"""

    is_riding: NDArray[np.bool_]
    predicted: Floats
    measured: Floats

    @classmethod
    def create(cls, running: Totals, predicted: Floats, context: RunContext) -> "RideSoFar":
        """Return the rides at running totals with their predicted energy, which is unknown outside of rides."""
        riding = running.ride >= 0
        measured = measure_energy(running, context.cars).energy
        return cls(riding, np.where(riding, predicted, np.nan), np.where(riding, measured, np.nan))


def fill_forecasts(
    running: Totals,
    columns: NDArray[np.void],
    ride: RideSoFar,
    ride_names: Sequence[str | None],
    context: RunContext,
) -> Iterator[Forecast]:
    """Return one forecast per row of running totals; NaN stands for an unknown number, and is encoded as null.

    `columns` holds those of `FORECAST_ROW` that are published.
    """
    names, riding = context.vehicle_ids, ride.is_riding
    counts = (running.quality[:, places].sum(axis=1).astype(np.int64).tolist() for places in _COUNTED)
    values: dict[str, Iterable[Any]] = {
        "vehicle_id": [names[lane] for lane in running.lane.tolist()],
        "time_s": running.at_last("time").tolist(),
        "ride_id": [name if is_riding else None for name, is_riding in zip(ride_names, riding.tolist(), strict=True)],
        "model": repeat(context.model_label),
        "ride_distance_km": np.where(riding, running.amount("distance") * 1e-3, 0.0).tolist(),
        "ride_duration_s": np.where(riding, running.amount("duration"), 0.0).tolist(),
        "ride_energy_predicted_kwh": ride.predicted.tolist(),
        "ride_energy_measured_kwh": ride.measured.tolist(),
        "quality": map(QualityCounts, *counts),
        "next_charge": _list_charges(columns),
    }
    for field in PUBLISHED:
        numbers = [field.scale * columns[name] for name in field.columns]
        values[field.name] = list_intervals(*numbers) if len(numbers) > 1 else numbers[0].tolist()
    return map(Forecast, *map(values.__getitem__, Forecast.__struct_fields__))


def _list_charges(columns: NDArray[np.void]) -> list[NextCharge | UnsetType]:
    """Return the forecasts of the next planned charges, UNSET where none is ahead."""
    mean, low, high = (100.0 * columns[name] for name in list_interval_columns("charge_soc"))
    if np.isnan(mean).all():
        return [UNSET] * len(mean)
    times, risks = columns["charge_time"].tolist(), columns["charge_risk"].tolist()
    parts = zip(times, list_intervals(mean, low, high), risks, strict=True)
    return [UNSET if soc is None else NextCharge(when, soc, none_if_unknown(risk)) for when, soc, risk in parts]


def list_intervals(mean: Floats, low: Floats, high: Floats) -> list[Interval | None]:
    """Return intervals, None where the quantity is unknown."""
    unknown = ~(np.isfinite(mean) & np.isfinite(low) & np.isfinite(high))
    if unknown.all():
        return [None] * len(mean)
    intervals: list[Interval | None] = list(map(Interval, mean.tolist(), low.tolist(), high.tolist()))
    for at in np.flatnonzero(unknown).tolist():
        intervals[at] = None
    return intervals
