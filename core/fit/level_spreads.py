"""Estimate the standard deviations of the levels of errors: rows, rides, vehicle-days and cars.

They are those of the largest evidence, with a wide prior about what simulated fleets show. The derivatives of the
evidence are exact: numerical ones are so inexact that the coefficients of a fit would depend on the last digits of its
input. Each level of the elimination maps sums A to B = A - A_s M A_s', with M = (V^-1 + A_ss)^-1 and the variances V of
the effects on the columns s. The derivatives by the sums are passed back level by level.

References
----------
Rasmussen, Williams, Gaussian Processes for Machine Learning, MIT 2006, eq. (2.30) and (5.9): evidence and derivatives.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import minimize

from socast.core.batch import Floats, Ints
from socast.core.fit.nested_effects import (
    EXPECTED_LEVELS,
    SHARED,
    Elimination,
    Gaussian,
    LevelSpreads,
    RideProducts,
    compute_coefficients,
    integrate_car_factor,
)
from socast.core.stats.random_effects import SweepStep, sum_units

MOST_RIDES: Final = 500
"""Number of rides that suffices to estimate the standard deviations of the levels."""
CAR_SPREADS: Final = (0.35, 0.6, 1.0, 1.7, 2.9, 5.0)
"""Spreads of the factors of cars over the most probable one, at equal steps of its logarithm. [1]"""
LEVELS_LOG_SD: Final = LevelSpreads(0.5, 1.0, 1.0, 1.0, 1.0, 0.7)
"""Standard deviation of the logarithm of each about that of the expected one. [1]"""
FARTHEST: Final = 4.0
"""Largest distance of a logarithm from the expected one, over that standard deviation. [1]"""
NEWTON_STEPS: Final = 10
"""Largest number of Newton steps that end the search."""
SMALL_STEP: Final = 1e-9
"""Step at which the search has converged, over the standard deviation of the logarithm. [1]"""
DIFFERENCE: Final = 1e-5
"""Step of the differences of derivatives, over the standard deviation of the logarithm. [1]"""


def integrate_car_spread(elimination: Elimination, prior: Gaussian, spreads: LevelSpreads) -> Gaussian:
    """Return the posterior of the coefficients, integrated over the unknown spread of the factors of cars.

    Few cars tell little of how much cars differ. Their common coefficients are therefore less certain than at the most
    probable spread.

    Returns
    -------
    Gaussian
        Mean and covariance of the mixture over `CAR_SPREADS`; a single one where cars have no factors.
    """
    candidates = [spreads.car * factor for factor in CAR_SPREADS] if spreads.car else [0.0]
    posteriors, logarithms = [], []
    for candidate in candidates:
        cars = integrate_car_factor(elimination.cars, candidate)
        posterior, evidence = _solve(prior, cars.sums.sum(axis=0))
        far = np.log(candidate / EXPECTED_LEVELS.car) / LEVELS_LOG_SD.car if candidate else 0.0
        posteriors.append(posterior)
        logarithms.append(evidence - 0.5 * (float(cars.log_determinant.sum()) + far**2))
    weight = np.exp(np.array(logarithms) - max(logarithms))
    weight /= weight.sum()
    means = np.array([each.mean for each in posteriors])
    mean = weight @ means
    covariance = np.einsum("g,gij->ij", weight, np.array([each.covariance for each in posteriors]))
    return Gaussian(mean, covariance + (means - mean).T @ ((means - mean) * weight[:, np.newaxis]))


class LevelSums(NamedTuple):
    """Hold what the evidence needs of the sums of products of rides.

    The effects of all levels act on the columns of `SHARED` and on the predicted energy. Only the sums of these columns
    are kept for each ride, so that an evaluation takes a fraction of the time that it takes with all columns.

    Parameters
    ----------
    own : (rides, s, s) float
        Sums of the columns of the effects.
    beside : (rides, s, p + 1) float
        Sums of these columns with those of the coefficients and the energy.
    total : (p + 1, p + 1) float
        Sums of the columns of the coefficients and the energy over all rides.
    rows : int
        Number of rows of all rides.
    day, car : (rides,), (days,) int64
        As in `RideProducts`.
    """

    own: Floats
    beside: Floats
    total: Floats
    rows: int
    day: Ints
    car: Ints

    @staticmethod
    def of(products: RideProducts) -> "LevelSums":
        """Return what the evidence needs of the sums of products of rides."""
        sums, first = products.sums, products.coefficients + 1
        return LevelSums(
            np.ascontiguousarray(sums[:, first:, first:]),
            np.ascontiguousarray(sums[:, first:, :first]),
            sums[:, :first, :first].sum(axis=0),
            int(products.rows.sum()),
            products.day,
            products.car,
        )


def differentiate_level_evidence(sums: LevelSums, prior: Gaussian, spreads: LevelSpreads) -> tuple[float, LevelSpreads]:
    """Return the logarithm of the evidence, and its derivatives by the logarithms of the standard deviations.

    Notes
    -----
    The sums are divided by the variance of a row. That multiplies all variances of effects and the sums that are left,
    so the derivative by it follows from those by both.
    """
    scale = 1.0 / spreads.row**2
    of_rides, of_days, of_car = spreads.variances
    none_of_cars = np.zeros(len(of_car))
    rides = SweepStep.of(scale * sums.own, scale * sums.beside, np.append(of_rides, none_of_cars))
    days = _step_up(rides, sums.day, np.append(of_days, none_of_cars))
    cars = _step_up(days, sums.car, np.append(np.zeros(SHARED), of_car))
    total = scale * sums.total - sum(_sum_squares(step) for step in (rides, days, cars))
    posterior, evidence = _solve(prior, total)
    determinants = sum(step.log_determinant for step in (rides, days, cars))
    evidence -= 0.5 * (2.0 * np.log(spreads.row) * sums.rows + determinants)
    outer = np.append(posterior.mean, -1.0)
    by_total = np.outer(outer, outer)  # of minus twice the logarithm, as in `SweepStep.pass_back`
    by_total[:-1, :-1] += posterior.covariance
    by_cars, by_own, by_beside = cars.pass_back(cars.beside @ by_total, None, None)
    by_days, by_own, by_beside = days.pass_back(days.beside @ by_total, by_own[sums.car], by_beside[sums.car])
    by_rides, _, _ = rides.pass_back(rides.beside @ by_total, by_own[sums.day], by_beside[sums.day])
    by_variance = -0.5 * np.concatenate([by_rides[:SHARED], by_days[:SHARED], by_cars[SHARED:]])
    by_effects = 2.0 * np.square(spreads[1:]) * by_variance
    by_row = float(np.sum(by_total * total)) - float(by_effects.sum()) - sums.rows
    return evidence, LevelSpreads(by_row, *by_effects.tolist())


def _step_up(step: SweepStep, parent: Ints, variance: Floats) -> SweepStep:
    """Return the integration over the effects of the level above."""
    return SweepStep.of(sum_units(step.own_left, parent), sum_units(step.beside_left, parent), variance)


def _sum_squares(step: SweepStep) -> Floats:
    """Return what the effects of a level take away from the sums of the coefficients and the energy."""
    wide = step.beside.shape[2]
    return np.asarray(step.beside.reshape(-1, wide).T @ step.gain.reshape(-1, wide))


def estimate_spreads(
    products: RideProducts,
    prior: Gaussian,
    *,
    cars: bool,
    start: LevelSpreads = EXPECTED_LEVELS,
    exact: bool = True,
) -> LevelSpreads:
    """Return the standard deviations of the levels that have the largest evidence, near the expected ones."""
    some = LevelSums.of(products.thinned(MOST_RIDES))
    free = len(EXPECTED_LEVELS) if cars else len(EXPECTED_LEVELS) - 1
    expected, sd = np.log(EXPECTED_LEVELS[:free]), np.array(LEVELS_LOG_SD[:free])

    def convert(x: Floats) -> LevelSpreads:
        values = np.exp(expected + sd * x).tolist()
        return LevelSpreads(*values, *([] if cars else [0.0]))

    def loss(x: Floats) -> tuple[float, Floats]:
        evidence, derivatives = differentiate_level_evidence(some, prior, convert(x))
        return 0.5 * float(x @ x) - evidence, x - np.array(derivatives[:free]) * sd

    begin = np.clip((np.log(np.maximum(start[:free], 1e-6)) - expected) / sd, -FARTHEST, FARTHEST)
    bounds, options = [(-FARTHEST, FARTHEST)] * free, {"maxiter": 30, "ftol": 1e-6, "gtol": 0.05}
    found = minimize(loss, begin, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return convert(_finish(lambda x: loss(x)[1], found.x) if exact else found.x)


def _finish(gradient: Callable[[Floats], Floats], x: Floats) -> Floats:
    """Return the minimum near x by Newton's method with the curvature at x; each step must lower the gradient."""
    slope = gradient(x)
    free = np.flatnonzero(np.abs(x) < FARTHEST)
    differences = np.eye(len(x))[free] * DIFFERENCE
    curvature = np.array([gradient(x + each) - slope for each in differences])[:, free] / DIFFERENCE
    for _ in range(NEWTON_STEPS):
        step = np.zeros(len(x))
        step[free] = np.linalg.solve((curvature + curvature.T) / 2.0, -slope[free])
        moved = np.clip(x + step, -FARTHEST, FARTHEST)
        there = gradient(moved)
        if np.abs(there[free]).sum() >= np.abs(slope[free]).sum():
            break
        x, slope = moved, there
        if np.abs(step).max() < SMALL_STEP:
            break
    return x


def _solve(prior: Gaussian, total: Floats) -> tuple[Gaussian, float]:
    """Return the posterior given sums, and the logarithm of the evidence without the determinant of the errors."""
    p = len(prior.mean)
    posterior = compute_coefficients(prior, total)
    off = posterior.mean - prior.mean
    left = total[p, p] - 2.0 * posterior.mean @ total[:p, p] + posterior.mean @ total[:p, :p] @ posterior.mean
    left += off @ np.linalg.solve(prior.covariance, off)
    _, before = np.linalg.slogdet(prior.covariance)
    _, after = np.linalg.slogdet(posterior.covariance)
    return posterior, -0.5 * float(left + before - after)
