"""Solve the fit of the windows of one vehicle model: weights, spreads of the levels, accessory curve, coefficients.

The accessory curve is linear in its three levels and not in its four choke points, so the fit takes Newton steps to the
largest posterior density. A step must raise the density, else it is halved, and the steps end when they are next to
nothing. The spreads of the levels, and the energies on which the factors of cars act, stay the same during these steps,
so that all steps have one posterior density. The spreads are estimated anew between the descents.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.fit.level_spreads import estimate_spreads, integrate_car_spread
from socast.core.fit.nested_effects import (
    EXPECTED_LEVELS,
    Elimination,
    Gaussian,
    LevelSpreads,
    RideProducts,
    compute_coefficients,
    eliminate,
    integrate_car_factor,
    limit,
    pin,
)
from socast.core.fit.row_noise import LEAST_ROWS, USUAL_PARTS, compute_robust_weights, estimate_variance
from socast.core.fit.softened_curve import compute_softened_power
from socast.core.fit.window_problem import (
    GroupRows,
    Nearby,
    Problem,
    State,
    move,
    shift_limits,
    shift_prior,
    sum_windows,
)
from socast.core.vehicles import ACCESSORIES, AccessoryCurve

WEIGHINGS: Final = 3
"""Number of times that the weights of the rows are computed from residuals."""
DESCENTS: Final = 3
"""Number of descents, between which the spreads of the levels are estimated."""
STEPS: Final = 100
"""Largest number of linearisations of the accessory curve in a descent."""
HALVINGS: Final = 30
"""Largest number of times that a step is halved until it raises the posterior density."""
SMALL_STEP: Final = 1e-9
"""Step of each number over the standard deviation of its prior, at which a descent has converged. [1]"""
ROUGH_STEP: Final = 1e-3
"""The same for a descent that others follow. [1]"""
INDEPENDENT: Final = LevelSpreads(1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Spreads of levels that leave the errors of all rows independent."""


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
    prior = shift_prior(group, state)
    posterior = compute_coefficients(prior, total)
    mean, at = limit(posterior, *shift_limits(group, state))
    return mean, pin(prior, at, mean)


def _descend(problem: Problem, state: State, small: float) -> tuple[State, bool]:
    """Return the state of the largest posterior density, and whether the steps became small."""
    group = problem.group
    sd = np.sqrt(np.diag(group.prior.covariance))
    here = problem.linearise(state)
    for _ in range(STEPS):
        solution, _ = _limited(group, state, _add_bend(group, here))
        step = solution.copy()
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
