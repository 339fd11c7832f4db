"""Solve a linear model whose errors are correlated within rides, vehicle-days and cars.

The energy of row w of ride r, on vehicle-day d of car c, is

    y = x'b + z'u_r + z'u_d + (x'b) f_c + e,    e ~ N(0, s^2 v),

with coefficients b of Gaussian prior, the consumption factor f_c of a car, and random effects u of each ride and of
each vehicle-day on the columns z: rolling energy and time. Traffic, load and weather that no column tells change the
drive and the power of a whole ride or day. Windows of one ride are therefore no independent observations.

All random effects are Gaussian and nested, so elimination integrates over them one level after the other: first the
rides, then the vehicle-days, then the cars. Each step needs only sums of products of columns, X'WX. The sums of single
rides therefore give every fit to a part of the rides: without a ride, without a day, without a car.

The standard deviations of the levels are those of the largest evidence, with a wide prior about what simulated fleets
show. The derivatives of the evidence are exact: numerical ones are so inexact that the coefficients of a fit would
depend on the last digits of its input. They are passed back level by level.

References
----------
Rasmussen, Williams, Gaussian Processes for Machine Learning, MIT 2006, eq. (2.30) and (5.9): evidence and derivatives.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import lsq_linear, minimize
from scipy.sparse import csc_array

from socast.core.batch import Floats, Ints
from socast.core.stats.random_effects import Integrated, SweepStep, integrate_out, link_units, number_units, sum_units

SHARED: Final = 2
"""Number of columns on which rides and vehicle-days have random effects: rolling energy and time."""
PINNED: Final = 1e-4
"""Standard deviation of a coefficient at a limit over that of its prior. [1]"""
MOST_RIDES: Final = 500
"""Number of rides that suffices to estimate the standard deviations of the levels."""
CAR_SPREADS: Final = (0.35, 0.6, 1.0, 1.7, 2.9, 5.0)
"""Spreads of the factors of cars over the most probable one, at equal steps of its logarithm. [1]"""
FARTHEST: Final = 4.0
"""Largest distance of a logarithm from the expected one, over that standard deviation. [1]"""
NEWTON_STEPS: Final = 10
"""Largest number of Newton steps that end the search."""
SMALL_STEP: Final = 1e-9
"""Step at which a search has converged, over the standard deviation of the prior. [1]"""
DIFFERENCE: Final = 1e-5
"""Step of the differences of derivatives, over the standard deviation of the logarithm. [1]"""


class LevelSpreads(NamedTuple):
    """Hold the standard deviation of the errors of each level.

    Parameters
    ----------
    row : float
        Factor on the standard deviation of each row. [1]
    ride_drive, day_drive : float
        Share of the rolling energy of the catalogue. [1]
    ride_power, day_power : float
        Power. [kW]
    car : float
        Consumption factor of a car minus 1. [1]
    """

    row: float
    ride_drive: float
    ride_power: float
    day_drive: float
    day_power: float
    car: float

    @property
    def variances(self) -> tuple[Floats, Floats, Floats]:
        """Variances of the random effects of rides, of vehicle-days and of cars."""
        every = np.square(np.array(self))
        return every[1:3], every[3:5], every[5:]


EXPECTED_LEVELS: Final = LevelSpreads(1.0, 0.05, 0.1, 0.05, 0.1, 0.03)
"""Expected standard deviations; see `LevelSpreads` for the units. Estimated on simulated fleets."""
LEVELS_LOG_SD: Final = LevelSpreads(0.5, 1.0, 1.0, 1.0, 1.0, 0.7)
"""Standard deviation of the logarithm of each about that of the expected one. [1]"""


class Gaussian(NamedTuple):
    """Hold a Gaussian distribution of p coefficients.

    Parameters
    ----------
    mean : (p,) float
        Mean.
    covariance : (p, p) float
        Covariance.
    """

    mean: Floats
    covariance: Floats


class RideProducts(NamedTuple):
    """Hold sums of products over the rows of each ride; rides are sorted by car, then by day.

    Parameters
    ----------
    sums : (rides, q, q) float
        S'WS of the columns S: the p columns of coefficients, the energy, the columns of `SHARED`, and the predicted
        energy, on which the factor of the car acts.
    rows : (rides,) int64
        Number of rows.
    day : (rides,) int64
        Vehicle-day of each ride, ascending without a gap.
    car : (days,) int64
        Car of each vehicle-day, ascending without a gap.
    """

    sums: Floats
    rows: Ints
    day: Ints
    car: Ints

    @property
    def coefficients(self) -> int:
        """Number of coefficients p."""
        return self.sums.shape[1] - SHARED - 2

    def thinned(self, most: int) -> "RideProducts":
        """Return the rides of some days, drawn at random and equal at every call, at most about `most` rides."""
        days = len(self.car)
        if len(self.rows) <= most:
            return self
        drawn = np.random.default_rng(0).permutation(days)
        count = np.cumsum(np.bincount(self.day, minlength=days)[drawn])
        chosen = np.zeros(days, np.bool_)
        chosen[drawn[: max(int(np.searchsorted(count, most)), 1)]] = True
        inside = chosen[self.day]
        return RideProducts(
            self.sums[inside], self.rows[inside], number_units(self.day[inside]), number_units(self.car[chosen])
        )


class Elimination(NamedTuple):
    """Hold sums of products from which the random effects of rides and vehicle-days are eliminated.

    Parameters
    ----------
    days, cars : (m, q, q) float
        Sums of each vehicle-day without the effects of days, and of each car with the factor of the car.
    ride_gain, day_gain : (m, s, q) float
        Expected effects of each ride and of each vehicle-day for each column.
    """

    days: Floats
    cars: Floats
    ride_gain: Floats
    day_gain: Floats


def eliminate(products: RideProducts, spreads: LevelSpreads) -> Elimination:
    """Return sums without the random effects of rides and of vehicle-days, level by level."""
    p = products.coefficients
    shared = slice(p + 1, p + 1 + SHARED)
    scaled = products.sums / spreads.row**2
    of_rides, of_days, _ = spreads.variances
    rides = integrate_out(scaled, shared, of_rides)
    days = integrate_out(sum_units(rides.sums, products.day), shared, of_days)
    return Elimination(days.sums, sum_units(days.sums, products.car), rides.gain, days.gain)


def integrate_car_factor(cars: Floats, spread: float) -> Integrated:
    """Return the sums of cars without their factors."""
    last = cars.shape[1] - 1
    return integrate_out(cars, slice(last, last + 1), np.array([spread**2]))


def compute_coefficients(prior: Gaussian, sums: Floats) -> Gaussian:
    """Return the posterior of the coefficients, given sums from which all random effects are eliminated."""
    p = len(prior.mean)
    precision = np.linalg.inv(prior.covariance)
    scale = np.sqrt(np.diag(prior.covariance))
    by = np.outer(scale, scale)
    covariance = by * np.linalg.inv((sums[..., :p, :p] + precision) * by)
    mean = (covariance @ (sums[..., :p, p] + precision @ prior.mean)[..., np.newaxis])[..., 0]
    return Gaussian(mean, (covariance + np.swapaxes(covariance, -1, -2)) / 2.0)


def solve_within_limits(prior: Gaussian, sums: Floats, low: Floats, high: Floats) -> tuple[Floats, Gaussian]:
    """Return the most probable coefficients within limits, and the prior that keeps those at a limit there."""
    posterior = compute_coefficients(prior, sums)
    if ((posterior.mean >= low) & (posterior.mean <= high)).all():
        return posterior.mean, prior
    scale = np.sqrt(np.diag(posterior.covariance))
    root = np.linalg.cholesky(np.linalg.inv(posterior.covariance / np.outer(scale, scale)))
    target = root.T @ (posterior.mean / scale)
    found = lsq_linear(root.T, target, (low / scale, high / scale), method="bvls")
    mean, at = np.clip(found.x * scale, low, high), found.active_mask != 0
    covariance = prior.covariance.copy()
    covariance[at], covariance[:, at] = 0.0, 0.0
    covariance[at, at] = (PINNED * np.sqrt(np.diag(prior.covariance))[at]) ** 2
    return mean, Gaussian(np.where(at, mean, prior.mean), covariance)


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
    of_days, of_cars : csc_array
        Matrices of `link_units` that add up rides by vehicle-day, and vehicle-days by car.
    """

    own: Floats
    beside: Floats
    total: Floats
    rows: int
    day: Ints
    car: Ints
    of_days: csc_array
    of_cars: csc_array

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
            link_units(products.day),
            link_units(products.car),
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
    days = _step_up(rides, sums.of_days, np.append(of_days, none_of_cars))
    cars = _step_up(days, sums.of_cars, np.append(np.zeros(SHARED), of_car))
    total = scale * sums.total - sum(step.taken for step in (rides, days, cars))
    posterior, evidence = _solve(prior, total)
    determinants = sum(step.log_determinant for step in (rides, days, cars))
    evidence -= 0.5 * (2.0 * np.log(spreads.row) * sums.rows + determinants)
    outer = np.append(posterior.mean, -1.0)
    by_total = np.outer(outer, outer)  # of minus twice the logarithm, as in `SweepStep.pass_back`
    by_total[:-1, :-1] += posterior.covariance
    by_cars, by_own, by_beside = cars.pass_back(cars.beside @ by_total, None, None)
    by_days, by_own, by_beside = days.pass_back(days.beside @ by_total, by_own[sums.car], by_beside[sums.car])
    by_rides = rides.differentiate(rides.beside @ by_total, by_own[sums.day], by_beside[sums.day])
    by_variance = -0.5 * np.concatenate([by_rides[:SHARED], by_days[:SHARED], by_cars[SHARED:]])
    by_effects = 2.0 * np.square(spreads[1:]) * by_variance
    by_row = float(np.sum(by_total * total)) - float(by_effects.sum()) - sums.rows
    return evidence, LevelSpreads(by_row, *by_effects.tolist())


def _step_up(step: SweepStep, parent: csc_array, variance: Floats) -> SweepStep:
    """Return the integration over the effects of the level above."""
    return SweepStep.of(sum_units(step.own_left, parent), sum_units(step.beside_left, parent), variance)


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
