"""Integrate sums of products of columns over random effects, with derivatives by what goes in.

With the sums M = Q'WQ of a unit, such as a ride, and effects of relative variances δ on the columns K, the sums under
the covariance with these effects are

    M - M_.K B M_K.,    B = (Δ^-1 + M_KK)^-1,

and the logarithm of the determinant of the covariance grows by log|I + Δ M_KK|. Sums of the units of a level, added up,
are those of the level above.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints


class Swept(NamedTuple):
    """Hold sums of products after integration over the random effects of each unit.

    Parameters
    ----------
    sums : (units, q, q) float
        Sums without the effects.
    gain : (units, s, q) float
        Expected effects for each column: with `c` the coefficients of the columns in the residual, `gain @ c` is the
        expectation of the effects.
    log_determinant : (units,) float
        What the effects of each unit add to the logarithm of the determinant of the covariance.
    """

    sums: Floats
    gain: Floats
    log_determinant: Floats


def sum_ride_products(columns: Floats, weight: Floats, ride: Ints) -> Floats:
    """Return the weighted sums of products of columns over the windows of each ride.

    Parameters
    ----------
    ride : (n,) int64
        Ride of each window, 0, 1, ... in ascending order.
    """
    weighted = columns * np.sqrt(weight)[:, np.newaxis]
    edges = np.r_[np.flatnonzero(np.r_[True, np.diff(ride) != 0]), len(ride)]
    sums = np.empty((len(edges) - 1, columns.shape[1], columns.shape[1]))
    for i, (start, end) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        part = weighted[start:end]
        np.matmul(part.T, part, out=sums[i])
    return sums


def sum_units(sums: Floats, parent: Ints) -> Floats:
    """Return the sums of the units of the level above.

    Parameters
    ----------
    parent : (units,) int64
        Unit of the level above, 0, 1, ... in any order; none is empty.
    """
    if np.all(parent[1:] >= parent[:-1]):
        return np.asarray(np.add.reduceat(sums, np.flatnonzero(np.r_[True, np.diff(parent) != 0]), axis=0))
    order = np.argsort(parent, kind="stable")
    return sum_units(sums[order], parent[order])


def sweep(sums: Floats, at: Sequence[int] | Ints, variance: Floats) -> Swept:
    """Return sums of products after integration over random effects on some of their columns.

    Parameters
    ----------
    variance : (s,) float
        Variance of each effect over that of a window of weight 1. It may be zero.

    Returns
    -------
    Swept
        M - M_.K B M_K. with B = (Δ^-1 + M_KK)^-1, the gain B M_K. and log|I + Δ M_KK|.

    Examples
    --------
    >>> swept = sweep(np.array([[[4.0, 2.0], [2.0, 3.0]]]), [0], np.array([0.25]))
    >>> swept.sums[0, 1, 1], swept.log_determinant.round(4)
    (np.float64(2.5), array([0.6931]))
    """
    at = np.asarray(at, dtype=np.int64)
    beside = sums[:, at, :]
    inner = np.eye(len(at)) + variance[:, np.newaxis] * beside[:, :, at]
    gain = np.linalg.solve(inner, variance[:, np.newaxis] * beside)
    left = sums - np.swapaxes(beside, 1, 2) @ gain
    return Swept(left, np.asarray(gain, dtype=np.float64), np.asarray(np.linalg.slogdet(inner)[1], dtype=np.float64))


class SweepStep(NamedTuple):
    """Hold the integration over the effects of one level, with what its derivatives need.

    Parameters
    ----------
    own : (units, s, s) float
        Sums of products A of the columns of the effects.
    beside : (units, s, k) float
        Sums of products N of these columns with those of the coefficients and the energy.
    inner : (units, s, s) float
        B = (Δ^-1 + A)^-1.
    kept : (units, s, s) float
        C = I - A B, what is left of A and of N.
    gain : (units, s, k) float
        B N.
    own_left, beside_left : (units, s, s), (units, s, k) float
        C A and C N.
    log_determinant : float
        Sum of log|I + Δ A|.
    """

    own: Floats
    beside: Floats
    inner: Floats
    kept: Floats
    gain: Floats
    own_left: Floats
    beside_left: Floats
    log_determinant: float

    @staticmethod
    def of(own: Floats, beside: Floats, variance: Floats) -> "SweepStep":
        """Return the step of effects with relative variances δ, (s,)."""
        identity = np.eye(len(variance))
        mixed = identity + own * variance  # I + A Δ
        kept: Floats = np.asarray(np.linalg.inv(mixed), dtype=np.float64)
        inner = variance[:, np.newaxis] * kept
        inner = (inner + np.swapaxes(inner, 1, 2)) / 2.0
        logarithm = float(np.linalg.slogdet(mixed)[1].sum())
        return SweepStep(own, beside, inner, kept, inner @ beside, kept @ own, kept @ beside, logarithm)

    def pass_back(
        self, times: Floats, by_own: Floats | None, by_beside: Floats | None
    ) -> tuple[Floats, Floats, Floats]:
        """Return the derivatives by δ (s,), by A and by N.

        `times` is N G, with G the derivatives by the total of the sums; the other two are the derivatives by the sums
        that are left, None at the highest level.
        """
        kept, turned = self.kept, np.swapaxes(self.kept, 1, 2)
        squares = times @ np.swapaxes(self.beside, 1, 2)  # N G N'
        by_delta = _diagonal(self.own_left) - _diagonal(kept @ squares @ turned)
        to_own = self.inner + self.inner @ squares @ self.inner
        to_beside = -2.0 * self.inner @ times
        if by_own is not None and by_beside is not None:
            crossed = kept @ (self.beside @ np.swapaxes(by_beside, 1, 2))  # C N N̄'
            by_delta = by_delta - _diagonal(crossed @ np.swapaxes(self.own_left, 1, 2))
            by_delta = by_delta - _diagonal(self.own_left @ by_own @ np.swapaxes(self.own_left, 1, 2))
            pulled = turned @ (by_beside @ np.swapaxes(self.gain, 1, 2))  # C' N̄ (B N)'
            to_own = to_own + turned @ by_own @ kept - (pulled + np.swapaxes(pulled, 1, 2)) / 2.0
            to_beside = to_beside + turned @ by_beside
        return np.asarray(by_delta.sum(axis=0)), to_own, to_beside


def _diagonal(matrices: Floats) -> Floats:
    """Return the diagonal of each matrix, (units, s)."""
    return np.asarray(np.diagonal(matrices, axis1=1, axis2=2))
