"""Simulate car-days of fleets in which the consumption of a car changed, and judge the estimates of the change.

`python -m tests.support.campaign_fleets [FLEETS]` prints the bias of the estimates, the coverage of their intervals and
the false alarms, from fleets that differ from the model of the estimate: noise of Student's t, and effects of dates.
"""

import sys
from collections.abc import Iterator
from datetime import date
from typing import Final, NamedTuple

import numpy as np

from socast.core.condition.before_after import Campaign, compare_before_after
from socast.core.condition.campaign_records import BeforeAfter
from socast.core.condition.car_days import CarDays
from socast.core.condition.level_model import Series

FIRST: Final = date(2018, 9, 20).toordinal()
"""Ordinal of the first date."""
BEFORE_DAYS, AFTER_DAYS = 60, 28
AT: Final = FIRST + BEFORE_DAYS
"""Ordinal of the date of the change."""
CARS: Final = 8
FREEDOM: Final = 4.0
"""Degrees of freedom of the noise."""


class Judged(NamedTuple):
    """Hold how estimates of a change of one size fare."""

    change: float
    bias_points: float
    held_90: float
    held_95: float
    shown: float
    placebo_below_10: float
    half_points: float


def make_fleet(change: float, seed: int, *, cars: int = CARS, noise: float = 0.04, changed: int = 1) -> CarDays:
    """Return a fleet of which the first cars changed."""
    draw = np.random.default_rng(seed)
    days = BEFORE_DAYS + 1 + AFTER_DAYS
    dates = FIRST + np.arange(days)
    heavy = draw.standard_t(FREEDOM, (cars, days)) / np.sqrt(FREEDOM / (FREEDOM - 2.0))
    amount = draw.uniform(5.0, 40.0, (cars, days))
    spread = np.sqrt(noise**2 + 0.1**2 / amount)
    wander = np.cumsum(draw.normal(0.0, 0.01 / 365.25**0.5, (cars, days)), axis=1)
    rate = draw.normal(0.0, 0.03 / 365.25, (cars, 1)) * np.arange(days)
    value = draw.normal(0.0, 0.05, (cars, 1)) + draw.normal(0.0, 0.05, days) + wander + rate + spread * heavy
    value[draw.uniform(size=value.shape) < 0.15] = np.nan
    value[:changed] += np.where(dates >= AT, np.log1p(change), 0.0)
    series = Series(dates, value, amount, np.zeros_like(value))
    names = [f"taxi-{i:03}" for i in range(1, cars + 1)]
    return CarDays(names, ["leaf"] * cars, np.full(cars, 24.0), series, series, np.zeros_like(value))


def compare_fleet(change: float, seed: int, **more: float) -> BeforeAfter:
    """Return what is estimated of the changed cars of a fleet."""
    changed = int(more.get("changed", 1))
    cars = tuple(f"taxi-{i:03}" for i in range(1, changed + 1))
    return compare_before_after(make_fleet(change, seed, **more), Campaign(cars, AT), "none")


def judge_changes(changes: tuple[float, ...], fleets: int, **more: float) -> Iterator[Judged]:
    """Yield how the estimates fare at each size."""
    for change in changes:
        found = [compare_fleet(change, seed, **more) for seed in range(fleets)]
        made = [each.change for each in found]
        yield Judged(
            change,
            100.0 * float(np.mean([each.change - change for each in made])),
            float(np.mean([each.ci90[0] <= change <= each.ci90[1] for each in made])),
            float(np.mean([each.ci95[0] <= change <= each.ci95[1] for each in made])),
            float(np.mean([each.is_shown for each in made])),
            float(np.mean([e.placebo.as_large < 0.1 * len(e.placebo.campaigns) for e in found])),
            50.0 * float(np.mean([each.ci90[1] - each.ci90[0] for each in made])),
        )


if __name__ == "__main__":
    for each in judge_changes((0.0, 0.03, 0.06), int(sys.argv[1]) if len(sys.argv) > 1 else 200):
        print(" ".join(f"{name}={value:.4g}" for name, value in each._asdict().items()))
