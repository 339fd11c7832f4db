"""Estimate how much cars of a model differ, and test effects within one car beside that spread.

The coefficients of car c are β + Σ s_cj d_j with s_cj ~ N(0, σ_j²) in each direction j. The variances σ² are those of
all other cars, with the expected ones as a prior that counts as `PRIOR_CARS` cars:

    σ_j² = (ν0 σ_0j² + Σ E s_cj²) / (ν0 + n),

by expectation and maximisation. Effects of the library that the model lacks everywhere have random coefficients, too,
so that what all cars show is not held against one of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.diagnose.siblings.shift_scores import Projected, ShiftScores
from socast.core.diagnose.siblings.sums import Siblings
from socast.core.stats.random_effects import integrate_out

PRIOR_CARS: Final = 4.0
"""Number of cars that the expected spread counts as (ν0)."""
ROUNDS: Final = 12
"""Number of steps of expectation and maximisation."""
EVERYWHERE_SHARE: Final = 0.01
"""Expected size of an effect that all cars of a model have and that was not found, as a share of the energy. [1]

Without such effects, a simulated fleet in which nothing was hidden named `cornering`."""
RIDGE: Final = 1e-9
"""Share of the diagonal that is added before a matrix is inverted."""


@dataclass(frozen=True)
class Deviations:
    """Hold the most probable deviation of each car in each direction.

    Parameters
    ----------
    mean : (cars, d) float
        Deviation in units of the expected spread.
    covariance : (cars, d, d) float
        Its covariance.
    """

    mean: Floats
    covariance: Floats

    @property
    def variance(self) -> Floats:
        """Variance of each deviation, (cars, d)."""
        return np.asarray(np.diagonal(self.covariance, axis1=1, axis2=2))


class SiblingBase:
    """Project columns off what cars of one model may share, and off the spread between them.

    Parameters
    ----------
    variance : (d,) float
        Variance of cars in each direction, in units of the expected one.
    own : dict of int to (d,) float, optional
        Variance of single cars that differs from it.
    """

    def __init__(self, siblings: Siblings, variance: Floats) -> None:
        self.siblings, self.variance = siblings, variance
        at = siblings.places
        self._d = np.arange(at.directions.start, at.directions.stop)
        cars = range(len(siblings.cars))
        self.of_car = np.array([siblings.sums[siblings.car == c].sum(axis=0) for c in cars])
        integrated = integrate_out(self.of_car, at.directions, variance)
        inner = integrated.inverse * variance
        self.inner = (inner + np.swapaxes(inner, 1, 2)) / 2.0
        self.gain, self.left = integrated.gain, integrated.sums
        total = self.left.sum(axis=0)
        self._x = np.arange(at.base.start, at.base.stop)
        self._c = np.arange(at.candidates.start, at.candidates.stop)
        shares = float(siblings.measured.sum()) / np.maximum(siblings.size.sum(axis=0), 1e-300)
        precise = np.r_[
            np.zeros(len(self._x)), 1.0 / (EVERYWHERE_SHARE * np.where(siblings.size.any(axis=0), shares, 1.0)) ** 2
        ]
        self._shared = np.r_[self._x, self._c]
        inside = total[np.ix_(self._shared, self._shared)]
        own = np.diag(inside) + precise
        scale = np.where(own > 0.0, np.sqrt(np.abs(own)), np.inf)  # a column without energy takes nothing
        matrix = (inside + np.diag(precise)) / np.outer(scale, scale)
        self.shared_inverse = np.linalg.inv(matrix + RIDGE * np.eye(len(scale))) / np.outer(scale, scale)
        self.coefficients = self.shared_inverse @ total[self._shared, at.energy]
        self.total = total

    def expect_deviations(self) -> Deviations:
        """Return the most probable deviations of all cars."""
        residual = self._residual
        beside = self.gain[:, :, self._shared]
        spread = self.inner + beside @ self.shared_inverse @ np.swapaxes(beside, 1, 2)
        return Deviations(self.gain @ residual, spread)

    @property
    def _residual(self) -> Floats:
        """Coefficients of the columns in the residual, zero for the directions, (q,)."""
        out = np.zeros(self.of_car.shape[1])
        out[self._shared], out[-1] = -self.coefficients, 1.0
        return out

    def score_shifts(self, car: int) -> ShiftScores:
        """Return the products of the candidates with the residual in each shift of a car."""
        residual = self._residual
        residual[self._d] = -(self.gain[car] @ residual)
        rows = self.siblings.sums[self.siblings.car == car][:, self._c, :]
        beside = rows[:, :, self._d]
        left = rows[:, :, self._shared] - beside @ self.gain[car][:, self._shared]
        return ShiftScores(
            score=rows @ residual,
            blocks=rows[:, :, self._c],
            factor=np.concatenate(
                [beside @ _take_root(self.inner[car]), left @ _take_root(self.shared_inverse)], axis=2
            ),
        )

    def project(self, car: int, rows: Floats, square: Floats, at: Ints) -> Projected:
        """Return the products of columns within one car off the spread between cars and off what they share."""
        down = self.siblings.places.candidates.start + at
        crossed = rows[:, self._d]
        left = rows - crossed @ self.gain[car]
        inside = square - np.einsum("md,de,me->m", crossed, self.inner[car], crossed)
        shared = left[:, self._shared]
        solved = shared @ self.shared_inverse
        own = self.left[car][down]
        whole_solved = own[:, self._shared] @ self.shared_inverse
        return Projected(
            score=left[:, -1] - shared @ self.coefficients,
            information=inside - (solved * shared).sum(axis=1),
            beside=left[np.arange(len(at)), down] - (solved * own[:, self._shared]).sum(axis=1),
            whole=own[np.arange(len(at)), down] - (whole_solved * own[:, self._shared]).sum(axis=1),
            whole_score=own[:, -1] - own[:, self._shared] @ self.coefficients,
        )

    def project_all(self, weights: Floats, whole: Floats) -> Projected:
        """Return products of the candidates in shifts of several cars, times weights, as `project` does."""
        left, inside = self._sweep_cars(weights)
        own, own_inside = self._sweep_cars(whole[np.newaxis])
        siblings, at = self.siblings, self.siblings.places.candidates
        square = np.diagonal(siblings.sums[:, at, at], axis1=1, axis2=2)
        shared, own_shared = left[:, :, self._shared], own[0][:, self._shared]
        solved, own_solved = shared @ self.shared_inverse, own_shared @ self.shared_inverse
        beside = (weights * whole) @ square
        for car in range(len(siblings.cars)):
            there = siblings.car == car
            rows = siblings.sums[there][:, at, self._d.min() : self._d.max() + 1]
            part = np.tensordot(weights[:, there], rows, axes=1)
            own_part = np.tensordot(whole[there], rows, axes=1)
            beside -= np.einsum("mkd,de,ke->mk", part, self.inner[car], own_part, optimize=True)
        return Projected(
            score=left[:, :, -1] - shared @ self.coefficients,
            information=weights**2 @ square - inside - (solved * shared).sum(axis=2),
            beside=beside - (solved * own_shared).sum(axis=2),
            whole=np.broadcast_to(
                whole**2 @ square - own_inside[0] - (own_solved * own_shared).sum(axis=1), beside.shape
            ),
            whole_score=np.broadcast_to(own[0][:, -1] - own_shared @ self.coefficients, beside.shape),
        )

    def _sweep_cars(self, weights: Floats) -> tuple[Floats, Floats]:
        """Return products of weighted candidates with all columns off the deviations of cars, and what these take."""
        siblings, at = self.siblings, self.siblings.places.candidates
        left = np.zeros((len(weights), len(self._c), len(self.total)))
        inside = np.zeros((len(weights), len(self._c)))
        for car in range(len(siblings.cars)):
            there = siblings.car == car
            rows = np.tensordot(weights[:, there], siblings.sums[there][:, at, :], axes=1)
            beside = rows[:, :, self._d]
            left += rows - beside @ self.gain[car]
            inside += np.einsum("mkd,de,mke->mk", beside, self.inner[car], beside, optimize=True)
        return left, inside


def _take_root(matrix: Floats) -> Floats:
    """Return R with R R' equal to a matrix without negative eigenvalues."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    return np.asarray(scale[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0)))


def estimate_spread(bases: Sequence[Siblings]) -> Floats:
    """Return the variance between all cars in each direction, in units of the expected one, (d,)."""
    return _estimate(bases, None)


def estimate_spread_without(bases: Sequence[Siblings], group: int, car: int) -> Floats:
    """Return the variance between all cars but one."""
    return _estimate(bases, (group, car))


def _estimate(groups: Sequence[Siblings], without: tuple[int, int] | None) -> Floats:
    variance = np.ones(groups[0].places.directions.stop - groups[0].places.directions.start)
    for _ in range(ROUNDS):
        square, count = np.zeros(len(variance)), 0
        for g, siblings in enumerate(groups):
            found = SiblingBase(siblings, variance).expect_deviations()
            kept = np.array([(g, c) != without for c in range(len(siblings.cars))])
            square += (found.mean**2 + found.variance)[kept].sum(axis=0)
            count += int(kept.sum())
        variance = (PRIOR_CARS + square) / (PRIOR_CARS + count)
    return variance
