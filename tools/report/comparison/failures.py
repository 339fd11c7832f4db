"""Show where a model fails: its error against the noise, and the mean residual of windows along a column."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import plotly.graph_objects as go
from rich.text import Text

from socast.core.diagnose.residual_survey import SIGNIFICANCE
from socast.core.formatting import format_count, format_minus
from socast.tools.report.comparison.tables import list_models
from socast.tools.report.evaluation.illustrations import Illustration
from socast.tools.report.evaluation.result import Result, get_mapping, get_number, get_part
from socast.tools.report.figure_style import make_figure

WIDTH: Final = 36
"""Number of characters of a picture in a terminal."""
MOST_CHARTS: Final = 6
"""Largest number of charts of a page."""
MOST_NAMED: Final = 3
"""Largest number of columns that are named."""
POINT, SPAN, ZERO = "●", "─", "│"
"""Characters of a mean, of its interval, and of the line of zero."""


def describe_failures(result: Result) -> str:
    """Return how large the error of the first model is against the noise, and where it is largest."""
    model = list_models(result)[0]
    error = get_number(get_part(result, "models", model, "mae_kwh")) or 0.0
    words = f"{model} is off by {error:.3f} kWh per ride on average"
    noise = get_number(get_part(result, "about", "noise_floor_kwh"))
    ratio = get_number(get_part(result, "models", model, "over_floor"))
    if noise and ratio is not None:
        words += f", {ratio:.1f} times what measurement noise alone causes ({noise:.3f} kWh)"
    failures = get_mapping(result, "failures")
    if why := failures.get("why_not"):
        return f"{words}. Where it fails cannot be said: {why}."
    failing = list_failing(failures)
    if not failing:
        return f"{words}. Along no column does the residual of its windows vary beyond chance."
    first, *others = failing
    words += f". It fails most along {_name(first)}: {describe_worst_bin(first)}; "
    words += f"{first['outside']} of {first['of']} intervals exclude zero"
    if others:
        words += f". Then along {', '.join(_name(each) for each in others[: MOST_NAMED - 1])}"
    return f"{words}."


def list_failing(failures: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the columns along which the residual varies beyond chance: numbers first, by spread."""
    failing = [chart for chart in failures.get("charts") or () if chart["q"] < SIGNIFICANCE and chart["outside"]]
    return sorted(failing, key=lambda chart: not chart["column"]["number"])


def describe_worst_bin(chart: Mapping[str, Any]) -> str:
    """Return the mean residual of the bin that differs most from zero, in words."""
    bins = chart["bins"]
    known = [i for i in range(len(bins["mean"])) if _is_outside(bins, i)]
    worst = max(known, key=lambda i: float(abs(bins["mean"][i])))
    mean, half = bins["mean"][worst], bins["ci95"][worst]
    more = "more" if mean > 0.0 else "less"
    return f"{abs(mean):,.0f} ± {half:,.0f} W {more} predicted than measured at {name_bin(chart, worst)}"


def name_bin(chart: Mapping[str, Any], place: int) -> str:
    """Return the range or the name of a bin."""
    bins, column = chart["bins"], chart["column"]
    if not column["number"]:
        return str(bins["x"][place])
    low, high = (_format(bins[end][place]) for end in ("low", "high"))
    return f"{low} to {high} {column['unit']}"


def draw_chart(chart: Mapping[str, Any], width: int = WIDTH) -> list[Text]:
    """Return the mean residual in the bins along a column, with its interval, as lines of text.

    Parameters
    ----------
    chart : mapping
        A chart of `socast.core.diagnose.residual_survey.survey_columns`.
    width : int
        Number of characters of the picture.
    """
    bins, column = chart["bins"], chart["column"]
    known = [i for i, half in enumerate(bins["ci95"]) if half is not None]
    reach: float = max(abs(bins["mean"][i]) + bins["ci95"][i] for i in known)
    names = [name_bin(chart, i).removesuffix(f" {column['unit']}") for i in known]
    room = max(map(len, [*names, column["label"]]))

    def place(power: float) -> int:
        return round((power / reach + 1.0) / 2.0 * (width - 1))

    unit = f", {column['unit']}" if column["unit"] else ""
    head = f"{column['label']}{unit}: mean of predicted less measured power of windows, W, and 95 % interval"
    lines = [Text(head, style="bold")]
    for i, name in zip(known, names, strict=True):
        mean, half, sure = bins["mean"][i], bins["ci95"][i], _is_outside(bins, i)
        marks = [" "] * width
        marks[place(0.0)] = ZERO
        for at in range(place(max(mean - half, -reach)), place(min(mean + half, reach)) + 1):
            marks[at] = SPAN
        marks[place(mean)] = POINT
        told = format_minus(f"{mean:+,.0f} ± {half:,.0f}")
        line = Text(f"  {name:>{room}}  ")
        line.append("".join(marks), "bold red" if sure else "")
        line.append(f"  {told:>14}{' *' if sure else ''}")
        lines.append(line)
    ends = f"{format_minus(f'{-reach:,.0f}')}{f'{reach:,.0f}':>{width - len(f'{-reach:,.0f}')}}"
    lines.append(Text(f"  {'':>{room}}  {ends}", style="dim"))
    return lines


def illustrate_failures(result: Result) -> list[Illustration]:
    """Return a figure for each of the columns along which the model fails most."""
    failures = get_mapping(result, "failures")
    caption = (
        "Mean of predicted less measured power of windows in bins along the column, with 95 % intervals clustered by "
        "vehicle-day. Filled: the interval excludes zero."
    )
    return [
        Illustration(f"failure-{i}", _name(chart), caption, _draw(chart), small=True)
        for i, chart in enumerate(list_failing(failures)[:MOST_CHARTS])
    ]


def _draw(chart: Mapping[str, Any]) -> go.Figure:
    """Return the figure of a chart."""
    bins, column = chart["bins"], chart["column"]
    known = [i for i, half in enumerate(bins["ci95"]) if half is not None]
    sure = [_is_outside(bins, i) for i in known]
    trace = go.Scatter(
        x=[bins["x"][i] for i in known],
        y=[bins["mean"][i] for i in known],
        error_y={"array": [bins["ci95"][i] for i in known], "thickness": 1.2, "width": 3},
        mode="markers",
        marker={"size": 9, "symbol": ["circle" if each else "circle-open" for each in sure]},
        customdata=[f"{format_count(bins['rows'][i], 'window')}, {name_bin(chart, i)}" for i in known],
        hovertemplate="%{customdata}: %{y:,.0f} W<extra></extra>",
        showlegend=False,
    )
    made = make_figure([trace], height=300)
    unit = f" [{column['unit']}]" if column["unit"] else ""
    made.update_xaxes(title=f"{column['label']}{unit}")
    made.update_yaxes(title="predicted less measured [W]", zeroline=True)
    return made


def _is_outside(bins: Mapping[str, Any], place: int) -> bool:
    """Return whether the interval of a bin excludes zero."""
    half = bins["ci95"][place]
    return half is not None and bool(abs(bins["mean"][place]) > half)


def _name(chart: Mapping[str, Any]) -> str:
    """Return the name of a column."""
    return str(chart["column"]["label"]).lower()


def _format(value: float) -> str:
    """Return a bound of a bin with sensible digits."""
    return format_minus(f"{value:.0f}" if abs(value) >= 20.0 else f"{value:.1f}")


def list_pictures(result: Result) -> Sequence[Text]:
    """Return the picture of the column along which the model fails most, none where it fails along none."""
    failing = list_failing(get_mapping(result, "failures"))
    return draw_chart(failing[0]) if failing else []
