"""Show where a model fails: its error against the noise, and the mean residual of windows along a column."""

from collections.abc import Sequence
from math import floor, log10
from typing import Final

import plotly.graph_objects as go
from rich.text import Text

from socast.core.evaluate.compare.records import ChartBins, Comparison, ResidualChart, ResidualSurvey
from socast.core.formatting import format_count, format_minus
from socast.tools.report.comparison.figures import get_model_style
from socast.tools.report.document import Illustration
from socast.tools.report.figure_style import REFERENCE_LINE, escape_label, make_figure

WIDTHS: Final = (16, 60)
"""Smallest and largest number of characters of the intervals in a terminal."""
LONGEST: Final = 22
"""Largest number of characters of the name of a bin in a terminal."""
MOST_CHARTS: Final = 6
"""Largest number of charts of a page."""
MOST_CHANGES: Final = 2
"""Largest number of charts of a page that shows a step."""
MOST_NAMED: Final = 3
"""Largest number of columns that are named."""
POINT, SPAN, ZERO, CROSSED = "●", "─", "│", "┼"
"""Characters of a mean, of its interval, of the line of zero, and of both."""
LEGEND: Final = (
    f"{POINT} mean, {SPAN * 2} its 95 % interval by vehicle-day. * off zero, with the bins of all columns tested "
    "together: 1 in 20 marks is expected to be a false finding."
)


def describe_failures(result: Comparison) -> str:
    """Return how large the error of the first model is against the noise, and where it is largest."""
    model, errors = next(iter(result.models.items()))
    words = f"{model} is off by {errors.mae_kwh.value or 0.0:.3f} kWh per ride on average"
    noise = result.about.noise_floor_kwh
    if noise and errors.over_floor is not None:
        words += f", {errors.over_floor:.1f} times what measurement noise alone causes ({noise:.3f} kWh)"
    if result.failures.why_not:
        return f"{words}. Where it fails cannot be said: {result.failures.why_not}."
    if not (failing := result.failures.failing):
        return f"{words}. Along no column does the residual of its windows vary beyond chance."
    first, *others = failing
    words += f". It fails most along {_name(first)}: {describe_worst_bin(first)}; "
    words += f"{first.outside} of {first.of} bins are off zero"
    if others:
        words += f". Then along {', '.join(_name(each) for each in others[: MOST_NAMED - 1])}"
    return f"{words}."


def describe_worst_bin(chart: ResidualChart) -> str:
    """Return the mean residual of the bin that differs most from zero, in words."""
    bins = chart.bins
    worst = max(filter(bins.is_off_zero, bins.known), key=lambda i: abs(bins.mean[i]))
    mean, half = bins.mean[worst], bins.known[worst]
    more = "more" if mean > 0.0 else "less"
    return f"{abs(mean):,.0f} ± {half:,.0f} W {more} predicted than measured at {name_bin(chart, worst)}"


def name_bin(chart: ResidualChart, place: int) -> str:
    """Return the range with its unit, or the name of a bin."""
    bins, column = chart.bins, chart.column
    if not column.number:
        return str(bins.x[place])
    return f"{_name_ranges(bins)[place]} {column.unit}"


def _name_ranges(bins: ChartBins) -> list[str]:
    """Return the ranges of the bins of numbers, with the digits that the narrowest of them needs."""
    widths = [high - low for low, high in zip(bins.low, bins.high, strict=True) if high > low]
    digits = min(max(1 - floor(log10(min(widths))), 0), 2) if widths else 0
    ends = [[format_minus(f"{value:,.{digits}f}") for value in end] for end in (bins.low, bins.high)]
    return [low if low == high else f"{low} to {high}" for low, high in zip(*ends, strict=True)]


def draw_chart(chart: ResidualChart, columns: int) -> list[Text]:
    """Return the mean residual in the bins along a column, with its interval, as lines of text."""
    bins, column, known = chart.bins, chart.column, chart.bins.known
    names = _name_ranges(bins) if column.number else [_shorten(str(name)) for name in bins.x]
    numbers = {i: format_minus(f"{bins.mean[i]:+,.0f} ± {half:,.0f}") for i, half in known.items()}
    room, wide = max(len(names[i]) for i in known), max(map(len, numbers.values()))
    width = min(max(columns - room - wide - 8, WIDTHS[0]), WIDTHS[1])
    reach = max(abs(bins.mean[i]) + half for i, half in known.items())
    lines = [Text(f"{column.title}: predicted less measured power, mean of windows [W]", style="bold")]
    for i, half in known.items():
        sure = bins.is_off_zero(i)
        line = Text(f"  {names[i]:>{room}}  ")
        line.append(_draw_interval(bins.mean[i] / reach, half / reach, width), "bold" if sure else "")
        line.append(f"  {numbers[i]:>{wide}}{' *' if sure else ''}")
        lines.append(line)
    ends = [format_minus(f"{-reach:,.0f}"), "0", f"{reach:,.0f} W"]
    middle = _place(0.0, width)
    scale = f"{ends[0]:<{middle}}{ends[1]}{ends[2]:>{width - middle - 1}}"
    return [*lines, Text(f"  {'':>{room}}  {scale}", style="dim"), Text(LEGEND, style="dim")]


def _draw_interval(mean: float, half: float, width: int) -> str:
    """Return a mean and its interval on a scale from -1 to 1, with the line of zero.

    Examples
    --------
    >>> _draw_interval(0.6, 0.2, 21), _draw_interval(0.0, 0.2, 9)
    ('          │   ──●──  ', '   ─●─   ')
    >>> _draw_interval(-0.2, 0.4, 21)
    '    ────●─┼──        '
    """
    marks = [" "] * width
    for at in range(_place(max(mean - half, -1.0), width), _place(min(mean + half, 1.0), width) + 1):
        marks[at] = SPAN
    zero = _place(0.0, width)
    marks[zero] = CROSSED if marks[zero] == SPAN else ZERO
    marks[_place(mean, width)] = POINT
    return "".join(marks)


def _place(share: float, width: int) -> int:
    """Return the character at which a value of a scale from -1 to 1 stands."""
    return round((share + 1.0) / 2.0 * (width - 1))


def _shorten(name: str) -> str:
    """Return a name that fits beside a picture."""
    return name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…"


def illustrate_failures(result: Comparison) -> list[Illustration]:
    """Return a figure for each of the columns along which the model fails most."""
    caption = (
        "Mean of predicted less measured power of windows in bins along the column, with 95 % intervals clustered by "
        "vehicle-day. Filled: off zero; 1 in 20 of the filled points is expected to be a false finding."
    )
    return [
        Illustration(f"failure-{i}", _name(chart), caption, _draw(chart), small=True)
        for i, chart in enumerate(result.failures.failing[:MOST_CHARTS])
    ]


def illustrate_change(before: ResidualSurvey, after: ResidualSurvey) -> list[Illustration]:
    """Return where a model fails before and after a step, along the columns along which it fails most."""
    caption = (
        "Mean of predicted less measured power of all windows in bins along the column, with 95 % intervals clustered "
        "by vehicle-day. Squares: before. Circles: after. Filled: off zero. The model after was fitted to these rides."
    )
    then, now = ({chart.column.key: chart for chart in side.charts} for side in (before, after))
    failing = dict.fromkeys(chart.column.key for side in (before, after) for chart in side.failing)
    return [
        Illustration(f"change-{i}", _name(then[key]), caption, _draw(now[key], then[key]), small=True)
        for i, key in enumerate([key for key in failing if key in then and key in now][:MOST_CHANGES])
    ]


def _draw(chart: ResidualChart, before: ResidualChart | None = None) -> go.Figure:
    """Return the figure of a chart, or of two."""
    traces = [_draw_means(before, "before", str(REFERENCE_LINE["color"]), "square")] if before else []
    return make_figure(
        [*traces, _draw_means(chart, "after" if before else "", get_model_style(0).colour, "circle")],
        height=300,
        x={"title": chart.column.title},
        y={"title": "predicted less measured [W]", "zeroline": True},
    )


def _draw_means(chart: ResidualChart, name: str, colour: str, symbol: str) -> go.Scatter:
    """Return the means of a chart with their intervals; those off zero are filled."""
    bins, known = chart.bins, chart.bins.known
    x = [bins.x[i] if chart.column.number else escape_label(str(bins.x[i])) for i in known]
    return go.Scatter(
        name=name,
        x=x,
        y=[bins.mean[i] for i in known],
        error_y={"array": list(known.values()), "thickness": 1.2, "width": 3},
        mode="markers",
        marker={
            "size": 9,
            "color": colour,
            "symbol": [symbol if bins.is_off_zero(i) else f"{symbol}-open" for i in known],
        },
        customdata=[f"{format_count(bins.rows[i], 'window')}, {escape_label(name_bin(chart, i))}" for i in known],
        hovertemplate="%{customdata}: %{y:,.0f} W<extra></extra>",
        showlegend=bool(name),
    )


def _name(chart: ResidualChart) -> str:
    """Return the name of a column."""
    return chart.column.label.lower()


def list_pictures(result: Comparison, columns: int) -> Sequence[Text]:
    """Return the picture of the column along which the model fails most, none where it fails along none."""
    failing = result.failures.failing
    return draw_chart(failing[0], columns) if failing else []
