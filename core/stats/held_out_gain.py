"""The gain of a coefficient: the share of a squared error that falls on data to which it was not fitted."""

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.stats.clustered import sum_over_clusters
from socast.core.stats.scores import Estimate


def cross_fit(column: Floats, residual: Floats, fold: Ints, limits: tuple[float, float]) -> Floats:
    """Return for each row the coefficient within limits that fits the rows of the other folds best, (n,)."""
    size, cross = np.bincount(fold, column**2), np.bincount(fold, column * residual)
    size, cross = size.sum() - size, cross.sum() - cross
    fitted = np.divide(cross, size, out=np.zeros(len(size)), where=size > 0.0)
    return np.asarray(np.clip(fitted, *limits)[fold])


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
