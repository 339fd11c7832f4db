"""Test whether candidate effects are present in the residual of a model, and measure what they gain.

All quantities are weighted and projected (`socast.core.diagnose.projection`): a residual r and one column c per
candidate, of which the terms of the model can explain nothing. The coefficient of a candidate is then c'r / c'c.

Errors of the rows of a cluster, such as a vehicle-day, may depend on each other in any way. The variance is therefore
the sum of the squared sums over clusters, each divided by (1 - h), as if the cluster were left out (CR3). h is the
share of c'c that the cluster contributes. A candidate that acts in few clusters has correspondingly few degrees of
freedom.

Cars that drive on the same date share its weather, including errors of the weather data. The test is therefore repeated
with dates as clusters, and the less significant of the two results counts.

References
----------
Bell and McCaffrey, Survey Methodology 28 (2002) 169, bias reduction in standard errors for linear regression with
multi-stage samples. Cameron and Miller, Journal of Human Resources 50 (2015) 317, DOI 10.3368/jhr.50.2.317, sections II
and VI. Benjamini and Hochberg, Journal of the Royal Statistical Society B 57 (1995) 289.

The gain of a coefficient is the share of a squared error that falls on data to which it was not fitted.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.special import stdtr

from socast.core.batch import Floats, Ints
from socast.core.stats.clustered import sum_over_clusters
from socast.core.stats.scores import Estimate, compute_half_widths
from socast.core.stats.splits import deal_folds

FOLDS: Final = 10
"""Number of folds to which clusters are assigned."""
WHOLE_SHARE: Final = 0.999
"""Share of a candidate in one cluster above which the data contain no information about its standard error."""
LEAST_FREEDOM: Final = 0.5
"""Least degrees of freedom of a standard error."""


class ClusterSums:
    """Sum columns over clusters of rows, such as vehicle-days or dates.

    Parameters
    ----------
    code : (n,) int64
        Cluster of each row.
    """

    def __init__(self, code: Ints) -> None:
        self.code = np.unique(code, return_inverse=True)[1].astype(np.int64)
        self.count = int(self.code.max()) + 1
        self._order = np.argsort(self.code, kind="stable")
        self._starts = np.flatnonzero(np.r_[True, np.diff(self.code[self._order]) > 0])

    def assign_folds(self, seed: int) -> Ints:
        """Return the fold of each cluster, one of at most `FOLDS`, (count,)."""
        return deal_folds(self.count, FOLDS, seed)

    def sum_by_cluster(self, values: Floats) -> Floats:
        """Return the sum of values over each cluster, (count, ...)."""
        return np.asarray(np.add.reduceat(values[self._order], self._starts, axis=0))


class Evidence(NamedTuple):
    """Hold the test result of each of k candidates, each tested alone beside the model.

    Parameters
    ----------
    coefficient, error : (k,) float
        Coefficient and its standard error. [unit of the coefficient]
    freedom : (k,) float
        Degrees of freedom of the standard error. [1]
    z, p : (k,) float
        Coefficient over standard error, and the probability of this evidence or more, with the sign that physics
        demands, if the effect is too small to report. [1]
    """

    coefficient: Floats
    error: Floats
    freedom: Floats
    z: Floats
    p: Floats

    def get_estimate(self, at: int) -> Estimate:
        """Return the coefficient of one candidate. [unit of the coefficient]"""
        return Estimate(float(self.coefficient[at]), float(self.error[at]), float(self.freedom[at]))


def compute_worst_case_evidence(
    residual: Floats, columns: Floats, sign: Ints, clusters: Sequence[ClusterSums], least: Floats | None = None
) -> Evidence:
    """Return for each candidate the evidence by the clustering that gives the least significance.

    Returns
    -------
    Evidence
        The largest probability of all clusterings, and separately the standard error with the widest interval.
    """
    results = [compute_evidence(residual, columns, sign, each, least) for each in clusters]
    worst = np.argmax([each.p for each in results], axis=0)
    widest = np.argmax([compute_half_widths(each.error, each.freedom) for each in results], axis=0)
    error, freedom = (np.choose(widest, [getattr(each, name) for each in results]) for name in ("error", "freedom"))
    z, p = (np.choose(worst, [getattr(each, name) for each in results]) for name in ("z", "p"))
    return Evidence(results[0].coefficient, error, freedom, z, p)


def compute_evidence(
    residual: Floats, columns: Floats, sign: Ints, clusters: ClusterSums, least: Floats | None = None
) -> Evidence:
    """Return the evidence for each candidate, by one clustering.

    Parameters
    ----------
    least : (k,) float, optional
        Coefficient below which an effect is too small to report; the test is whether the coefficient is larger.
        [unit of the coefficient]
    """
    size = np.maximum((columns**2).sum(axis=0), 1e-300)
    coefficient = columns.T @ residual / size
    share = clusters.sum_by_cluster(columns**2) / size
    scores = clusters.sum_by_cluster(columns * (residual[:, np.newaxis] - columns * coefficient))
    scores /= 1.0 - np.minimum(share, WHOLE_SHARE)
    alone = share.max(axis=0) > WHOLE_SHARE
    error = np.where(alone, np.inf, np.sqrt((scores**2).sum(axis=0)) / size)
    freedom = np.maximum(1.0 / np.maximum((share**2).sum(axis=0), 1e-300) - 1.0, LEAST_FREEDOM)
    z = np.divide(coefficient, error, out=np.zeros(len(size)), where=error > 0.0)
    beyond = np.where(sign == 0, np.abs(coefficient), coefficient * sign) - (0.0 if least is None else least)
    ratio = np.divide(beyond, error, out=np.full(len(size), -np.inf), where=error > 0.0)
    one_sided = stdtr(freedom, -ratio)
    return Evidence(coefficient, error, freedom, z, np.where(sign == 0, np.minimum(2.0 * one_sided, 1.0), one_sided))


def fit_other_folds(size: Floats, cross: Floats, fold: Ints) -> Floats:
    """Return for each unit the coefficients that fit the units of the other folds best, (units, ...).

    Parameters
    ----------
    size, cross : (units, ...) float
        Sums of squares of each column, and of its products with the residual.
    """
    rest = [fold != k for k in range(int(fold.max()) + 1)]
    size, cross = (np.array([each[others].sum(axis=0) for others in rest]) for each in (size, cross))
    return np.asarray(np.divide(cross, size, out=np.zeros_like(cross), where=size > 0.0)[fold])


def cross_fit(column: Floats, residual: Floats, fold: Ints, limits: tuple[float, float]) -> Floats:
    """Return for each row the coefficient within limits that fits the rows of the other folds best, (n,)."""
    return np.clip(fit_other_folds(column**2, column * residual, fold), *limits)


def measure_gain(before: Floats, after: Floats, cluster: Ints) -> Estimate:
    """Return the gain from errors before and after.

    Parameters
    ----------
    before, after : (n,) float
        Errors on data to which what was added is not fitted.
    cluster : (n,) int64
        Clusters within which errors depend on each other, from 0.

    Examples
    --------
    >>> measure_gain(np.array([2.0, 2.0, 2.0]), np.array([1.0, 1.0, 1.0]), np.array([0, 1, 2]))
    Estimate(value=0.75, error=0.0, freedom=2)
    """
    return sum_over_clusters(np.bincount(cluster, before**2 - after**2) / max(float(before @ before), 1e-300))
