"""Compute the forecasts at rows of running totals: charge now, at the end of the shift, range and risk."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.conformal import BY_PLAN, OVER_CHARGE
from socast.core.forecast.learning.fleet import FleetStatistics
from socast.core.forecast.outlook import (
    CarEstimate,
    compute_planned_energy,
    compute_range,
    compute_soc_sd,
    compute_temperature_weights,
    fill_from_history,
    schedule_plan,
)
from socast.core.forecast.plan_tracker import get_ride_km
from socast.core.forecast.soc_ahead import find_charging_since, forecast_soc_ahead
from socast.core.totals.accumulator import Totals
from socast.core.vehicles.fleet import Cars
from socast.core.wire.live_fields import LiveField, list_interval_columns, list_live_fields
from socast.core.wire.messages import Forecast


class ForecastRows(NamedTuple):
    """Hold the forecasts at n rows of running totals, (n,) each; NaN where unknown.

    A field of `socast.core.wire.messages.Forecast` with a live display is published from the column of its name, or
    from the column without `_pct`, as a percentage. An interval has two further columns for its percentiles.

    Parameters
    ----------
    predicted : Energy predicted of the ride so far. [kWh]
    soc, soc_sd : Present charge and its standard deviation. [1]
    soc_end_of_shift, soc_end_of_shift_p05, soc_end_of_shift_p95 : Charge at the end of the shift: mean, 5th and 95th
        percentile. [1]
    reserve_risk : Probability of ending below the reserve. [1]
    range_km, range_km_p05, range_km_p95 : Distance that the car can drive now without a pause, down to the reserve:
        mean, 5th and 95th percentile. [km]
    raw_end_soc, raw_end_soc_sd : Charge at the end and its standard deviation, before the conformal correction. [1]
    shift_end_s : End of the shift. [s]
    basis : `BY_PLAN`, `BY_HISTORY` or `OVER_CHARGE`, (n,) int.
    ride_km_ahead : Distance of rides ahead. [km]
    energy_km_ahead : Distance that the energy ahead, after planned charges, would usually drive. [km]
    reserve : [1]
    ambient_c : Outside temperature. [°C]
    begin, begin_soc : Beginning of the shift [s], and the charge then [1].
    distance : Driven in the shift so far. [m]
    reported_soc : Charge as reported last. [1]
    charged : When the car charged last within the shift. [s]
    faulty : When the reported charge was faulty last within the shift. [s]
    driving_kwh, waiting_kwh : Planned energy until the next planned charge, or else the end of the shift. [kWh]
    shift_kwh, level : Energy predicted since the car woke [kWh], and the level of the tables [1].
    charge_time : When the next planned charge begins. [s]
    charge_km : Distance of rides until then. [km]
    charge_to : Planned charge after the last planned charge. [1]
    charge_soc, charge_soc_p05, charge_soc_p95 : Charge then. [1]
    charge_risk : Probability that it is below the reserve. [1]
    raw_charge_soc, raw_charge_soc_sd : The same as `raw_end_soc`. [1]
    charge_energy_km : Distance that the energy until then would usually drive. [km]
    arrived : When the last charge within the shift began. [s]
    arrival_soc : Charge as reported before it. [1]
    """

    predicted: Floats
    soc: Floats
    soc_sd: Floats
    soc_end_of_shift: Floats
    soc_end_of_shift_p05: Floats
    soc_end_of_shift_p95: Floats
    reserve_risk: Floats
    range_km: Floats
    range_km_p05: Floats
    range_km_p95: Floats
    raw_end_soc: Floats
    raw_end_soc_sd: Floats
    shift_end_s: Floats
    basis: Ints
    ride_km_ahead: Floats
    energy_km_ahead: Floats
    reserve: Floats
    ambient_c: Floats
    shift: Floats
    begin: Floats
    begin_soc: Floats
    distance: Floats
    reported_soc: Floats
    charged: Floats
    faulty: Floats
    driving_kwh: Floats
    waiting_kwh: Floats
    shift_kwh: Floats
    level: Floats
    charge_time: Floats
    charge_km: Floats
    charge_to: Floats
    charge_soc: Floats
    charge_soc_p05: Floats
    charge_soc_p95: Floats
    charge_risk: Floats
    raw_charge_soc: Floats
    raw_charge_soc_sd: Floats
    charge_energy_km: Floats
    arrived: Floats
    arrival_soc: Floats

    def rows(self, which: Ints) -> "ForecastRows":
        """Return some of the rows."""
        return ForecastRows(**{name: column[which] for name, column in self._asdict().items()})

    def get_newest(self) -> NDArray[np.void]:
        """Return the published columns, (n,) NEWEST_FORECAST."""
        out = np.empty(len(self.soc), NEWEST_FORECAST)
        for name in NEWEST_FORECAST.names or ():
            out[name] = getattr(self, name)
        return out

    @classmethod
    def join(cls, parts: Sequence["ForecastRows"]) -> "ForecastRows":
        """Return rows one after another."""
        if len(parts) == 1:
            return parts[0]
        none = {name: np.empty(0, np.int64 if name == "basis" else np.float64) for name in cls._fields}
        return cls(
            **{name: np.concatenate([empty, *(getattr(p, name) for p in parts)]) for name, empty in none.items()}
        )


class PublishedField(NamedTuple):
    """Describe a field of a forecast that is published from columns of `ForecastRows`.

    Parameters
    ----------
    columns : tuple of str
        The column of a number, or those of mean and percentiles of an interval.
    scale : float
        Value of one unit of a column in the unit of the field.
    """

    name: str
    columns: tuple[str, ...]
    scale: float

    @classmethod
    def of(cls, field: LiveField) -> "PublishedField":
        """Return the columns of a declared field: those of its name, or without `_pct` those of a share."""
        is_share = field.name.endswith("_pct")
        column = field.name.removesuffix("_pct")
        if column not in ForecastRows._fields:
            raise AttributeError(f"ForecastRows has no column {column} for the field {field.name} of a forecast")
        return cls(
            field.name, list_interval_columns(column) if field.is_interval else (column,), 100.0 if is_share else 1.0
        )


PUBLISHED: Final = tuple(
    PublishedField.of(field) for field in list_live_fields(Forecast) if not field.name.startswith("ride_")
)
"""Fields of a forecast from columns of `ForecastRows`; those of the ride in progress come from its totals."""
INTERVALS: Final = (*(each.columns for each in PUBLISHED if len(each.columns) > 1), list_interval_columns("charge_soc"))
"""Columns of mean and percentiles of each published interval."""
NEWEST_FORECAST: Final = np.dtype(
    [
        (column, "f8")
        for column in (
            *(column for each in PUBLISHED for column in each.columns),
            *list_interval_columns("charge_soc"),
            *("charge_time", "charge_risk"),
        )
    ]
)
"""Newest forecast of a car, as a state keeps it: the columns of `ForecastRows` from which it is published."""


def compute_forecast_rows(
    running: Totals,
    predicted: Floats,
    estimates: NDArray[np.void],
    progress: NDArray[np.void],
    ambient: Floats,
    statistics: FleetStatistics,
    cars: Cars,
) -> ForecastRows:
    """Return the forecasts at rows of running totals.

    Units: predicted [kWh].
    """
    if not len(running.lane):
        return ForecastRows.join([])
    time, kind = running.at_last("time"), running.at_last("kind").astype(np.int64)
    patterns = statistics.get_patterns(running.lane)
    usual = statistics.compute_usual(kind, compute_temperature_weights(ambient), time - estimates["begin"])
    estimate = CarEstimate.from_filter(estimates, cars.capacity[kind])
    riding, charging_since = running.ride >= 0, find_charging_since(estimates, progress["came"])
    times = schedule_plan(progress, time, get_ride_km(running), riding, charging_since)
    ahead = compute_planned_energy(progress, times, time, riding, usual)
    ahead = fill_from_history(ahead, usual, time - estimates["begin"], time, patterns)
    learned = statistics.conformal, statistics.charged_soc
    soc = forecast_soc_ahead(estimate, ahead, progress, times, time, charging_since, usual, *learned)
    reach = compute_range(estimate, ahead.reserve, usual)
    by_plan, of_reach = np.full_like(ahead.basis, BY_PLAN), reach.energy / usual.energy_per_km
    bounds = statistics.conformal.get_quantiles(by_plan, of_reach)[1]
    range_km, range_km_p05, range_km_p95 = (np.maximum(reach.km.mean + reach.km.sd * each, 0.0) for each in bounds)
    return ForecastRows(
        predicted=predicted,
        soc=estimate.soc,
        soc_sd=compute_soc_sd(estimate),
        soc_end_of_shift=soc.end.mean,
        soc_end_of_shift_p05=soc.end.p05,
        soc_end_of_shift_p95=soc.end.p95,
        reserve_risk=soc.end.risk,
        range_km=range_km,
        range_km_p05=range_km_p05,
        range_km_p95=range_km_p95,
        raw_end_soc=soc.end.raw_mean,
        raw_end_soc_sd=soc.end.raw_sd,
        shift_end_s=ahead.end,
        basis=soc.basis,
        ride_km_ahead=np.where(soc.basis == OVER_CHARGE, ahead.km + progress["after_km"], ahead.km),
        energy_km_ahead=soc.end.energy_km,
        reserve=ahead.reserve,
        ambient_c=estimates["ambient"] - ZERO_CELSIUS,
        shift=estimates["shift"],
        begin=estimates["begin"],
        begin_soc=estimates["begin_soc"],
        distance=estimates["distance"],
        reported_soc=estimates["reported"],
        charged=estimates["charged"],
        faulty=estimates["faulty"],
        driving_kwh=ahead.planned[:, 0],
        waiting_kwh=ahead.planned[:, 1],
        shift_kwh=estimates["predicted"],
        level=estimates["level"],
        charge_time=soc.charge_time,
        charge_km=np.where(np.isfinite(soc.charge_time), ahead.km, np.nan),
        charge_to=np.where(soc.basis == OVER_CHARGE, progress["charge_to"], np.nan),
        charge_soc=soc.charge.mean,
        charge_soc_p05=soc.charge.p05,
        charge_soc_p95=soc.charge.p95,
        charge_risk=soc.charge.risk,
        raw_charge_soc=soc.charge.raw_mean,
        raw_charge_soc_sd=soc.charge.raw_sd,
        charge_energy_km=soc.charge.energy_km,
        arrived=estimates["arrived"],
        arrival_soc=estimates["arrival_soc"],
    )
