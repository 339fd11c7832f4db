"""Means, ratios and shares over clusters of rides that resemble each other.

Rides of one car on one day share weather, load and driver. A plain standard error of a mean counts every ride as
independent. Here errors may depend on each other within a cluster, and the interval allows for few clusters of unequal
size: with n_g of n rides in cluster g, p_g = n_g / n, and the sum s_g of its rides' deviations from the mean,

    var = sum of s_g² / (1 - p_g) / n²,    df = 1 / (Σp² + (Σq)² - Σq²),   q_g = p_g² / (1 - p_g),

the bias-reduced estimator of a regression on a constant, which with clusters of equal size is the variance between
their means. Cars are assumed to differ by chance from day to day: the error does not cover what one car does every day.

References
----------
Bell and McCaffrey, Survey Methodology 28 (2002) 169, "Bias Reduction in Standard Errors for Linear Regression with
Multi-Stage Samples", eqs. (4) and (9), here for a constant alone.
"""

from math import inf, nan, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.stats.scores import NORMAL_95, UNKNOWN, Codes, Estimate, compute_half_widths

LEAST_CLUSTERS: Final = 30
"""Number of clusters, or of independent cases, below which a share is too uncertain to be shown as a figure."""
FEWEST_CLUSTERS: Final = 10
"""Number of clusters below which they do not tell how many independent cases they are worth."""
SPARSE: Final = 16
"""Largest code over the number of cases above which codes are renumbered before they are counted. [1]"""


def compute_clustered_mean(values: Floats, clusters: Codes) -> Estimate:
    """Return a mean with a standard error that lets rides of a cluster resemble each other.

    Examples
    --------
    >>> compute_clustered_mean(np.array([1.0, 1.0, 3.0, 3.0]), np.array([0, 0, 1, 1]))
    Estimate(value=2.0, error=1.0, freedom=1.0)
    """
    if not len(values):
        return UNKNOWN
    mean = float(np.mean(values))
    if clusters.min() < 0 or clusters.max() > SPARSE * len(values):
        clusters = np.unique(clusters, return_inverse=True)[1]
    every = np.bincount(clusters)
    count = every[every > 0]
    if len(count) == 1:  # one cluster holds no information on how clusters differ
        return Estimate(mean, nan, nan)
    share = count / len(values)
    sums = np.bincount(clusters, weights=values - mean)[every > 0]
    error = sqrt(float(np.sum(sums**2 / (1.0 - share)))) / len(values)
    spread = share**2 / (1.0 - share)
    inverse = np.sum(share**2) + np.sum(spread) ** 2 - np.sum(spread**2)
    return Estimate(mean, error, float(round(1.0 / inverse, 9)))


def compute_clustered_ratio(above: Floats, below: Floats, clusters: Codes) -> Estimate:
    """Return the ratio of two sums, such as energy over distance, with a clustered standard error.

    Returns
    -------
    Estimate
        Ratio with its error by linearisation; unknown where the denominator is not positive.

    Examples
    --------
    >>> compute_clustered_ratio(np.array([1.0, 2.0]), np.array([10.0, 20.0]), np.array([0, 1])).value
    0.1
    """
    total = float(np.sum(below))
    if total <= 0.0:
        return UNKNOWN
    ratio = float(np.sum(above)) / total
    deviation = compute_clustered_mean((above - ratio * below) * (len(below) / total), clusters)
    return deviation._replace(value=ratio)


def sum_over_clusters(values: Floats) -> Estimate:
    """Return the sum of values over independent clusters.

    Examples
    --------
    >>> sum_over_clusters(np.array([1.0, 3.0]))
    Estimate(value=4.0, error=2.0, freedom=1)
    """
    freedom = len(values) - 1
    spread = float(((values - values.mean()) ** 2).sum()) * len(values) / max(freedom, 1)
    return Estimate(float(values.sum()), sqrt(spread), freedom)


def compute_fieller_interval(above: Floats, below: Floats, clusters: Codes) -> tuple[float, float, float]:
    """Return the ratio of two means with Fieller's 95 % interval, which holds for an uncertain denominator too.

    Returns
    -------
    value, low, high : float
        Ratio and the ends of its interval; all NaN where the denominator is not distinguished from zero, because the
        interval is then unbounded.

    Notes
    -----
    With the means x and y, their clustered covariance, and the quantile t, the interval holds every ratio r for which
    x - r y is not distinguished from zero: (x - r y)² <= t² (var_x - 2 r cov + r² var_y).

    References
    ----------
    Fieller, Journal of the Royal Statistical Society B 16 (1954) 175, "Some problems in interval estimation".

    Examples
    --------
    >>> numbers = np.array([1.0, 2.0, 3.0, 4.0])
    >>> compute_fieller_interval(numbers - 1.0, numbers + 1.0, np.arange(4))[0]
    0.42857142857142855
    """
    x, y = compute_clustered_mean(above, clusters), compute_clustered_mean(below, clusters)
    if not y.freedom > 0.0 or not y.value - y.ci95 > 0.0:
        return nan, nan, nan
    both, apart = compute_clustered_mean(above + below, clusters), compute_clustered_mean(above - below, clusters)
    covariance = 0.25 * (both.error**2 - apart.error**2)
    square = float(compute_half_widths(1.0, y.freedom)) ** 2
    a = y.value**2 - square * y.error**2
    b = x.value * y.value - square * covariance
    c = x.value**2 - square * x.error**2
    half = sqrt(max(b * b - a * c, 0.0))
    return x.value / y.value, (b - half) / a, (b + half) / a


def subtract(minuend: Estimate, subtrahend: Estimate) -> Estimate:
    """Return the difference of two independent estimates, with Satterthwaite's degrees of freedom.

    Examples
    --------
    >>> subtract(Estimate(3.0, 0.3, 10), Estimate(1.0, 0.4, 10)).error
    0.5
    """
    variances = minuend.error**2, subtrahend.error**2
    total = sum(variances)
    spread = sum(v * v / e.freedom for v, e in zip(variances, (minuend, subtrahend), strict=True) if v > 0.0)
    return Estimate(minuend.value - subtrahend.value, sqrt(total), total * total / spread if spread > 0.0 else inf)


def compute_clustered_share(holds: NDArray[np.bool_], clusters: Codes) -> dict[str, float]:
    """Return a share with a 95 % interval that lets cases of a cluster resemble each other.

    Notes
    -----
    Wilson's interval for the effective number of cases m,

        (p + z²/2m ± z sqrt(p (1 - p)/m + z²/4m²)) / (1 + z²/m).

    m is the number of cases, reduced by the ratio of the variance of independent cases to the clustered variance and by
    the degrees of freedom of the latter. Where the condition holds in all cases or in
    none, m is the number of clusters.

    References
    ----------
    Wilson, Journal of the American Statistical Association 22 (1927) 209, DOI 10.1080/01621459.1927.10502953. Korn and
    Graubard, Survey Methodology 24 (1998) 193, section 3, on the effective number.

    Examples
    --------
    >>> share = compute_clustered_share(np.array([True] * 18 + [False] * 2), np.arange(20))
    >>> [round(share[name], 2) for name in ("value", "low", "high")]
    [0.9, 0.7, 0.97]
    """
    estimate, count = compute_clustered_mean(holds.astype(np.float64), clusters), len(np.unique(clusters))
    n, share = float(len(holds)), estimate.value
    if not n or not estimate.freedom > 0.0:
        return {"value": share, "low": nan, "high": nan, "clusters": count}
    if estimate.error > 0.0:
        stretch = float(compute_half_widths(1.0, n - 1.0) / compute_half_widths(1.0, estimate.freedom))
        independent = share * (1.0 - share) / (n - 1.0)
        n = min(n, n * independent / estimate.error**2 * stretch**2)
    else:
        n = float(count)
    low, high = compute_wilson_interval(share, n)
    return {"value": share, "low": low, "high": high, "clusters": count}


def compute_wilson_interval(share: float, n: float) -> tuple[float, float]:
    """Return the ends of Wilson's 95 % interval for a share of n cases.

    Examples
    --------
    >>> [round(end, 3) for end in compute_wilson_interval(0.0, 10)]
    [0.0, 0.278]
    """
    square = NORMAL_95**2
    middle, half = share + square / (2.0 * n), sqrt(square * (share * (1.0 - share) / n + square / (4.0 * n * n)))
    whole = 1.0 + square / n
    return (middle - half) / whole if share > 0.0 else 0.0, (middle + half) / whole if share < 1.0 else 1.0


def count_independent_cases(share: float, low: float, high: float) -> float:
    """Return the number of independent cases that have the same interval of Wilson.

    Examples
    --------
    >>> round(count_independent_cases(0.9, *compute_wilson_interval(0.9, 47.0)), 6)
    47.0
    """
    square = (high - low) ** 2  # with u = z² / n: square (1 + u)² = 4 share (1 - share) u + u²
    middle = 2.0 * share * (1.0 - share) - square
    return NORMAL_95**2 * (middle + sqrt(middle**2 + (1.0 - square) * square)) / square
