"""Average values in bins, with intervals that let rows of one cluster depend on each other."""

from typing import Final, NamedTuple

import numpy as np
from scipy.special import stdtr

from socast.core.batch import Floats, Ints
from socast.core.stats.scores import compute_half_widths

LEAST_FREEDOM: Final = 2.0
"""Degrees of freedom below which a bin holds too few clusters for an interval."""


class BinMeans(NamedTuple):
    """Hold the mean of a value in each of b bins.

    Parameters
    ----------
    value : (b,) float
        Weighted mean.
    ci95 : (b,) float
        Half width of its 95 % interval; NaN where a bin holds too few clusters.
    p : (b,) float
        Probability of a mean at least as far from zero by chance; NaN where there is no interval. [1]
    windows, days : (b,) int64
        Number of rows and of clusters, such as windows and vehicle-days.
    """

    value: Floats
    ci95: Floats
    p: Floats
    windows: Ints
    days: Ints


def average_in_bins(place: Ints, bins: int, values: Floats, weight: Floats, day: Ints) -> BinMeans:
    """Return the weighted mean of values in each bin, with clustered intervals.

    Parameters
    ----------
    bins : int
        Number of bins, each with at least one row of positive weight.

    Notes
    -----
    With the share p of a cluster in the weight of its bin, and the sum s of its weighted deviations from the mean,
    the variance is the sum of s^2/(1 - p) over the squared weight, with 1/(sum of p^2) - 1 degrees of freedom, as in
    `socast.core.stats.evidence`.

    Examples
    --------
    >>> one = np.ones(4)
    >>> means = average_in_bins(np.array([0, 0, 1, 1]), 2, np.array([1.0, 3.0, 5.0, 5.0]), one, np.arange(4))
    >>> means.value.tolist(), means.windows.tolist()
    ([2.0, 5.0], [2, 2])
    """
    total = np.bincount(place, weight, bins)
    mean = np.bincount(place, weight * values, bins) / total
    pair, of_pair = np.unique(place * (int(day.max()) + 1) + day, return_inverse=True)
    bin_of_pair = pair // (int(day.max()) + 1)
    share = np.bincount(of_pair, weight, len(pair)) / total[bin_of_pair]
    sums = np.bincount(of_pair, weight * (values - mean[place]), len(pair))
    rest = np.maximum(1.0 - share, 1e-12)
    error = np.sqrt(np.bincount(bin_of_pair, sums**2 / rest, bins)) / total
    freedom = 1.0 / np.bincount(bin_of_pair, share**2, bins) - 1.0
    enough = freedom >= LEAST_FREEDOM
    freedom = np.maximum(freedom, LEAST_FREEDOM)
    half = np.where(enough, compute_half_widths(error, freedom), np.nan)
    apart = np.divide(np.abs(mean), error, out=np.where(mean == 0.0, 0.0, np.inf), where=error > 0.0)
    p = np.where(enough, 2.0 * stdtr(freedom, -apart), np.nan)
    windows = np.bincount(place, minlength=bins).astype(np.int64)
    return BinMeans(mean, half, p, windows, np.bincount(bin_of_pair, minlength=bins))


def split_at_quantiles(values: Floats, most: int) -> tuple[Ints, int]:
    """Return the bin of each value, of about equal numbers of rows, and the number of bins.

    A value of zero has a bin of its own where many rows have it, such as hours without rain.

    Examples
    --------
    >>> split_at_quantiles(np.array([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]), 3)
    (array([0, 0, 0, 1, 2, 2]), 3)
    """
    zero = values == 0.0
    apart = most > 1 and float(zero.mean()) > 1.0 / most and not zero.all()
    code = np.zeros(len(values), dtype=np.int64)
    rows = np.flatnonzero(~zero) if apart else np.arange(len(values))
    edges = np.unique(np.quantile(values[rows], np.linspace(0.0, 1.0, most + 1 - apart)))
    code[rows] = np.searchsorted(edges[1:-1], values[rows], side="right") * 2
    if apart:
        code[rows] += np.where(values[rows] > 0.0, 1, -1)  # the bin of zero lies between negative and positive values
        code[zero] = 2 * int(np.searchsorted(edges[1:-1], 0.0, side="right"))
    kept, place = np.unique(code, return_inverse=True)
    return place.astype(np.int64), len(kept)
