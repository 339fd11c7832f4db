"""Draw the figures of a comparison: predicted against measured, errors by condition, two sets of rides."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import plotly.graph_objects as go

from core.stats.scores import BANDS
from tools.report.comparison.tables import (
    UNITS,
    format_bin,
    index_bins,
    list_models,
    list_varying_conditions,
    select_most_significant,
)
from tools.report.evaluation.illustrations import Illustration
from tools.report.evaluation.result import Result, get_half_width, get_mapping, get_number, get_part
from tools.report.figure_style import (
    REFERENCE_LINE,
    Style,
    draw_curve,
    draw_dots,
    escape_label,
    get_style,
    make_figure,
    make_stacked_figure,
)

MOST_POINTS: Final = 2000
"""Largest number of rides in a scatter plot."""
BAND_DASHES: Final = ("dot", "dash", "longdashdot")
"""Dashes of the bands, narrowest first."""
WIDEST: Final = 1.5
"""Widest interval that is drawn, relative to the largest bias of a figure."""
LEFT_OUT: Final = "Intervals far wider than the figure (bins of few vehicle-days) are in the table only."
PLACES: Final = (2, 4, 5, 3, 7, 6, 9, 10, 11, 8)
"""Positions of models in the order of styles; neighbours differ. Grey is kept for measurements."""


def select_interval_widths(biases: Sequence[Any], among: Sequence[Any]) -> list[float | None]:
    """Return half widths of intervals; None where an interval would dwarf the figure."""
    most = WIDEST * max((abs(get_number(bias) or 0.0) for bias in among), default=0.0)
    widths = [get_half_width(bias) for bias in biases]
    return [width if width is not None and width <= most else None for width in widths]


def get_model_style(place: int) -> Style:
    """Return the style of the model at a position on the command line, the same in every figure."""
    return get_style(PLACES[place % len(PLACES)])


def get_look(result: Result, model: str) -> Style:
    """Return the style of a model."""
    return get_model_style(list_models(result).index(model))


def illustrate_scatters(result: Result) -> list[Illustration]:
    """Return predicted against measured energy of each model."""
    rides = len(get_part(result, "rides", "measured_kwh") or ())
    every = -(-rides // MOST_POINTS)
    some = "" if every <= 1 else f" Every {every}th of {rides:,} rides is shown."
    caption = (
        "Each point is a ride. Solid line: prediction equals measurement. Broken lines: "
        f"{', '.join(f'±{band}' for band in BANDS)} %.{some}"
    )
    return [
        Illustration(
            f"scatter-{i}",
            f"{model}: predicted against measured",
            caption,
            draw_scatter(result, model, every),
            small=True,
        )
        for i, model in enumerate(list_models(result))
    ]


def draw_scatter(result: Result, model: str, every: int = 1) -> go.Figure:
    """Return a figure of the energies of rides, with bands of relative error."""
    rides = get_mapping(result, "rides")
    measured, predicted = list(rides["measured_kwh"])[::every], list(rides["predicted_kwh"][model])[::every]
    style = get_look(result, model)
    points = go.Scatter(
        name="ride",
        x=measured,
        y=predicted,
        text=[escape_label(str(key)) for key in list(rides["key"])[::every]],
        mode="markers",
        marker={"symbol": f"{style.symbol}-open", "size": 5, "color": style.colour, "line": {"width": 1}},
        hovertemplate="%{text}: measured %{x:.3f}, predicted %{y:.3f} kWh<extra></extra>",
    )
    ends = [min(0.0, *measured), max(measured)]
    lines = [_line("equal", 0.0, ends, {"width": 1.5, "color": REFERENCE_LINE["color"]})]
    for band, dash in zip(BANDS, BAND_DASHES, strict=True):
        for sign in (1.0, -1.0):
            line = {"width": 1, "dash": dash, "color": REFERENCE_LINE["color"]}
            lines.append(_line(f"±{band} %", sign * band / 100.0, [0.0, ends[1]], line, shown=sign > 0.0))
    made = make_figure([points, *lines], 400)
    made.update_xaxes(title_text="Measured energy of a ride [kWh]")
    made.update_yaxes(title_text="Predicted energy of a ride [kWh]")
    return made


def _line(
    name: str, beyond: float, ends: Sequence[float], line: Mapping[str, Any], *, shown: bool = True
) -> go.Scatter:
    """Return the line of a constant relative error."""
    y = [(1.0 + beyond) * x for x in ends]
    return go.Scatter(
        name=name, x=list(ends), y=y, mode="lines", line=line, legendgroup=name, showlegend=shown, hoverinfo="skip"
    )


def illustrate_conditions(result: Result) -> list[Illustration]:
    """Return bias and error of all models by each condition."""
    caption = (
        f"Above: bias (mean of predicted less measured), with 95 % intervals. Below: mean absolute error. {LEFT_OUT}"
    )
    return [
        Illustration(
            f"by-{i}", f"Bias and error by {name}", caption, draw_errors_by_condition(result, name), small=True
        )
        for i, name in enumerate(list_varying_conditions(result))
    ]


def draw_errors_by_condition(result: Result, name: str) -> go.Figure:
    """Return a figure of the bias above and the mean absolute error below, of all models."""
    made = make_stacked_figure(("", ""), 560)
    by_model = {
        model: index_bins(get_part(bins_of_model, "by", name))
        for model, bins_of_model in get_mapping(result, "models").items()
    }
    shown = select_most_significant(
        [{key: get_part(e, "bias_kwh") for key, e in bins_of_model.items()} for bins_of_model in by_model.values()]
    )
    among = [get_part(entry, "bias_kwh") for bins_of_model in by_model.values() for entry in bins_of_model.values()]
    for model, bins_of_model in by_model.items():
        bins = [key for key in shown if key in bins_of_model]
        x = [escape_label(format_bin(name, key)) for key in bins]
        bias = [get_part(bins_of_model, key, "bias_kwh") for key in bins]
        look_of = get_look(result, model)
        above = draw_curve(
            escape_label(model),
            look_of,
            x,
            [get_number(one) for one in bias],
            select_interval_widths(bias, among),
            legendgroup=model,
        )
        below = draw_curve(
            escape_label(model),
            look_of,
            x,
            [get_number(get_part(bins_of_model, key, "mae_kwh")) for key in bins],
            legendgroup=model,
            showlegend=False,
        )
        made.add_trace(above, row=1, col=1)
        made.add_trace(below, row=2, col=1)
    made.add_hline(y=0.0, line={**REFERENCE_LINE, "width": 1}, row=1, col=1)
    unit = f" [{UNITS[name]}]" if name in UNITS else ""
    order = [escape_label(format_bin(name, key)) for key in shown]
    made.update_xaxes(type="category", categoryorder="array", categoryarray=order)
    made.update_xaxes(title_text=f"{name.capitalize()}{unit}")
    made.update_yaxes(title_text="Bias [kWh per ride]", row=1, col=1)
    made.update_yaxes(title_text="Mean absolute<br>error [kWh per ride]", rangemode="tozero", row=2, col=1)
    return made


def illustrate_terms(result: Result) -> list[Illustration]:
    """Return, for each model, the terms of the difference in consumption between two sets of rides."""
    caption = (
        "Second set less first: the contribution of each term of the model, their sum, and the measured "
        "difference, with 95 % intervals."
    )
    return [
        Illustration(
            f"account-{i}",
            f"{model}: the difference in consumption, term by term",
            caption,
            draw_difference_terms(result, model),
        )
        for i, model in enumerate(get_mapping(result, "against", "models"))
    ]


def draw_difference_terms(result: Result, model: str) -> go.Figure:
    """Return a figure of a difference in consumption; from the top: measured, predicted, remainder, terms."""
    difference = get_mapping(result, "against", "models", model)
    rows = [
        ("measured", get_part(result, "against", "consumption", "difference")),
        ("predicted", get_part(difference, "explained", "difference")),
        ("measured less predicted", get_part(difference, "unexplained", "difference")),
        *((str(term["name"]), term["difference"]) for term in get_part(difference, "terms") or ()),
    ]
    rows.reverse()
    x, spread = [get_number(value) for _, value in rows], [get_half_width(value) for _, value in rows]
    made = make_figure(
        [draw_dots("second less first", get_look(result, model), x, [escape_label(name) for name, _ in rows], spread)],
        120 + 26 * len(rows),
    )
    made.add_vline(x=0.0, line={**REFERENCE_LINE, "width": 1})
    made.update_xaxes(title_text="Difference in consumption [kWh/100 km]")
    made.update_yaxes(type="category")
    made.update_layout(showlegend=False)
    return made


def illustrate_datasets(result: Result) -> list[Illustration]:
    """Return the bias of each model on both sets of rides, by each condition."""
    caption = f"Bias (mean of predicted less measured) on both sets of rides, with 95 % intervals. {LEFT_OUT}"
    return [
        Illustration(
            f"contrast-{i}-{j}", f"{model}: bias by {name}", caption, draw_bias_of_datasets(name, bins), small=True
        )
        for i, (model, of_model) in enumerate(get_mapping(result, "against", "models").items())
        for j, (name, bins) in enumerate(get_mapping(of_model, "by").items())
    ]


def draw_bias_of_datasets(name: str, bins: Sequence[Mapping[str, Any]]) -> go.Figure:
    """Return a figure of the bias of one model on both sets of rides."""
    shown = select_most_significant([{str(e["bin"]): get_part(e, "bias_kwh", "difference") for e in bins}])
    kept = [entry for entry in bins if str(entry["bin"]) in shown]
    x = [escape_label(format_bin(name, str(entry["bin"]))) for entry in kept]
    sides = {side: [get_part(entry, "bias_kwh", side) for entry in kept] for side in ("first", "second")}
    among = [bias for errors in sides.values() for bias in errors]
    traces = [
        draw_curve(
            side,
            get_model_style(place),
            x,
            [get_number(bias) for bias in errors],
            select_interval_widths(errors, among),
        )
        for place, (side, errors) in enumerate(sides.items())
    ]
    made = make_figure(traces, 320)
    made.add_hline(y=0.0, line={**REFERENCE_LINE, "width": 1})
    unit = f" [{UNITS[name]}]" if name in UNITS else ""
    made.update_xaxes(title_text=f"{name.capitalize()}{unit}", type="category")
    made.update_yaxes(title_text="Bias [kWh per ride]")
    return made
