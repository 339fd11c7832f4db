"""Solve least squares from moments summed block by block, so that memory does not grow with the number of rides.

Moments are means and centred sums of products, merged block by block [1]_. Large means cost them no digits, unlike
plain sums of products. The eigenvectors of the normal equations in standardised columns yield the solution. The solver
omits eigenvectors along which the columns hardly vary (`CUTOFF`): the least-squares solution of minimum norm.

Columns that are collinear by construction therefore share the explained part equally and do not grow against each other
without limit. Examples are winter + summer = 1, and a histogram that sums to the distance. The predictions equal those
of any other solution, because the omitted directions do not vary in the data.

References
----------
.. [1] Chan, Golub, LeVeque 1983, The American Statistician 37:242, DOI 10.1080/00031305.1983.10483115, eq. (2.1).
.. [2] Liang, Zeger 1986, Biometrika 73:13, DOI 10.1093/biomet/73.1.13: the cluster-robust covariance.
.. [3] MacKinnon, White 1985, J. Econometrics 29:305, DOI 10.1016/0304-4076(85)90158-7: HC3. A few long and fast rides
   determine most of the drag, and the fit follows them. Without the division of their residuals by 1 - leverage, the
   covariance of the coefficient of drag comes out at less than half.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np
from scipy.optimize import nnls

from socast.core.batch import Floats, Ints

CUTOFF: Final = 1e-4
"""Variance of a combination of standardised columns below which they count as collinear: a hundredth of their spread.

Columns that are collinear by construction lie below it; rounding leaves 1e-14. So do columns that are collinear except
for rounding and the cosine of the grade. Examples are rolling resistance against the distance of a car of unknown load
(1e-5), and climbing against gained and lost altitude (1e-6 to 1e-3). Products and squares of speed and distance carry
information and lie above 3e-4.
"""
NO_VARIATION: Final = 1e-9
"""Standard deviation over root mean square below which a column does not vary."""
GROUPS: Final = 2048
"""Number of groups into which clusters are hashed. Clusters that share a group form one larger cluster."""
_MOST_LEVERAGE: Final = 0.95
"""Upper limit of the leverage. A ride that alone forms a group and alone determines a coefficient has leverage 1."""
_CACHED_ROWS: Final = 1024
"""Rows whose leverage is computed together: few enough for their columns to stay in the cache of the processor."""
LEAST_GROUPS: Final = 30
"""Fewest groups for the cluster-robust covariance; with fewer, the covariance is the classical one."""


class Moments:
    """Accumulate the means of columns and their centred sums of products over the added rows."""

    def __init__(self, width: int) -> None:
        self.rows = 0
        self.mean: Floats = np.zeros(width)
        self.scatter: Floats = np.zeros((width, width))

    @classmethod
    def of(cls, block: Floats) -> "Moments":
        """Return the moments of rows, (n, width)."""
        moments = cls(block.shape[1])
        if len(block):
            moments.rows, moments.mean = len(block), block.mean(axis=0)
            centred = block - moments.mean
            moments.scatter = centred.T @ centred
        return moments

    def merge(self, other: "Moments") -> None:
        """Add the rows of other moments."""
        rows = self.rows + other.rows
        if not rows:
            return
        shift = other.mean - self.mean
        self.scatter += other.scatter + np.outer(shift, shift) * (self.rows * other.rows / rows)
        self.mean = self.mean + shift * (other.rows / rows)
        self.rows = rows

    def clear(self, columns: Sequence[int]) -> None:
        """Set columns to zero, so that no fit gives them a coefficient."""
        self.mean[list(columns)] = 0.0
        self.scatter[list(columns)] = 0.0
        self.scatter[:, list(columns)] = 0.0

    def sums(self, *, centred: bool) -> Floats:
        """Return the sums of products."""
        return self.scatter if centred else self.scatter + self.rows * np.outer(self.mean, self.mean)

    def only(self, columns: Sequence[int]) -> "Moments":
        """Return the moments of some columns."""
        part = Moments(0)
        part.rows, part.mean = self.rows, self.mean[list(columns)]
        part.scatter = self.scatter[np.ix_(columns, columns)]
        return part


@dataclass(frozen=True)
class Solution:
    """Hold the least-squares fit of one column on others.

    Parameters
    ----------
    coefficients : (p,) float
        Coefficients without the constant.
    constant : float, optional
        None for a fit without a constant.
    rank : int
        Number of directions in the solution, without the constant.
    weight : (p,) float
        Weights added to the diagonal of the normal equations.
    """

    coefficients: Floats
    constant: float | None
    rank: int
    residual: float
    rows: int
    weight: Floats

    @property
    def freedom(self) -> int:
        """Return the degrees of freedom of the residuals."""
        return self.rows - self.rank - (self.constant is not None)

    @property
    def variance(self) -> float:
        """Return the variance of the residuals, NaN without degrees of freedom."""
        return self.residual / self.freedom if self.freedom > 0 else np.nan


def solve(
    moments: Moments,
    *,
    constant: bool,
    weight: Floats | None = None,
    toward: Floats | None = None,
    least: Floats | None = None,
) -> Solution:
    """Return the least-squares fit of the last column on the others, of minimum norm in standardised columns.

    Parameters
    ----------
    weight, toward : (p,) float, optional
        Penalty `weight (coefficient - toward)^2` on the sum of squares; without it, ordinary least squares. An
        observation of the coefficient with variance v has the weight s^2 / v, where s^2 is the residual variance.
    least : (k, p) float, optional
        Sums of coefficients, by row, that must not be negative. Their multipliers solve the dual, non-negative least
        squares.
    """
    p = len(moments.mean) - 1
    weight = np.zeros(p) if weight is None else weight
    toward = np.zeros(p) if toward is None else toward
    sums = moments.sums(centred=constant)
    gram, cross, squares = sums[:p, :p], sums[:p, p], float(sums[p, p])
    inverse, rank = compute_pseudo_inverse(gram + np.diag(weight), np.sqrt(moments.rows) * moments.mean[:p])
    right = cross + weight * toward
    coefficients = inverse @ right
    if least is not None and (least @ coefficients < 0.0).any():
        half = _root(inverse)
        change = half.T @ (least / np.linalg.norm(least, axis=1, keepdims=True)).T
        coefficients = half @ (half.T @ right + change @ nnls(change, -half.T @ right)[0])
    residual = max(float(squares - 2.0 * coefficients @ cross + coefficients @ gram @ coefficients), 0.0)
    offset = float(moments.mean[p] - moments.mean[:p] @ coefficients) if constant else None
    return Solution(coefficients, offset, rank, residual, moments.rows, weight)


def compute_pseudo_inverse(gram: Floats, size: Floats) -> tuple[Floats, int]:
    """Return the inverse of sums of products over the directions that carry information.

    Parameters
    ----------
    size : (p,) float
        Size of the mean of each column, in the scale of the root of the diagonal of `gram`. A root that is small
        relative to it is rounding.
    """
    scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
    varies = np.flatnonzero(scale > NO_VARIATION * np.hypot(scale, size))
    inverse = np.zeros_like(gram)
    if not len(varies):
        return inverse, 0
    by = np.outer(scale[varies], scale[varies])
    values, vectors = np.linalg.eigh(gram[np.ix_(varies, varies)] / by)
    kept = values > CUTOFF
    half = vectors[:, kept] / np.sqrt(values[kept])
    inverse[np.ix_(varies, varies)] = half @ half.T / by
    return inverse, int(kept.sum())


class Influence:
    """Compute the influence of the residual of each ride on the coefficients, and from it their covariance.

    Parameters
    ----------
    moments : Moments
        Moments of p columns, of q nuisance columns and, last, of the explained column. The fit also determines the
        coefficients of the nuisance columns, which are of no interest.
    beside : int, optional
        Column to which the nuisance columns are made orthogonal first, so that its coefficient stays identified.
    """

    def __init__(self, moments: Moments, solution: Solution, beside: int | None = None) -> None:
        self.solution = solution
        width, p = len(moments.mean) - 1, len(solution.coefficients)
        centred = solution.constant is not None
        gram = moments.sums(centred=centred)[:width, :width]
        mix = np.eye(width)
        if beside is not None and gram[beside, beside] > 0.0:
            mix[beside, p:] = -gram[beside, p:] / gram[beside, beside]
        weight = np.concatenate([solution.weight, np.zeros(width - p)])
        mean = moments.mean[:width]
        inverse = compute_pseudo_inverse(mix.T @ gram @ mix + np.diag(weight), np.sqrt(moments.rows) * mean)[0]
        change = inverse[:p] @ mix.T
        pulled = inverse[:p, :p] * np.sqrt(solution.weight)
        self.mean: Floats = mean if centred else np.zeros(width)
        meat = gram
        if centred:
            offset = -mean @ mix @ inverse
            change = np.block([[change, np.zeros((p, 1))], [offset @ mix.T, 1.0 / moments.rows]])
            pulled = np.vstack([pulled, offset[:p] * np.sqrt(solution.weight)])
            meat = np.block([[gram, np.zeros((width, 1))], [np.zeros((1, width)), moments.rows]])
        self._change, self._pulled, self._meat = change, pulled @ pulled.T, meat
        self._half = mix @ _root(inverse)

    def leverage(self, centred: Floats) -> Floats:
        """Return the leverage of each ride: the share of its residual that the fit absorbs."""
        parts = np.array_split(centred, max(1, len(centred) // _CACHED_ROWS))
        taken = np.concatenate([((part @ self._half) ** 2).sum(axis=1) for part in parts])
        if self.solution.constant is not None:
            taken += 1.0 / self.solution.rows
        return np.clip(taken, 0.0, _MOST_LEVERAGE)

    def classical(self) -> Floats:
        """Return the covariance of (coefficients, constant) for independent errors of equal variance."""
        return (self._change @ self._meat @ self._change.T + self._pulled) * self.solution.variance

    def robust(self, scores: "ClusterScores") -> Floats:
        """Return the covariance of (coefficients, constant) for errors that are correlated within groups [2]_."""
        half = self._change @ scores.sums.T
        return half @ half.T * (scores.groups / (scores.groups - 1)) + self._pulled * self.solution.variance


def _root(matrix: Floats) -> Floats:
    """Return a matrix whose product with its transpose is this symmetric matrix."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    by = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(by, by))
    return by[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0))


class Scores(NamedTuple):
    """Hold the sums of scores over the groups of some rows.

    Parameters
    ----------
    groups : (g,) int
        Groups that have rows.
    sums : (g, p + constant) float
        Their sums.
    """

    groups: Ints
    sums: Floats


def sum_scores(columns: Floats, residual: Floats, group: Ints, *, constant: bool) -> Scores:
    """Return the sums of each column times the residual over groups of rows."""
    order = np.argsort(group, kind="stable")
    groups, first = np.unique(group[order], return_index=True)
    scores = columns[order]
    scores *= residual[order, np.newaxis]
    sums = np.add.reduceat(scores, first, axis=0)
    if constant:
        sums = np.column_stack([sums, np.add.reduceat(residual[order], first)])
    return Scores(groups, sums)


class ClusterScores:
    """Add up the scores of groups of rows, for a cluster-robust covariance."""

    def __init__(self, width: int) -> None:
        self.sums: Floats = np.zeros((GROUPS, width))
        self._seen = np.zeros(GROUPS, np.bool_)

    @property
    def groups(self) -> int:
        """Return the number of groups that have rows."""
        return int(self._seen.sum())

    def add(self, scores: Scores) -> None:
        """Add the scores of rows."""
        self.sums[scores.groups] += scores.sums
        self._seen[scores.groups] = True


def assign_groups(vehicles: Iterable[str], dates: Iterable[str]) -> Ints:
    """Return the group of each ride; rides of one vehicle on one day always share a group."""
    keys = [f"{vehicle}/{date}" for vehicle, date in zip(vehicles, dates, strict=True)]
    group = {key: crc32(key.encode()) % GROUPS for key in set(keys)}
    return np.array([group[key] for key in keys], dtype=np.int64)
