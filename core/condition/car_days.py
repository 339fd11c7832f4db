"""Sum rides to car-days: the consumption of each car on each date over what a model predicts, and its usable capacity.

A series is a grid of cars by dates of the logarithm of a factor, with a variance of two parts: the same for every day,
and one that falls with the amount that was measured. `socast.core.condition.level_model` estimates both.

Cars of a fleet share the weather of a date and whatever the model lacks of it. Where a date has measurements of several
cars, the mean of the others is taken off each of them, so that the series of a car is its deviation from its siblings.
"""

from datetime import date
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from msgspec.structs import replace

from socast.core.batch import Floats
from socast.core.condition.level_model import CONSUMPTION, Series, estimate_wandering
from socast.core.errors import ModelError
from socast.core.evaluate.compare.models import ComparedRides
from socast.core.evaluate.ride_filter import NEEDED_COLUMNS
from socast.core.fit.measurement_noise import compute_noise_variance
from socast.core.fit.ride_blocks import get_numbers, parse_ride_date
from socast.core.formatting import format_count
from socast.core.models import LinearModel
from socast.core.models.features import VEHICLE_SCOPE

CAPACITY_COLUMNS: Final = ("nominal_capacity_kwh", "energy_vi_kwh", "soc_start_pct", "soc_end_pct")
"""Columns of the ride table that tell the usable capacity, besides the outside temperature."""
NOISE_COLUMNS: Final = ("energy_vi_sd_kwh", "energy_soc_noise_kwh")
"""Columns that tell the noise of the measured energy."""
LEAST_DATES: Final = 6
"""Number of dates below which nothing is told of a condition."""
LEAST_KWH: Final = 0.1
"""Least predicted energy of a car-day. [kWh]"""
LEAST_FALL: Final = 5.0
"""Least fall of the display over the rides of a car-day from which its capacity is estimated. [%]"""
LEAST_SIBLINGS: Final = 2
"""Least number of other cars with a measurement on a date whose mean is taken off."""
LARGEST_FACTOR: Final = 3.0
"""A car-day with a larger factor, or one below its inverse, is none: its energy was not measured. [1]"""
MILD_C: Final = 10.0
"""Outside temperature below which a battery holds less. [°C]"""


def list_car_day_columns(model: LinearModel) -> list[str]:
    """Return the columns of a ride table from which car-days are made; those of capacity and noise may be absent."""
    return list(dict.fromkeys((*NEEDED_COLUMNS, *model.needs, *CAPACITY_COLUMNS, *NOISE_COLUMNS)))


def select_car_day_columns(rides: pd.DataFrame, model: LinearModel) -> pd.DataFrame:
    """Return the columns of rides from which car-days are made, so that copies of them are small."""
    return rides[[name for name in list_car_day_columns(model) if name in rides]]


class CarDays(NamedTuple):
    """Hold the car-days of n cars.

    Parameters
    ----------
    cars, models : (n,) list of str
        Name and vehicle model of each car.
    nominal_kwh : (n,) float
        Usable capacity by the catalogue. [kWh]
    consumption : Series
        Measured over predicted energy; its amount is the predicted energy [kWh], its extra variance that of the meter.
    capacity : Series
        Usable capacity over that of the catalogue; its amount is the square of the fall of the display over the number
        of rides [%^2].
    cold : (n, t) float
        How much colder than `MILD_C` a car-day was, by the fall of the display. [K]
    left_out : int
        Number of car-days with rides that have no consumption.
    energy_left_out : float
        Their share of the measured energy. [1]
    distance_km : (n, t) float, optional
        Distance of a car-day.
    """

    cars: list[str]
    models: list[str]
    nominal_kwh: Floats
    consumption: Series
    capacity: Series
    cold: Floats
    left_out: int = 0
    energy_left_out: float = 0.0
    distance_km: Floats | None = None


def forget_cars(model: LinearModel) -> LinearModel:
    """Return a model without what it knows of single cars, which is what a condition is to show."""
    shared = [not any(name.startswith(VEHICLE_SCOPE) for name in term.columns) for term in model.terms]
    fits = {
        key: replace(fit, coefficients=tuple((np.array(fit.coefficients) * shared).tolist()))
        for key, fit in model.fits.items()
    }
    return replace(model, cars={}, fits=fits)


def gather_car_days(compared: ComparedRides, label: str, least_kwh: float = LEAST_KWH) -> CarDays:
    """Return the car-days of rides that a model of this label predicts.

    Units: least_kwh [kWh].
    """
    rides = compared.rides
    car, cars = pd.factorize(rides["vehicle_id"].astype(str), sort=True)
    at, days = pd.factorize(rides["date"].astype(str), sort=True)
    dates = np.array([parse_ride_date(each).toordinal() for each in days])
    if len(dates) < LEAST_DATES:
        raise ModelError(
            f"the rides are of {format_count(len(dates), 'date')}, and a condition takes {LEAST_DATES}: give more days"
        )
    shape = len(cars), len(dates)

    def total(values: Floats) -> Floats:
        return np.asarray(np.bincount(car * shape[1] + at, values, shape[0] * shape[1]).reshape(shape))

    measured, predicted = total(compared.measured), total(compared.predicted[label])
    factor = np.divide(measured, predicted, out=np.full(shape, np.nan), where=predicted >= least_kwh)
    noise = total(np.nan_to_num(compute_noise_variance(rides))) / np.maximum(predicted, least_kwh) ** 2
    first = np.unique(car, return_index=True)[1]
    nominal, energy, ambient = (_read(rides, name) for name in ("nominal_capacity_kwh", "energy_vi_kwh", "ambient_c"))
    nominal, fall = nominal[first], _read(rides, "soc_start_pct") - _read(rides, "soc_end_pct")
    known = np.isfinite(energy) & np.isfinite(fall) & np.isfinite(ambient)
    falls, used, number = (total(np.where(known, each, 0.0)) for each in (fall, energy, np.ones(len(fall))))
    whole = np.divide(100.0 * used, falls, out=np.full(shape, np.nan), where=falls >= LEAST_FALL)
    colder = np.where(known, np.maximum(MILD_C - ambient, 0.0) * np.maximum(fall, 0.0), 0.0)
    consumption, unknown = _take_logarithm(factor), total(np.ones(len(rides))) > 0.0
    unknown &= np.isnan(consumption)
    return CarDays(
        list(map(str, cars)),
        rides["vehicle_model"].astype(str).to_numpy()[first].tolist(),
        nominal,
        Series(dates, consumption, predicted, noise),
        Series(
            dates, _take_logarithm(whole / nominal[:, np.newaxis]), falls**2 / np.maximum(number, 1.0), np.zeros(shape)
        ),
        total(colder) / np.maximum(falls, 1e-9),
        int(unknown.sum()),
        float(np.abs(measured[unknown]).sum() / np.abs(measured).sum()),
        total(_read(rides, "distance_km")),
    )


def _read(rides: pd.DataFrame, name: str) -> Floats:
    """Return a column of a ride table, NaN where it is absent."""
    return get_numbers(rides, name) if name in rides else np.full(len(rides), np.nan)


def _take_logarithm(factor: Floats) -> Floats:
    """Return the logarithms of factors that a car can have, NaN for others."""
    possible = (factor > 1.0 / LARGEST_FACTOR) & (factor < LARGEST_FACTOR)
    return np.log(factor, out=np.full(factor.shape, np.nan), where=possible)


def write_date(ordinal: int) -> str:
    """Return the ISO date of an ordinal."""
    return date.fromordinal(int(ordinal)).isoformat()


def estimate_day_noise(series: Series, models: list[str]) -> Floats:
    """Return the variance of each value's own noise, (n, t): what is far off beside its siblings has a larger one."""
    beside = subtract_siblings(series, models)
    found, heavy = estimate_wandering(beside, CONSUMPTION)
    heavier = heavy.compute_variance(found) / beside.compute_variance(found)
    return np.asarray(series.compute_variance(found) * heavier)


def subtract_siblings(
    series: Series, models: list[str], noise: Floats | None = None, without: Floats | None = None
) -> Series:
    """Return the deviation of each car from the other cars of its vehicle model.

    The deviations keep the level of the car. A value without enough siblings on its date stays as it is.

    Parameters
    ----------
    noise : (n, t) float, optional
        Variance of each value's own noise, by default that before any data. [1]
    without : (n, t) float, optional
        Values of the siblings where they are others than those of the cars: without their sudden changes. [1]
    """
    given = series.value if without is None else without
    noise = series.compute_variance(CONSUMPTION) if noise is None else noise
    level = np.array([np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else 0.0 for row in given])
    weight = np.where(np.isfinite(given), 1.0 / noise, 0.0)
    apart = np.where(np.isfinite(given), given - level[:, np.newaxis], 0.0)
    value, extra = series.value.copy(), series.extra.copy()
    for name in sorted(set(models)):
        rows = np.array([each == name for each in models])
        others = weight[rows].sum(axis=0) - weight[rows]
        sums = (weight[rows] * apart[rows]).sum(axis=0) - weight[rows] * apart[rows]
        enough = (weight[rows] > 0.0).sum(axis=0) - (weight[rows] > 0.0) >= LEAST_SIBLINGS
        value[rows] -= np.divide(sums, others, out=np.zeros_like(others), where=enough)
        extra[rows] += np.divide(1.0, others, out=np.zeros_like(others), where=enough)
    return series._replace(value=value, extra=extra)
