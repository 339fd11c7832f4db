"""Partial pooling: what vehicle models, and cars, have in common, what is their own, and how sure either is.

The coefficients of a vehicle model are thought of as drawn about a mean that all share,

    b_k ~ N(m, S),    y = X b_k + e,    e ~ N(0, noise * size),

where `size` is about the energy of the ride, as the error of a longer ride is the sum of more errors. The mean m is
found from the rides of all vehicle models, and held near physics. The spread S is a small one of each coefficient by
itself, and one of each block of them (drive, climate) by a common factor: cars of another vehicle model are above all
more or less efficient, and better or worse insulated. How large these are is chosen by the probability that they give
to what is seen of each vehicle model, from the mean of the others.

So one equation serves all: a vehicle model with many rides gets what is its own, a new one gets the mean, and with each
ride comes nearer to its own. The spread is also the uncertainty with which a new vehicle model is predicted.

References
----------
Gelman, Hill, Data Analysis Using Regression and Multilevel/Hierarchical Models, Cambridge 2007, ch. 12 and 13.
Rasmussen, Williams, Gaussian Processes for Machine Learning, MIT 2006, eqs. (2.8) and (2.30): posterior and evidence.
DerSimonian, Laird 1986, Controlled Clinical Trials 7:177, DOI 10.1016/0197-2456(86)90046-2: variance between cars.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats

PHYSICS_WEIGHT: Final = 0.03
"""Weight of physics against that of all rides, in the mean. Chosen on simulated fleets of which one vehicle model was
left out, of 0.003 to 1: with more, thirsty cars are predicted worse, with less, frugal ones."""
PHYSICS_RIDES: Final = 10.0
"""Rides that physics counts for besides: with few, the mean is that of physics."""
SEPARATE_SPREADS: Final = (0.005, 0.01, 0.02, 0.04, 0.08)
"""What is tried as spread of each coefficient by itself, times the root mean square of its column. [kWh]"""
FACTOR_SPREADS: Final = (0.03, 0.1, 0.2, 0.3)
"""What is tried as spread of the common factor of a block. [1]"""
EXPECTED_SPREADS: Final = (0.02, 0.1, 0.2)
"""Spreads to be expected: apart [kWh], drive [1], climate [1]. A few vehicle models tell little of them."""
UNSEEN_COLUMN: Final = 1e6
"""Stands for the size of a column that is 0 in all rides: so large that its coefficient is held where physics has it.
Its own size is not known, and a guess that is too small would let a single ride of another car set it to anything."""
SPREAD_LOG_SD: Final = np.log(3.0)
"""Standard deviation of the logarithm of spreads about those to be expected."""
EARLY_NOISE_FACTOR: Final = 4.0
"""The first rides of a vehicle model tell as much as so many times fewer: those of one car on one day err alike. Chosen
on simulated fleets, of 1 to 8; with 1, a few rides can do harm."""


class NormalEquations(NamedTuple):
    """Weighted normal equations of the rides of one vehicle model.

    Parameters
    ----------
    gram : (p, p) float
        X' W X, with weights 1 / size. [1/kWh times units]
    cross : (p,) float
        X' W y.
    square : float
        y' W y. [kWh]
    weight : float
        Sum of the weights. [1/kWh]
    rides : int
    """

    gram: Floats
    cross: Floats
    square: float
    weight: float
    rides: int

    def left(self, coefficients: Floats) -> float:
        """Return the weighted sum of squares that coefficients leave. [kWh]"""
        square = self.square - 2.0 * coefficients @ self.cross + coefficients @ self.gram @ coefficients
        return max(float(square), 0.0)


class Prior(NamedTuple):
    """What is known of the coefficients of a vehicle model before its rides are seen.

    Parameters
    ----------
    mean : (p,) float
    covariance : (p, p) float
    noise : float
        Variance of a ride's error over its size. [kWh]
    """

    mean: Floats
    covariance: Floats
    noise: float


def sum_normal_equations(design: Floats, energy: Floats, size: Floats) -> NormalEquations:
    """Return the sums of some rides.

    Parameters
    ----------
    design : (n, p) float
        Each term's product of columns.
    energy : (n,) float
        Measured. [kWh]
    size : (n,) float
        About the energy, above 0. [kWh]
    """
    weighted = design / size[:, np.newaxis]
    square = float(energy @ (energy / size))
    return NormalEquations(design.T @ weighted, weighted.T @ energy, square, float((1.0 / size).sum()), len(energy))


def compute_column_scale(groups: Sequence[NormalEquations]) -> Floats:
    """Return the root mean square of each term's column, `UNSEEN` where it is 0."""
    square = np.diag(_averaged(groups)[0])
    return np.where(square > 0.0, np.sqrt(np.maximum(square, 0.0)), UNSEEN_COLUMN)


def _averaged(groups: Sequence[NormalEquations]) -> tuple[Floats, Floats]:
    """Return X' W X and X' W y of a ride of average weight: rides of all vehicle models have the same say."""
    say = [sums.rides for sums in groups]
    gram = np.average([sums.gram / sums.weight for sums in groups], axis=0, weights=say)
    return gram, np.average([sums.cross / sums.weight for sums in groups], axis=0, weights=say)


def compute_common_mean(groups: Sequence[NormalEquations], physics: Floats) -> Floats:
    """Return the mean of the coefficients, held near those of physics."""
    scale = compute_column_scale(groups)
    gram, cross = _averaged(groups)
    standard = gram / np.outer(scale, scale)
    hold = PHYSICS_WEIGHT + PHYSICS_RIDES / sum(sums.rides for sums in groups)
    return physics + np.linalg.solve(standard + hold * np.eye(len(scale)), (cross - gram @ physics) / scale) / scale


def estimate_noise(sums: NormalEquations, mean: Floats, scale: Floats) -> float:
    """Return the variance of rides' errors over their size, about a fit of their own, held weakly to a mean. [kWh]"""
    own = sums.gram + np.diag(scale**2)
    found = mean + np.linalg.solve(own, sums.cross - sums.gram @ mean)
    freedom = sums.rides - np.trace(np.linalg.solve(own, sums.gram))
    return sums.left(found) / max(float(freedom), 1.0)


def estimate_common_noise(groups: Sequence[NormalEquations], mean: Floats) -> float:
    """Return the noise of a vehicle model that is not known: the mean of the others, each with the same say. [kWh]"""
    scale = compute_column_scale(groups)
    return float(np.mean([estimate_noise(sums, mean, scale) for sums in groups]))


def build_covariance(
    mean: Floats, scale: Floats, blocks: Sequence[NDArray[np.bool_]], apart: float, factors: Sequence[float]
) -> Floats:
    """Return the spread between vehicle models: of each coefficient by itself, and of each block by a factor."""
    spread = np.diag((apart / scale) ** 2)
    for block, factor in zip(blocks, factors, strict=True):
        own = np.where(block, mean, 0.0)
        spread += factor**2 * np.outer(own, own)
    return spread


def compute_posterior(prior: Prior, sums: NormalEquations) -> tuple[Floats, Floats]:
    """Return the mean and the covariance of the coefficients of a vehicle model whose rides were seen."""
    inverse = np.linalg.inv(prior.covariance)
    information = (inverse + inverse.T) / 2.0 + sums.gram / prior.noise
    covariance = np.linalg.inv(information)
    found = prior.mean + covariance @ ((sums.cross - sums.gram @ prior.mean) / prior.noise)
    return found, (covariance + covariance.T) / 2.0


def compute_early_posterior(prior: Prior, sums: NormalEquations) -> tuple[Floats, Floats]:
    """Return the same of a vehicle model of which the first rides were seen, whose errors are alike."""
    return compute_posterior(prior._replace(noise=prior.noise * EARLY_NOISE_FACTOR), sums)


def compute_log_evidence(prior: Prior, sums: NormalEquations) -> float:
    """Return the logarithm of the probability that a prior gives to rides, but for what is the same for all priors."""
    residual = sums.cross - sums.gram @ prior.mean
    _, covariance = compute_posterior(prior, sums)
    fit = sums.left(prior.mean) / prior.noise - residual @ covariance @ residual / prior.noise**2
    _, volume = np.linalg.slogdet(np.eye(len(residual)) + prior.covariance @ sums.gram / prior.noise)
    return float(-0.5 * (fit + volume))


def estimate_prior(
    groups: Mapping[str, NormalEquations], physics: Floats, blocks: Sequence[NDArray[np.bool_]]
) -> Prior:
    """Return what vehicle models have in common, and how far a new one will be from it.

    Parameters
    ----------
    groups : mapping of str to Sums
        By vehicle model; at least one.
    physics : (p,) float
        Coefficients that physics has.
    blocks : sequence of (p,) bool
        Terms that share a factor: drive, climate.
    """
    every = list(groups.values())
    mean = compute_common_mean(every, physics)
    noise = estimate_common_noise(every, mean)
    scale = compute_column_scale(every)
    apart, *factors = _spreads(every, physics, blocks, scale, noise)
    return Prior(mean, build_covariance(mean, scale, blocks, apart, factors), noise)


def _spreads(
    groups: Sequence[NormalEquations], physics: Floats, blocks: Sequence[NDArray[np.bool_]], scale: Floats, noise: float
) -> tuple[float, ...]:
    """Return the spreads that make most probable what is seen of each vehicle model, from the mean of the others."""
    if len(groups) < 2:
        return EXPECTED_SPREADS
    means = [compute_common_mean([other for other in groups if other is not own], physics) for own in groups]
    farther = 1.0 + 1.0 / (len(groups) - 1)  # the mean of the others is itself off

    def probability(spreads: tuple[float, ...]) -> float:
        told = -0.5 * sum(
            (np.log(s / usual) / SPREAD_LOG_SD) ** 2 for s, usual in zip(spreads, EXPECTED_SPREADS, strict=True)
        )
        for own, mean in zip(groups, means, strict=True):
            between = build_covariance(mean, scale, blocks, spreads[0], spreads[1:]) * farther
            told += compute_log_evidence(Prior(mean, between, noise), own)
        return float(told)

    return max(product(SEPARATE_SPREADS, *([FACTOR_SPREADS] * len(blocks))), key=probability)


def estimate_car_factors(
    vehicles: NDArray[np.object_], predicted: Floats, energy: Floats, size: Floats, noise: float
) -> dict[str, float]:
    """Return each car's factor on predictions, shrunk towards 1 as it is uncertain.

    Parameters
    ----------
    vehicles : (n,) str
        Whose ride it is; all of one vehicle model.
    predicted, energy, size : (n,) float
        [kWh]
    noise : float
        Variance of a ride's error over its size. [kWh]

    Returns
    -------
    dict of str to float
        None where cars do not differ by more than chance.
    """
    names, car = np.unique(vehicles.astype(str), return_inverse=True)
    weight = np.maximum(np.bincount(car, predicted**2 / (noise * size), len(names)), 1e-12)
    off = np.bincount(car, predicted * (energy - predicted) / (noise * size), len(names)) / weight
    between = _between(off, weight)
    if between <= 0.0:
        return {}
    shrunk = 1.0 + off * between / (between + 1.0 / weight)
    return {str(name): float(factor) for name, factor in zip(names, shrunk, strict=True)}


def _between(off: Floats, weight: Floats) -> float:
    """Return the variance between cars, from deviations with variances 1 / weight; DerSimonian and Laird, eq. (8)."""
    if len(off) < 2:
        return 0.0
    centre = float(weight @ off / weight.sum())
    excess = float(weight @ (off - centre) ** 2) - (len(off) - 1)
    return max(excess / float(weight.sum() - (weight**2).sum() / weight.sum()), 0.0)
