"""Judge the condition of cars on made-up series of car-days, whose laws are not those of the model, and publish.

Noise has heavy tails, drivers alternate, dates share the weather, and a season is common to all cars. Series of
car-days are made, not telemetry, so that a fleet of 300 days takes no simulation of weeks.

What a test of steps can reach is measured on the same series: a likelihood ratio that knows the variances of all parts,
and the date of the step or not, with a threshold that the share `FALSE` of cars without a step exceeds.

Example: python -m socast.tools.bench.condition_fleets
"""

from collections.abc import Callable, Iterator, Sequence
from datetime import date
from functools import partial
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.stats import binomtest

from socast.core.batch import Floats
from socast.core.condition.car_condition import CLEAR_SDS, Followed, follow, follow_beside_siblings
from socast.core.condition.level_model import CAPACITY, Series
from socast.core.condition.level_steps import LEAST_SIDE, STEP_SD
from socast.core.stats.scores import NORMAL_95
from socast.tools.bench.figures.published import make_parser, publish, write_goal, write_table, write_verdict

FIRST: Final = date(2018, 9, 1).toordinal()
"""First date of the made-up fleets."""
CARS: Final = 8
FLEETS: Final = 300
"""Number of fleets of each kind."""
SEED: Final = 4400
"""First seed, on which nothing was chosen."""
FALSE: Final = 0.006
"""Share of cars without a step that may seem to have one: one car in 20 fleets. [1]"""
Goal = tuple[float, float]
"""Least and largest share with which a goal is met. [1]"""
FEW: Final[Goal] = (0.0, FALSE)
HELD: Final[Goal] = (0.93, 0.97)
HELD_68: Final[Goal] = (0.65, 0.71)
HELD_DATE: Final[Goal] = (0.88, 0.95)
HEADS: Final = ("what", "goal", "measured", "")
STEPS: Final = (CARS, 60, 0.06), (CARS, 120, 0.06), (5, 120, 0.1), (3, 120, 0.15)
"""Cars, days and planted step of the fleets."""
RATE: Final = 0.04
FADE: Final = 0.05
"""Planted rates of the consumption and of the capacity a year. [1]"""
AGING: Final = 0.02
"""Share of the capacity that each of the other batteries loses in a year. [1]"""
WANDERS: Final = (0.0, 0.005, 0.01, 0.02)
"""Standard deviations by which capacities wander in a year. [1]"""
NEAR: Final = 4
"""Days with driving within which a step is dated well."""


def make_fleet(
    seed: int,
    cars: int = CARS,
    days: int = 120,
    *,
    step: float = 0.0,
    at: int = 60,
    rate: float = 0.0,
    is_noisy: bool = True,
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
    value = 0.05 * rng.normal(size=(cars, 1)) + is_noisy * (of_date + noise + drivers)
    value += 0.01 / np.sqrt(365.0) * rng.normal(size=(cars, days)).cumsum(axis=1)
    value[0, at:] += step
    value[0] += rate * time / 365.25
    value[is_noisy & (rng.uniform(size=(cars, days)) < 1.0 / 7.0)] = np.nan
    return Series(FIRST + time, value, amount, np.zeros((cars, days)))


def make_batteries(
    seed: int, cars: int = CARS, days: int = 300, *, fade: float = AGING, aging: float = AGING, wander: float = 0.0
) -> Series:
    """Return the logarithms of the usable capacities of cars that lose a share in a year, the first one another share.

    They wander by a standard deviation in a year.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(days)
    fall = rng.uniform(20.0, 60.0, (cars, days))
    value = 0.04 * rng.normal(size=(cars, 1)) - aging * time / 365.25 + 0.7 * rng.standard_t(5, (cars, days)) / fall
    value[0] -= (fade - aging) * time / 365.25
    value[rng.uniform(size=(cars, days)) < 0.3] = np.nan
    value += wander / np.sqrt(365.0) * rng.normal(size=(cars, days)).cumsum(axis=1)
    return Series(FIRST + time, value, fall**2, np.zeros((cars, days)))


def draw_steps(days: int) -> Iterator[tuple[int, float]]:
    """Yield the place and the sign of the step of each fleet."""
    rng = np.random.default_rng(SEED)
    for _ in range(FLEETS):
        yield int(rng.integers(days // 5, 4 * days // 5)), float(rng.choice([-1.0, 1.0]))


def measure_limit(cars: int, days: int, size: float) -> list[list[str]]:
    """Return how often a likelihood ratio that knows all variances finds the steps of `judge_steps`."""
    healthy, stepped, near = list[tuple[float, float]](), list[tuple[float, float]](), list[bool]()
    for number, (at, sign) in enumerate(draw_steps(days)):
        series, with_step = (make_fleet(SEED + number, cars, days, step=step, at=at) for step in (0.0, sign * size))
        car, day = np.nonzero(np.isfinite(series.value))
        same_car, same_day = car[:, np.newaxis] == car, day[:, np.newaxis] == day
        covariance = same_car * (0.05**2 + 0.01**2 / 365.0 * np.minimum.outer(day, day))
        covariance += same_day * (0.03**2 + 0.5 * 0.02**2)
        covariance[np.diag_indices(len(car))] += 0.03**2 + 0.15**2 / series.amount[car, day] + 0.01**2
        root = np.linalg.cholesky(covariance)
        white, white_step = (solve_triangular(root, each.value[car, day], lower=True) for each in (series, with_step))
        for one in range(cars):
            days_driven = day[car == one]
            places = days_driven[LEAST_SIDE : len(days_driven) - LEAST_SIDE + 1]
            steps = ((car == one)[:, np.newaxis] & (day[:, np.newaxis] >= places)).astype(np.float64)
            steps = solve_triangular(root, steps, lower=True)
            place = min(int(np.searchsorted(places, at)), len(places) - 1)
            healthy.append(_weigh(steps, white, place)[:2])
            if one == 0:
                *ratios, likeliest = _weigh(steps, white_step, place)
                stepped.append((ratios[0], ratios[1]))
                near.append(abs(int(places[likeliest]) - at) <= days // 8)
    least = np.quantile(healthy, 1.0 - FALSE, axis=0)
    dated, undated = (np.array(stepped) > least).T
    undated &= near
    what = f"step of {100 * size:.0f} % in one of {cars} cars, {days} days: found by a test that knows all variances"
    return [write_row(f"{what} and the date", None, dated.tolist()), write_row(what, None, undated.tolist())]


def _weigh(steps: Floats, value: Floats, place: int) -> tuple[float, float, int]:
    """Return the likelihood ratio of a step at a place, the mean evidence of one anywhere, and the likeliest place."""
    score, information = steps.T @ value, (steps**2).sum(axis=0)
    precise = information + STEP_SD**-2.0
    evidence = 0.5 * score**2 / precise - 0.5 * np.log(precise * STEP_SD**2)
    return float(score[place] ** 2 / information[place]), float(np.exp(evidence).mean()), int(np.argmax(evidence))


def judge_steps(cars: int, days: int, size: float) -> list[list[str]]:
    """Return how steps of one car in each fleet are found, and what they do to the others."""
    found, near, held, sized, now, false = [], [], [], [], [], list[bool]()
    for number, (at, sign) in enumerate(draw_steps(days)):
        series = make_fleet(SEED + number, cars, days, step=sign * size, at=at)
        fleet = follow_beside_siblings(series, ["m"] * cars)
        driven = fleet.series.dates[np.isfinite(fleet.series.value[0])]
        place = int(np.searchsorted(driven, FIRST + at))
        first = int(driven[place])
        off = [abs(int(np.searchsorted(driven, each.since)) - place) for each in fleet.steps[0]]
        right = [fleet.steps[0][int(np.argmin(off))]] if off and min(off) <= days // 8 else []
        found.append(bool(right))
        near += [min(off) <= NEAR for _ in right]
        held += [each.low <= first <= each.high for each in right]
        sized += [abs(each.size - sign * size) <= NORMAL_95 * each.sd for each in right]
        false += [bool(each) for each in fleet.steps[1:]]
        level = make_fleet(SEED + number, cars, days, step=sign * size, at=at, is_noisy=False)
        truth = level.value[0, -1] - level.value[1:, -1].mean()
        beside = fleet.path.level[0, -1] - fleet.path.level[1:, -1].mean()
        sd = np.hypot(fleet.path.sd[0, -1], np.sqrt((fleet.path.sd[1:, -1] ** 2).sum()) / (cars - 1))
        now.append(abs(beside - truth) <= NORMAL_95 * sd)
    what = f"step of {100 * size:.0f} % in one of {cars} cars, {days} days"
    return [
        write_row(f"{what}: found", (0.8, 1.0), found),
        write_row(f"{what}: dated within {NEAR} days with driving", (0.75, 1.0), near),
        write_row(f"{what}: 90 % interval holds the date", HELD_DATE, held),
        write_row(f"{what}: 95 % interval holds the size", HELD, sized),
        write_row(f"{what}: 95 % interval holds the last level beside the others", HELD, now),
        write_row(f"{what}: other cars with a step", FEW, false),
    ]


def judge_rates(what: str, follow_fleet: Callable[[int], Followed], truth: float, of_others: float) -> list[list[str]]:
    """Return how the rate of one car in each fleet is found, and how often others seem to change."""
    held, others, narrow, told = list[bool](), list[bool](), list[bool](), list[bool]()
    for number in range(FLEETS):
        path = follow_fleet(SEED + number).path
        off = np.abs(path.rate - np.r_[truth, np.full(len(path.rate) - 1, of_others)])
        held.append(bool(off[0] <= NORMAL_95 * path.rate_sd[0]))
        others += (off[1:] <= NORMAL_95 * path.rate_sd[1:]).tolist()
        narrow += (off <= path.rate_sd).tolist()
        told += (off[1:] > CLEAR_SDS * path.rate_sd[1:]).tolist()
    return [
        write_row(f"{what}: 95 % interval holds the rate", HELD, held),
        write_row(f"{what}: 95 % interval holds the rates of the others", HELD, others),
        write_row(f"{what}: 68 % interval holds the rates of all", HELD_68, narrow),
        write_row(f"{what}: others further than {CLEAR_SDS:.0f} standard deviations from the truth", FEW, told),
    ]


def judge_constant(wander: float) -> list[str]:
    """Return how many batteries that hold what they held seem to change, by a rate or a step."""
    told = list[bool]()
    for number in range(FLEETS):
        fleet = follow(make_batteries(SEED + number, fade=0.0, aging=0.0, wander=wander), CAPACITY)
        changing = np.abs(fleet.path.rate) > CLEAR_SDS * fleet.path.rate_sd
        told += [bool(rate or steps) for rate, steps in zip(changing, fleet.steps, strict=True)]
    what = f"{CARS} batteries that lose nothing, 300 days{_describe_wander(wander)}: seem to change"
    return write_row(what, FEW, told)


def _follow_batteries(wander: float, seed: int) -> Followed:
    """Return the paths of the capacities of a fleet."""
    return follow(make_batteries(seed, fade=FADE, wander=wander), CAPACITY)


def _describe_wander(wander: float) -> str:
    """Return by how much capacities wander, as the end of a sentence."""
    return f", which wander by {100 * wander:g} % in a year" if wander else ""


def write_row(what: str, goal: Goal | None, values: Sequence[bool]) -> list[str]:
    """Return what was measured beside its goal, as cells below `HEADS`."""
    if goal is None:
        return [what, "", write_share(values), write_verdict(None)]
    met = bool(values) and goal[0] <= float(np.mean(values)) <= goal[1]
    return [what, write_goal(*goal), write_share(values), write_verdict(met)]


def write_share(values: Sequence[bool]) -> str:
    """Return a share with its 95 % interval and its number of cases."""
    if not values:
        return "none"
    low, high = binomtest(sum(values), len(values)).proportion_ci(method="wilson")
    return f"{100.0 * np.mean(values):.1f} % ({100.0 * low:.0f} to {100.0 * high:.0f}; n {len(values)})"


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge and publish."""
    make_parser("condition_fleets", __doc__).parse_args(arguments)
    rows = [row for kind in STEPS for row in judge_steps(*kind)]
    rows += [row for kind in STEPS[:2] for row in measure_limit(*kind)]
    models = ["m"] * CARS
    what = f"{100 * RATE:.0f} % more each year in one of {CARS} cars, 300 days"
    of_others = -RATE / (CARS - 1)  # beside siblings, one of which changes
    rows += judge_rates(
        what, lambda seed: follow_beside_siblings(make_fleet(seed, days=300, rate=RATE), models), RATE, of_others
    )
    what = (
        f"battery that fades by {100 * FADE:.0f} % a year beside {CARS - 1} that fade by {100 * AGING:.0f} %, 300 days"
    )
    for wander in WANDERS:
        rows += judge_rates(what + _describe_wander(wander), partial(_follow_batteries, wander), -FADE, -AGING)
    rows += [judge_constant(wander) for wander in WANDERS[:-1]]
    about = (
        f"{FLEETS} made-up fleets for each line, seeds from {SEED} on, whose laws are not those of the model: noise "
        "with heavy tails, alternating drivers, weather that dates share, a season. The tests that know all variances "
        f"call {100 * FALSE:.1f} % of healthy cars stepped. In parentheses: 95 % interval (Wilson)."
    )
    command = "python -m socast.tools.bench.condition_fleets"
    publish("condition", command, [about, "", *write_table(HEADS, rows)])


if __name__ == "__main__":
    main()
