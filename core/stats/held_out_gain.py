"""The gain of a coefficient: the share of a squared error that falls on data to which it was not fitted."""

from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from socast.core.batch import Floats, Ints


class HeldOutGain(NamedTuple):
    """Hold a gain with its uncertainty.

    Parameters
    ----------
    value : float
        Fall of the squared error, as a share of that before. [1]
    half : float
        Half the width of its 95 % interval, by Student's t over independent clusters; NaN with fewer than two. [1]
    """

    value: float
    half: float


def cross_fit(column: Floats, residual: Floats, fold: Ints, limits: tuple[float, float]) -> Floats:
    """Return for each row the coefficient within limits that fits the rows of the other folds best, (n,)."""
    size, cross = np.bincount(fold, column**2), np.bincount(fold, column * residual)
    size, cross = size.sum() - size, cross.sum() - cross
    fitted = np.divide(cross, size, out=np.zeros(len(size)), where=size > 0.0)
    return np.asarray(np.clip(fitted, *limits)[fold])


def sum_over_clusters(values: Floats) -> tuple[float, float]:
    """Return the sum of values over independent clusters and its standard error."""
    count = len(values)
    spread = float(((values - values.mean()) ** 2).sum()) * count / max(count - 1, 1)
    return float(values.sum()), float(np.sqrt(spread))


def measure_gain(before: Floats, after: Floats, cluster: Ints) -> HeldOutGain:
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
    HeldOutGain(value=0.75, half=0.0)
    """
    fall = np.bincount(cluster, before**2 - after**2) / max(float(before @ before), 1e-300)
    value, error = sum_over_clusters(fall)
    return HeldOutGain(value, float(stdtrit(len(fall) - 1, 0.975) * error))
