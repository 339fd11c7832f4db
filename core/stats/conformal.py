"""Quantiles of earlier errors between which the next error lies as often as their levels say.

Of n errors that came in any order, the next one is below the k-th smallest with a probability of k / (n + 1). The
quantile of a level is therefore the error of rank (n + 1) level, farther out than the plain quantile.

References
----------
Vovk, Gammerman, Shafer, Algorithmic Learning in a Random World, Springer 2005, chapter 2.
"""

from collections.abc import Sequence

import numpy as np

from socast.core.batch import Floats


def find_conformal_ranks(count: int, levels: Sequence[float]) -> Floats:
    """Return the rank of each level among `count` ascending errors, from 0; outside of them where these are too few."""
    return (count + 1) * np.array(levels) - 1.0


def compute_conformal_quantiles(errors: Floats, levels: Sequence[float]) -> Floats:
    """Return quantiles of errors, at least as far out as their levels say.

    Examples
    --------
    >>> compute_conformal_quantiles(np.arange(1.0, 10.0), (0.05, 0.5, 0.78)).tolist()
    [1.0, 5.0, 8.0]
    """
    ranks = find_conformal_ranks(len(errors), levels)
    ranks = np.where(np.array(levels) > 0.5, np.ceil(ranks), np.floor(ranks))
    return np.asarray(np.sort(errors)[np.clip(ranks, 0, len(errors) - 1).astype(np.int64)])


def compute_counted_quantiles(counts: Floats, errors: Floats, levels: Sequence[float]) -> Floats:
    """Return quantiles of errors that were counted, with any weight, at each of ascending errors.

    Examples
    --------
    >>> compute_counted_quantiles(np.full(101, 1.0), np.arange(101.0), (0.05, 0.5)).round(1).tolist()
    [4.1, 50.0]
    """
    number = float(counts.sum())
    at = (np.cumsum(counts) - 0.5 * counts) / number
    wider = np.clip(0.5 + (np.array(levels) - 0.5) * (1.0 + 1.0 / number), 0.0, 1.0)  # the middle of each rank
    return np.asarray(np.interp(wider, at, errors))
