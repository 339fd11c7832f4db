"""Assess how each car of a fleet is doing: its consumption beside its siblings, its usable battery, and since when.

Rides are summed to car-days (`socast.core.condition.car_days`). A state-space model follows the consumption and the
usable capacity of each car (`socast.core.condition.level_model`), and sudden changes are dated
(`socast.core.condition.level_steps`). What the cold takes off the capacity is estimated of the whole fleet first.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.condition.car_days import (
    LEAST_SIBLINGS,
    CarDays,
    estimate_day_noise,
    forget_cars,
    gather_car_days,
    select_car_day_columns,
    subtract_siblings,
    write_date,
)
from socast.core.condition.known_events import place_events
from socast.core.condition.level_model import CAPACITY, CONSUMPTION, YEAR, Path, Series, Wandering
from socast.core.condition.level_steps import LevelStep, separate_steps, smooth_between_steps, subtract_steps
from socast.core.condition.records import CarCondition, ConditionStep, FleetCondition, Trend
from socast.core.diagnose.inference.events import KnownEvent
from socast.core.evaluate.compare.models import select_rides
from socast.core.models import LinearModel
from socast.core.records import ConfidenceInterval
from socast.core.stats.scores import NORMAL_95

COLD_SD: Final = 0.004
"""Standard deviation of the share of the capacity that a kelvin takes off, before any data. [1/K]"""
FEW_CARS: Final = 12
"""Number of cars of a vehicle model up to which a step of one of them shifts the mean of the others noticeably."""
LARGEST_RATE_SD: Final = 1.3
"""A rate is told if its standard deviation is less than this multiple of that of the rates of cars. [1]"""
CLEAR_SDS: Final = 3.0
"""Number of standard deviations from which a rate is a finding; by chance, one car in 370 has such a rate."""
LEAST_DAYS: Final = 6
"""Number of car-days below which nothing is told of a car."""


class Followed(NamedTuple):
    """Hold a quantity of n cars: its series, its path with the steps in it, and the steps."""

    series: Series
    path: Path
    steps: list[list[LevelStep]]
    found: Wandering


def assess_condition(rides: pd.DataFrame, model: LinearModel, events: Sequence[KnownEvent] = ()) -> FleetCondition:
    """Return how each car is doing, from its rides and a model of its consumption.

    Parameters
    ----------
    rides : DataFrame
        Ride table, as `socast tables` writes it.
    events : sequence of KnownEvent
        Known events, which are placed beside the sudden changes and do not alter them.

    Raises
    ------
    ModelError
        If there are no rides to compare, or fewer than six dates.
    """
    compared = select_rides(select_car_day_columns(rides, model), {model.name: forget_cars(model)})
    days = gather_car_days(compared, model.name)
    consumption = follow_beside_siblings(days.consumption, days.models)
    capacity, cold_loss = _subtract_cold(days)
    batteries = follow(capacity, CAPACITY)
    models, written = np.array(days.models), [write_date(each) for each in days.consumption.dates]
    cars = [_assess_car(days, i, models == models[i], written, consumption, batteries) for i in range(len(models))]
    known = np.isfinite(days.consumption.value)
    result = FleetCondition(
        model=model.name,
        rides=len(compared.rides),
        car_days=int(known.sum()),
        car_days_left_out=days.left_out,
        energy_left_out=days.energy_left_out,
        first_date=written[0],
        last_date=written[-1],
        left_out=compared.left_out,
        day_sd_pct=100.0 * float(np.sqrt(np.median(consumption.series.compute_variance(consumption.found)[known]))),
        cold_loss_pct=None if cold_loss is None else 100.0 * cold_loss,
        cars=sorted(cars, key=_rank),
    )
    return place_events(result, events)


def follow(series: Series, prior: Wandering) -> Followed:
    """Return the paths and the steps of a quantity."""
    found, heavy, steps = separate_steps(series, prior)
    path = smooth_between_steps(heavy, found, steps)
    return Followed(series, path, steps, found)


def follow_beside_siblings(series: Series, models: list[str]) -> Followed:
    """Return the paths and the steps of the consumption of cars beside their siblings.

    A step of one car in a small fleet shifts the mean of its siblings, and so all of them seem to have one. The car
    with the clearest steps is therefore taken first: as a sibling it counts without them, and the others are judged
    anew.
    """
    noise = estimate_day_noise(series, models)
    explained: dict[int, list[LevelStep]] = {}
    counts = {name: models.count(name) for name in models}
    while True:
        taken = [explained.get(i, []) for i in range(len(models))]
        without = subtract_steps(series, taken).value
        beside = subtract_siblings(series, models, noise, without)
        found, heavy, steps = separate_steps(beside, CONSUMPTION)
        open_cars = [i for i, each in enumerate(steps) if each and i not in explained and counts[models[i]] <= FEW_CARS]
        if not open_cars or len(explained) >= FEW_CARS:
            path = smooth_between_steps(heavy, found, steps)
            return Followed(beside, path, steps, found)
        clearest = max(open_cars, key=lambda i: max(abs(each.size) / each.sd for each in steps[i]))
        explained = {i: steps[i] for i in (*explained, clearest)}


def _subtract_cold(days: CarDays) -> tuple[Series, float | None]:
    """Return the capacities as if it were mild, and what a kelvin of cold takes off, None where nothing tells. [1/K]"""
    value, series = days.capacity.value, days.capacity
    known = np.isfinite(value)
    if not known.any():
        return series, None
    weight = np.where(known, 1.0 / series.compute_variance(CAPACITY), 0.0)
    sums = np.maximum(weight.sum(axis=1, keepdims=True), 1e-12)
    years = np.broadcast_to((series.dates - series.dates[0]) / YEAR, value.shape)

    def center(column: Floats) -> Floats:
        filled = np.where(known, column, 0.0)
        return np.asarray(filled - (weight * filled).sum(axis=1, keepdims=True) / sums)

    design = np.stack([-center(days.cold), center(years)])  # all cars also age: a winter is told from a trend
    precision = np.einsum("int,nt,jnt->ij", design, weight, design) + np.diag([COLD_SD**-2.0, CAPACITY.rate**-2.0])
    covariance = np.linalg.inv(precision)
    slope = float((covariance @ np.einsum("int,nt,nt->i", design, weight, center(value)))[0])
    extra = series.extra + covariance[0, 0] * days.cold**2
    return series._replace(value=value + slope * days.cold, extra=extra), slope


def _assess_car(
    days: CarDays, i: int, same: NDArray[np.bool_], dates: list[str], consumption: Followed, batteries: Followed
) -> CarCondition:
    """Return how a car is doing beside those of the same vehicle model."""
    same[i] = False
    others = consumption.path.level[same, -1]
    siblings = int(np.isfinite(others).sum())
    expected, of_expected, has_siblings = 0.0, 0.0, siblings >= LEAST_SIBLINGS
    if has_siblings:
        known = others[np.isfinite(others)]
        expected, of_expected = float(known.mean()), float(known.var(ddof=1)) / siblings
    nominal = float(days.nominal_kwh[i])
    return CarCondition(
        vehicle_id=days.cars[i],
        vehicle_model=days.models[i],
        siblings=siblings if has_siblings else 0,
        consumption=_describe_trend(consumption, i, dates, expected, of_expected),
        capacity=_describe_trend(batteries, i, dates),
        nominal_kwh=nominal if np.isfinite(nominal) else None,
    )


def _describe_trend(
    followed: Followed, i: int, dates: list[str], expected: float = 0.0, of_expected: float = 0.0
) -> Trend | None:
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
        dates=[dates[each] for each in shown.tolist()],
        measured_pct=_to_percents(value[shown] - expected),
        path_pct=_to_percents(path.level[i, shown] - expected),
        path_sd_pct=(100.0 * np.hypot(path.sd[i, shown], np.sqrt(of_expected))).tolist(),
    )


def _describe_step(step: LevelStep) -> ConditionStep:
    """Return a step as a record."""
    low, high = _around(step.size, step.sd)
    return ConditionStep(
        since=write_date(step.since),
        interval=(write_date(step.low), write_date(step.high)),
        change_pct=_to_percent(step.size),
        ci95_pct=(_to_percent(low), _to_percent(high)),
        probability=step.probability,
    )


def _rank(car: CarCondition) -> tuple[bool, float]:
    """Return the place of a car: those with a finding first, and of these the one that takes most."""
    return not car.has_finding, -(car.consumption.level_pct if car.consumption else -100.0)


def _around(value: float, sd: float) -> ConfidenceInterval:
    """Return the 95 % interval of a value with a standard deviation."""
    return value - NORMAL_95 * sd, value + NORMAL_95 * sd


def _to_percent(log: float) -> float:
    """Return the change that the logarithm of a factor means. [%]"""
    return 100.0 * float(np.expm1(log))


def _to_percents(logs: Floats) -> list[float | None]:
    """Return the changes that logarithms of factors mean. [%]"""
    return list((100.0 * np.expm1(logs)).tolist())
