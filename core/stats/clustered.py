"""Means of rides that are alike: rides of one car on one day share weather, load and driver.

A plain standard error of a mean counts every ride as news. Here errors may depend on each other within a cluster, and
the interval allows for few clusters of unequal size: with n_g of n rides in cluster g, p_g = n_g / n, and the sum s_g
of its rides' departures from the mean,

    var = sum of s_g² / (1 - p_g) / n²,    df = 1 / (Σp² + (Σq)² - Σq²),   q_g = p_g² / (1 - p_g),

the bias-reduced estimator of a regression on a constant, which with clusters of equal size is the variance between
their means. Cars are taken to differ by chance from day to day: what one car does every day is not allowed for.

References
----------
Bell and McCaffrey, Survey Methodology 28 (2002) 169, "Bias Reduction in Standard Errors for Linear Regression with
Multi-Stage Samples", eqs. (4) and (9), here for a constant alone.
"""

from math import inf, nan, sqrt
from typing import Final

import numpy as np
import pandas as pd

from core.batch import Floats
from core.stats.scores import UNKNOWN, Codes, Estimate

CLUSTER: Final = ("vehicle_id", "date")
"""Rides that agree in these are alike."""


def assign_vehicle_days(rides: pd.DataFrame) -> Codes:
    """Return the cluster of each ride, from 0."""
    return np.asarray(rides.groupby(list(CLUSTER), sort=False, dropna=False).ngroup(), dtype=np.int64)


def compute_clustered_mean(values: Floats, clusters: Codes) -> Estimate:
    """Return a mean with the standard error that allows for rides of a cluster being alike.

    Parameters
    ----------
    values : (n,) float
        Of each ride; all known.
    clusters : (n,) int64
        Cluster of each.

    Returns
    -------
    Estimate
        Without a standard error where all rides are of one cluster.

    Examples
    --------
    >>> clustered_mean(np.array([1.0, 1.0, 3.0, 3.0]), np.array([0, 0, 1, 1]))
    Estimate(value=2.0, error=1.0, freedom=1.0)
    """
    if not len(values):
        return UNKNOWN
    mean = float(np.mean(values))
    _, own, count = np.unique(clusters, return_inverse=True, return_counts=True)
    if len(count) == 1:  # nothing tells how clusters differ
        return Estimate(mean, nan, nan)
    share = count / len(values)
    sums = np.bincount(own, weights=values - mean)
    error = sqrt(float(np.sum(sums**2 / (1.0 - share)))) / len(values)
    spread = share**2 / (1.0 - share)
    inverse = np.sum(share**2) + np.sum(spread) ** 2 - np.sum(spread**2)
    return Estimate(mean, error, float(round(1.0 / inverse, 9)))


def compute_clustered_ratio(above: Floats, below: Floats, clusters: Codes) -> Estimate:
    """Return a sum over a sum, such as energy over distance, with its clustered standard error by linearisation.

    Examples
    --------
    >>> clustered_ratio(np.array([1.0, 2.0]), np.array([10.0, 20.0]), np.array([0, 1])).value
    0.1
    """
    total = float(np.sum(below))
    if total <= 0.0:
        return UNKNOWN
    ratio = float(np.sum(above)) / total
    found = compute_clustered_mean((above - ratio * below) * (len(below) / total), clusters)
    return found._replace(value=ratio)


def subtract(one: Estimate, other: Estimate) -> Estimate:
    """Return the difference of two independent estimates, with Satterthwaite's degrees of freedom.

    Examples
    --------
    >>> less(Estimate(3.0, 0.3, 10), Estimate(1.0, 0.4, 10)).error
    0.5
    """
    variances = one.error**2, other.error**2
    total = sum(variances)
    spread = sum(v * v / e.freedom for v, e in zip(variances, (one, other), strict=True) if v > 0.0)
    return Estimate(one.value - other.value, sqrt(total), total * total / spread if spread > 0.0 else inf)
