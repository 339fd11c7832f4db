"""Weigh causes and dates: a probability for each, and the smallest sets that hold 90 % of it."""

from typing import Final

import numpy as np
from scipy.special import logsumexp

from socast.core.batch import Floats, Ints
from socast.core.diagnose.siblings.scan import Scan

CREDIBLE: Final = 0.9
"""Probability that a credible set holds."""
TAIL: Final = (6.5, 7.8)
"""Parameters ν and ν0 of the tempering of evidence, see `weigh_causes`; fitted on 31 simulated data sets."""


def weigh_causes(scan: Scan, sign: Ints) -> Floats:
    """Return the probability of each candidate, given that one of them is the cause, (k,).

    Notes
    -----
    The evidence ℓ of a candidate is averaged over the places of a change. The shapes of the library are not exactly
    those of nature, so that differences of evidence are tempered: log odds to the best candidate are
    -(ν/2) log(1 + 2 (L - ℓ)/ν0), with L the evidence of the best one.
    """
    evidence = average_places(scan, scan.compute_evidence(sign))
    behind = evidence.max() - evidence
    odds = -0.5 * TAIL[0] * np.log1p(2.0 * behind / TAIL[1])
    odds = np.where(np.isfinite(evidence), odds, -np.inf)
    return np.asarray(np.exp(odds - logsumexp(odds)))


def weigh_dates(scan: Scan, evidence: Floats, causes: Floats) -> Floats:
    """Return the probability that a change begins at each place, (m,)."""
    known = np.isfinite(evidence).any(axis=0) & (causes > 0.0)
    of_cause = evidence[:, known] + _get_place_prior(scan)[:, np.newaxis]
    of_cause = of_cause - logsumexp(of_cause, axis=0, keepdims=True)
    return np.asarray(np.exp(of_cause) @ causes[known] / max(float(causes[known].sum()), 1e-300))


def average_places(scan: Scan, evidence: Floats) -> Floats:
    """Return the evidence of each candidate with an unknown date: the mean over the dates, (k,)."""
    with np.errstate(divide="ignore"):
        return np.asarray(logsumexp(evidence + _get_place_prior(scan)[:, np.newaxis], axis=0))


def select_credible_set(probability: Floats, level: float = CREDIBLE) -> Ints:
    """Return the places of the fewest elements that hold a probability, the most probable first.

    Examples
    --------
    >>> select_credible_set(np.array([0.2, 0.75, 0.05]))
    array([1, 0])
    """
    order = np.argsort(-probability, kind="stable")
    count = int(np.searchsorted(np.cumsum(probability[order]), level - 1e-12)) + 1
    return np.asarray(order[:count], dtype=np.int64)


def select_credible_range(probability: Floats, level: float = CREDIBLE) -> tuple[int, int]:
    """Return the first and the last place of the shortest range that holds a probability.

    Examples
    --------
    >>> select_credible_range(np.array([0.05, 0.0, 0.5, 0.42, 0.03]))
    (2, 3)
    """
    total = np.r_[0.0, np.cumsum(probability)]
    ends = np.searchsorted(total, total[:-1] + level * total[-1] - 1e-12)
    ends = np.where(ends < len(total), ends, 2 * len(total))
    first = int(np.argmin(ends - np.arange(len(ends))))
    return first, min(int(ends[first]) - 1, len(probability) - 1)


def _get_place_prior(scan: Scan) -> Floats:
    """Return the logarithm of the probability of each place beforehand: equal per shift."""
    return np.full(len(scan.begin), -np.log(max(len(scan.begin), 1)))
