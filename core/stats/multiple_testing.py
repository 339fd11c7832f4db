"""The difference score: which models differ on the same test rides, and which dominate.

Two models that are tested on the same rides are compared by the difference of their absolute errors, ride by ride, not
by whether their intervals overlap: what is hard about a ride is hard for both and cancels. The mean difference of each
repeat is one figure; the interval over repeats allows for their overlap (`core.stats.scores`). All pairs of models
are tested, so that the probability of any false finding among them is kept at 5 % by Holm's method. That also covers
that the best one was chosen on the same rides.

References
----------
Holm, Scandinavian Journal of Statistics 6 (1979) 65, "A Simple Sequentially Rejective Multiple Test Procedure", JSTOR
4615733.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from core.batch import Floats
from core.stats.scores import Estimate

SIGNIFICANCE: Final = 0.05
"""Probability, over all pairs, of a difference found where there is none."""

Pair = tuple[str, str]


def list_pairs(names: Sequence[str]) -> list[Pair]:
    """Return every pair of models once, in order."""
    return list(combinations(names, 2))


def adjust_holm(p: Floats) -> Floats:
    """Return probabilities adjusted for there being several.

    Parameters
    ----------
    p : (n,) float
        NaN where there was nothing to test.

    Examples
    --------
    >>> holm(np.array([0.04, 0.01, 0.03])).tolist()
    [0.06, 0.03, 0.06]
    """
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested], kind="stable")]
    adjusted = np.full(len(p), np.nan)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)), 1.0)
    return adjusted


def adjust_differences(differences: Mapping[Pair, Estimate]) -> dict[Pair, float]:
    """Return the probability of each difference, adjusted over all of them."""
    found = adjust_holm(np.array([difference.p for difference in differences.values()]))
    return dict(zip(differences, found.tolist(), strict=True))


def select_dominating(errors: Mapping[str, float], differences: Mapping[Pair, Estimate]) -> list[str]:
    """Return the models that none is significantly better than the best of which: it dominates, or they co-dominate.

    Parameters
    ----------
    errors : mapping of str to float
        Mean absolute error of each model. [kWh]
    differences : mapping
        Of each pair (a, b): error of a less error of b.

    Returns
    -------
    list of str
        The one of least error, and all that are not significantly worse than it; best first.
    """
    known = sorted((error, name) for name, error in errors.items() if not np.isnan(error))
    if not known:
        return []
    best = known[0][1]
    p = adjust_differences(differences)
    worse = {
        a if b == best else b for (a, b), chance in p.items() if best in {a, b} and chance < SIGNIFICANCE
    }  # NaN is not below
    return [name for _, name in known if name not in worse]
