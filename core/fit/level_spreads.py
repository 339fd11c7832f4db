"""Estimate the standard deviations of the levels of errors: rows, rides, vehicle-days and cars.

They are those of the largest evidence, with a wide prior about what simulated fleets show. The derivatives of the
evidence are exact: numerical ones are so inexact that the coefficients of a fit would depend on the last digits of its
input. Each level of the elimination maps sums A to B = A - A_s M A_s', with M = (V^-1 + A_ss)^-1 and the variances V of
the effects on the columns s. A derivative dA becomes dB = P dA P', with P = I - A_s M E_s', so the derivatives by the
sums are passed back level by level.

References
----------
Rasmussen, Williams, Gaussian Processes for Machine Learning, MIT 2006, eq. (2.30) and (5.9): evidence and derivatives.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.optimize import minimize

from socast.core.batch import Floats
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
from socast.core.stats.random_effects import integrate_out, sum_units

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


def differentiate_level_evidence(
    products: RideProducts, prior: Gaussian, spreads: LevelSpreads
) -> tuple[float, LevelSpreads]:
    """Return the logarithm of the evidence, and its derivatives by the logarithms of the standard deviations."""
    p = products.coefficients
    shared = slice(p + 1, p + 1 + SHARED)
    scaled = products.sums / spreads.row**2
    of_rides, of_days, of_cars = spreads.variances
    rides = integrate_out(scaled, shared, of_rides)
    days = integrate_out(sum_units(rides.sums, products.day), shared, of_days)
    last = scaled.shape[1] - 1
    cars = integrate_out(sum_units(days.sums, products.car), slice(last, last + 1), of_cars)
    total = cars.sums.sum(axis=0)
    posterior, evidence = _solve(prior, total)
    rows = float(products.rows.sum())
    determinants = sum(float(each.log_determinant.sum()) for each in (rides, days, cars))
    evidence -= 0.5 * (2.0 * np.log(spreads.row) * rows + determinants)
    outer = np.append(posterior.mean, -1.0)
    by_total = np.zeros_like(total)
    by_total[: p + 1, : p + 1] = -0.5 * np.outer(outer, outer)
    by_total[:p, :p] -= 0.5 * posterior.covariance
    by_days, by_car = cars.pass_back(np.broadcast_to(by_total, cars.sums.shape))
    by_rides, by_day = days.pass_back(by_days[products.car])
    by_rows, by_ride = rides.pass_back(by_rides[products.day])
    by_row = -2.0 * float(np.sum(by_rows * scaled)) - rows
    by_variance = np.concatenate([by_ride, by_day, by_car])
    return evidence, LevelSpreads(by_row, *(2.0 * np.square(spreads[1:]) * by_variance).tolist())


def estimate_spreads(
    products: RideProducts,
    prior: Gaussian,
    *,
    cars: bool,
    start: LevelSpreads = EXPECTED_LEVELS,
    exact: bool = True,
) -> LevelSpreads:
    """Return the standard deviations of the levels that have the largest evidence, near the expected ones."""
    some = products.thinned(MOST_RIDES)
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
