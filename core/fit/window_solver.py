"""Solve the fit of the windows of one vehicle model: weights, spreads of the levels, accessory curve, coefficients.

A state is a set of coefficients and an accessory curve. Temperature hardly changes within a ride, so its mean serves
all windows of the ride. The sums of products of each ride, weighted as its windows are, suffice for every state.

The accessory curve is linear in its three levels and not in its four choke points, so the fit takes Newton steps to the
largest posterior density. A step must raise the density, else it is halved, and the steps end when they are next to
nothing. The spreads of the levels, and the energies on which the factors of cars act, stay the same during these steps,
so that all steps have one posterior density. The spreads are estimated anew between the descents.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.fit.accessory_curve import (
    CURVE_NUMBERS,
    build_curve,
    compute_softened_power,
    differentiate_softened_power,
    flatten_curve,
)
from socast.core.fit.nested_effects import (
    EXPECTED_LEVELS,
    SHARED,
    SMALL_STEP,
    Elimination,
    Gaussian,
    LevelSpreads,
    RideProducts,
    eliminate,
    estimate_spreads,
    integrate_car_factor,
    integrate_car_spread,
    solve_within_limits,
)
from socast.core.fit.row_noise import LEAST_ROWS, USUAL_PARTS, compute_robust_weights, estimate_variance
from socast.core.stats.random_effects import Integrated, sum_products
from socast.core.vehicles import ACCESSORIES, AccessoryCurve

ROUNDING: Final = 1e-13
"""Rounding error of a posterior density, over the sums that it is computed from. [1]"""
WEIGHINGS: Final = 3
"""Number of times that the weights of the rows are computed from residuals."""
DESCENTS: Final = 3
"""Number of descents, between which the spreads of the levels are estimated."""
STEPS: Final = 100
"""Largest number of linearisations of the accessory curve in a descent."""
HALVINGS: Final = 30
"""Largest number of times that a step is halved until it raises the posterior density."""
ROUGH_STEP: Final = 1e-3
"""Step at which a descent that others follow has converged, over the standard deviation of the prior. [1]"""
INDEPENDENT: Final = LevelSpreads(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Spreads of levels that leave the errors of all rows independent."""


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
class WindowSums:
    """Hold the sums of the rows of each ride.

    Parameters
    ----------
    products : (rides, k, k) float
        Weighted sums of products of the columns of `GroupRows`.
    ambient_c : (rides,) float
        Mean outside temperature, weighted as the accessory energy of the windows is. [°C]
    rows : (rides,) int64
        Number of rows.
    """

    products: Floats
    ambient_c: Floats
    rows: Ints


@dataclass(frozen=True)
class State:
    """Hold the coefficients, and the accessory curve where there is one.

    Parameters
    ----------
    coefficients : (terms,) float
        Coefficients.
    """

    coefficients: Floats
    curve: AccessoryCurve | None


class Nearby(NamedTuple):
    """Hold the posterior density of a problem near a state.

    Parameters
    ----------
    total : (q, q) float
        Sums of all cars without any random effect, linearised at the state.
    bend : (p, p) float
        What the curvature of the accessory power adds to the sums of the p coefficients and numbers of the curve.
    loss : float
        Minus twice the logarithm of the posterior density, up to a constant.
    """

    total: Floats
    bend: Floats
    loss: float
    rounding: float


@dataclass(frozen=True)
class Problem:
    """Hold what stays the same while states are compared.

    Parameters
    ----------
    scaled : State
        State whose energies the factors of cars scale.
    """

    group: GroupRows
    rides: WindowSums
    spreads: LevelSpreads
    scaled: State

    def sum_products(self, state: State) -> RideProducts:
        """Return the sums of rides, linearised at a state."""
        return self._sum(_change_columns(self, state)[0])

    def linearise(self, state: State) -> Nearby:
        """Return the posterior density near a state."""
        group, p = self.group, len(self.group.prior.mean)
        change, second = _change_columns(self, state)
        elimination = eliminate(self._sum(change), self.spreads)
        cars = integrate_car_factor(elimination.cars, self.spreads.car)
        total = cars.sums.sum(axis=0)
        z = np.zeros(len(total))
        z[: group.terms], z[p] = state.coefficients, -1.0
        off = z[:p] - shift_prior(group, state).mean
        loss = z @ total @ z + off @ np.linalg.solve(group.prior.covariance, off)
        bend = np.zeros((p, p))
        if group.curved:
            pull = change @ _find_effects(elimination, cars, group, z)[:, :, np.newaxis]
            pull = (self.rides.products[:, group.terms, np.newaxis] @ pull)[:, 0, 0] / self.spreads.row**2
            bend[group.terms :, group.terms :] = np.tensordot(pull, second, 1)
        return Nearby(total, bend, float(loss), ROUNDING * float(np.abs(z) @ np.abs(total) @ np.abs(z)))

    def _sum(self, change: Floats) -> RideProducts:
        """Return the sums of changed columns."""
        sums = np.swapaxes(change, 1, 2) @ self.rides.products @ change
        return RideProducts(sums, self.rides.rows, self.group.day, self.group.car)


@dataclass(frozen=True)
class GroupFit:
    """Hold the fit of one vehicle model, or of all.

    Parameters
    ----------
    posterior : Gaussian
        Coefficients, then the deviations of the numbers of the curve from those of `curve`.
    products : RideProducts
        Sums of rides, linearised at the fit.
    elimination : Elimination
        The same without the effects of rides and vehicle-days.
    prior : Gaussian
        Prior of `posterior`; coefficients at an end of their plausible ranges stay there.
    rides : tuple of str
        Keys of the rides, in the order of `products`.
    converged : bool
        Whether the last descent ended at a maximum of the posterior density.
    """

    posterior: Gaussian
    curve: AccessoryCurve | None
    spreads: LevelSpreads
    products: RideProducts
    elimination: Elimination
    prior: Gaussian
    rides: tuple[str, ...]
    converged: bool


def solve_group(group: GroupRows) -> GroupFit:
    """Return the fit of the rows of one vehicle model, or of all."""
    weight, state = _weigh(group)
    rides = sum_windows(group, weight)
    cars = len(group.cars) > 1
    spreads = EXPECTED_LEVELS if cars else EXPECTED_LEVELS._replace(car=0.0)
    for following in reversed(range(DESCENTS)):
        problem = Problem(group, rides, spreads, state)
        state, converged = _descend(problem, state, ROUGH_STEP if following else SMALL_STEP)
        products = problem.sum_products(state)
        if following:
            spreads = estimate_spreads(
                products, shift_prior(group, state), cars=cars, start=spreads, exact=following == 1
            )
    elimination, prior = eliminate(products, spreads), shift_prior(group, state)
    total = integrate_car_factor(elimination.cars, spreads.car).sums.sum(axis=0)
    posterior = integrate_car_spread(elimination, prior, spreads)
    _, prior = _limited(group, state, total)
    mean = np.zeros(len(prior.mean))
    mean[: group.terms] = state.coefficients
    posterior = posterior._replace(mean=mean)
    return GroupFit(posterior, state.curve, spreads, products, elimination, prior, group.rides, converged)


def _limited(group: GroupRows, state: State, total: Floats) -> tuple[Floats, Gaussian]:
    """Return the solution of a linearised problem within limits, and the prior that keeps it at them."""
    low, high = _shift(group, state, group.low), _shift(group, state, group.high)
    return solve_within_limits(shift_prior(group, state), total, low, high)


def _descend(problem: Problem, state: State, small: float) -> tuple[State, bool]:
    """Return the state of the largest posterior density, and whether the steps became small."""
    group = problem.group
    sd = np.sqrt(np.diag(group.prior.covariance))
    here = problem.linearise(state)
    for _ in range(STEPS):
        step, _ = _limited(group, state, _add_bend(group, here))
        step[: group.terms] -= state.coefficients
        if state.curve is None:
            return move(group, state, step), True
        if (np.abs(step) <= small * sd).all():
            return state, True
        for _ in range(HALVINGS):
            moved = move(group, state, step)
            there = problem.linearise(moved)
            if there.loss <= here.loss + here.rounding:
                break
            step = step / 2.0
        else:
            return state, False
        state, here = moved, there
    return state, False


def _add_bend(group: GroupRows, here: Nearby) -> Floats:
    """Return the sums with the bend of the accessory power, or with its positive part where the density is no hill."""
    p, bend = len(here.bend), here.bend
    precision = here.total[:p, :p] + np.linalg.inv(group.prior.covariance)
    if np.linalg.eigvalsh(precision + bend)[0] <= 0.0:
        size = np.sqrt(np.diag(group.prior.covariance))
        values, vectors = np.linalg.eigh(bend * np.outer(size, size))
        bend = (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(size, size)
    total = here.total.copy()
    total[:p, :p] += bend
    return total


def _weigh(group: GroupRows) -> tuple[Floats, State]:
    """Return the weights of the rows, and the coefficients that they give to independent rows."""
    p = group.terms
    energy, time = group.columns[:, p + group.curved], group.columns[:, p]
    state = State(group.prior.mean[:p], ACCESSORIES if group.curved else None)
    variance = np.maximum(group.parts @ np.array(USUAL_PARTS), 1e-10)
    weight = 1.0 / variance
    for _ in range(WEIGHINGS):
        state, _ = _descend(Problem(group, sum_windows(group, weight), INDEPENDENT, state), state, ROUGH_STEP)
        residual = energy - group.columns[:, :p] @ state.coefficients
        if state.curve is not None:
            residual -= time * compute_softened_power(state.curve, group.ambient_c)
        if len(energy) >= LEAST_ROWS:
            variance = estimate_variance(group.parts, residual)
        weight = compute_robust_weights(residual / np.sqrt(variance)) / variance
    return weight, state


def sum_windows(group: GroupRows, weight: Floats) -> WindowSums:
    """Return the sums of each ride."""
    n = len(group.rides)
    rows = np.bincount(group.ride, minlength=n)
    if not group.curved:
        return WindowSums(sum_products(group.columns, weight, group.ride), np.zeros(n), rows)
    time = group.columns[:, group.terms]
    sums = sum_products(np.column_stack([group.columns, time * group.ambient_c]), weight, group.ride)
    own = sums[:, group.terms, group.terms]
    ambient = np.divide(sums[:, group.terms, -1], own, out=np.zeros(len(own)), where=own > 0.0)
    return WindowSums(sums[:, :-1, :-1], ambient, rows)


def shift_prior(group: GroupRows, state: State) -> Gaussian:
    """Return the prior of the coefficients and of the deviations from the numbers of the curve."""
    return group.prior._replace(mean=_shift(group, state, group.prior.mean))


def move(group: GroupRows, state: State, step: Floats) -> State:
    """Return the state after a step of the coefficients and of the numbers of the curve."""
    p = group.terms
    coefficients = state.coefficients + step[:p]
    if state.curve is None:
        return State(coefficients, None)
    numbers = flatten_curve(state.curve) + step[p:]
    return State(coefficients, build_curve(np.clip(numbers, group.low[p:], group.high[p:])))


def _shift(group: GroupRows, state: State, values: Floats) -> Floats:
    """Return values of coefficients and numbers of the curve, the latter less those of the state."""
    values = values.copy()
    if state.curve is not None:
        values[group.terms :] -= flatten_curve(state.curve)
    return values


def _change_columns(problem: Problem, state: State) -> tuple[Floats, Floats]:
    """Return how the columns of `RideProducts` consist of those of `GroupRows`, and the bends of the accessory power.

    The former is (rides, k, q), the latter, second derivatives by the numbers of the curve, is (rides, 7, 7).
    """
    group, ambient_c = problem.group, problem.rides.ambient_c
    k, p = problem.rides.products.shape[1], group.terms
    energy = p + group.curved
    place = p + CURVE_NUMBERS * group.curved
    change = np.zeros((len(ambient_c), k, place + 2 + SHARED))
    change[:, range(p), range(p)] = 1.0
    for i in range(1 + SHARED):
        change[:, energy + i, place + i] = 1.0
    change[:, :p, -1] = problem.scaled.coefficients
    if state.curve is None or problem.scaled.curve is None:
        return change, np.zeros((len(ambient_c), 0, 0))
    power = differentiate_softened_power(state.curve, ambient_c)
    change[:, p, p:place], change[:, p, place] = power.first, -power.power
    change[:, p, -1] = compute_softened_power(problem.scaled.curve, ambient_c)
    return change, power.second


def _find_effects(elimination: Elimination, cars: Integrated, group: GroupRows, z: Floats) -> Floats:
    """Return the factors of all columns in the residuals of each ride: `z`, and the expected random effects."""
    p = len(group.prior.mean)
    shared = slice(p + 1, p + 1 + SHARED)
    of_cars = np.tile(z, (len(cars.sums), 1))
    of_cars[:, -1:] -= cars.gain @ z
    of_days = of_cars[group.car]
    of_days[:, shared] -= (elimination.day_gain @ of_days[:, :, np.newaxis])[..., 0]
    of_rides = of_days[group.day]
    of_rides[:, shared] -= (elimination.ride_gain @ of_rides[:, :, np.newaxis])[..., 0]
    return of_rides
