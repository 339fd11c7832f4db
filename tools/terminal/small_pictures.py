"""Pictures of a few characters for tables in a terminal: a charge with its forecast, and the course of a value."""

from collections.abc import Sequence
from itertools import pairwise
from math import floor, isfinite
from typing import Final

from rich.text import Text

LEVELS: Final = "▁▂▃▄▅▆▇█"
"""Characters of the course of a value, from low to high."""
SCALE, SPAN, MIDDLE, NOW = "·", "━", "┃", "●"
"""Characters of a charge: the scale, the interval of the forecast, its mean, and the present charge."""


def draw_charge(now_pct: float, end_pct: tuple[float, float, float] | None, width: int, style: str = "cyan") -> Text:
    """Return a charge and its forecast on a scale from 0 to 100 %.

    Parameters
    ----------
    now_pct : float
        Present state of charge, NaN where unknown. [%]
    end_pct : tuple of (float, float, float), optional
        Mean, 5th and 95th percentile of the charge at the end of the shift. [%]

    Examples
    --------
    >>> draw_charge(80.0, (45.0, 30.0, 60.0), 10).plain
    '···━┃━━·●·'
    >>> draw_charge(float("nan"), None, 10).plain
    '··········'
    """

    def place(pct: float) -> int:
        return min(max(floor(pct / 100.0 * width), 0), width - 1)

    marks = [(SCALE, "dim")] * width
    if end_pct is not None:
        mean, low, high = map(place, end_pct)
        marks[low : high + 1] = [(SPAN, style)] * (high + 1 - low)
        marks[mean] = MIDDLE, f"bold {style}"
    if isfinite(now_pct):
        marks[place(now_pct)] = NOW, "bold"
    return Text.assemble(*marks)


def draw_course(values: Sequence[float], width: int) -> str:
    """Return the course of values from 0 to the largest, the newest last.

    Examples
    --------
    >>> draw_course([4.0, 3.0, 2.0, 1.0], 4)
    '█▆▄▂'
    >>> draw_course([], 4)
    ''
    """
    if not values:
        return ""
    count = min(width, len(values))
    edges = [len(values) * place // count for place in range(count + 1)]
    means = [sum(values[a:b]) / (b - a) for a, b in pairwise(edges)]
    most = max(*means, 1e-12)
    return "".join(LEVELS[min(max(round(value / most * len(LEVELS)) - 1, 0), len(LEVELS) - 1)] for value in means)
