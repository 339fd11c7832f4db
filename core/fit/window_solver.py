"""Solve the fit of the windows of one vehicle model: weights, spreads of the levels, accessory curve, coefficients.

The accessory curve is linear in its three levels and not in its four choke points, so the fit linearises it at the last
estimate and repeats (Gauss-Newton), with shorter steps where a whole one does not raise the posterior density.
Temperature hardly changes within a ride, so its mean serves all windows of the ride, and the sums of products of each
ride suffice for every step.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from core.batch import Floats, Ints
from core.columns import ZERO_CELSIUS
from core.fit.nested_effects import (
    EXPECTED_LEVELS,
    SHARED,
    Elimination,
    Gaussian,
    LevelSpreads,
    RideProducts,
    compute_coefficients,
    eliminate,
    estimate_spreads,
    integrate_car_spread,
    limit,
    pin,
    sum_products,
    without_car_factor,
)
from core.fit.priors import build_curve, compute_curve_columns, curve_numbers
from core.fit.row_noise import LEAST_ROWS, USUAL_PARTS, compute_robust_weights, estimate_variance
from core.vehicles import ACCESSORIES, AccessoryCurve

WEIGHINGS: Final = 3
"""Number of times that the weights of the rows are computed from residuals."""
CURVE_NUMBERS: Final = 7
"""Number of numbers of an accessory curve."""
STEPS: Final = 8
"""Largest number of linearisations of the accessory curve for each estimate of the spreads."""
SHARES: Final = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step that are tried until the posterior density rises. [1]"""
SMALL_STEP: Final = 0.02
"""Step of each number of the curve, over the standard deviation of its prior, at which the steps end. [1]"""


@dataclass(frozen=True)
class GroupRows:
    """Hold the rows of one vehicle model, or of all, in the order of cars, vehicle-days and rides.

    Parameters
    ----------
    columns : (n, k) float
        Columns of the terms without the accessories'; the time of the accessories times the car's scale where there
        is a curve; the energy [kWh]; rolling energy by the catalogue [kWh]; and time [h].
    ambient_c : (n,) float
        Outside temperature. [°C]
    ride : (n,) int64
        Ride of each row.
    day, car : (rides,), (days,) int64
        Vehicle-day of each ride, and car of each vehicle-day.
    rides : (rides,) str
        Keys of the rides.
    cars : (cars,) str
        Names of the cars.
    parts : (n, 4) float
        Parts of the variance, see `build_variance_parts`.
    prior : Gaussian
        Prior of the coefficients, then of the numbers of the curve where there is one.
    low, high : (p,) float
        Plausible range of each coefficient, then the limits of the numbers of the curve; beyond them the prior is zero.
    curved : bool
        Whether there is a curve.
    """

    columns: Floats
    ambient_c: Floats
    ride: Ints
    day: Ints
    car: Ints
    rides: tuple[str, ...]
    cars: tuple[str, ...]
    parts: Floats
    prior: Gaussian
    low: Floats
    high: Floats
    curved: bool

    @property
    def terms(self) -> int:
        """Number of terms without the accessories'."""
        return self.columns.shape[1] - self.curved - 1 - SHARED


@dataclass(frozen=True)
class GroupFit:
    """Hold the fit of one vehicle model, or of all.

    Parameters
    ----------
    posterior : Gaussian
        Coefficients, then the deviations of the numbers of the curve from those of `curve`.
    curve : AccessoryCurve or None
        Accessory curve.
    spreads : LevelSpreads
        Standard deviations of the levels.
    products : RideProducts
        Sums of rides, linearised at the fit.
    elimination : Elimination
        The same without the effects of rides and vehicle-days.
    prior : Gaussian
        Prior of `posterior`; coefficients at an end of their plausible ranges stay there.
    rides : tuple of str
        Keys of the rides, in the order of `products`.
    """

    posterior: Gaussian
    curve: AccessoryCurve | None
    spreads: LevelSpreads
    products: RideProducts
    elimination: Elimination
    prior: Gaussian
    rides: tuple[str, ...]


def solve_group(group: GroupRows) -> GroupFit:
    """Return the fit of the rows of one vehicle model, or of all."""
    weight, state = _weigh(group)
    sums, ambient = _sum_rides(group, weight)
    rows = np.bincount(group.ride, minlength=len(group.rides))

    def linearise(state: _Linearised) -> RideProducts:
        return RideProducts(_linearise(group, sums, ambient, state), rows, group.day, group.car)

    cars = len(group.cars) > 1
    spreads = EXPECTED_LEVELS if cars else EXPECTED_LEVELS._replace(car=0.0)
    for _ in range(2):
        state = _descend(group, linearise, state, spreads)
        spreads = estimate_spreads(linearise(state), _shifted(group, state), cars=cars, start=spreads)
    state = _descend(group, linearise, state, spreads)
    products = linearise(state)
    elimination, prior = eliminate(products, spreads), _shifted(group, state)
    total = without_car_factor(elimination.cars, spreads.car)[0].sum(axis=0)
    posterior = integrate_car_spread(elimination, prior, spreads)
    _, prior = _limited(group, state, total)
    pinned = compute_coefficients(_pin_curve(group, prior), total)
    mean, _ = limit(pinned, *_limits(group, state))
    return GroupFit(posterior._replace(mean=mean), state.curve, spreads, products, elimination, prior, group.rides)


def _sum_rides(group: GroupRows, weight: Floats) -> tuple[Floats, Floats]:
    """Return the sums of products of each ride, and its mean temperature, weighted as its windows are. [°C]"""
    if not group.curved:
        return sum_products(group.columns, weight, group.ride, len(group.rides)), np.zeros(len(group.rides))
    time = group.columns[:, group.terms]
    sums = sum_products(np.column_stack([group.columns, time * group.ambient_c]), weight, group.ride, len(group.rides))
    own = sums[:, group.terms, group.terms]
    ambient = np.divide(sums[:, group.terms, -1], own, out=np.zeros(len(own)), where=own > 0.0)
    return sums[:, :-1, :-1], ambient


@dataclass(frozen=True)
class _Linearised:
    """Hold the coefficients and the curve at which the fit is linearised."""

    coefficients: Floats
    curve: AccessoryCurve | None


def _shifted(group: GroupRows, state: _Linearised) -> Gaussian:
    """Return the prior of the coefficients and of the deviations from the numbers of the curve."""
    return group.prior._replace(mean=_shift(group, state, group.prior.mean))


def _limits(group: GroupRows, state: _Linearised) -> tuple[Floats, Floats]:
    """Return the limits of the coefficients and of the deviations from the numbers of the curve."""
    return _shift(group, state, group.low), _shift(group, state, group.high)


def _shift(group: GroupRows, state: _Linearised, values: Floats) -> Floats:
    """Return values of coefficients and numbers of the curve, the latter less those of the state."""
    values = values.copy()
    if state.curve is not None:
        values[group.terms :] -= curve_numbers(state.curve)
    return values


def _limited(group: GroupRows, state: _Linearised, total: Floats) -> tuple[Floats, Gaussian]:
    """Return the solution of a linearised problem within limits, and the prior that keeps it at them."""
    prior = _shifted(group, state)
    posterior = compute_coefficients(prior, total)
    mean, at = limit(posterior, *_limits(group, state))
    return mean, pin(prior, at, mean)


def _pin_curve(group: GroupRows, prior: Gaussian) -> Gaussian:
    """Return a prior that keeps the numbers of the curve at those of the state."""
    at = np.arange(len(prior.mean)) >= group.terms
    return pin(prior, at, np.zeros(len(prior.mean)))


def _descend(
    group: GroupRows, linearise: Callable[[_Linearised], RideProducts], state: _Linearised, spreads: LevelSpreads
) -> _Linearised:
    """Return the state of the largest posterior density that some steps reach, each no longer than it helps."""
    total = _total(linearise(state), spreads)
    for _ in range(STEPS):
        solution, _ = _limited(group, state, total)
        if state.curve is None:
            return _Linearised(solution, None)
        loss = _loss(group, state, total)
        for share in SHARES:
            moved = _moved(group, state, solution, share)
            there = _total(linearise(moved), spreads)
            if _loss(group, moved, there) < loss or share == SHARES[-1]:
                break
        change = np.abs(curve_numbers(moved.curve or ACCESSORIES) - curve_numbers(state.curve))
        state, total = moved, there
        if (change < SMALL_STEP * np.sqrt(np.diag(group.prior.covariance))[group.terms :]).all():
            break
    return state


def _total(products: RideProducts, spreads: LevelSpreads) -> Floats:
    """Return the sums of all cars without any random effect."""
    return np.asarray(without_car_factor(eliminate(products, spreads).cars, spreads.car)[0].sum(axis=0))


def _loss(group: GroupRows, state: _Linearised, total: Floats) -> float:
    """Return minus twice the logarithm of the posterior density of a state, up to a constant."""
    p = len(group.prior.mean)
    x = np.zeros(p)
    x[: group.terms] = state.coefficients
    off = x - _shifted(group, state).mean
    left = total[p, p] - 2.0 * x @ total[:p, p] + x @ total[:p, :p] @ x
    return float(left + off @ np.linalg.solve(group.prior.covariance, off))


def _moved(group: GroupRows, state: _Linearised, solution: Floats, share: float = 1.0) -> _Linearised:
    """Return the state part of the way to a solution of the linearised problem."""
    p = group.terms
    coefficients = state.coefficients + share * (solution[:p] - state.coefficients)
    if state.curve is None:
        return _Linearised(coefficients, None)
    numbers = curve_numbers(state.curve) + share * solution[p:]
    return _Linearised(coefficients, build_curve(np.clip(numbers, group.low[p:], group.high[p:])))


def _linearise(group: GroupRows, sums: Floats, ambient: Floats, state: _Linearised) -> Floats:
    """Return the sums of the columns of `RideProducts`, from those of `GroupRows`."""
    k, p = sums.shape[1], group.terms
    numbers = CURVE_NUMBERS if group.curved else 0
    energy = p + group.curved
    change = np.zeros((len(sums), k, p + numbers + 2 + SHARED))
    change[:, range(p), range(p)] = 1.0
    place = p + numbers
    change[:, energy, place] = 1.0
    for i in range(SHARED):
        change[:, energy + 1 + i, place + 1 + i] = 1.0
    change[:, :p, -1] = state.coefficients
    if state.curve is not None:
        power = state.curve.power(ambient + ZERO_CELSIUS)
        change[:, p, p:place] = compute_curve_columns(state.curve, ambient)
        change[:, p, place], change[:, p, -1] = -power, power
    return np.swapaxes(change, 1, 2) @ sums @ change


def _weigh(group: GroupRows) -> tuple[Floats, _Linearised]:
    """Return the weights of the rows, and the coefficients that they give to independent rows."""
    p = group.terms
    energy, time = group.columns[:, p + group.curved], group.columns[:, p : p + group.curved]
    state = _Linearised(group.prior.mean[:p], ACCESSORIES if group.curved else None)
    variance = np.maximum(group.parts @ np.array(USUAL_PARTS), 1e-10)
    weight = 1.0 / variance
    for _ in range(WEIGHINGS):
        columns, left = group.columns[:, :p], energy
        if state.curve is not None:
            columns = np.column_stack([columns, compute_curve_columns(state.curve, group.ambient_c) * time])
            left = energy - time[:, 0] * state.curve.power(group.ambient_c + ZERO_CELSIUS)
        table = np.column_stack([columns, left])
        solution, _ = _limited(group, state, table.T @ (table * weight[:, np.newaxis]))
        state = _moved(group, state, solution)
        residual = left - columns @ solution
        if len(energy) >= LEAST_ROWS:
            variance = estimate_variance(group.parts, residual)
        weight = compute_robust_weights(residual / np.sqrt(variance)) / variance
    return weight, state
