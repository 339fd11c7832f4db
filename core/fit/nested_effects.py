"""Solve a linear model whose errors are correlated within rides, vehicle-days and cars.

The energy of row w of ride r, on vehicle-day d of car c, is

    y = x'b + z'u_r + z'u_d + (x'b) f_c + e,    e ~ N(0, s^2 v),

with coefficients b of Gaussian prior, the consumption factor f_c of a car, and random effects u of each ride and of
each vehicle-day on the columns z: rolling energy and time. Traffic, load and weather that no column tells change the
drive and the power of a whole ride or day. Windows of one ride are therefore no independent observations.

All random effects are Gaussian and nested, so elimination integrates over them one level after the other: first the
rides, then the vehicle-days, then the cars. Each step needs only sums of products of columns, X'WX. The sums of single
rides therefore give every fit to a part of the rides: without a ride, without a day, without a car.

`socast.core.fit.level_spreads` estimates the standard deviations of the levels.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from socast.core.batch import Floats, Ints
from socast.core.stats.random_effects import Integrated, integrate_out, number_units, sum_units

SHARED: Final = 2
"""Number of columns on which rides and vehicle-days have random effects: rolling energy and time."""
PINNED: Final = 1e-4
"""Standard deviation of a coefficient at a limit over that of its prior. [1]"""


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
    rides, days, cars : (m, q, q) float
        Sums of each ride without the effects of rides, of each vehicle-day without those of days, and of each car with
        the factor of the car.
    ride_gain, day_gain : (m, s, q) float
        Expected effects of each ride and of each vehicle-day for each column.
    """

    rides: Floats
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
    cars = sum_units(days.sums, products.car)
    return Elimination(rides.sums, days.sums, cars, rides.gain, days.gain)


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


def limit(posterior: Gaussian, low: Floats, high: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the most probable coefficients within limits."""
    if ((posterior.mean >= low) & (posterior.mean <= high)).all():
        return posterior.mean, np.zeros(len(low), np.bool_)
    scale = np.sqrt(np.diag(posterior.covariance))
    root = np.linalg.cholesky(np.linalg.inv(posterior.covariance / np.outer(scale, scale)))
    target = root.T @ (posterior.mean / scale)
    found = lsq_linear(root.T, target, (low / scale, high / scale), method="bvls")
    return np.clip(found.x * scale, low, high), np.asarray(found.active_mask != 0)


def pin(prior: Gaussian, at: NDArray[np.bool_], mean: Floats) -> Gaussian:
    """Return a prior that keeps some coefficients at given values, with a spread of next to nothing."""
    covariance = prior.covariance.copy()
    covariance[at], covariance[:, at] = 0.0, 0.0
    covariance[at, at] = (PINNED * np.sqrt(np.diag(prior.covariance))[at]) ** 2
    return Gaussian(np.where(at, mean, prior.mean), covariance)
