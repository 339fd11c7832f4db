"""Compare stated probabilities with how often they are right, in a table and in a figure."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from socast.core.stats.clustered import compute_wilson_interval

BINS: Final = 10
Stated = Sequence[tuple[float, bool]]
"""Stated probabilities, and whether each name was right."""

FILE: Final = "docs/hidden-reliability.svg"
"""Place of the figure in the repository."""
WIDTH, HEIGHT = 560, 440
LEFT, RIGHT, TOP, BOTTOM = 80, 440, 50, 380
"""Edges of the plot. [px]"""
INK, QUIET, GRID, POINT = "#1f2933", "#5f6b76", "#c9d1d9", "#1f6fb2"
TICKS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)


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


def draw_reliability(stated: Stated) -> str:
    """Return the figure of stated probabilities and of how often they are right, with 95 % intervals."""
    lines = [
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}' "
            "role='img' font-family='Helvetica, Arial, sans-serif' font-size='14'>"
        ),
        "<title>Share of right names against the stated probability</title>",
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#ffffff'/>",
        f"<text x='{LEFT - 60}' y='28' fill='{INK}' font-weight='bold'>Share of names that are right [%]</text>",
    ]
    for tick in TICKS:
        x, y = _across(tick), _down(tick)
        lines += [
            f"<line x1='{LEFT}' x2='{RIGHT}' y1='{y:.1f}' y2='{y:.1f}' stroke='{GRID}'/>",
            f"<text x='{LEFT - 10}' y='{y + 5:.1f}' fill='{QUIET}' text-anchor='end'>{100 * tick:.0f}</text>",
            f"<text x='{x:.1f}' y='{BOTTOM + 22}' fill='{QUIET}' text-anchor='middle'>{100 * tick:.0f}</text>",
        ]
    middle = (LEFT + RIGHT) / 2
    lines += [
        f"<text x='{middle}' y='{BOTTOM + 46}' fill='{QUIET}' text-anchor='middle'>stated probability [%]</text>",
        f"<line x1='{LEFT}' y1='{BOTTOM}' x2='{RIGHT}' y2='{TOP}' stroke='{QUIET}' stroke-dasharray='7 5'/>",
        f"<text x='{RIGHT + 10}' y='{TOP + 5}' fill='{QUIET}'>as stated</text>",
    ]
    for each in bin_probabilities(stated):
        lines += _draw_bin(each)
    return "\n".join([*lines, "</svg>"]) + "\n"


def _draw_bin(each: Bin) -> list[str]:
    """Return the point of a bin, its interval, and its number of names."""
    x, (low, high) = _across(each.stated), each.interval
    return [
        (
            f"<line x1='{x:.1f}' x2='{x:.1f}' y1='{_down(low):.1f}' y2='{_down(high):.1f}' stroke='{POINT}' "
            "stroke-width='2'/>"
        ),
        f"<circle cx='{x:.1f}' cy='{_down(each.right):.1f}' r='5' fill='{POINT}'/>",
        f"<text x='{x + 8:.1f}' y='{_down(each.right) + 5:.1f}' fill='{POINT}'>{each.of}</text>",
    ]


def _across(probability: float) -> float:
    """Return the horizontal place of a probability. [px]"""
    return LEFT + (RIGHT - LEFT) * probability


def _down(share: float) -> float:
    """Return the vertical place of a share. [px]"""
    return BOTTOM - (BOTTOM - TOP) * share
