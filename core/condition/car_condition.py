"""Assess how each car of a fleet is doing: its consumption beside its siblings, its usable battery, and since when.

Rides are summed to car-days (`socast.core.condition.car_days`). A state-space model follows the consumption and the
usable capacity of each car (`socast.core.condition.level_model`), and sudden changes are dated
(`socast.core.condition.level_steps`). What the cold takes off the capacity is estimated of the whole fleet first.
"""

from datetime import date
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from socast.core.batch import Floats
from socast.core.condition.car_days import CarDays, Series, gather_car_days, subtract_siblings
from socast.core.condition.level_model import CAPACITY, CONSUMPTION, Path, Wandering, smooth_levels
from socast.core.condition.level_steps import LevelStep, separate_steps, subtract_steps
from socast.core.condition.records import CarCondition, ConditionStep, FleetCondition, Trend
from socast.core.evaluate.compare.models import select_rides
from socast.core.models import LinearModel
from socast.core.records import ConfidenceInterval
from socast.core.stats.scores import NORMAL_95

COLD_SD: Final = 0.004
"""Standard deviation of the share of the capacity that a kelvin takes off, before any data. [1/K]"""
LARGEST_RATE_SD: Final = 0.8
"""Standard deviation of a rate over that before any data, from which on the data tell little of it. [1]"""
CLEAR_SDS: Final = 3.0
"""Standard deviations from which a rate is told; by chance, one car in 370 has such a rate."""
LEAST_DAYS: Final = 6
"""Number of car-days below which nothing is told of a car."""


class _Followed(NamedTuple):
    """Hold a quantity of n cars: its series, its path with the steps in it, and the steps."""

    series: Series
    path: Path
    steps: list[list[LevelStep]]
    found: Wandering


def assess_condition(rides: pd.DataFrame, model: LinearModel) -> FleetCondition:
    """Return how each car is doing, from its rides and a model of its consumption.

    Parameters
    ----------
    rides : DataFrame
        Ride table, as `socast tables` writes it.

    Raises
    ------
    ModelError
        If there are no rides to compare, or fewer than six dates.
    """
    compared = select_rides(rides, {model.name: model})
    days = gather_car_days(compared, model.name)
    beside, _ = subtract_siblings(days.consumption, days.models, CONSUMPTION.of_day**2, CONSUMPTION.of_amount**2)
    consumption = _follow(beside, CONSUMPTION)
    capacity, cold_loss = _subtract_cold(days)
    batteries = _follow(capacity, CAPACITY)
    cars = [_assess_car(days, i, consumption, batteries) for i in range(len(days.cars))]
    known = np.isfinite(days.consumption.value)
    return FleetCondition(
        model=model.name,
        rides=len(compared.rides),
        car_days=int(known.sum()),
        first_date=_write_date(days.consumption.dates[0]),
        last_date=_write_date(days.consumption.dates[-1]),
        left_out=compared.left_out,
        day_sd_pct=100.0 * consumption.found.of_day,
        cold_loss_pct=None if cold_loss is None else 100.0 * cold_loss,
        cars=sorted(cars, key=_rank, reverse=True),
    )


def _follow(series: Series, prior: Wandering) -> _Followed:
    """Return the paths and the steps of a quantity."""
    found, heavy, steps = separate_steps(series, prior)
    path = smooth_levels(subtract_steps(heavy, steps), found)
    level = subtract_steps(series._replace(value=path.level), steps, 1.0).value
    return _Followed(series, path._replace(level=level), steps, found)


def _subtract_cold(days: CarDays) -> tuple[Series, float | None]:
    """Return the capacities as if it were mild, and what a kelvin of cold takes off, None where nothing tells. [1/K]"""
    value, series = days.capacity.value, days.capacity
    known = np.isfinite(value)
    if not known.any():
        return series, None
    weight = np.where(known, 1.0 / series.compute_variance(CAPACITY.of_day**2, CAPACITY.of_amount**2), 0.0)
    sums = np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    filled = np.where(known, value, 0.0)
    apart = filled - (weight * filled).sum(axis=1, keepdims=True) / sums
    cold = days.cold - (weight * days.cold).sum(axis=1, keepdims=True) / sums
    slope = -float((weight * cold * apart).sum() / ((weight * cold**2).sum() + COLD_SD**-2.0))
    return series._replace(value=value + slope * days.cold), slope


def _assess_car(days: CarDays, i: int, consumption: _Followed, batteries: _Followed) -> CarCondition:
    """Return how a car is doing."""
    same = np.array([each == days.models[i] for each in days.models])
    same[i] = False
    others = consumption.path.level[same, -1]
    siblings = int(np.isfinite(others).sum())
    expected, of_expected = 0.0, 0.0
    if siblings:
        expected = float(np.nanmean(others))
        of_expected = float(np.nanvar(others)) / siblings if siblings > 1 else 0.0
    nominal = float(days.nominal_kwh[i])
    return CarCondition(
        vehicle_id=days.cars[i],
        vehicle_model=days.models[i],
        siblings=siblings,
        consumption=_describe_trend(consumption, i, expected, of_expected),
        capacity=_describe_trend(batteries, i, 0.0, 0.0),
        nominal_kwh=nominal if np.isfinite(nominal) else None,
    )


def _describe_trend(followed: _Followed, i: int, expected: float, of_expected: float) -> Trend | None:
    """Return the trend of a car beside what is expected, None where too few days are known."""
    value, path = followed.series.value[i], followed.path
    known = np.isfinite(value)
    if known.sum() < LEAST_DAYS:
        return None
    level, sd = float(path.level[i, -1]) - expected, float(np.hypot(path.sd[i, -1], np.sqrt(of_expected)))
    rate, rate_sd, shown = 100.0 * float(path.rate[i]), 100.0 * float(path.rate_sd[i]), np.flatnonzero(known)
    tells = rate_sd < LARGEST_RATE_SD * 100.0 * followed.found.rate
    return Trend(
        days=int(known.sum()),
        level_pct=_to_percent(level),
        ci68_pct=(_to_percent(level - sd), _to_percent(level + sd)),
        ci95_pct=(_to_percent(level - NORMAL_95 * sd), _to_percent(level + NORMAL_95 * sd)),
        rate_pct=rate if tells else None,
        rate_ci95_pct=_around(rate, rate_sd) if tells else None,
        is_changing=tells and abs(rate) > CLEAR_SDS * rate_sd,
        steps=[_describe_step(each) for each in followed.steps[i]],
        dates=[_write_date(each) for each in followed.series.dates[shown]],
        measured_pct=_to_percents(value[shown] - expected),
        path_pct=_to_percents(path.level[i, shown] - expected),
        path_sd_pct=[100.0 * each for each in path.sd[i, shown].tolist()],
    )


def _describe_step(step: LevelStep) -> ConditionStep:
    """Return a step as a record."""
    low, high = _around(step.size, step.sd)
    return ConditionStep(
        since=_write_date(step.since),
        interval=(_write_date(step.low), _write_date(step.high)),
        change_pct=_to_percent(step.size),
        ci95_pct=(_to_percent(low), _to_percent(high)),
        probability=step.probability,
    )


def _rank(car: CarCondition) -> float:
    """Return how badly a car is doing: the least that it takes more, or the least that its battery lacks. [%]"""
    more = car.consumption.ci95_pct[0] if car.consumption else -100.0
    less = -car.capacity.ci95_pct[1] if car.capacity else -100.0
    return max(more, less)


def _around(value: float, sd: float) -> ConfidenceInterval:
    """Return the 95 % interval of a value with a standard deviation."""
    return value - NORMAL_95 * sd, value + NORMAL_95 * sd


def _to_percent(log: float) -> float:
    """Return the change that the logarithm of a factor means. [%]"""
    return 100.0 * float(np.expm1(log))


def _to_percents(logs: Floats) -> list[float | None]:
    """Return the changes that logarithms of factors mean. [%]"""
    return [_to_percent(each) for each in logs.tolist()]


def _write_date(ordinal: float) -> str:
    """Return the ISO date of an ordinal."""
    return date.fromordinal(int(ordinal)).isoformat()
