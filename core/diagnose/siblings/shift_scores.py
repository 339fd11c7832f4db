"""Test any part of a car's shifts from the scores of single shifts, and draw what scores chance would give.

The score of candidate j in shift s is u_sj = c_sj' W r, with the residual r beside what cars share and what the car has
always had in the directions in which cars differ. Without any deviation, scores are normal with mean zero and

    cov(u_si, u_tj) = [s = t] M_s,ij - F_si · F_tj,

with M_s the sums of products of the shift, and F what the fit of the base and of the directions takes. A deviation of
size w_s in each shift has the score Σ w_s u_sj.
"""

from typing import Final, NamedTuple

import numpy as np

from socast.core.batch import Floats

RANK: Final = 1e-9
"""Share of the largest product below which a candidate, or a combination of candidates, is absent from a shift."""


class Projected(NamedTuple):
    """Hold products of m columns within one car.

    Parameters
    ----------
    score, information : (m,) float
        Products with the energy and with themselves.
    beside : (m,) float
        Products with the same candidate in all shifts of the car.
    whole, whole_score : (m,) float
        Products of the latter with itself and with the energy.
    """

    score: Floats
    information: Floats
    beside: Floats
    whole: Floats
    whole_score: Floats

    @property
    def whole_share(self) -> Floats:
        """Coefficient of the same candidate in all shifts of the car."""
        return np.divide(self.beside, self.whole, out=np.zeros(self.whole.shape), where=self.whole > 0.0)

    def remove_whole(self) -> tuple[Floats, Floats]:
        """Return score and information off the same candidate in all shifts of the car."""
        share = self.whole_share
        return self.score - share * self.whole_score, self.information - share * self.beside


class ShiftScores(NamedTuple):
    """Hold the scores of n shifts of a car.

    Parameters
    ----------
    score : (n, k) float
        Products of the candidates with the residual.
    blocks : (n, k, k) float
        Products of the candidates with each other in each shift (M).
    factor : (n, k, r) float
        What the fit takes from their covariance (F).
    """

    score: Floats
    blocks: Floats
    factor: Floats

    @property
    def square(self) -> Floats:
        """Products of the candidates with themselves in each shift, (n, k)."""
        return np.asarray(np.diagonal(self.blocks, axis1=1, axis2=2))

    def project(self, weights: Floats) -> Projected:
        """Return the tests of the candidates with some sizes in each shift."""
        taken = np.tensordot(weights, self.factor, axes=1)
        whole = self.factor.sum(axis=0)
        square = self.square
        return Projected(
            score=weights @ self.score,
            information=weights**2 @ square - (taken**2).sum(axis=2),
            beside=weights @ square - (taken * whole).sum(axis=2),
            whole=np.broadcast_to(square.sum(axis=0) - (whole**2).sum(axis=1), taken.shape[:2]),
            whole_score=np.broadcast_to(self.score.sum(axis=0), taken.shape[:2]),
        )

    def test_without_shifts(self, at: int, weight: Floats, *, own_past: bool) -> float:
        """Return the least z of a candidate, in the direction of all shifts, when any one of them is left out.

        Notes
        -----
        The information is divided among shifts like the squares of the column.
        """
        found = self.project(weight[np.newaxis])
        information, left = float(found.information[0, at]), weight
        if own_past:
            left = weight - float(found.whole_share[0, at])
            information = float(found.remove_whole()[1][0, at])
        parts, own = left * self.score[:, at], left**2 * self.square[:, at]
        own = own * information / own.sum()
        total = parts.sum()
        left_out = np.sign(total) * (total - parts) / np.sqrt(np.maximum(information - own, 1e-300))
        return float(left_out.min())

    def draw(self, count: int, rng: np.random.Generator) -> Floats:
        """Return scores as they would be without any deviation, (count, n, k).

        Notes
        -----
        With M = R R', G = R⁻¹ F and the eigenvalues s² and eigenvectors V of G'G, the covariance is R (1 - G G') R',
        whose root is R (1 - G V diag(1 / (1 + √(1 - s²))) V' G').
        """
        n, k, r = self.factor.shape
        present = self.square > RANK * self.square.max(axis=0)
        scale = np.where(present, np.sqrt(np.maximum(self.square, 0.0)), 0.0)[:, :, np.newaxis]
        shrunk = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
        values, vectors = np.linalg.eigh(self.blocks * shrunk * np.swapaxes(shrunk, 1, 2))
        root = np.sqrt(np.where(values > RANK, values, 0.0))[:, np.newaxis, :]
        inverse = np.divide(vectors, root, out=np.zeros_like(vectors), where=root > 0.0)
        inside = (np.swapaxes(inverse, 1, 2) @ (self.factor * shrunk)).reshape(n * k, r)
        squares, along = np.linalg.eigh(inside.T @ inside)
        middle = along / (1.0 + np.sqrt(np.clip(1.0 - squares, 0.0, 1.0))) @ along.T
        random = rng.standard_normal((count, n * k))
        random -= random @ inside @ middle @ inside.T
        spread = np.swapaxes(scale * vectors * root, 1, 2)
        by_shift = np.swapaxes(random.reshape(count, n, k), 0, 1) @ spread
        return np.asarray(np.swapaxes(by_shift, 0, 1))
