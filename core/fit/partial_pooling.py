"""Pool coefficients partially across vehicle models and cars, with the uncertainty of the common and separate parts.

The coefficients b_k of vehicle model k are drawn about a mean m that all vehicle models share:

    b_k ~ N(m, S),    y = X b_k + e,    e ~ N(0, noise * size).

Here `size` is approximately the energy of the ride, as the error of a longer ride is the sum of more errors. The rides
of all vehicle models determine the mean m, which is held near physics.

The spread S has two parts. One is a small separate spread of each coefficient. The other is a common factor of each
block of coefficients (drive, climate), because vehicle models differ mainly in efficiency and in insulation. The sizes
of both are those that give the highest probability to the rides of each vehicle model, given the mean of the others.

One equation therefore serves every case. A vehicle model with many rides receives its own coefficients, and a new one
receives the mean and approaches its own coefficients with each ride. The spread is also the uncertainty of the
prediction for a new vehicle model.

References
----------
Gelman, Hill, Data Analysis Using Regression and Multilevel/Hierarchical Models, Cambridge 2007, ch. 12 and 13.
Rasmussen, Williams, Gaussian Processes for Machine Learning, MIT 2006, eqs. (2.8) and (2.30): posterior and evidence.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.stats.random_effects import estimate_variance_between

PHYSICS_WEIGHT: Final = 0.03
"""Weight of physics relative to that of all rides, in the mean. [1]

Chosen from 0.003 to 1 on simulated fleets with one vehicle model left out. A larger weight predicts cars of high
consumption worse, and a smaller weight predicts cars of low consumption worse.
"""
PHYSICS_RIDES: Final = 10.0
"""Additional weight of physics, as a number of rides: with few rides, the mean is that of physics."""
SEPARATE_SPREADS: Final = (0.005, 0.01, 0.02, 0.04, 0.08)
"""Candidate spreads of each separate coefficient, times the root mean square of its column. [kWh]"""
FACTOR_SPREADS: Final = (0.03, 0.1, 0.2, 0.3)
"""Candidate spreads of the common factor of a block. [1]"""
EXPECTED_SPREADS: Final = (0.02, 0.1, 0.2)
"""Expected spreads: separate [kWh], drive [1], climate [1]. A few vehicle models determine the spreads only weakly."""
UNSEEN_COLUMN: Final = 1e6
"""Size assigned to a column that is 0 in all rides, so large that its coefficient stays at its physical value.

The true size of such a column is unknown. A value that is too small would let a single ride of another car set the
coefficient to anything.
"""
SPREAD_LOG_SD: Final = np.log(3.0)
"""Standard deviation of the logarithm of a spread about that of the expected spread. [1]"""
EARLY_NOISE_FACTOR: Final = 4.0
"""Factor on the noise of the first rides of a vehicle model, as the errors of one car on one day are correlated. [1]

Chosen from 1 to 8 on simulated fleets. With 1, a few rides can make the predictions worse.
"""


class NormalEquations(NamedTuple):
    """Hold the weighted normal equations of the rides of one vehicle model.

    Parameters
    ----------
    gram : (p, p) float
        X' W X, with weights 1 / size. [1/kWh times the units of both terms]
    cross : (p,) float
        X' W y. [units of the term]
    square : float
        y' W y. [kWh]
    weight : float
        Sum of the weights. [1/kWh]
    """

    gram: Floats
    cross: Floats
    square: float
    weight: float
    rides: int

    def left(self, coefficients: Floats) -> float:
        """Return the weighted sum of squared residuals under given coefficients.

        Units: returns [kWh].
        """
        square = self.square - 2.0 * coefficients @ self.cross + coefficients @ self.gram @ coefficients
        return max(float(square), 0.0)


class Prior(NamedTuple):
    """Hold the prior of the coefficients of a vehicle model, before any of its rides.

    Parameters
    ----------
    mean : (p,) float
        Expected coefficients.
    covariance : (p, p) float
        Covariance of the coefficients about their mean.
    noise : float
        Variance of the error of a ride over its size. [kWh]
    """

    mean: Floats
    covariance: Floats
    noise: float


def sum_normal_equations(design: Floats, energy: Floats, size: Floats) -> NormalEquations:
    """Return the weighted normal equations of rides.

    Units: energy [kWh], size [kWh].
    """
    weighted = design / size[:, np.newaxis]
    square = float(energy @ (energy / size))
    return NormalEquations(design.T @ weighted, weighted.T @ energy, square, float((1.0 / size).sum()), len(energy))


def compute_column_scale(groups: Sequence[NormalEquations]) -> Floats:
    """Return the root mean square of the column of each term."""
    square = np.diag(_averaged(groups)[0])
    return np.where(square > 0.0, np.sqrt(np.maximum(square, 0.0)), UNSEEN_COLUMN)


def _averaged(groups: Sequence[NormalEquations]) -> tuple[Floats, Floats]:
    """Return X' W X and X' W y for a ride of average weight; rides of all vehicle models count equally."""
    say = [sums.rides for sums in groups]
    gram = np.average([sums.gram / sums.weight for sums in groups], axis=0, weights=say)
    return gram, np.average([sums.cross / sums.weight for sums in groups], axis=0, weights=say)


def compute_common_mean(groups: Sequence[NormalEquations], physics: Floats) -> Floats:
    """Return the common mean of the coefficients, held near their physical values."""
    scale = compute_column_scale(groups)
    gram, cross = _averaged(groups)
    standard = gram / np.outer(scale, scale)
    hold = PHYSICS_WEIGHT + PHYSICS_RIDES / sum(sums.rides for sums in groups)
    return physics + np.linalg.solve(standard + hold * np.eye(len(scale)), (cross - gram @ physics) / scale) / scale


def estimate_noise(sums: NormalEquations, mean: Floats, scale: Floats) -> float:
    """Return the variance of the errors of rides over their size, under a separate fit held weakly near a mean.

    Units: returns [kWh].
    """
    precision = sums.gram + np.diag(scale**2)
    coefficients = mean + np.linalg.solve(precision, sums.cross - sums.gram @ mean)
    freedom = sums.rides - np.trace(np.linalg.solve(precision, sums.gram))
    return sums.left(coefficients) / max(float(freedom), 1.0)


def estimate_common_noise(groups: Sequence[NormalEquations], mean: Floats) -> float:
    """Return the noise of an unknown vehicle model: the unweighted mean over the known ones.

    Units: returns [kWh].
    """
    scale = compute_column_scale(groups)
    return float(np.mean([estimate_noise(sums, mean, scale) for sums in groups]))


def build_covariance(
    mean: Floats, scale: Floats, blocks: Sequence[NDArray[np.bool_]], apart: float, factors: Sequence[float]
) -> Floats:
    """Return the covariance between vehicle models: separate spreads, and a common factor of each block.

    Units: apart [kWh].
    """
    spread = np.diag((apart / scale) ** 2)
    for block, factor in zip(blocks, factors, strict=True):
        block_mean = np.where(block, mean, 0.0)
        spread += factor**2 * np.outer(block_mean, block_mean)
    return spread


def compute_posterior(prior: Prior, sums: NormalEquations) -> tuple[Floats, Floats]:
    """Return the posterior of the coefficients of a vehicle model, given its rides."""
    inverse = np.linalg.inv(prior.covariance)
    information = (inverse + inverse.T) / 2.0 + sums.gram / prior.noise
    covariance = np.linalg.inv(information)
    coefficients = prior.mean + covariance @ ((sums.cross - sums.gram @ prior.mean) / prior.noise)
    return coefficients, (covariance + covariance.T) / 2.0


def compute_early_posterior(prior: Prior, sums: NormalEquations) -> tuple[Floats, Floats]:
    """Return the posterior given the first rides of a vehicle model, whose errors are correlated."""
    return compute_posterior(prior._replace(noise=prior.noise * EARLY_NOISE_FACTOR), sums)


def compute_log_evidence(prior: Prior, sums: NormalEquations) -> float:
    """Return the logarithm of the probability of rides under a prior, up to a constant common to all priors."""
    residual = sums.cross - sums.gram @ prior.mean
    _, covariance = compute_posterior(prior, sums)
    fit = sums.left(prior.mean) / prior.noise - residual @ covariance @ residual / prior.noise**2
    _, volume = np.linalg.slogdet(np.eye(len(residual)) + prior.covariance @ sums.gram / prior.noise)
    return float(-0.5 * (fit + volume))


def estimate_prior(
    groups: Mapping[str, NormalEquations], physics: Floats, blocks: Sequence[NDArray[np.bool_]]
) -> Prior:
    """Return the common mean of vehicle models, and the expected distance of a new vehicle model from it."""
    every = list(groups.values())
    mean = compute_common_mean(every, physics)
    noise = estimate_common_noise(every, mean)
    scale = compute_column_scale(every)
    apart, *factors = _spreads(every, physics, blocks, scale, noise)
    return Prior(mean, build_covariance(mean, scale, blocks, apart, factors), noise)


def _spreads(
    groups: Sequence[NormalEquations], physics: Floats, blocks: Sequence[NDArray[np.bool_]], scale: Floats, noise: float
) -> tuple[float, ...]:
    """Return the spreads with the largest probability of each vehicle model's rides, given the mean of the others."""
    if len(groups) < 2:
        return EXPECTED_SPREADS
    means = [compute_common_mean([other for other in groups if other is not group], physics) for group in groups]
    farther = 1.0 + 1.0 / (len(groups) - 1)  # the mean of the others is uncertain itself

    def probability(spreads: tuple[float, ...]) -> float:
        log_probability = -0.5 * sum(
            (np.log(s / usual) / SPREAD_LOG_SD) ** 2 for s, usual in zip(spreads, EXPECTED_SPREADS, strict=True)
        )
        for group, mean in zip(groups, means, strict=True):
            between = build_covariance(mean, scale, blocks, spreads[0], spreads[1:]) * farther
            log_probability += compute_log_evidence(Prior(mean, between, noise), group)
        return float(log_probability)

    return max(product(SEPARATE_SPREADS, *([FACTOR_SPREADS] * len(blocks))), key=probability)


def estimate_car_factors(
    vehicles: NDArray[np.object_], predicted: Floats, energy: Floats, size: Floats, noise: float
) -> dict[str, float]:
    """Return the factor of each car on predictions, shrunk towards 1 according to its uncertainty.

    Units: predicted [kWh], energy [kWh], size [kWh], noise [kWh].

    Returns
    -------
    dict of str to float
        Factor by car; empty where cars do not differ by more than chance. [1]
    """
    names, car = np.unique(vehicles.astype(str), return_inverse=True)
    weight = np.maximum(np.bincount(car, predicted**2 / (noise * size), len(names)), 1e-12)
    off = np.bincount(car, predicted * (energy - predicted) / (noise * size), len(names)) / weight
    between = estimate_variance_between(off, weight)
    if between <= 0.0:
        return {}
    shrunk = 1.0 + off * between / (between + 1.0 / weight)
    return {str(name): float(factor) for name, factor in zip(names, shrunk, strict=True)}
