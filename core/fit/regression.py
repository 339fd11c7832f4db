"""Least squares from moments that are added up block by block, so that memory does not grow with the number of rides.

Moments are means and centred sums of products, merged block by block [1]_, which loses no digits to large means as
plain sums of products do. The normal equations are solved in standardised columns by their eigenvectors, leaving out
those along which the columns hardly vary (`CUTOFF`): the least-squares solution of minimum norm. So columns that are
collinear by construction (winter + summer = 1, a histogram that sums to the distance) share what they explain in
equal parts instead of growing against each other without limit; predictions are those of any other solution, as the
directions that are left out do not vary in the data.

References
----------
.. [1] Chan, Golub, LeVeque 1983, The American Statistician 37:242, DOI 10.1080/00031305.1983.10483115, eq. (2.1).
.. [2] Liang, Zeger 1986, Biometrika 73:13, DOI 10.1093/biomet/73.1.13: the cluster-robust covariance.
.. [3] MacKinnon, White 1985, J. Econometrics 29:305, DOI 10.1016/0304-4076(85)90158-7: HC3. A few long and fast rides
   tell most of the drag, and the fit follows them: without dividing their residuals by 1 - leverage the covariance of
   its coefficient comes out at less than half.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final
from zlib import crc32

import numpy as np

from core.batch import Floats, Ints

CUTOFF: Final = 1e-4
"""Variance of a combination of standardised columns below which they count as collinear: a hundredth of their spread.

Below it lie what is collinear by construction (rounding leaves 1e-14) and what is so but for rounding and the cosine of
the grade: rolling resistance against the distance of a car whose load is not known (1e-5), climbing against gained and
lost altitude (1e-6 to 1e-3). Above 3e-4 come products and squares of speed and distance, which tell something.
"""
NO_VARIATION: Final = 1e-9
"""Standard deviation over root mean square below which a column does not vary."""
GROUPS: Final = 2048
"""Groups into which clusters are hashed: a few clusters in one group are still one cluster, only a larger one."""
_MOST_LEVERAGE: Final = 0.95
"""The most leverage that is believed: a ride that is a group of its own and tells a coefficient alone has 1."""
LEAST_GROUPS: Final = 30
"""Fewer groups than this cannot tell a covariance; then it is the classical one."""


class Moments:
    """Means of columns and their centred sums of products, of all rows added so far.

    Parameters
    ----------
    width : int
        Number of columns.
    """

    def __init__(self, width: int) -> None:
        self.rows = 0
        self.mean: Floats = np.zeros(width)
        self.scatter: Floats = np.zeros((width, width))

    def add(self, block: Floats) -> None:
        """Add rows.

        Parameters
        ----------
        block : (n, width) float
        """
        if not len(block):
            return
        other = Moments(block.shape[1])
        other.rows = len(block)
        other.mean = block.mean(axis=0)
        centred = block - other.mean
        other.scatter = centred.T @ centred
        self.merge(other)

    def merge(self, other: "Moments") -> None:
        """Add the rows that another has added."""
        rows = self.rows + other.rows
        if not rows:
            return
        shift = other.mean - self.mean
        self.scatter += other.scatter + np.outer(shift, shift) * (self.rows * other.rows / rows)
        self.mean = self.mean + shift * (other.rows / rows)
        self.rows = rows

    def sums(self, *, centred: bool) -> Floats:
        """Return sums of products, about the means or as they are."""
        return self.scatter if centred else self.scatter + self.rows * np.outer(self.mean, self.mean)

    def only(self, columns: Sequence[int]) -> "Moments":
        """Return the moments of some columns, in that order."""
        part = Moments(0)
        part.rows, part.mean = self.rows, self.mean[list(columns)]
        part.scatter = self.scatter[np.ix_(columns, columns)]
        return part


@dataclass(frozen=True)
class Solution:
    """Least squares of a column on others.

    Parameters
    ----------
    coefficients : (p,) float
        Without the constant.
    constant : float, optional
        None where none was asked for.
    rank : int
        Directions that were solved for, the constant apart.
    residual : float
        Sum of squared residuals.
    rows : int
    weight : (p,) float
        What was added to the diagonal of the normal equations.
    """

    coefficients: Floats
    constant: float | None
    rank: int
    residual: float
    rows: int
    weight: Floats

    @property
    def freedom(self) -> int:
        """Degrees of freedom that are left."""
        return self.rows - self.rank - (self.constant is not None)

    @property
    def variance(self) -> float:
        """Variance of what is left, NaN where no freedom is."""
        return self.residual / self.freedom if self.freedom > 0 else np.nan


def solve(moments: Moments, *, constant: bool, weight: Floats | None = None, toward: Floats | None = None) -> Solution:
    """Return the least squares of the last column on the others, of minimum norm in standardised columns.

    Parameters
    ----------
    moments : Moments
        Of p columns and, last, of what is to be explained.
    constant : bool
        Fit a constant beside them.
    weight, toward : (p,) float, optional
        Least squares with `weight (coefficient - toward)^2` added to the sum of squares; none for ordinary least
        squares. An observation of the coefficient with variance v weighs s^2 / v, s^2 the variance of what is left.
    """
    p = len(moments.mean) - 1
    weight = np.zeros(p) if weight is None else weight
    toward = np.zeros(p) if toward is None else toward
    sums = moments.sums(centred=constant)
    gram, cross, own = sums[:p, :p], sums[:p, p], float(sums[p, p])
    inverse, rank = compute_pseudo_inverse(gram + np.diag(weight), np.sqrt(moments.rows) * moments.mean[:p])
    coefficients = inverse @ (cross + weight * toward)
    residual = max(float(own - 2.0 * coefficients @ cross + coefficients @ gram @ coefficients), 0.0)
    offset = float(moments.mean[p] - moments.mean[:p] @ coefficients) if constant else None
    return Solution(coefficients, offset, rank, residual, moments.rows, weight)


def compute_pseudo_inverse(gram: Floats, size: Floats) -> tuple[Floats, int]:
    """Return the inverse of sums of products over the directions that carry information, and their number.

    Parameters
    ----------
    gram : (p, p) float
    size : (p,) float
        Of each column's mean, in the scale of the root of `gram`'s diagonal: what is small against it is rounding.
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
    """How much each ride's residual moves the coefficients, and so the covariance of those.

    Parameters
    ----------
    moments : Moments
        Of p columns, of q nuisance columns whose coefficients are of no interest but were found too, and of what was
        explained, last.
    solution : Solution
        For the p columns.
    beside : int, optional
        The column to which nuisance columns are made orthogonal first, so that its coefficient stays identified.
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

    def leverage(self, columns: Floats) -> Floats:
        """Return how much of each ride's residual the fit takes up, 0 to 1.

        Parameters
        ----------
        columns : (n, p + q) float
        """
        taken = (((columns - self.mean) @ self._half) ** 2).sum(axis=1)
        if self.solution.constant is not None:
            taken += 1.0 / self.solution.rows
        return np.clip(taken, 0.0, _MOST_LEVERAGE)

    def classical(self) -> Floats:
        """Return the covariance of (coefficients, constant) where errors are independent and alike."""
        return (self._change @ self._meat @ self._change.T + self._pulled) * self.solution.variance

    def robust(self, scores: "ClusterScores") -> Floats:
        """Return the covariance of (coefficients, constant) where errors depend on each other within groups [2]_.

        Parameters
        ----------
        scores : Scores
            Of residuals over one minus leverage [3]_.
        """
        half = self._change @ scores.sums.T
        return half @ half.T * (scores.groups / (scores.groups - 1)) + self._pulled * self.solution.variance


def _root(matrix: Floats) -> Floats:
    """Return a matrix that, times its transpose, is this symmetric one."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    by = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(by, by))
    return by[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0))


class ClusterScores:
    """Sums over groups of rows of each column times the residual: what a cluster-robust covariance is made of.

    Parameters
    ----------
    mean : (p,) float
        What columns are taken about.
    constant : bool
        Sum up the residual itself too.
    """

    def __init__(self, mean: Floats, *, constant: bool) -> None:
        self.mean = mean
        self.constant = constant
        self.sums: Floats = np.zeros((GROUPS, len(mean) + constant))
        self._seen = np.zeros(GROUPS, np.bool_)

    @property
    def groups(self) -> int:
        """Groups that have rows."""
        return int(self._seen.sum())

    def add(self, columns: Floats, residual: Floats, group: Ints) -> None:
        """Add rows.

        Parameters
        ----------
        columns : (n, p) float
        residual : (n,) float
        group : (n,) int
            As `grouped` returns it.
        """
        p = columns.shape[1]
        order = np.argsort(group, kind="stable")
        found, first = np.unique(group[order], return_index=True)
        scores = (columns - self.mean) * residual[:, np.newaxis]
        self.sums[found, :p] += np.add.reduceat(scores[order], first, axis=0)
        if self.constant:
            self.sums[found, p] += np.add.reduceat(residual[order], first)
        self._seen[found] = True


def assign_groups(vehicles: Sequence[str], dates: Sequence[str]) -> Ints:
    """Return the group of each ride: rides of one vehicle on one day are always in the same."""
    keys = [f"{vehicle}/{date}" for vehicle, date in zip(vehicles, dates, strict=True)]
    group = {key: crc32(key.encode()) % GROUPS for key in set(keys)}
    return np.array([group[key] for key in keys], dtype=np.int64)
