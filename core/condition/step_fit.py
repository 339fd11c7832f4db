"""Fit the change of consumption that came with a campaign, by generalised least squares.

The deviation of a car from its siblings of the same vehicle model (`socast.core.condition.car_days`) on its days is

    y = level + change h + wander + noise,    h = 1 after the begin of the campaign, or on days on, and 0 else,

with the covariance K that `socast.core.condition.level_model` estimates: a level that wanders, a rate, and noise. The
estimate is (X'K⁻¹X)⁻¹ X'K⁻¹ y with X = (1, h). Level and change have no prior, so that the estimate is unbiased, and
whatever drifts widens its interval.

References
----------
Aitken, Proceedings of the Royal Society of Edinburgh 55 (1936) 42, DOI 10.1017/S0370164600014346.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dposv

from socast.core.batch import Floats, Ints
from socast.core.condition.campaign import AFTER, BEFORE, LEAST_DAYS, OUT, States
from socast.core.condition.car_days import LEAST_SIBLINGS, estimate_day_noise, subtract_siblings
from socast.core.condition.level_model import CONSUMPTION, YEAR, Series, Wandering, estimate_wandering


@dataclass(frozen=True)
class DeviationPanel:
    """Hold deviations of n cars on t dates, the variance of their noise, and that part of it that siblings cause."""

    dates: Ints
    value: Floats
    noise: Floats
    shared: Floats
    found: Wandering

    @cached_property
    def wander(self) -> Floats:
        """Covariance of the level of a car on all dates, up to a constant and an unknown rate, (t, t)."""
        return compute_wander(self.dates, self.found)


class StepFit(NamedTuple):
    """Hold an estimated change of the logarithm, its variance, the level before, and the weights of all dates."""

    size: float
    variance: float
    level: float
    weight: Floats

    @property
    def ratio(self) -> float:
        """Estimate over its standard error. [1]"""
        return self.size / self.variance**0.5


def subtract_untreated(series: Series, models: list[str], treated: NDArray[np.bool_]) -> tuple[Series, Floats, Ints]:
    """Return deviations from the siblings without a campaign, the variance that siblings add, and their numbers.

    Of a car that has siblings, days without enough of them are left out: the weather of those days is in them.
    """
    value, extra, noise = series.value.copy(), series.extra.copy(), np.ones_like(series.value)
    untreated = np.flatnonzero(~treated)

    def select(rows: Ints) -> tuple[Series, list[str]]:
        return Series(series.dates, *(each[rows] for each in series[1:])), [models[i] for i in rows]

    if len(untreated):
        noise[untreated] = estimate_day_noise(*select(untreated))
    groups = [(untreated, untreated)]
    groups += [(np.array([row]), np.sort(np.append(untreated, row))) for row in np.flatnonzero(treated)]
    for wanted, rows in groups:
        apart = subtract_siblings(*select(rows), noise[rows])
        at = np.searchsorted(rows, wanted)
        value[wanted], extra[wanted] = apart.value[at], apart.extra[at]
    shared = extra - series.extra
    count = np.array([sum(m == each and not t for m, t in zip(models, treated, strict=True)) for each in models])
    count -= ~treated
    has = ((shared > 0.0) & np.isfinite(value)).sum(axis=1) >= 2 * LEAST_DAYS
    value[has] = np.where(shared[has] > 0.0, value[has], np.nan)
    return series._replace(value=value, extra=extra), shared, np.where(has & (count >= LEAST_SIBLINGS), count, 0)


def estimate_panel(
    deviation: Series, shared: Floats, states: States, treated: NDArray[np.bool_], alike: NDArray[np.bool_]
) -> tuple[DeviationPanel, Series]:
    """Return the panel, and the days before and the days after of each car as cars of their own.

    The days after have a level of their own in the estimate of the variances, so that the change counts as no wander.
    """

    def keep(state: int) -> Floats:
        kept = (states == state) if state == AFTER else (states == state) | ~treated[:, np.newaxis]
        used = kept & (alike if state == BEFORE else treated)[:, np.newaxis]
        return np.where(used, deviation.value, np.nan)

    parts = (np.concatenate((keep(BEFORE), keep(AFTER))), *(np.tile(each, (2, 1)) for each in deviation[2:]))
    found, split = estimate_wandering(Series(deviation.dates, *parts), CONSUMPTION)
    noise = split.compute_variance(found)
    n = len(treated)
    later = (states == AFTER) & treated[:, np.newaxis]
    return DeviationPanel(deviation.dates, deviation.value, np.where(later, noise[n:], noise[:n]), shared, found), split


def compute_wander(dates: Ints, found: Wandering) -> Floats:
    """Return the covariance of a level that wanders from the first date on, with an unknown rate."""
    time = (dates - dates[0]).astype(np.float64)
    rate = (found.rate / YEAR) ** 2 * np.outer(time - time.mean(), time - time.mean())
    return np.asarray(rate + found.wander**2 / YEAR * np.minimum.outer(time, time))


def fit_step(panel: DeviationPanel, row: int, state: States) -> StepFit:
    """Return the change of a car by generalised least squares."""
    used = np.isfinite(panel.value[row]) & (state != OUT)
    wander = panel.wander[used][:, used]
    estimator, variance = weigh_step(wander, panel.noise[row, used], state[used] == AFTER)
    level, size = (estimator @ panel.value[row, used]).tolist()
    weight = np.zeros(len(panel.dates))
    weight[used] = estimator[1]
    return StepFit(size, variance, level, weight)


def weigh_step(wander: Floats, noise: Floats, after: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Return the weights of values in level and change (2, n), and the variance of the change."""
    design = np.column_stack((np.ones(len(after)), after))
    _, solved, failed = dposv(wander + np.diag(noise), design, lower=True)  # without the checks of `cho_factor`
    if failed:
        raise LinAlgError("the covariance of the days is not positive definite")
    inverse = np.linalg.inv(design.T @ solved)
    return inverse @ solved.T, float(inverse[1, 1])


def combine_steps(
    panel: DeviationPanel, fits: list[StepFit], rows: list[int], models: list[str], siblings: Ints
) -> StepFit:
    """Return the change of several cars together by generalised least squares; they share the error of their siblings.

    The level of a deviation wanders with that of the mean of n siblings, a share 1/(n + 1) of its variance. Cars
    without siblings share the weather, to an unknown extent: their errors count as if they were the same.
    """
    wander = panel.wander
    covariance = np.diag([fit.variance for fit in fits])
    for i, first in enumerate(rows):
        for j, second in enumerate(rows[:i]):
            if siblings[first] and models[first] == models[second]:
                both = wander / (siblings[first] + 1.0) + np.diag(np.minimum(panel.shared[first], panel.shared[second]))
                covariance[i, j] = covariance[j, i] = fits[i].weight @ both @ fits[j].weight
    solved = np.linalg.solve(covariance, np.ones(len(fits)))
    weight = solved / solved.sum()
    alone = siblings[rows] == 0
    errors = np.sqrt(np.diag(covariance))
    covariance = np.where(np.outer(alone, alone), np.outer(errors, errors), covariance)
    size, level = (float(weight @ [each[k] for each in fits]) for k in (0, 2))
    return StepFit(size, float(weight @ covariance @ weight), level, np.zeros(len(panel.dates)))
