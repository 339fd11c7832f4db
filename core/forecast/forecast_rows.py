"""Compute the forecasts at rows of running totals: charge now, at the end of the shift, range and risk."""

from collections.abc import Sequence
from math import inf, isfinite, nan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.conformal import BY_PLAN, LEVELS, OVER_CHARGE, TO_CHARGE
from socast.core.forecast.learning.fleet import FleetStatistics
from socast.core.forecast.learning.forecast_errors import ForecastRecord
from socast.core.forecast.learning.plan_outcomes import PLAN_PARTS
from socast.core.forecast.outlook import (
    compute_planned_energy,
    compute_range,
    compute_soc_sd,
    fill_from_history,
    schedule_plan,
)
from socast.core.forecast.plan_tracker import get_ride_km
from socast.core.forecast.soc_ahead import CarsNow, find_charging_since, forecast_soc_ahead
from socast.core.totals.accumulator import Totals
from socast.core.vehicles.fleet import Cars
from socast.core.wire.live_fields import LiveField, list_interval_columns, list_live_fields
from socast.core.wire.messages import Forecast


def _list_fields(name: str) -> list[tuple[str, str]]:
    """Return the fields of an interval: its mean, and its 5th and 95th percentile."""
    return [(column, "f8") for column in list_interval_columns(name)]


FORECAST_ROW: Final = np.dtype(
    [
        ("lane", "i8"),
        ("kind", "i8"),  # of car
        ("time", "f8"),  # [s]
        ("predicted", "f8"),  # energy predicted of the ride so far [kWh]
        ("soc", "f8"),  # present charge [1]
        ("soc_sd", "f8"),  # its standard deviation [1]
        *_list_fields("range_km"),  # distance that the car can drive now without a pause, down to the reserve [km]
        ("shift_end_s", "f8"),  # [s]
        ("basis", "i8"),  # `BY_PLAN`, `BY_HISTORY` or `OVER_CHARGE`
        ("ride_km_ahead", "f8"),  # distance of rides ahead [km]
        ("reserve", "f8"),  # [1]
        ("ambient_c", "f8"),  # outside temperature [°C]
        # energy as planned until the next planned charge, or else the end of the shift [kWh]
        *((name, "f8") for name in PLAN_PARTS),
        # at the end of the shift
        *_list_fields("soc_end_of_shift"),  # charge [1]
        ("reserve_risk", "f8"),  # probability of ending below the reserve [1]
        ("raw_end_soc", "f8"),  # mean charge before the conformal correction [1]
        ("raw_end_soc_sd", "f8"),
        ("energy_km_ahead", "f8"),  # distance that the energy ahead, after planned charges, would usually drive [km]
        # at the next planned charge
        *_list_fields("charge_soc"),  # charge [1]
        ("charge_risk", "f8"),  # probability that it is below the reserve [1]
        ("raw_charge_soc", "f8"),  # mean charge before the conformal correction [1]
        ("raw_charge_soc_sd", "f8"),
        ("charge_energy_km", "f8"),  # distance that the energy until then would usually drive [km]
        ("charge_time", "f8"),  # when it begins [s]
        ("charge_km", "f8"),  # distance of rides until then [km]
        ("charge_to", "f8"),  # planned charge after the last planned charge [1]
        # as `SOC_ESTIMATE` has them
        *((name, "f8") for name in ("shift", "begin", "begin_soc", "distance", "last_soc", "charged", "faulty")),
        *((name, "f8") for name in ("awake_predicted", "level", "arrived", "arrival_soc")),
    ]
)
"""Forecasts at a row of running totals; NaN where unknown.

A field of `socast.core.wire.messages.Forecast` with a live display is published from the column of its name, or from
the column without `_pct`, as a percentage. An interval has two further columns for its percentiles."""
Rows = NDArray[np.void]
"""Rows of the type `FORECAST_ROW`, (n,)."""
_COLUMNS: Final = FORECAST_ROW.names or ()
_OF_END: Final = _COLUMNS[_COLUMNS.index("soc_end_of_shift") : _COLUMNS.index("charge_soc")]
_OF_CHARGE: Final = _COLUMNS[_COLUMNS.index("charge_soc") : _COLUMNS.index("charge_time")]
_OF_ESTIMATE: Final = _COLUMNS[_COLUMNS.index("shift") :]


class PublishedField(NamedTuple):
    """Describe a field of a forecast that is published from columns of `FORECAST_ROW`.

    Parameters
    ----------
    columns : The column of a number, or those of mean and percentiles of an interval.
    scale : Value of one unit of a column in the unit of the field.
    """

    name: str
    columns: tuple[str, ...]
    scale: float

    @classmethod
    def of(cls, field: LiveField) -> "PublishedField":
        """Return the columns of a declared field: those of its name, or without `_pct` those of a share."""
        is_share = field.name.endswith("_pct")
        column = field.name.removesuffix("_pct")
        if column not in _COLUMNS:
            raise AttributeError(f"FORECAST_ROW has no column {column} for the field {field.name} of a forecast")
        return cls(
            field.name, list_interval_columns(column) if field.is_interval else (column,), 100.0 if is_share else 1.0
        )


PUBLISHED: Final = tuple(
    PublishedField.of(field) for field in list_live_fields(Forecast) if not field.name.startswith("ride_")
)
"""Fields of a forecast from columns of `FORECAST_ROW`; those of the ride in progress come from its totals."""
INTERVALS: Final = (*(each.columns for each in PUBLISHED if len(each.columns) > 1), list_interval_columns("charge_soc"))
"""Columns of mean and percentiles of each published interval."""
_COLUMNS_OF_CHARGE: Final = *list_interval_columns("charge_soc"), "charge_time", "charge_risk"
NEWEST_COLUMNS: Final = [*(column for each in PUBLISHED for column in each.columns), *_COLUMNS_OF_CHARGE]
"""Columns of `FORECAST_ROW` from which a forecast is published."""
NEWEST_FORECAST: Final = np.dtype([(column, "f8") for column in NEWEST_COLUMNS])
"""Newest forecast of a car, as a state keeps it."""


def compute_forecast_rows(
    running: Totals,
    predicted: Floats,
    estimates: NDArray[np.void],
    progress: NDArray[np.void],
    ambient: Floats,
    statistics: FleetStatistics,
    cars: Cars,
) -> Rows:
    """Return the forecasts at rows of running totals.

    Units: predicted [kWh].
    """
    rows = np.empty(len(running.lane), FORECAST_ROW)
    if not len(rows):
        return rows
    kinds, time, riding = running.kinds, running.at_last("time"), running.ride >= 0
    now = CarsNow.create(running.lane, kinds, time, estimates, ambient, statistics, cars)
    times = schedule_plan(
        progress, time, get_ride_km(running), riding, find_charging_since(estimates, progress["came"])
    )
    ahead = compute_planned_energy(progress, times, time, riding, now.usual)
    if np.isnan(ahead.energy).any():
        ahead = fill_from_history(ahead, now.usual, time - estimates["begin"], time, now.patterns)
    soc = forecast_soc_ahead(now, ahead, progress, times)
    reach = compute_range(now.estimate, ahead.reserve, now.usual)
    by_plan, of_reach = np.full_like(ahead.basis, BY_PLAN), reach.energy / now.usual.energy_per_km
    quantiles, bounds = statistics.conformal.get_quantiles(by_plan, of_reach)
    bounds = bounds._replace(middle=quantiles[:, LEVELS.index(0.5)])  # a ride of this length reaches it with even odds
    for name, bound in zip(list_interval_columns("range_km"), bounds, strict=True):
        rows[name] = np.maximum(reach.km.mean + reach.km.sd * bound, 0.0)
    for name, column in (*zip(_OF_END, soc.end, strict=True), *zip(_OF_CHARGE, soc.charge, strict=True)):
        rows[name] = column
    for name in _OF_ESTIMATE:
        rows[name] = estimates[name]
    rows["lane"], rows["kind"], rows["time"], rows["predicted"] = running.lane, kinds, time, predicted
    rows["soc"], rows["soc_sd"] = now.estimate.soc, compute_soc_sd(now.estimate)
    rows["shift_end_s"], rows["reserve"], rows["basis"] = ahead.end, ahead.reserve, soc.basis
    rows["ambient_c"] = estimates["ambient"] - ZERO_CELSIUS
    for name, planned in zip(PLAN_PARTS, ahead.planned.T, strict=True):
        rows[name] = planned
    charges = soc.basis == OVER_CHARGE
    rows["ride_km_ahead"] = np.where(charges, ahead.km + progress["after_km"], ahead.km)
    rows["charge_to"] = np.where(charges, progress["charge_to"], np.nan)
    rows["charge_time"] = soc.charge_time
    rows["charge_km"] = np.where(np.isfinite(soc.charge_time), ahead.km, np.nan)
    return rows


def select_newest(rows: Rows) -> NDArray[np.void]:
    """Return the columns that are published, (n,) NEWEST_FORECAST."""
    newest = np.empty(len(rows), NEWEST_FORECAST)
    for name in NEWEST_COLUMNS:
        newest[name] = rows[name]
    return newest


def join_rows(parts: Sequence[Rows]) -> Rows:
    """Return rows one after another; as plain numbers, which takes a tenth of the time."""
    if len(parts) == 1:
        return parts[0]
    return np.concatenate([np.empty(0), *(part.view(np.float64) for part in parts)]).view(FORECAST_ROW)


def create_records(row: NDArray[np.void]) -> tuple[ForecastRecord, ForecastRecord | None]:
    """Return the records of the forecasts of a FORECAST_ROW: for the end of the shift, and for a planned charge."""
    end, charge = _create_record(row, _OF_END), _create_record(row, _OF_CHARGE)
    if end.basis == OVER_CHARGE:
        end = end._replace(driving_kwh=nan, waiting_kwh=nan)
    return end, charge._replace(end=inf, basis=TO_CHARGE) if isfinite(charge.mean) else None


def _create_record(row: NDArray[np.void], columns: Sequence[str]) -> ForecastRecord:
    """Return the record of the forecast in some columns, for the end of the shift."""
    _, lower, upper, _, mean, sd, ahead_km = (row[name].item() for name in columns)
    time, end, basis, ambient_c = (row[name].item() for name in ("time", "shift_end_s", "basis", "ambient_c"))
    planned = (row[name].item() for name in (*PLAN_PARTS, "awake_predicted", "level"))
    return ForecastRecord(time, end, basis, ahead_km, ambient_c, mean, sd, lower, upper, *planned)
