"""The gain of a coefficient: the share of a squared error that falls on data to which it was not fitted."""

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.stats.clustered import sum_over_clusters
from socast.core.stats.scores import Estimate


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
