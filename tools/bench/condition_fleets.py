"""Judge the condition of cars on made-up series of car-days, whose laws are not those of the model, and publish.

Noise has heavy tails, drivers alternate, dates share the weather, and a season is common to all cars. Series of
car-days are made, not telemetry, so that a fleet of 300 days takes no simulation of weeks.

Example: python -m socast.tools.bench.condition_fleets
"""

import argparse
from collections.abc import Callable, Sequence
from datetime import date
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.condition.car_days import Series, subtract_siblings
from socast.core.condition.level_model import CAPACITY, CONSUMPTION, Path, Wandering, smooth_levels
from socast.core.condition.level_steps import LevelStep, separate_steps, subtract_steps
from socast.core.stats.scores import NORMAL_95
from socast.tools.bench.figures.published import publish, write_table

FIRST: Final = date(2018, 9, 1).toordinal()
"""First date of the made-up fleets."""
CARS: Final = 8
FLEETS: Final = 40
"""Number of fleets of each kind."""
SEED: Final = 500
STEP: Final = 0.06
RATE: Final = 0.04
FADE: Final = 0.05
"""Planted step, and rates of the consumption and of the capacity a year. [1]"""
NEAR: Final = 4
"""Days with driving within which a step is dated well."""


def make_fleet(
    seed: int, cars: int = CARS, days: int = 120, *, step: float = 0.0, at: int = 60, rate: float = 0.0
) -> Series:
    """Return the logarithms of the consumption factors of cars; a step or rate [1/year] is of the first one.

    Each car rests on one day in seven. Dates share a deviation of 3 % and a season, cars differ by 5 %, two drivers of
    a car by 2 %, and the noise of a day is Student's t with four degrees of freedom.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(days)
    amount = rng.uniform(5.0, 25.0, (cars, days))
    of_date = 0.03 * rng.normal(size=days) + 0.02 * np.sin(2.0 * np.pi * time / 365.0)
    noise = 0.03 / np.sqrt(2.0) * rng.standard_t(4, size=(cars, days))
    noise += 0.15 * rng.normal(size=(cars, days)) / np.sqrt(amount)
    drivers = 0.01 * rng.choice([-1.0, 1.0], size=(cars, days))
    value = 0.05 * rng.normal(size=(cars, 1)) + of_date + noise + drivers
    value += 0.01 / np.sqrt(365.0) * rng.normal(size=(cars, days)).cumsum(axis=1)
    value[0, at:] += step
    value[0] += rate * time / 365.25
    value[rng.uniform(size=(cars, days)) < 1.0 / 7.0] = np.nan
    return Series(FIRST + time, value, amount, np.zeros((cars, days)))


def make_batteries(seed: int, days: int = 300, *, fade: float = 0.0) -> Series:
    """Return the logarithms of the usable capacities of cars, all of which fade by 2 % a year, the first by more."""
    rng = np.random.default_rng(seed)
    time = np.arange(days)
    fall = rng.uniform(20.0, 60.0, (CARS, days))
    value = 0.04 * rng.normal(size=(CARS, 1)) - 0.02 * time / 365.25 + 0.7 * rng.standard_t(5, (CARS, days)) / fall
    value[0] -= (fade - 0.02) * time / 365.25 if fade else 0.0
    value[rng.uniform(size=(CARS, days)) < 0.3] = np.nan
    return Series(FIRST + time, value, fall**2, np.zeros((CARS, days)))


class Judged(NamedTuple):
    """Hold what was found of a fleet."""

    series: Series
    path: Path
    steps: list[list[LevelStep]]


def judge(series: Series, prior: Wandering, *, has_siblings: bool) -> Judged:
    """Return what is found of a fleet, as `assess_condition` finds it."""
    if has_siblings:
        series, _ = subtract_siblings(series, ["m"] * len(series.value), prior.of_day**2, prior.of_amount**2)
    found, heavy, steps = separate_steps(series, prior)
    return Judged(series, smooth_levels(subtract_steps(heavy, steps), found), steps)


def judge_steps(days: int) -> list[list[str]]:
    """Return how steps of one car in each fleet are found."""
    rng, found, near, held, sized, false = np.random.default_rng(SEED), [], [], [], [], 0
    for number in range(FLEETS):
        at, sign = int(rng.integers(days // 5, 4 * days // 5)), float(rng.choice([-1.0, 1.0]))
        fleet = judge(make_fleet(SEED + number, days=days, step=sign * STEP, at=at), CONSUMPTION, has_siblings=True)
        driven = fleet.series.dates[np.isfinite(fleet.series.value[0])]
        first = int(driven[driven >= FIRST + at][0])
        place = {int(day): i for i, day in enumerate(driven)}
        right = [each for each in fleet.steps[0] if abs(each.since - first) <= days // 4][:1]
        found.append(bool(right))
        near += [abs(place[each.since] - place[first]) <= NEAR for each in right]
        held += [each.low <= first <= each.high for each in right]
        sized += [abs(each.size - sign * STEP) <= NORMAL_95 * each.sd for each in right]
        false += sum(map(bool, fleet.steps[1:]))
    what = f"step of {100 * STEP:.0f} % in one of {CARS} cars, {days} days"
    return [
        [f"{what}: found", "80 %", _share(found)],
        [f"{what}: dated within {NEAR} days with driving", "75 %", _share(near)],
        [f"{what}: interval holds the date", "88 to 95 %", _share(held)],
        [f"{what}: 95 % interval holds the size", "93 to 97 %", _share(sized)],
        [f"{what}: other cars with a step", "0.6 %", f"{100.0 * false / FLEETS / (CARS - 1):.1f} %"],
    ]


def judge_rates(
    what: str, make: Callable[[int], Series], prior: Wandering, truth: float, of_others: float, *, has_siblings: bool
) -> list[list[str]]:
    """Return how the rate of one car in each fleet is found, and how often others seem to change."""
    held, others, told = list[bool](), list[bool](), 0
    for number in range(FLEETS):
        path = judge(make(SEED + number), prior, has_siblings=has_siblings).path
        off = np.abs(path.rate - np.r_[truth, np.full(CARS - 1, of_others)])
        inside = off <= NORMAL_95 * path.rate_sd
        held.append(bool(inside[0]))
        others += inside[1:].tolist()
        told += int((np.abs(path.rate[1:] - of_others) > 3.0 * path.rate_sd[1:]).sum())
    return [
        [f"{what}: 95 % interval holds the rate", "93 to 97 %", _share(held)],
        [f"{what}: 95 % interval holds the rates of the others", "93 to 97 %", _share(others)],
        [f"{what}: others beyond three standard deviations", "0.6 %", f"{100.0 * told / len(others):.1f} %"],
    ]


def _share(values: Sequence[bool] | Floats) -> str:
    """Return a share and its number of cases."""
    return f"{100.0 * np.mean(values):.0f} % (n {len(values)})" if len(values) else "none"


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge and publish."""
    argparse.ArgumentParser("condition_fleets", description=(__doc__ or "").splitlines()[0]).parse_args(arguments)
    rows = [*judge_steps(60), *judge_steps(120)]
    what = f"{100 * RATE:.0f} % more each year in one of {CARS} cars, 300 days"
    of_others = -RATE / (CARS - 1)  # beside siblings, one of which changes
    rows += judge_rates(
        what, lambda seed: make_fleet(seed, days=300, rate=RATE), CONSUMPTION, RATE, of_others, has_siblings=True
    )
    what = f"battery that fades by {100 * FADE:.0f} % a year beside {CARS - 1} that fade by 2 %, 300 days"
    rows += judge_rates(what, lambda seed: make_batteries(seed, fade=FADE), CAPACITY, -FADE, -0.02, has_siblings=False)
    about = (
        f"{FLEETS} made-up fleets of {CARS} cars for each line, seeds from {SEED} on, whose laws are not those of the "
        "model: noise with heavy tails, alternating drivers, weather that dates share, a season."
    )
    publish(
        "condition",
        "python -m socast.tools.bench.condition_fleets",
        [about, "", *write_table(["what", "goal", "measured"], rows)],
    )


if __name__ == "__main__":
    main()
