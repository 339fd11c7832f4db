"""Forecast the charge at the next planned charge of a car and at the end of its shift.

Both forecasts are made by the same function. The first begins with the present charge. The second begins with it, too,
where no charge is planned. Where one is, it begins with the charge that cars reach in planned charges
(`socast.core.forecast.learning.charged_soc`), and which is not below the charge on arrival; the energy ahead is then
that of the rides and waits after the last planned charge. What happens between several charges is not computed, because
the last one decides what follows.
"""

from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, replace_nan
from socast.core.forecast.conformal import OVER_CHARGE, TO_CHARGE, ConformalIntervals
from socast.core.forecast.learning.charged_soc import ChargedSoc
from socast.core.forecast.learning.fleet import FleetStatistics
from socast.core.forecast.outlook import (
    FACTOR_DECAY_TIME,
    CarEstimate,
    EnergyAhead,
    MeanAndSd,
    PlanTimes,
    UsualConsumption,
    compute_end_soc,
    compute_reserve_risk,
    compute_temperature_weights,
)
from socast.core.forecast.plan_tracker import PLAN_LAG
from socast.core.forecast.soc_filter import CONSUMPTION_WANDER
from socast.core.vehicles.fleet import Cars

EMPTY_SOC: Final = 0.05
"""Charge that a display may still show when the battery is empty, and the least upper bound of a forecast. [1]

Estimated: in the cold, and with aged cells, the voltage ends a drive before the display reaches 0 %."""
_Columns = TypeVar("_Columns", CarEstimate, PlanTimes, UsualConsumption)


class SocForecast(NamedTuple):
    """Hold the charge of n cars at a point ahead, (n,) each.

    Parameters
    ----------
    mean, p05, p95 : Mean, 5th and 95th percentile. [1]
    risk : Probability that it is below the reserve. [1]
    raw_mean, raw_sd : Mean and standard deviation before the conformal correction. [1]
    energy_km : Distance that the energy until there would usually drive. [km]
    """

    mean: Floats
    p05: Floats
    p95: Floats
    risk: Floats
    raw_mean: Floats
    raw_sd: Floats
    energy_km: Floats


class CarsNow(NamedTuple):
    """Hold what is known of n cars, and what the fleet has learned.

    Parameters
    ----------
    time : (n,) float. Time of the newest sample. [s]
    filtered : (n,) SOC_ESTIMATE.
    estimate : The same, with the capacities of the cars.
    usual : Usual consumption at the temperature ahead.
    patterns : (n,) SHIFT_PATTERNS.
    """

    time: Floats
    filtered: NDArray[np.void]
    estimate: CarEstimate
    usual: UsualConsumption
    patterns: NDArray[np.void]
    conformal: ConformalIntervals
    charged_soc: ChargedSoc

    @classmethod
    def create(
        cls,
        lanes: Ints,
        kinds: Ints,
        time: Floats,
        filtered: NDArray[np.void],
        ambient: Floats,
        statistics: FleetStatistics,
        cars: Cars,
    ) -> "CarsNow":
        """Return what is known of cars, where `ambient` is the outside temperature of the time ahead. [K]"""
        weights = compute_temperature_weights(ambient)
        usual = statistics.compute_usual(kinds, weights, time - filtered["begin"])
        estimate, patterns = CarEstimate.from_filter(filtered, cars.capacity[kinds]), statistics.patterns[lanes]
        less_known = np.maximum(usual.level_sd**2 - replace_nan(filtered["level_sd"], 0.0) ** 2, 0.0)
        estimate = estimate._replace(log_factor_variance=estimate.log_factor_variance + less_known)
        return cls(time, filtered, estimate, usual, patterns, statistics.conformal, statistics.charged_soc)

    def forecast_soc(
        self, begin: CarEstimate, energy: MeanAndSd, hours: Floats, basis: Ints, reserve: Floats, most: Floats
    ) -> SocForecast:
        """Return the charge after energies, from an estimate on; it is at most `most`.

        Units: energy [kWh], hours [h].
        """
        raw = compute_end_soc(begin, energy, hours)
        energy_km = energy.mean / self.usual.energy_per_km
        unknown = np.clip((self.usual.level_sd * energy.mean / begin.capacity / raw.sd) ** 2, 0.0, 1.0)
        quantiles, bounds = self.conformal.get_quantiles(basis, energy_km, unknown)
        mean, low, high = (np.clip(raw.mean + raw.sd * bound, 0.0, most) for bound in bounds)
        high = np.minimum(np.maximum(high, EMPTY_SOC), most)
        return SocForecast(mean, low, high, compute_reserve_risk(raw, reserve, quantiles), *raw, energy_km)


class SocAhead(NamedTuple):
    """Hold the forecasts of n cars for the end of the shift and for the next planned charge.

    Parameters
    ----------
    end : At the end; its risk is that of falling below the reserve at any time before.
    charge : At the next charge; NaN of cars without a planned charge, and at the charger.
    charge_time : When the next planned charge begins, (n,) float. [s]
    basis : Basis of `end`, (n,) int: `BY_PLAN`, `BY_HISTORY` or `OVER_CHARGE`.
    charged : Estimates after the last planned charge, of those cars that have one.
    """

    end: SocForecast
    charge: SocForecast
    charge_time: Floats
    basis: Ints
    charged: CarEstimate | None = None


def find_charging_since(estimates: NDArray[np.void], plan_came: Floats) -> Floats:
    """Return since when cars stand at the charger of the next planned charge, NaN of others, (n,). [s]

    A plan that was sent as the charge ended, or later, is about what follows.
    """
    follows = plan_came > estimates["unplugged"] - PLAN_LAG
    return np.where((estimates["departed"] == 1.0) | follows, np.nan, estimates["arrived"])


def forecast_soc_ahead(now: CarsNow, ahead: EnergyAhead, progress: NDArray[np.void], times: PlanTimes) -> SocAhead:
    """Return the forecasts for the end of the shift and for the next planned charge."""
    energy, present = MeanAndSd(ahead.energy, ahead.sd), now.estimate.soc
    first = now.forecast_soc(now.estimate, energy, ahead.hours, ahead.basis, ahead.reserve, present)
    to_charge = ahead.basis == TO_CHARGE
    awaits = to_charge & np.isnan(find_charging_since(now.filtered, progress["came"]))
    charge = SocForecast(*(np.where(awaits, each, np.nan) for each in first))
    charge_time = np.where(awaits, now.time + 3600.0 * ahead.hours, np.nan)
    rows = np.flatnonzero(to_charge)
    if not len(rows):
        return SocAhead(first, charge, charge_time, ahead.basis)
    time, risk = now.time[rows], first.risk[rows]
    now = now._replace(usual=_take_rows(now.usual, rows), estimate=_take_rows(now.estimate, rows))
    times, progress = _take_rows(times, rows), progress.take(rows)
    hours = (times.end - time) / 3600.0 - times.after
    charged = estimate_after_charge(now.estimate, progress["charge_to"], hours, now.charged_soc)
    arrival, sd = first.raw_mean[rows], first.raw_sd[rows]
    higher = (arrival > charged.soc) & (progress["charges"] == 1.0)
    charged = charged._replace(
        soc=np.where(higher, arrival, charged.soc), variance=np.where(higher, sd**2, charged.variance)
    )
    energy, basis = compute_energy_after_charges(progress, times, now.usual), np.full(len(rows), OVER_CHARGE)
    last = now.forecast_soc(charged, energy, times.after, basis, ahead.reserve[rows], np.ones(len(rows)))
    last = last._replace(risk=1.0 - (1.0 - risk) * (1.0 - last.risk))
    end = SocForecast(*(whole.copy() for whole in first))
    for whole, part in zip(end, last, strict=True):
        whole[rows] = part
    return SocAhead(end, charge, charge_time, np.where(to_charge, OVER_CHARGE, ahead.basis), charged)


def _take_rows(columns: _Columns, rows: Ints) -> _Columns:
    """Return some rows of columns."""
    return type(columns)(*(each[rows] for each in columns))


def estimate_after_charge(
    estimate: CarEstimate, charge_to: Floats, hours: Floats, charged_soc: ChargedSoc
) -> CarEstimate:
    """Return the estimate of cars that have charged as planned, some hours from now. [h]

    The charge is then independent of the consumption, which returns to the usual meanwhile and keeps wandering.
    """
    soc, variance = charged_soc.expect(charge_to)
    decay = np.exp(-hours / FACTOR_DECAY_TIME)
    return estimate._replace(
        soc=soc,
        variance=variance,
        log_factor=estimate.usual + (estimate.log_factor - estimate.usual) * decay,
        log_factor_variance=estimate.log_factor_variance + CONSUMPTION_WANDER**2 * hours,
        covariance=np.zeros(len(hours)),
    )


def compute_energy_after_charges(progress: NDArray[np.void], times: PlanTimes, usual: UsualConsumption) -> MeanAndSd:
    """Return the energy from the last planned charge to the end of the shift. [kWh]"""
    driving = usual.weigh(progress["after_kwh"])
    waiting = times.waiting_after * usual.standing_power + progress["after_legs"] * usual.approach_energy
    spare = np.where(progress["after_legs"] > 0.0, np.inf, times.waiting_after)
    return usual.expect_plan(usual.compute_parts(driving, waiting, spare))
