"""Draw how often names are right against the probability that diagnosis states, as SVG."""

from typing import Final

from socast.tools.bench.hidden.reliability import Bin, Stated, bin_probabilities

FILE: Final = "docs/hidden-reliability.svg"
"""Place of the figure in the repository."""
WIDTH, HEIGHT = 560, 440
LEFT, RIGHT, TOP, BOTTOM = 80, 440, 50, 380
"""Edges of the plot. [px]"""
INK, QUIET, GRID, POINT = "#1f2933", "#5f6b76", "#c9d1d9", "#1f6fb2"
TICKS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)


def draw_reliability(stated: Stated) -> str:
    """Return the figure of stated probabilities and of how often they are right, with 95 % intervals."""
    lines = [
        (
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}' "
            "role='img' font-family='Helvetica, Arial, sans-serif' font-size='14'>"
        ),
        "<title>Share of right names against the stated probability</title>",
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='#ffffff'/>",
        f"<text x='{LEFT - 60}' y='28' fill='{INK}' font-weight='bold'>Share of first names that are right [%]</text>",
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
