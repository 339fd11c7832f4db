"""Draw the selection of terms and the differences between models."""

import math

import plotly.graph_objects as go

from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.formatting import format_minus
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.tools.report.evaluation.error_tables import get_difference, list_compared
from socast.tools.report.figure_style import (
    DIVERGING,
    draw_curve,
    escape_label,
    format_recipe_label,
    get_style,
    make_figure,
    make_stacked_figure,
)


def draw_elimination(result: RecipeEvaluation) -> go.Figure:
    """Return a figure of the errors as terms are eliminated.

    The upper panel shows the cross-validated error against the number of terms kept, the lower panel the loss as terms
    are removed one after the other.
    """
    rfecv, rfe = result.selection.rfecv, result.selection.rfe
    scores = [each for each in rfecv.scores or () if each.mae is not None] if rfecv else []
    steps = [each for each in rfe.steps or () if each.loss.value is not None] if rfe else []
    made = make_stacked_figure(
        ("RFECV: cross-validated error", "RFE: increase of the error over that with all terms"), 640
    )
    if scores:
        trace = draw_curve("RFECV", get_style(2), [s.terms for s in scores], [s.mae for s in scores])
        made.add_trace(trace.update(showlegend=False), row=1, col=1)
    if steps:
        x, y = list(range(1, len(steps) + 1)), [s.loss.value for s in steps]
        trace = draw_curve("RFE", get_style(4), x, y, [s.loss.ci95 for s in steps])
        trace.update(showlegend=False, text=[escape_label(s.term) for s in steps])
        made.add_trace(trace, row=2, col=1)
    made.update_xaxes(title_text="Terms kept [number]", row=1)
    made.update_xaxes(title_text="Terms removed [number]", row=2)
    made.update_yaxes(title_text="Mean absolute error [kWh]", row=1)
    made.update_yaxes(title_text="Loss [kWh]", zeroline=True, row=2)
    return made


def draw_difference_matrix(result: RecipeEvaluation, vehicle_model: str) -> go.Figure:
    """Return a figure of the difference scores of all pairs of models.

    A score is the error of the row's model less that of the column's model [Wh]; a star marks significant scores.
    Shades follow the square root of the score, so that small differences between good models remain visible.
    """
    differences = result.difference.get(vehicle_model, {})
    names = list_compared(result, differences)
    scores = [[get_difference(differences, a, b) for b in names] for a in names]
    values = [[None if score is None else 1000.0 * score[0] for score in row] for row in scores]
    shades = [[None if v is None else math.copysign(math.sqrt(abs(v)), v) for v in row] for row in values]
    most = max((abs(shade) for row in shades for shade in row if shade is not None), default=1.0)
    heat = go.Heatmap(
        z=shades,
        customdata=values,
        x=[str(i) for i in range(1, len(names) + 1)],
        y=[f"{format_recipe_label(result, recipe)} · {i}" for i, recipe in enumerate(names, start=1)],
        text=[[_score(score) for score in row] for row in scores],
        texttemplate="%{text}",
        colorscale=DIVERGING,
        zmin=-most,
        zmax=most,
        xgap=1,
        ygap=1,
        showscale=False,
        hovertemplate="%{y}<br>less %{x}: %{customdata:.1f} Wh<extra></extra>",
    )
    made = make_figure([heat], 80 + 38 * len(names))
    made.update_layout(margin={"t": 60, "b": 10})
    made.update_xaxes(title_text="Model, numbered as on the left", type="category", side="top", showgrid=False)
    made.update_yaxes(title_text="Model", type="category", autorange="reversed", showgrid=False)
    return made


def _score(score: tuple[float, float | None] | None) -> str:
    """Return the text of a difference score in Wh, with a star where it is significant."""
    if score is None:
        return ""
    value, p = score
    star = "*" if p is not None and p < SIGNIFICANCE else ""
    return format_minus(f"{round(1000.0 * value):+d}{star}")
