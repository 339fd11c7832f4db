"""Define how figures look: each model has a colour, dash and symbol, each vehicle model a pattern, in every figure.

No information is in colour alone, so figures can be read in black and white. Colours are of medium lightness, for light
and dark backgrounds; text and grid take the colours of the page.
"""

from collections.abc import Mapping, Sequence
from html import escape
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import plotly.graph_objects as go
import plotly.io
from plotly.subplots import make_subplots

from socast.core.batch import Floats
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.formatting import format_count
from socast.tools.report.evaluation.result import WAYS, get_recipes, get_title, list_vehicle_models

plotly.io.templates.default = None  # `LAYOUT` stands for it

COLOURS: Final = (
    "#8a8a8a",
    "#56a3d9",
    "#0b76c4",
    "#c98b1b",
    "#d1571f",
    "#1f9e77",
    "#c4679b",
    "#8064c8",
    "#a5722c",
    "#2aa3a3",
    "#d04a5f",
    "#7f8f1f",
)
DASHES: Final = ("dot", "dashdot", "dash", "longdash", "longdashdot", "solid")
SYMBOLS: Final = (
    "circle",
    "square",
    "diamond",
    "triangle-up",
    "triangle-down",
    "pentagon",
    "star",
    "cross",
    "x",
    "hexagram",
    "hourglass",
    "bowtie",
    "triangle-left",
)
"""Symbols. Their number and that of the dashes have no common divisor, so that pairs of both repeat late."""
PATTERNS: Final = ("", "/", "x", ".", "-", "|", "\\", "+")

DIVERGING: Final = [[0.0, "rgba(11,118,196,0.75)"], [0.5, "rgba(128,128,128,0.06)"], [1.0, "rgba(209,87,31,0.75)"]]
"""Colour scale from better to worse."""

LAYOUT: Final[dict[str, object]] = {
    "margin": {"l": 60, "r": 15, "t": 30, "b": 60},
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "legend": {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom", "x": 0, "xref": "container"},
    "hoverlabel": {"namelength": -1},
    "barmode": "group",
}
"""Layout that all figures have in common, but for the height."""
AXIS: Final[dict[str, object]] = {"automargin": True, "zeroline": False, "ticks": "outside"}
"""Properties of every axis."""
REFERENCE_LINE: Final = {"dash": "dash", "width": 1.5, "color": "#8a8a8a"}

DATES: Final = {"title_text": "date [UTC]", "tickformat": "%-d %b %y", "nticks": 5}
"""Properties of an axis of dates, which are written as in the workbench."""
FAR: Final = 6.0
"""Distance from the levels, in medians of it, beyond which a day is outside its figure."""
MARGIN: Final = 0.03
"""Room beyond the outermost days, of their range, so that no marker is cut."""

PAPER_NAME: Final = "the paper's (other data)"
"""Name of the paper's figures in legends."""


class Style(NamedTuple):
    """Hold colour, dash, symbol and pattern of a model or vehicle model."""

    colour: str
    dash: str
    symbol: str
    pattern: str


def get_style(place: int) -> Style:
    """Return the style of the model or vehicle model at a position in its order."""
    return Style(*(kinds[place % len(kinds)] for kinds in (COLOURS, DASHES, SYMBOLS, PATTERNS)))


def get_recipe_style(result: RecipeEvaluation, recipe: str) -> Style:
    """Return the style of a model, the same in every figure."""
    names = [*get_recipes(result), *WAYS]
    return get_style(names.index(recipe) if recipe in names else len(names))


def get_vehicle_style(result: RecipeEvaluation, vehicle_model: str) -> Style:
    """Return the style of a vehicle model, the same in every figure."""
    keys = list_vehicle_models(result)
    return get_style(2 + (keys.index(vehicle_model) if vehicle_model in keys else len(keys)))


def escape_label(text: str) -> str:
    """Return text that plotly shows literally; plotly interprets some tags."""
    return escape(text, quote=False)


def to_percent(share: float | None) -> float | None:
    """Return a share in percent, None where it is unknown."""
    return None if share is None else 100.0 * share


def format_recipe_label(result: RecipeEvaluation, recipe: str, width: int = 30) -> str:
    """Return the title of a model, in lines of about `width` characters."""
    lines = [""]
    for word in get_title(result, recipe).split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append(word)
        else:
            lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(escape_label(line) for line in lines)


def make_figure(
    traces: list[Any],
    height: int = 420,
    x: Mapping[str, Any] = MappingProxyType({}),
    y: Mapping[str, Any] = MappingProxyType({}),
    **layout: Any,
) -> go.Figure:
    """Return a figure of traces in the common layout, with properties of its axes and of the layout.

    Parameters
    ----------
    height : int
        Height of the plot and its axes; the page adds that of the legend. [px]
    """
    made = apply_layout(go.Figure(traces), height)
    made.update_xaxes(**x)
    made.update_yaxes(**y)
    return made.update_layout(**layout)


def make_stacked_figure(titles: tuple[str, ...], height: int) -> go.Figure:
    """Return an empty figure of plots one above the other that share their x axis."""
    made = make_subplots(rows=len(titles), cols=1, subplot_titles=titles, vertical_spacing=0.16)
    return apply_layout(made, height)


def apply_layout(made: go.Figure, height: int) -> go.Figure:
    """Apply the common layout to a figure and return it.

    Notes
    -----
    Each value is set by itself: `update_layout` and `update_xaxes` of plotly take twice as long for the whole figure.
    """
    made.layout.height = height
    for name, value in LAYOUT.items():
        made.layout[name] = value
    for axis in (*made.select_xaxes(), *made.select_yaxes()):
        for name, value in AXIS.items():
            axis[name] = value
    for axis in made.select_yaxes():
        axis.title.standoff = 12
    return made


def find_robust_range(values: Floats, levels: Floats) -> tuple[float, float]:
    """Return the range of a figure that holds all levels, and all values but those far off."""
    reach = FAR * float(np.median(np.abs(values - np.median(values)))) + 1.0
    low, high = float(levels.min()) - reach, float(levels.max()) + reach
    shown = np.concatenate([values[(values >= low) & (values <= high)], levels])
    room = MARGIN * float(np.ptp(shown)) + 1.0
    return max(low, float(shown.min()) - room), min(high, float(shown.max()) + room)


def tell_outside(number: int) -> str:
    """Return how many days are outside a figure as the end of its caption, nothing where none is."""
    return f" Outside the figure: {format_count(number, 'day')}." if number else ""


def find_limit(values: Sequence[float], ends: Sequence[float], widest: float) -> float:
    """Return the end of a common scale that shows each value, and the ends of intervals unless far beyond."""
    most = max(map(abs, values), default=0.0) or 1.0
    return 1.05 * max([most, *(end for end in ends if end <= widest * most)])


def make_error_bars(
    up: Sequence[float | None] | None,
    down: Sequence[float | None] | None = None,
    *,
    thickness: float = 1,
    width: int = 3,
) -> dict[str, Any] | None:
    """Return error bars of half widths, or of the parts above and below; None where none is known."""
    if not up or not any(up):
        return None
    sides = {"array": list(up)} | ({} if down is None else {"arrayminus": list(down), "symmetric": False})
    return {"type": "data", **sides, "thickness": thickness, "width": width}


def draw_curve(
    name: str, look: Style, x: list[Any], y: list[Any], ci95: list[float | None] | None = None, **more: Any
) -> Any:
    """Return a line with markers, with error bars where half widths of intervals are given."""
    return go.Scatter(
        name=name,
        x=x,
        y=y,
        mode="lines+markers",
        line={"color": look.colour, "dash": look.dash, "width": 2},
        marker={"symbol": look.symbol, "size": 8, "color": look.colour},
        error_y=make_error_bars(ci95),
        **more,
    )


def draw_interval_rows(
    name: str, look: Style, rows: Sequence[str], values: Sequence[float], ends: Sequence[tuple[float, float] | None]
) -> go.Scatter:
    """Return a marker in each row with an interval that need not be symmetric."""
    up = [None if end is None else end[1] - value for value, end in zip(values, ends, strict=True)]
    down = [None if end is None else value - end[0] for value, end in zip(values, ends, strict=True)]
    return go.Scatter(
        name=name,
        x=list(values),
        y=[escape_label(row) for row in rows],
        mode="markers",
        marker={"symbol": look.symbol, "size": 10, "color": look.colour},
        error_x=make_error_bars(up, down, thickness=1.5, width=4),
    )


def draw_bars(
    name: str, look: Style, y: list[Any], x: list[Any], *, orientation: str | None = "h", **more: Any
) -> go.Bar:
    """Return bars with the pattern of a style, horizontal ones by default."""
    marker = {
        "color": look.colour,
        "pattern": {"shape": look.pattern, "fillmode": "replace", "size": 6, "solidity": 0.5},
        "line": {"color": look.colour, "width": 1},
    }
    return go.Bar(name=name, x=x, y=y, orientation=orientation, marker=marker, **more)


def draw_dots(
    name: str,
    look: Style,
    x: list[Any],
    y: list[Any],
    ci95: list[float | None] | None = None,
    *,
    outline: bool = False,
) -> go.Scatter:
    """Return markers in rows, filled or as outlines."""
    symbol = f"{look.symbol}-open" if outline else look.symbol
    marker = {"symbol": symbol, "size": 9, "color": look.colour, "line": {"width": 1.5, "color": look.colour}}
    return go.Scatter(name=name, x=x, y=y, mode="markers", marker=marker, error_x=make_error_bars(ci95))


def draw_equality(ends: Sequence[float]) -> go.Scatter:
    """Return the line on which both coordinates are equal."""
    line = {"width": 1.5, "color": REFERENCE_LINE["color"]}
    return go.Scatter(name="equal", x=list(ends), y=list(ends), mode="lines", line=line, hoverinfo="skip")


def add_reference_line(made: go.Figure, text: str, x: float) -> None:
    """Draw a dashed vertical line through a figure, with a label above it."""
    above = {"text": text, "textangle": 0, "yref": "paper", "y": 1.0, "yanchor": "bottom", "xanchor": "left"}
    made.add_vline(x=x, line=REFERENCE_LINE, annotation=above)
