"""Integrate sums of products of columns over random effects of nested units, with derivatives by what goes in.

With the sums M = Q'WQ of a unit, such as a ride, and effects of variances δ on the columns K, the sums under the
covariance with these effects are

    M - M_.K B M_K.,    B = (Δ^-1 + M_KK)^-1,

and the logarithm of the determinant of the covariance grows by log|I + Δ M_KK|. Sums of the units of a level, added up,
are those of the level above. Variances are relative to that of a row of weight 1, and may be zero.

References
----------
Laird, Ware, Biometrics 38 (1982) 963, DOI 10.2307/2529876: random effects. DerSimonian, Laird, Controlled Clinical
Trials 7 (1986) 177, DOI 10.1016/0197-2456(86)90046-2: the variance between units from their estimates alone.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from socast.core.batch import Floats, Ints


class Integrated(NamedTuple):
    """Hold sums of products before and after integration over the random effects on some of their columns.

    Parameters
    ----------
    given, sums : (units, q, q) float
        Sums with and without the effects.
    at : slice or (s,) int64
        Columns on which the effects act.
    variance : (s,) float
        Their variances.
    inverse : (units, s, s) float
        (I + Δ M_KK)^-1.
    gain : (units, s, q) float
        B M_K.: with `c` the coefficients of the columns in the residual, `gain @ c` is the expectation of the effects.
    log_determinant : (units,) float
        What the effects of each unit add to the logarithm of the determinant of the covariance.
    """

    given: Floats
    sums: Floats
    at: slice | Ints
    variance: Floats
    inverse: Floats
    gain: Floats
    log_determinant: Floats

    def pass_back(self, by_sums: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of the logarithm of a Gaussian density by `given` and by `variance`.

        Notes
        -----
        A change dM of `given` becomes P dM P' in `sums`, with P = I - M_.K B E_K'.
        """
        beside, own = np.ascontiguousarray(self.given[:, :, self.at]), self.given[:, self.at][:, :, self.at]
        middle = self.inverse * self.variance
        changed = -beside @ middle
        changed[:, self.at] += np.eye(len(self.variance))
        by_given = by_sums.copy()
        by_given[:, :, self.at] = by_sums @ changed
        by_given[:, self.at] = np.swapaxes(changed, 1, 2) @ by_given
        by_given[:, self.at, self.at] -= 0.5 * middle
        gain = beside @ self.inverse
        by_variance = -np.einsum("mis,mis->s", gain, by_sums @ gain)
        return by_given, by_variance - 0.5 * np.sum(np.swapaxes(own, 1, 2) * self.inverse, axis=(0, 1))


def number_units(codes: Ints) -> Ints:
    """Return codes numbered from 0 in the order of first appearance.

    Examples
    --------
    >>> number_units(np.array([7, 7, 2, 7, 3])).tolist()
    [0, 0, 1, 0, 2]
    """
    _, first, place = np.unique(codes, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[place], dtype=np.int64)


def sum_products(columns: Floats, weight: Floats, unit: Ints) -> Floats:
    """Return the weighted sums of products of columns over the rows of each unit, whose codes have no gap."""
    weighted = columns * np.sqrt(weight)[:, np.newaxis]
    if np.any(np.diff(unit) < 0):
        order = np.argsort(unit, kind="stable")
        unit, weighted = unit[order], weighted[order]
    edges = np.r_[np.flatnonzero(np.r_[True, np.diff(unit) != 0]), len(unit)]
    sums = np.empty((len(edges) - 1, columns.shape[1], columns.shape[1]))
    for i, (start, end) in enumerate(zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)):
        part = weighted[start:end]
        np.matmul(part.T, part, out=sums[i])
    return sums


def link_units(parent: Ints) -> csc_array:
    """Return the matrix, (parents, units), that adds up units by their parents, whose codes have no gap."""
    return csc_array((np.ones(len(parent)), parent, np.arange(len(parent) + 1)), (int(parent.max()) + 1, len(parent)))


def sum_units(sums: Floats, parent: Ints | csc_array) -> Floats:
    """Return the sums of units by their parents, given as codes or, for many calls, as the matrix of `link_units`."""
    # a product with a sparse matrix takes a tenth of the time of `np.add.reduceat` along the first axis
    adding = link_units(parent) if isinstance(parent, np.ndarray) else parent
    return np.asarray(adding @ sums.reshape(len(sums), -1)).reshape(-1, *sums.shape[1:])


def integrate_out(sums: Floats, at: slice | Ints, variance: Floats) -> Integrated:
    """Return sums of products of each unit without random effects on some of their columns.

    Examples
    --------
    >>> found = integrate_out(np.array([[[4.0, 2.0], [2.0, 3.0]]]), slice(0, 1), np.array([0.25]))
    >>> found.sums[0, 1, 1], found.log_determinant.round(4)
    (np.float64(2.5), array([0.6931]))
    """
    if not variance.any():
        units, size, _ = sums.shape
        none = np.zeros((units, len(variance), size))
        inverse = np.broadcast_to(np.eye(len(variance)), (units, len(variance), len(variance)))
        return Integrated(sums, sums, at, variance, inverse, none, np.zeros(units))
    beside = np.ascontiguousarray(sums[:, :, at])
    inverse, logarithm = _invert(beside[:, at], variance)
    gain = (inverse * variance) @ np.swapaxes(beside, 1, 2)
    left = beside @ gain
    np.subtract(sums, left, out=left)
    return Integrated(sums, left, at, variance, inverse, gain, logarithm)


def _invert(own: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Return (I + Δ A)^-1 of each unit and the logarithm of the determinant of its inverse."""
    inner = np.eye(len(variance)) + variance[:, np.newaxis] * own
    if len(variance) == 2:  # LAPACK takes ten times as long for many matrices of two rows
        (a, b), (c, d) = np.moveaxis(inner, 0, -1)
        determinant = a * d - b * c
        adjugate = np.stack([d, -b, -c, a], axis=-1).reshape(inner.shape)
        return adjugate / determinant[:, np.newaxis, np.newaxis], np.log(determinant)
    # `solve` takes ten times as long for many right sides of few equations
    return np.asarray(np.linalg.inv(inner), np.float64), np.asarray(np.linalg.slogdet(inner)[1], np.float64)


def estimate_variance_between(values: Floats, weight: Floats) -> float:
    """Return the variance between units, from estimates of variances 1 / weight; DerSimonian and Laird, eq. (8).

    Examples
    --------
    >>> estimate_variance_between(np.array([1.0, 3.0]), np.array([2.0, 2.0]))
    1.5
    """
    if len(values) < 2:
        return 0.0
    total = float(weight.sum())
    excess = float(weight @ (values - weight @ values / total) ** 2) - (len(values) - 1)
    return max(excess / (total - float(weight @ weight) / total), 0.0)


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
    own_left : (units, s, s) float
        C A.
    log_determinant : float
        Sum of log|I + Δ A|.
    """

    own: Floats
    beside: Floats
    inner: Floats
    kept: Floats
    gain: Floats
    own_left: Floats
    log_determinant: float

    @staticmethod
    def of(own: Floats, beside: Floats, variance: Floats) -> "SweepStep":
        """Return the step of effects with relative variances δ, (s,)."""
        inverse, logarithm = _invert(own, variance)
        kept, inner = np.swapaxes(inverse, 1, 2), inverse * variance
        inner = (inner + np.swapaxes(inner, 1, 2)) / 2.0
        return SweepStep(own, beside, inner, kept, inner @ beside, kept @ own, float(logarithm.sum()))

    @property
    def beside_left(self) -> Floats:
        """C N, (units, s, k)."""
        return self.kept @ self.beside

    @property
    def taken(self) -> Floats:
        """What the effects take away from the sums of the coefficients and the energy: N'BN over all units, (k, k)."""
        wide = self.beside.shape[2]
        return np.asarray(self.beside.reshape(-1, wide).T @ self.gain.reshape(-1, wide))

    def differentiate(self, times: Floats, by_own: Floats | None, by_beside: Floats | None) -> Floats:
        """Return the derivatives by δ, (s,), see `pass_back`."""
        return self._differentiate(times @ np.swapaxes(self.beside, 1, 2), by_own, by_beside)

    def pass_back(
        self, times: Floats, by_own: Floats | None, by_beside: Floats | None
    ) -> tuple[Floats, Floats, Floats]:
        """Return the derivatives by δ (s,), by A and by N.

        `times` is N G, with G the derivatives by the total of the sums; the other two are the derivatives by the sums
        that are left, None at the highest level.
        """
        kept, turned = self.kept, np.swapaxes(self.kept, 1, 2)
        squares = times @ np.swapaxes(self.beside, 1, 2)  # N G N'
        to_own = self.inner + self.inner @ squares @ self.inner
        to_beside = -2.0 * self.inner @ times
        if by_own is not None and by_beside is not None:
            pulled = turned @ (by_beside @ np.swapaxes(self.gain, 1, 2))  # C' N̄ (B N)'
            to_own = to_own + turned @ by_own @ kept - (pulled + np.swapaxes(pulled, 1, 2)) / 2.0
            to_beside = to_beside + turned @ by_beside
        return self._differentiate(squares, by_own, by_beside), to_own, to_beside

    def _differentiate(self, squares: Floats, by_own: Floats | None, by_beside: Floats | None) -> Floats:
        kept, turned = self.kept, np.swapaxes(self.kept, 1, 2)
        by_delta = get_diagonals(self.own_left) - get_diagonals(kept @ squares @ turned)
        if by_own is not None and by_beside is not None:
            crossed = kept @ (self.beside @ np.swapaxes(by_beside, 1, 2))  # C N N̄'
            by_delta = by_delta - get_diagonals(crossed @ np.swapaxes(self.own_left, 1, 2))
            by_delta = by_delta - get_diagonals(self.own_left @ by_own @ np.swapaxes(self.own_left, 1, 2))
        return np.asarray(by_delta.sum(axis=0))


def get_diagonals(matrices: Floats) -> Floats:
    """Return the diagonal of each matrix, (units, s)."""
    return np.asarray(np.diagonal(matrices, axis1=1, axis2=2))
