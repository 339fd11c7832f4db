"""Compute the forecasts at rows of running totals: charge now, at the end of the shift, range and risk."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, Ints
from core.columns import ZERO_CELSIUS
from core.forecast.conformal import BY_HISTORY, BY_PLAN
from core.forecast.learning.fleet import FleetStatistics
from core.forecast.outlook import (
    CarEstimate,
    MeanAndSd,
    clip_charge,
    compute_end_soc,
    compute_planned_energy,
    compute_range,
    compute_reserve_risk,
    compute_temperature_weights,
    fill_from_history,
    find_expected_end,
)
from core.forecast.plan_tracker import get_ride_km
from core.forecast.soc_reading import READING_SD
from core.totals.accumulator import Totals
from core.vehicles.fleet import Cars

END_OF_SHIFT: Final = np.dtype([("mean", "f8"), ("p05", "f8"), ("p95", "f8"), ("risk", "f8")])
"""Charge at the end of a shift: mean, 5th and 95th percentile, and the risk of ending below the reserve. [1]"""


class ForecastRows(NamedTuple):
    """Hold the forecasts at n rows of running totals, (n,) each; NaN where unknown.

    Parameters
    ----------
    predicted : Energy predicted of the ride so far. [kWh]
    soc, soc_sd : Present charge and its standard deviation. [1]
    end_soc, end_soc_p05, end_soc_p95 : Charge at the end of the shift: mean, 5th and 95th percentile. [1]
    risk : Probability of ending below the reserve. [1]
    range_km, range_km_p05, range_km_p95 : Range down to the reserve: mean, 5th and 95th percentile. [km]
    raw_end_soc, raw_end_soc_sd : Charge at the end and its standard deviation, before the conformal correction. [1]
    end : End of the shift. [s]
    basis : `BY_PLAN` or `BY_HISTORY`, (n,) int.
    ride_km_ahead : Distance of rides ahead. [km]
    energy_km_ahead : Distance that all the energy ahead would usually drive. [km]
    reserve : [1]
    ambient_c : Outside temperature. [°C]
    shift : Ordinal of the shift.
    begin, begin_soc : Beginning of the shift [s], and the charge then [1].
    distance : Driven in the shift so far. [m]
    reported_soc : Charge as reported last. [1]
    charged : When the car charged last within the shift. [s]
    faulty : When the reported charge was faulty last within the shift. [s]
    driving_fall, waiting_fall : Fall of the charge by driving and by waiting, before their correction. [1]
    """

    predicted: Floats
    soc: Floats
    soc_sd: Floats
    end_soc: Floats
    end_soc_p05: Floats
    end_soc_p95: Floats
    risk: Floats
    range_km: Floats
    range_km_p05: Floats
    range_km_p95: Floats
    raw_end_soc: Floats
    raw_end_soc_sd: Floats
    end: Floats
    basis: Ints
    ride_km_ahead: Floats
    energy_km_ahead: Floats
    reserve: Floats
    ambient_c: Floats
    ahead_c: Floats
    shift: Floats
    begin: Floats
    begin_soc: Floats
    distance: Floats
    reported_soc: Floats
    charged: Floats
    faulty: Floats
    driving_fall: Floats
    waiting_fall: Floats

    def rows(self, which: Ints) -> "ForecastRows":
        """Return some of the rows."""
        return ForecastRows(**{name: column[which] for name, column in self._asdict().items()})

    def get_end_of_shift(self) -> NDArray[np.void]:
        """Return the charge at the end of the shift, (n,) END_OF_SHIFT."""
        out = np.empty(len(self.end_soc), END_OF_SHIFT)
        out["mean"], out["p05"], out["p95"], out["risk"] = self.end_soc, self.end_soc_p05, self.end_soc_p95, self.risk
        return out

    @classmethod
    def join(cls, parts: Sequence["ForecastRows"]) -> "ForecastRows":
        """Return rows one after another."""
        none = {name: np.empty(0, np.int64 if name == "basis" else np.float64) for name in cls._fields}
        return cls(
            **{name: np.concatenate([empty, *(getattr(p, name) for p in parts)]) for name, empty in none.items()}
        )


def compute_forecast_rows(
    running: Totals,
    predicted: Floats,
    estimates: NDArray[np.void],
    progress: NDArray[np.void],
    statistics: FleetStatistics,
    cars: Cars,
) -> ForecastRows:
    """Return the forecasts at rows of running totals.

    Parameters
    ----------
    running : Totals
        Of n rows.
    predicted : (n,) float
        Energy predicted of the rides so far. [kWh]
    estimates : (n,) SOC_ESTIMATE
    progress : (n,) PLAN_PROGRESS
    statistics : FleetStatistics
    cars : Cars

    Returns
    -------
    ForecastRows
    """
    time, kind = running.at_last("time"), running.at_last("kind").astype(np.int64)
    patterns = statistics.get_patterns(running.lane)
    expected_end = find_expected_end(progress, time, estimates["begin"], patterns)
    ambient = statistics.daily_cycle.expect_ambient(estimates["ambient"], time, expected_end)
    ahead_c = ambient - ZERO_CELSIUS
    usual = statistics.compute_usual(kind, compute_temperature_weights(ambient))
    estimate = CarEstimate.from_filter(estimates, cars.capacity[kind])
    ahead = compute_planned_energy(progress, time, get_ride_km(running), running.ride >= 0, usual)
    ahead = fill_from_history(ahead, usual, time - estimates["begin"], time, patterns)
    end = compute_end_soc(estimate, MeanAndSd(ahead.energy, ahead.sd), ahead.hours)
    falls = ahead.parts * (np.exp(estimate.compute_mean_log_factor(ahead.hours)) / estimate.capacity)[:, np.newaxis]
    energy_km = ahead.energy / usual.energy_per_km
    quantiles, bounds = statistics.conformal.get_quantiles(ahead.basis, energy_km, ahead_c)
    end_soc, end_soc_p05, end_soc_p95 = (clip_charge(end.mean + end.sd * bound, estimate) for bound in bounds)
    distance = compute_range(estimate, ahead.reserve, usual)
    by_plan, by_history = (
        statistics.conformal.get_quantiles(np.full_like(ahead.basis, basis), distance.mean, ahead_c)[1]
        for basis in (BY_PLAN, BY_HISTORY)
    )
    range_km, range_km_p05, range_km_p95 = (
        np.maximum(distance.mean + distance.sd * np.where(np.isfinite(planned), planned, usual_bound), 0.0)
        for planned, usual_bound in zip(by_plan, by_history, strict=True)
    )
    return ForecastRows(
        predicted=predicted,
        soc=estimate.soc,
        soc_sd=np.sqrt(np.maximum(estimate.variance, READING_SD**2)),
        end_soc=end_soc,
        end_soc_p05=end_soc_p05,
        end_soc_p95=end_soc_p95,
        risk=compute_reserve_risk(end, ahead.reserve, quantiles),
        range_km=range_km,
        range_km_p05=range_km_p05,
        range_km_p95=range_km_p95,
        raw_end_soc=end.mean,
        raw_end_soc_sd=end.sd,
        end=ahead.end,
        basis=ahead.basis,
        ride_km_ahead=ahead.km,
        energy_km_ahead=energy_km,
        reserve=ahead.reserve,
        ambient_c=estimates["ambient"] - ZERO_CELSIUS,
        ahead_c=ahead_c,
        shift=estimates["shift"],
        begin=estimates["begin"],
        begin_soc=estimates["begin_soc"],
        distance=estimates["distance"],
        reported_soc=estimates["reported"],
        charged=estimates["charged"],
        faulty=estimates["faulty"],
        driving_fall=falls[:, 0],
        waiting_fall=falls[:, 1],
    )
