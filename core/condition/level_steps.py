"""Find when the level of a car changed: compare a state-space model with and without a step on each date.

Without a step, the values of a car are Gaussian with the covariance K that its state-space model gives
(`socast.core.condition.level_model`). A step of unknown size a ~ N(0, `STEP_SD`²) since date τ changes the evidence by

    log B(τ) = b² / (2 (A + 1/s²)) - log(1 + A s²) / 2,    A = h'K⁻¹h, b = h'K⁻¹(y - mean),

where h is 0 before τ and 1 from then on. All dates are equally likely before the data. What wanders or changes by a
constant rate is in K, so that a slow change is no step. Steps are searched one after another. A and b of all dates come
from one pass of `socast.core.condition.level_smoother`.

References
----------
Harvey, Koopman, Journal of Business & Economic Statistics 10 (1992) 377, DOI 10.1080/07350015.1992.10509913, on
auxiliary residuals of breaks in the level. Kass, Raftery, Journal of the American Statistical Association 90 (1995)
773, DOI 10.1080/01621459.1995.10476572, on evidence.
"""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.condition.level_model import (
    MOST_CARS,
    YEAR,
    Path,
    Series,
    Wandering,
    average_wander,
    estimate_wandering,
    smooth_cars,
)
from socast.core.condition.level_smoother import SmoothedLevel, smooth_level
from socast.core.condition.step_mixture import NO_SHOCK, mix_shocks

STEP_SD: Final = 0.06
"""Standard deviation of the size of a step before any data. [1]"""
REPORTED: Final = 0.8
"""Probability of a step from which it is reported. [1]"""
SUSPECTED: Final = 0.5
"""Probability of a step from which it does not count as wandering. [1]"""
WEIGHED: Final = 0.1
"""Probability of a step from which the level is a mean over the step and none. [1]"""
MOST_STEPS: Final = 3
"""Largest number of steps of a car."""
ROUNDS: Final = 4
"""Largest number of times that the variances are estimated without the suspected steps."""
LEAST_SIDE: Final = 3
"""Number of days with measurements before and after a step."""
DATE_SHARE: Final = 0.9
"""Probability that the interval of the date holds it. [1]"""


class LevelStep(NamedTuple):
    """Hold a step of the level of a car.

    Parameters
    ----------
    since, low, high : int
        Ordinal of the first date after it, and the interval of that.
    size, sd : float
        Change of the level and its standard deviation. [1]
    probability : float
        That there is a step at all. [1]
    """

    since: int
    low: int
    high: int
    size: float
    sd: float
    probability: float


def separate_steps(series: Series, prior: Wandering) -> tuple[Wandering, Series, list[list[LevelStep]]]:
    """Return the variances of a quantity, the series with larger variances of what is far off, and each car's steps.

    The variances are estimated again without the steps that the first ones let suspect, until the same steps are
    suspected by the variances without them: a level that wanders far seems to step at first.
    """
    found, rough = estimate_wandering(series, prior)
    quiet, every = found._replace(wander=min(found.wander, prior.wander)), max(-(-len(series.value) // MOST_CARS), 1)
    suspected = _list_steps(rough, quiet, SUSPECTED, every)
    for _ in range(ROUNDS):
        without = subtract_steps(series, suspected)
        found, heavy = estimate_wandering(without, prior)
        heavy, before = heavy._replace(value=series.value), suspected
        suspected = _list_steps(heavy, found, SUSPECTED, every)
        if all([a.since for a in of] == [b.since for b in was] for of, was in zip(suspected, before, strict=True)):
            break
    return average_wander(without, heavy, found, prior), heavy, _list_steps(heavy, found, REPORTED)


def subtract_steps(series: Series, steps: list[list[LevelStep]]) -> Series:
    """Return the series without the steps of its cars."""
    value = series.value.copy()
    for row, of_car in zip(value, steps, strict=True):
        for step in of_car:
            row[series.dates >= step.since] -= step.size
    return series._replace(value=value)


def _list_steps(series: Series, found: Wandering, least: float, every: int = 1) -> list[list[LevelStep]]:
    """Return the steps of each car, or of one of so many."""
    variance, out = series.compute_variance(found), list[list[LevelStep]]()
    for i, value in enumerate(series.value):
        known = np.isfinite(value)
        of_car = series.dates[known].astype(np.float64), value[known], variance[i][known]
        out.append(find_steps(*of_car, found, least) if i % every == 0 else [])
    return out


def find_steps(
    dates: Floats, value: Floats, variance: Floats, found: Wandering, least: float = REPORTED
) -> list[LevelStep]:
    """Return the steps of a car that are at least so probable, in the order of their dates.

    Parameters
    ----------
    dates, value, variance : (n,) float
        Ordinals of the dates with a measurement, the values, and the variances of their noise. [d], [1], [1]
    """
    n = len(value)
    if n < 2 * LEAST_SIDE:
        return []
    steps: list[LevelStep] = []
    gaps, shocks, variances = np.diff(dates, prepend=dates[0]), np.zeros(n), found.compute_variances()
    mean = float(np.average(value, weights=1.0 / variance))
    for _ in range(MOST_STEPS):
        car = smooth_level(value, variance, gaps, shocks, start=mean, variances=variances)
        step, at = _find_step(dates, car, found.steps)
        if step.probability < least:
            break
        steps.append(step)
        shocks[at] += STEP_SD**2
    return sorted(steps)


class _Evidence(NamedTuple):
    """Hold the steps that may begin on n places of a car.

    Parameters
    ----------
    places, odds, sizes, variances : (n,)
        Place among the measurements; odds against no step [1]; size and its variance [1].
    """

    places: Ints
    odds: Floats
    sizes: Floats
    variances: Floats

    @property
    def probability(self) -> float:
        """Probability of a step on any of the dates. [1]"""
        total = float(self.odds.sum())
        return total / (1.0 + total)

    def rank_likely(self) -> Ints:
        """Return the likeliest ones, which hold the date with a probability of `DATE_SHARE`, by their odds."""
        chances = self.odds / self.odds.sum()
        order = np.argsort(-chances, kind="stable")
        return order[: int(np.searchsorted(np.cumsum(chances[order]), DATE_SHARE)) + 1]


def _weigh_steps(dates: Floats, score: Floats, information: Floats, steps: float) -> _Evidence:
    """Return the evidence of a step on each date with enough measurements before and after.

    Units: steps [1/year].
    """
    places = np.arange(LEAST_SIDE, len(dates) - LEAST_SIDE + 1)
    precise, match = information[places] + STEP_SD**-2.0, score[places]
    evidence = 0.5 * match**2 / precise - 0.5 * np.log(precise * STEP_SD**2)
    prior = steps * max(float(dates[-1] - dates[0]), 1.0) / YEAR / len(places)
    return _Evidence(places, prior * np.exp(np.clip(evidence, -50.0, 600.0)), match / precise, 1.0 / precise)


def _find_step(dates: Floats, car: SmoothedLevel, steps: float) -> tuple[LevelStep, int]:
    """Return the most likely step, and the place of its date, where so many are expected in a year."""
    found = _weigh_steps(dates, car.score, car.information, steps)
    chances, inside, best = found.odds / found.odds.sum(), found.rank_likely(), int(np.argmax(found.odds))
    size = float(chances @ found.sizes)
    sd = float(np.sqrt(chances @ (found.variances + (found.sizes - size) ** 2)))
    since = dates[found.places].astype(np.int64)
    low, high = int(since[inside].min()), int(since[inside].max())
    step = LevelStep(int(since[best]), low, high, size, sd, found.probability)
    return step, int(found.places[best])


def smooth_between_steps(series: Series, found: Wandering, steps: list[list[LevelStep]]) -> Path:
    """Return the smoothed paths of cars with the steps that were found, averaged over one more step and none.

    A step that is too uncertain to be reported is weighed by its probability, if that is at least `WEIGHED`, so that
    the interval holds what the level would be with it and without. The level is the mean of this mixture, with its
    standard deviation. The rate is that without such a step.
    """
    path, variances = Path.make_empty(series), found.compute_variances()
    for car in smooth_cars(series, found, [[each.since for each in of_car] for of_car in steps]):
        known, added = np.flatnonzero(car.known), NO_SHOCK
        if len(known) >= 2 * LEAST_SIDE:
            evidence = car.smoothed.score[known], car.smoothed.information[known]
            weighed = _weigh_steps(series.dates[known].astype(np.float64), *evidence, found.steps)
            if (chance := weighed.probability) >= WEIGHED:
                likely = np.sort(weighed.rank_likely())
                chances = chance * weighed.odds[likely] / weighed.odds[likely].sum()
                places, of_steps = known[weighed.places[likely]], (weighed.sizes[likely], weighed.variances[likely])
                added = mix_shocks(*car[1:5], variances, places, chances, *of_steps)
        path.put(car.row, car.smoothed, found, added)
    return path
