"""Draw the figures of a comparison: predicted against measured, errors by condition, two sets of rides."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import plotly.graph_objects as go
from plotly.subplots import make_subplots

from socast.core.evaluate.compare.records import Comparison, ConditionBin, ContrastBin, DatasetContrast
from socast.core.stats.scores import BANDS
from socast.tools.report.comparison.tables import (
    UNITS,
    format_bin,
    index_bins,
    list_varying_conditions,
    select_most_significant,
)
from socast.tools.report.document import Illustration
from socast.tools.report.figure_style import (
    REFERENCE_LINE,
    Style,
    apply_layout,
    draw_dots,
    escape_label,
    find_limit,
    get_style,
    make_figure,
)
from socast.tools.report.table import format_count

MOST_POINTS: Final = 2000
"""Largest number of rides in a scatter plot."""
BAND_DASHES: Final = ("dot", "dash", "longdashdot")
"""Dashes of the bands, narrowest first."""
WIDEST: Final = 1.5
"""Farthest end of an interval that the common scale shows, relative to the largest value."""
GAP: Final = 80
"""Height between two plots of a figure. [px]"""
LONG: Final = 26
"""Length of the name of a row above which it has two lines. [characters]"""
SIDES: Final = ("first", "second")
"""The two sets of rides."""
PLACES: Final = (2, 4, 5, 3, 7, 6, 9, 10, 11, 8)
"""Positions of models in the order of styles; neighbours differ. Grey is kept for measurements."""


def get_model_style(place: int) -> Style:
    """Return the style of the model at a position on the command line, the same in every figure."""
    return get_style(PLACES[place % len(PLACES)])


def get_look(result: Comparison | DatasetContrast, model: str) -> Style:
    """Return the style of a model."""
    return get_model_style(list(result.models).index(model))


def illustrate_scatters(result: Comparison) -> list[Illustration]:
    """Return predicted against measured energy of each model."""
    rides = len(result.rides.measured_kwh)
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
        for i, model in enumerate(result.models)
    ]


def draw_scatter(result: Comparison, model: str, every: int = 1) -> go.Figure:
    """Return a figure of the energies of rides, with bands of relative error."""
    rides = result.rides
    measured, predicted = rides.measured_kwh[::every], rides.predicted_kwh[model][::every]
    style = get_look(result, model)
    points = go.Scatter(
        name="ride",
        x=measured,
        y=predicted,
        text=[escape_label(key) for key in rides.key[::every]],
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
    return make_figure(
        [points, *lines],
        400,
        x={"title_text": "Measured energy of a ride [kWh]"},
        y={"title_text": "Predicted energy of a ride [kWh]"},
    )


def _line(
    name: str, beyond: float, ends: Sequence[float], line: Mapping[str, Any], *, shown: bool = True
) -> go.Scatter:
    """Return the line of a constant relative error."""
    y = [(1.0 + beyond) * x for x in ends]
    return go.Scatter(
        name=name, x=list(ends), y=y, mode="lines", line=line, legendgroup=name, showlegend=shown, hoverinfo="skip"
    )


def illustrate_conditions(result: Comparison) -> list[Illustration]:
    """Return bias and error of all models by each condition, on one scale."""
    caption = (
        "Above: bias (mean of predicted less measured). Below: mean absolute error. Lines: 95 % intervals. All these "
        "figures have one scale, which an interval may leave. In parentheses: the number of rides. Bins of a single "
        "vehicle-day have no interval and are in the table only."
    )
    conditions = [name for name in list_varying_conditions(result) if _index_known_bins(result, name)]
    scales = [_find_scale(result, conditions, figure) for figure in (_get_bias, _get_error)]
    return [
        Illustration(
            f"by-{i}", f"Bias and error by {name}", caption, draw_errors_by_condition(result, name, *scales), small=True
        )
        for i, name in enumerate(conditions)
    ]


def _index_known_bins(result: Comparison, name: str) -> dict[str, dict[str, ConditionBin]]:
    """Return the bins of a condition that have an interval, for each model that has any."""
    known = {
        model: index_bins([entry for entry in one.by.get(name, ()) if entry.bias_kwh.ci95 is not None])
        for model, one in result.models.items()
    }
    return {model: bins for model, bins in known.items() if bins}


def _get_bias(entry: ConditionBin) -> tuple[float, float]:
    """Return the bias of a bin and half the width of its interval. [kWh]"""
    return entry.bias_kwh.value or 0.0, entry.bias_kwh.ci95 or 0.0


def _get_error(entry: ConditionBin) -> tuple[float, float]:
    """Return the mean absolute error of a bin and half the width of its interval. [kWh]"""
    return entry.mae_kwh or 0.0, entry.mae_ci95_kwh or 0.0


def _find_scale(
    result: Comparison, conditions: Sequence[str], figure: Callable[[ConditionBin], tuple[float, float]]
) -> float:
    """Return the end of the common scale of a figure of bins. [kWh]"""
    bins = [of_model for name in conditions for of_model in _index_known_bins(result, name).values()]
    pairs = [figure(entry) for of_model in bins for entry in of_model.values()]
    return find_limit([value for value, _ in pairs], [abs(value) + half for value, half in pairs], WIDEST)


def draw_errors_by_condition(result: Comparison, name: str, most_bias: float, most_error: float) -> go.Figure:
    """Return a figure of the bias above and the mean absolute error below, a row for each bin.

    Units: most_bias [kWh], most_error [kWh].
    """
    by_model = _index_known_bins(result, name)
    shown = select_most_significant(
        [{key: entry.bias_kwh for key, entry in bins_of_model.items()} for bins_of_model in by_model.values()]
    )
    counts = {key: entry.n for bins_of_model in by_model.values() for key, entry in bins_of_model.items()}
    labels = {key: _format_row(f"{format_bin(name, key)} ({format_count(counts[key])})") for key in shown}
    area = GAP + 2 * len(shown) * (16 + 8 * len(by_model))
    made = make_subplots(rows=2, cols=1, vertical_spacing=GAP / area)
    for row, figure in enumerate((_get_bias, _get_error), start=1):
        for model, bins_of_model in by_model.items():
            rows = [each for each in shown if each in bins_of_model]
            known = [figure(bins_of_model[each]) for each in rows]
            dots = draw_dots(
                escape_label(model),
                get_look(result, model),
                [value for value, _ in known],
                [labels[each] for each in rows],
                [half for _, half in known],
            )
            dots.update(orientation="h", offsetgroup=model, legendgroup=model, showlegend=row == 1)
            made.add_trace(dots, row=row, col=1)
    apply_layout(made, area + 90)
    made.update_layout(scattermode="group", showlegend=len(result.models) > 1)
    made.add_vline(x=0.0, line={**REFERENCE_LINE, "width": 1}, row=1, col=1)
    made.update_xaxes(nticks=5, tickangle=0)
    made.update_xaxes(title_text="Bias [kWh per ride]", range=[-most_bias, most_bias], row=1, col=1)
    made.update_xaxes(title_text="Mean absolute error [kWh per ride]", range=[0.0, most_error], row=2, col=1)
    unit = f" [{UNITS[name]}]" if name in UNITS else ""
    order = [labels[key] for key in shown]
    made.update_yaxes(type="category", categoryorder="array", categoryarray=order, autorange="reversed")
    made.update_yaxes(title_text=f"{name.capitalize()}{unit}")
    return made


def _format_row(label: str) -> str:
    """Return the name of a row, in two lines where it is long."""
    text = escape_label(label)
    return text.replace(" (", "<br>(", 1) if len(label) > LONG else text


def illustrate_terms(against: DatasetContrast) -> list[Illustration]:
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
            draw_difference_terms(against, model),
        )
        for i, model in enumerate(against.models)
    ]


def draw_difference_terms(against: DatasetContrast, model: str) -> go.Figure:
    """Return a figure of a difference in consumption; from the top: measured, predicted, remainder, terms."""
    one = against.models[model]
    rows = [
        ("measured", against.consumption.difference),
        ("predicted", one.explained.difference),
        ("measured less predicted", one.unexplained.difference),
        *((term.name, term.difference) for term in one.terms),
    ]
    rows.reverse()
    x, spread = [each.value for _, each in rows], [each.ci95 for _, each in rows]
    made = make_figure(
        [draw_dots("second less first", get_look(against, model), x, [escape_label(name) for name, _ in rows], spread)],
        120 + 26 * len(rows),
        x={"title_text": "Difference in consumption [kWh/100 km]"},
        y={"title_text": "Part of the difference", "type": "category"},
        showlegend=False,
    )
    made.add_vline(x=0.0, line={**REFERENCE_LINE, "width": 1})
    return made


def illustrate_datasets(against: DatasetContrast) -> list[Illustration]:
    """Return the bias of each model on both sets of rides, by each condition, on one scale."""
    caption = (
        "Bias (mean of predicted less measured) on both sets of rides. Lines: 95 % intervals. All these figures have "
        "one scale, which an interval may leave. A side of a single vehicle-day has no interval and is in the table "
        "only."
    )
    parts = [
        (i, j, model, name, bins)
        for i, (model, one) in enumerate(against.models.items())
        for j, (name, bins) in enumerate(one.by.items())
    ]
    biases = [each for *_, bins in parts for side in SIDES for each in _list_biases(bins, side)]
    limit = find_limit([value for _, value, _ in biases], [abs(value) + half for _, value, half in biases], WIDEST)
    return [
        Illustration(
            f"contrast-{i}-{j}",
            f"{model}: bias by {name}",
            caption,
            draw_bias_of_datasets(name, bins, limit),
            small=True,
        )
        for i, j, model, name, bins in parts
        if any(_list_biases(bins, side) for side in SIDES)
    ]


def _list_biases(bins: Sequence[ContrastBin], side: str) -> list[tuple[str, float, float]]:
    """Return the bins of a set of rides that have an interval: name, bias and half the width of the interval."""
    known = [(entry.bin, getattr(entry.bias_kwh, side)) for entry in bins]
    return [(key, bias.value or 0.0, bias.ci95) for key, bias in known if bias.ci95 is not None]


def draw_bias_of_datasets(name: str, bins: Sequence[ContrastBin], limit: float) -> go.Figure:
    """Return a figure of the bias of one model on both sets of rides, a row for each bin."""
    shown = select_most_significant([{entry.bin: entry.bias_kwh.difference for entry in bins}])
    made = make_figure(
        [],
        130 + 34 * len(shown),
        x={"title_text": "Bias [kWh per ride]", "range": [-limit, limit]},
        scattermode="group",
    )
    for place, side in enumerate(SIDES):
        known = [(key, value, half) for key, value, half in _list_biases(bins, side) if key in shown]
        dots = draw_dots(
            side,
            get_model_style(place),
            [value for _, value, _ in known],
            [escape_label(format_bin(name, key)) for key, _, _ in known],
            [half for *_, half in known],
        )
        made.add_trace(dots.update(orientation="h", offsetgroup=side))
    made.add_vline(x=0.0, line={**REFERENCE_LINE, "width": 1})
    unit = f" [{UNITS[name]}]" if name in UNITS else ""
    order = [escape_label(format_bin(name, key)) for key in shown]
    made.update_yaxes(title_text=f"{name.capitalize()}{unit}", type="category", autorange="reversed")
    made.update_yaxes(categoryorder="array", categoryarray=order)
    return made
