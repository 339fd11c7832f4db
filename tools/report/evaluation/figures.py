"""Draw the figures of a report: each function takes the result of an evaluation and returns a plotly figure."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from socast.core.columns import ZERO_CELSIUS
from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import AVERAGE, PHYSICAL
from socast.core.evaluate.paper.records import AccessoryPoint, RecipeEvaluation
from socast.core.formatting import format_minus, format_range
from socast.core.vehicles import AccessoryCurve
from socast.tools.report.evaluation.held_out import SPLITS, compute_means_by_split
from socast.tools.report.evaluation.result import (
    get_average_error,
    get_recipes,
    get_vehicle_name,
    list_clusters,
    list_vehicle_models,
    select_principal,
)
from socast.tools.report.evaluation.use_tables import (
    AXES,
    LEAST_COVERAGE,
    MANY_BINS,
    NOMINAL,
    format_bin,
    get_bins,
    get_coverage,
    list_bins,
)
from socast.tools.report.figure_style import (
    PAPER_NAME,
    REFERENCE_LINE,
    Style,
    add_reference_line,
    draw_bars,
    draw_curve,
    draw_dots,
    escape_label,
    format_recipe_label,
    get_recipe_style,
    get_style,
    get_vehicle_style,
    make_figure,
    make_stacked_figure,
    to_percent,
)
from socast.tools.report.table import format_cluster

PERCENT_TICKS = (5, 10, 15, 20, 30, 40, 60, 80, 100, 150, 200)
"""Tick values of a logarithmic axis of shares. [%]"""

AXIS_UNITS: Mapping[str, str] = {"distance": "Distance [km]", "temperature": "Outside temperature [°C]"}
"""Properties by which errors are reported -> titles of their axes, for those with a unit."""


def draw_accessory_curve(result: RecipeEvaluation, vehicle_model: str) -> go.Figure:
    """Return a figure of accessory power against outside temperature, as Figure 1 of the paper.

    The figure shows the means of temperature bins, the fitted curve, and its choke points.
    """
    look = get_vehicle_style(result, vehicle_model)
    traces: list[Any] = []
    power = result.curve[vehicle_model]
    if power.points:
        traces.append(_points(power.points, look))
    if power.curve:
        traces += _five_segments(AccessoryCurve(**power.curve), look, [point.ambient_c for point in power.points])
    made = make_figure(traces, 340, x={"title_text": "Outside temperature [°C]"})
    powers = [0.0, *(y for trace in traces for y in trace.y)]
    room = 0.12 * (max(powers) - min(powers))
    made.update_yaxes(title_text="Climate and accessory power [kW]", range=[min(powers) - room, max(powers) + room])
    return made


def _points(points: Sequence[AccessoryPoint], look: Style) -> go.Scatter:
    """Return the means of temperature bins, with larger markers for more rides."""
    rides = np.array([point.rides for point in points], dtype=np.float64)
    return go.Scatter(
        name="mean of a bin",
        x=[point.ambient_c for point in points],
        y=[point.power_w / 1000.0 for point in points],
        mode="markers",
        marker={
            "symbol": "circle-open",
            "size": (5.0 + 7.0 * np.sqrt(rides / rides.max())).tolist(),
            "color": look.colour,
        },
        customdata=rides.tolist(),
        hovertemplate="%{x:.1f} °C: %{y:.2f} kW, %{customdata:,.0f} rides<extra></extra>",
    )


def _five_segments(fitted: AccessoryCurve, look: Style, ambient_c: Sequence[float]) -> list[go.Scatter]:
    """Return the fitted curve and its choke points; the curve spans all bins and all choke points."""
    chokes = np.array([fitted.heating_full, fitted.heating_off, fitted.cooling_on, fitted.cooling_full])
    ends = np.array([*ambient_c, chokes[0] - ZERO_CELSIUS - 4.0, chokes[-1] - ZERO_CELSIUS + 4.0]) + ZERO_CELSIUS
    at = np.array([ends.min(), *chokes, ends.max()])
    line = {"color": look.colour, "width": 2}
    return [
        go.Scatter(
            name="fitted curve",
            x=(at - ZERO_CELSIUS).tolist(),
            y=(fitted.power(at) / 1000.0).tolist(),
            mode="lines",
            line=line,
        ),
        go.Scatter(
            name="choke points",
            x=(chokes - ZERO_CELSIUS).tolist(),
            y=(fitted.power(chokes) / 1000.0).tolist(),
            mode="markers+text",
            marker={"symbol": "diamond", "size": 11, "color": look.colour},
            text=[format_minus(f"{t - ZERO_CELSIUS:.1f}") for t in chokes],
            textposition=["top right", "bottom left", "bottom right", "top left"],
            cliponaxis=False,
        ),
    ]


def draw_relative_errors(result: RecipeEvaluation) -> go.Figure:
    """Return a figure of error over consumption against distance, as Figure 2 of the paper.

    The upper panel shows this evaluation, the lower panel the paper.
    """
    errors = result.relative
    columns = list_clusters(result, errors.values())
    made = make_stacked_figure(("here", PAPER_NAME), 680)
    for recipe in (name for name in get_recipes(result) if name in errors):
        look, name = get_recipe_style(result, recipe), format_recipe_label(result, recipe)
        here = [to_percent(errors[recipe].get(c)) for c in columns]
        theirs = [to_percent(published.get_relative_error(recipe, c)) for c in columns]
        made.add_trace(draw_curve(name, look, _label_clusters(columns), here, legendgroup=recipe), row=1, col=1)
        if any(value is not None for value in theirs):
            below = draw_curve(name, look, _label_clusters(columns), theirs, legendgroup=recipe, showlegend=False)
            made.add_trace(below, row=2, col=1)
    made.update_xaxes(title_text="Distance [km]", type="category")
    made.update_yaxes(title_text="Error over consumption [%]", type="log", tickvals=PERCENT_TICKS, matches="y")
    return made


def draw_average_errors(result: RecipeEvaluation) -> go.Figure:
    """Return a figure of the average error of each model on each vehicle model, as Figure 3 of the paper.

    Outlines show the paper's figures.
    """
    names = [recipe for recipe in get_recipes(result) if result.mae.get(recipe)]
    keys = list_vehicle_models(result)
    traces: list[Any] = []
    for i, key in enumerate(keys):
        look, rows = get_vehicle_style(result, key), [place + _offset(i, len(keys)) for place in range(len(names))]
        cells, name = [get_average_error(result, recipe, key) for recipe in names], escape_label(get_vehicle_name(key))
        traces.append(draw_dots(name, look, [c.value for c in cells], rows, [c.ci95 for c in cells]))
        theirs = [published.get_mae(recipe, key, AVERAGE) for recipe in names]
        if any(theirs):
            values = [None if f is None else f.value for f in theirs]
            traces.append(draw_dots(f"{name}, {PAPER_NAME}", look, values, rows, outline=True))
    return _by_model(result, names, traces, "Average error over clusters [kWh]", 16 + 10 * len(keys))


def draw_splits(result: RecipeEvaluation) -> go.Figure:
    """Return a figure of the average error of each model by what was held out."""
    present = [split for split in SPLITS if result.splits.get(split)]
    means = {recipe: compute_means_by_split(result, recipe, present) for recipe in get_recipes(result)}
    names = [recipe for recipe, values in means.items() if values and values[0] is not None]
    series = {f"by {split}": [means[recipe][i] for recipe in names] for i, split in enumerate(present)}
    return _draw_series(result, names, series, "Average error, mean over vehicle models [kWh]")


def draw_bands(result: RecipeEvaluation) -> go.Figure:
    """Return a figure of the share of rides that each model predicts within bands of relative error."""
    names = [recipe for recipe in get_recipes(result) if recipe in result.bands]
    limits = list(dict.fromkeys(limit for recipe in names for limit in result.bands[recipe]))
    series = {
        f"within ±{limit} %": [to_percent(result.bands[recipe].get(limit)) for recipe in names] for limit in limits
    }
    return _draw_series(result, names, series, "Share of rides [%]")


def draw_buffers(result: RecipeEvaluation) -> go.Figure:
    """Return a figure of the buffer that keeps a share of rides above their reserve, for each model."""
    names = [recipe for recipe in get_recipes(result) if result.buffer_kwh.get(recipe)]
    shares = list(dict.fromkeys(share for recipe in names for share in result.buffer_kwh[recipe]))
    rows = [format_recipe_label(result, recipe) for recipe in names]
    traces: list[Any] = [
        draw_bars(
            f"{share} % of rides",
            get_style(2 * i + 1),
            rows,
            [result.buffer_kwh[recipe].get(share) for recipe in names],
        )
        for i, share in enumerate(shares)
    ]
    made = make_figure(
        traces,
        90 + 44 * len(names),
        x={"title_text": "Buffer [kWh]", "rangemode": "tozero"},
        y={"title_text": "Model", "type": "category", "autorange": "reversed"},
    )
    published_kwh = published.get_statement("buffer").value
    add_reference_line(made, f"{published_kwh:g} kWh: the paper's company (other data)", published_kwh)
    return made


def draw_errors_by(result: RecipeEvaluation, axis: str) -> go.Figure:
    """Return a figure of mean absolute error and bias against distance, temperature, season or driver.

    The upper panel shows the mean absolute error, the lower panel the bias. Values are sorted where there are more than
    `MANY_BINS` bins.
    """
    shown, labels = set(select_principal(result)) - {PHYSICAL}, list_bins(result, axis)
    ranked = len(labels) > MANY_BINS
    made = make_stacked_figure(("mean absolute error", "bias: predicted less measured"), 640)
    for recipe in (name for name in get_recipes(result) if get_bins(result, axis, name)):
        look, bins = get_recipe_style(result, recipe), {each.bin: each for each in get_bins(result, axis, recipe)}
        for row, figure_name in enumerate(("mae", "bias"), start=1):
            values = [getattr(bins.get(name), figure_name, None) for name in labels]
            x: list[Any] = [escape_label(format_bin(axis, name)) for name in labels]
            if ranked:
                values = [*sorted(value for value in values if value is not None)]
                x = list(range(1, len(values) + 1))
            trace = draw_curve(
                format_recipe_label(result, recipe), look, x, values, legendgroup=recipe, showlegend=row == 1
            )
            trace.update(mode="markers" if axis == "season" else "lines" if ranked else "lines+markers")
            trace.update(visible=True if recipe in shown else "legendonly", offsetgroup=recipe)
            made.add_trace(trace, row=row, col=1)
    made.update_layout(scattermode="group" if axis == "season" else "overlay", scattergap=0.6)
    name = f"{AXES[axis].capitalize()}s, from least to most [rank]" if ranked else AXES[axis].capitalize()
    made.update_xaxes(title_text=AXIS_UNITS.get(axis, name), type="linear" if ranked else "category")
    made.update_yaxes(title_text="Error [kWh]", rangemode="tozero", row=1)
    made.update_yaxes(title_text="Bias [kWh]", row=2, zeroline=True)
    return made


def draw_coverage(result: RecipeEvaluation) -> go.Figure:
    """Return a figure of the share of rides inside their prediction interval.

    The shares are overall, by cluster of distance, by season and by vehicle model.
    """
    coverage = get_coverage(result)
    distances = list_clusters(result, (each.cluster for each in coverage.values()))
    traces = []
    for recipe, each in coverage.items():
        values = {"overall": each.overall}
        values |= {escape_label(format_cluster(c)): each.cluster.get(c) for c in distances} | each.season
        values |= {escape_label(get_vehicle_name(key)): share for key, share in each.vehicle_model.items()}
        shares = [to_percent(value) for value in values.values()]
        trace = draw_curve(format_recipe_label(result, recipe), get_recipe_style(result, recipe), list(values), shares)
        traces.append(trace.update(mode="markers", offsetgroup=recipe))
    made = make_figure(
        traces, 400, scattermode="group", scattergap=0.5, x={"title_text": "Rides of", "type": "category"}
    )
    for share in (NOMINAL, LEAST_COVERAGE):
        made.add_hline(y=100.0 * share, line=REFERENCE_LINE)
    least = min((y for trace in traces for y in trace.y if y is not None), default=100.0)
    made.update_yaxes(title_text="Inside their 90 % interval [%]", range=[min(80.0, least - 2.0), 101.0])
    return made


def _draw_series(
    result: RecipeEvaluation, names: Sequence[str], series: Mapping[str, Sequence[float | None]], unit: str
) -> go.Figure:
    """Return a figure with one row per model, which holds one dot of each series."""
    traces = [
        draw_dots(
            label, get_style(3 * i + 2), list(values), [row + _offset(i, len(series)) for row in range(len(names))]
        )
        for i, (label, values) in enumerate(series.items())
    ]
    return _by_model(result, names, traces, unit, 34)


def _by_model(
    result: RecipeEvaluation, names: Sequence[str], traces: list[Any], unit: str, row_height: int
) -> go.Figure:
    """Return a figure with one row of dots per model."""
    return make_figure(
        traces,
        90 + row_height * len(names),
        x={"title_text": unit, "rangemode": "tozero"},
        y={
            "title_text": "Model",
            "tickvals": list(range(len(names))),
            "ticktext": [format_recipe_label(result, recipe) for recipe in names],
            "range": [len(names) - 0.4, -0.6],
        },
    )


def _offset(place: int, of: int) -> float:
    """Return the vertical offset of a dot within its row from its place among several dots."""
    return 0.7 * ((place + 0.5) / of - 0.5)


def _label_clusters(columns: Sequence[str]) -> list[str]:
    """Return the names of clusters, safe as labels."""
    return [escape_label(format_range(column)) for column in columns]
