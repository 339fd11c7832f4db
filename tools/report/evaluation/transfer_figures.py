"""Draw the errors on a vehicle model that was left out of training."""

from typing import Any

import plotly.graph_objects as go

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.tools.report.evaluation.result import FITTED, get_new_vehicle_errors, get_recipes
from socast.tools.report.evaluation.transfer_tables import index_points
from socast.tools.report.figure_style import (
    PAPER_NAME,
    add_reference_line,
    draw_bars,
    draw_curve,
    draw_dots,
    format_recipe_label,
    get_recipe_style,
    get_vehicle_style,
    make_figure,
)

NO_RIDES = 0.3
"""Position of zero rides on a logarithmic axis of rides seen."""


def draw_new_vehicle(result: RecipeEvaluation, vehicle_model: str) -> go.Figure:
    """Return a figure of the errors of all models on a vehicle model left out of training, as Table 12 of the paper."""
    every = {recipe: get_new_vehicle_errors(result, recipe, vehicle_model).mae for recipe in get_recipes(result)}
    errors = {recipe: error for recipe, error in every.items() if error is not None}
    rows = [format_recipe_label(result, recipe) for recipe in errors]
    look = get_vehicle_style(result, vehicle_model)
    traces: list[Any] = [draw_bars("here", look._replace(pattern=""), rows, list(errors.values()), opacity=0.5)]
    theirs = [published.get_new_vehicle_mae(recipe, vehicle_model) for recipe in errors]
    if any(theirs):
        values = [None if f is None else f.value for f in theirs]
        traces.append(draw_dots(PAPER_NAME, look._replace(symbol="diamond"), values, rows, outline=True))
    made = make_figure(traces, 90 + 32 * len(errors))
    if FITTED in errors:
        add_reference_line(made, "fitted physical", errors[FITTED])
    made.update_xaxes(title_text="Mean absolute error [kWh]", rangemode="tozero")
    made.update_yaxes(title_text="Model", type="category", autorange="reversed")
    return made


def draw_few_shot(result: RecipeEvaluation, vehicle_model: str) -> go.Figure:
    """Return a figure of the error on a new vehicle model against the number of its rides seen.

    The curve of the fitted physical model is thicker than the others.
    """
    traces, numbers = [], set()
    for recipe, curve in result.few_shot[vehicle_model].items():
        points = index_points(curve)
        numbers |= set(points)
        x, y = [n or NO_RIDES for n in points], [point.value for point in points.values()]
        name, spreads = format_recipe_label(result, recipe), [point.ci95 for point in points.values()]
        trace = draw_curve(name, get_recipe_style(result, recipe), x, y, spreads)
        traces.append(trace.update(line={"width": 4}) if recipe == FITTED else trace)
    made = make_figure(traces, 360)
    made.update_layout(showlegend=True)
    ticks = sorted(numbers)
    made.update_xaxes(
        title_text="Rides of the new vehicle model seen [number]",
        type="log",
        tickvals=[n or NO_RIDES for n in ticks],
        ticktext=[str(n) for n in ticks],
    )
    made.update_yaxes(title_text="Mean absolute error [kWh]", rangemode="tozero")
    return made
