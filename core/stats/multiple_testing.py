"""Corrections for testing several hypotheses at once, and the comparison of models on the same test rides.

Two models that are tested on the same rides are compared by the difference of their absolute errors, ride by ride, not
by the overlap of their intervals: what makes a ride hard is hard for both models and cancels. Each repeat gives one
mean difference, and the interval over repeats allows for their overlap (`socast.core.stats.scores`). All pairs of
models are tested, so Holm's method keeps the probability of any false difference among them at 5 %. This also covers
the choice of the best model on the same rides.

Where many hypotheses are screened, Benjamini and Hochberg's method keeps the expected share of false ones among those
accepted.

References
----------
Holm, Scandinavian Journal of Statistics 6 (1979) 65, "A Simple Sequentially Rejective Multiple Test Procedure", JSTOR
4615733. Benjamini and Hochberg, Journal of the Royal Statistical Society B 57 (1995) 289, "Controlling the False
Discovery Rate".
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.stats.scores import Estimate

SIGNIFICANCE: Final = 0.05
"""Probability, over all pairs, of reporting a difference where there is none. [1]"""

CO_DOMINANCE_MARGIN: Final = 0.25
"""Share of the least error by which that of a co-dominating model may be larger, at the end of its interval. [1]"""

Pair = tuple[str, str]


def list_pairs(names: Sequence[str]) -> list[Pair]:
    """Return every pair of models once, in order."""
    return list(combinations(names, 2))


def adjust_false_discovery(p: Floats) -> Floats:
    """Return Benjamini and Hochberg's q-values.

    Parameters
    ----------
    p : (n,) float
        Probabilities under the null hypotheses; NaN where nothing was tested. [1]

    Returns
    -------
    (n,) float
        Accepting all q-values up to a level keeps the expected share of false ones among them at that level. NaN where
        nothing was tested. [1]

    Examples
    --------
    >>> adjust_false_discovery(np.array([0.01, 0.04, 0.03, 0.5])).round(4).tolist()
    [0.04, 0.0533, 0.0533, 0.5]
    >>> adjust_false_discovery(np.array([0.01, np.nan, 0.04])).tolist()
    [0.02, nan, 0.04]
    """
    order = np.argsort(p)[: np.count_nonzero(~np.isnan(p))]  # NaN is last
    scaled = p[order] * (len(order) / np.arange(1, len(order) + 1))
    q = np.full(len(p), np.nan)
    q[order] = np.minimum(np.minimum.accumulate(scaled[::-1])[::-1], 1.0)
    return q


def adjust_holm(p: Floats) -> Floats:
    """Return probabilities adjusted by Holm's method.

    Parameters
    ----------
    p : (n,) float
        Probabilities under the null hypotheses; NaN where nothing was tested. [1]

    Returns
    -------
    (n,) float
        Rejecting all below a level keeps the probability of any false rejection at that level. NaN where nothing was
        tested. [1]

    Examples
    --------
    >>> adjust_holm(np.array([0.04, 0.01, 0.03])).tolist()
    [0.06, 0.03, 0.06]
    """
    tested = np.flatnonzero(~np.isnan(p))
    order = tested[np.argsort(p[tested], kind="stable")]
    adjusted = np.full(len(p), np.nan)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)), 1.0)
    return adjusted


def adjust_differences(differences: Mapping[Pair, Estimate]) -> dict[Pair, float]:
    """Return the probability of each difference under the null hypothesis, adjusted over all of them."""
    adjusted = adjust_holm(np.array([difference.p for difference in differences.values()]))
    return dict(zip(differences, adjusted.tolist(), strict=True))


def select_dominating(errors: Mapping[str, float], differences: Mapping[Pair, Estimate]) -> list[str]:
    """Return the dominating model, or the co-dominating ones.

    A difference that is not significant proves nothing where its interval is wide. A model therefore co-dominates only
    if the interval also excludes that its error is larger by more than `CO_DOMINANCE_MARGIN`.

    Units: errors [kWh], differences [kWh].

    Returns
    -------
    list of str
        The model of least error, and all that are neither significantly worse than it nor possibly worse by more than
        the margin, best first. An unknown interval excludes nothing, so the difference itself has to lie within it.
    """
    known = sorted((error, name) for name, error in errors.items() if not np.isnan(error))
    if not known:
        return []
    least, best = known[0]
    p = adjust_differences(differences)
    worse = set()
    for (a, b), difference in differences.items():
        if best in {a, b}:
            low, high = difference.interval
            more = abs(difference.value) if np.isnan(high) else -low if a == best else high
            if p[a, b] < SIGNIFICANCE or more > CO_DOMINANCE_MARGIN * least:  # NaN is neither
                worse.add(b if a == best else a)
    return [name for _, name in known if name not in worse]
