"""Compare stated probabilities with how often they are right."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from socast.core.stats.clustered import compute_wilson_interval

BINS: Final = 10
Stated = Sequence[tuple[float, bool]]
"""Stated probabilities, and whether each name was right."""


class Bin(NamedTuple):
    """Hold the names within a range of stated probabilities.

    Parameters
    ----------
    low, high : float
        The range. [1]
    stated, right : float
        Mean stated probability and share of right names. [1]
    weight : float
        Weight of the names among all. [1]
    effective : float
        Number of equally weighted names that would be as certain.
    """

    low: float
    high: float
    stated: float
    right: float
    weight: float
    effective: float
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share of right names. [1]"""
        return compute_wilson_interval(self.right, self.effective)


def bin_probabilities(stated: Stated, weights: Sequence[float] | None = None, bins: int = BINS) -> list[Bin]:
    """Return the bins of equal width that hold names.

    Examples
    --------
    >>> [(each.low, each.of) for each in bin_probabilities([(0.95, True), (1.0, False), (0.12, False)])]
    [(0.1, 1), (0.9, 2)]
    """
    values = np.array(stated, dtype=np.float64).reshape(-1, 2)
    share = np.ones(len(values)) if weights is None else np.array(weights, dtype=np.float64)
    place = np.minimum((values[:, 0] * bins).astype(np.int64), bins - 1)
    out = []
    for number in np.unique(place).tolist():
        inside = values[place == number]
        weight = share[place == number]
        total = float(weight.sum())
        probability, right = (float(value) for value in weight @ inside / total)
        effective = total**2 / float(weight @ weight)
        low, high = number / bins, (number + 1) / bins
        out.append(Bin(low, high, probability, right, total / float(share.sum()), effective, len(inside)))
    return out


def compute_calibration_error(stated: Stated, weights: Sequence[float] | None = None, bins: int = BINS) -> float:
    """Return the expected calibration error: the mean distance of a bin from being right as often as stated.

    Returns
    -------
    float
        Each bin counts by the weight of its names; NaN without any. [1]

    References
    ----------
    Naeini, Cooper and Hauskrecht, AAAI 2015, 2901, "Obtaining Well Calibrated Probabilities Using Bayesian Binning".
    """
    if not stated:
        return float("nan")
    return sum(each.weight * abs(each.right - each.stated) for each in bin_probabilities(stated, weights, bins))


def draw_calibration_error(stated: Stated, draws: int = 2000, seed: int = 0) -> tuple[float, float]:
    """Return the range that holds 95 % of the calibration errors if each name is right as often as stated.

    Few names in a bin differ from their mean probability by chance, so the error of right probabilities is not zero.

    References
    ----------
    Bröcker and Smith, Weather and Forecasting 22 (2007) 651, DOI 10.1175/WAF993.1, consistency resampling.
    """
    if not stated:
        return float("nan"), float("nan")
    rng = np.random.default_rng(seed)
    values = [probability for probability, _ in stated]
    right = rng.uniform(size=(draws, len(values))) < np.array(values)
    errors = [compute_calibration_error(list(zip(values, row, strict=True))) for row in right.tolist()]
    low, high = np.quantile(errors, [0.025, 0.975]).tolist()
    return low, high


def tabulate_reliability(stated: Stated, weights: Sequence[float] | None = None) -> list[str]:
    """Return a table of stated probabilities and of how often they are right."""
    lines = ["| stated probability | mean stated | right | 95 % interval | names |", "|" + "---|" * 5]
    for each in bin_probabilities(stated, weights):
        low, high = each.interval
        lines.append(
            f"| {100 * each.low:.0f} to {100 * each.high:.0f} % | {100 * each.stated:.0f} % | {100 * each.right:.0f} % "
            f"| {100 * low:.0f} to {100 * high:.0f} % | {each.of:,} |"
        )
    return lines
