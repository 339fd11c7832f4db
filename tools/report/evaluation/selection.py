"""Show the removable terms of the hybrid model, section 5.2 of the paper, and the differences between models."""

import math
from typing import Final

import plotly.graph_objects as go

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import EliminationStep, RecipeEvaluation
from socast.core.formatting import format_minus
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.tools.report.evaluation.tables import get_difference, list_compared
from socast.tools.report.figure_style import (
    DIVERGING,
    draw_curve,
    escape_label,
    format_recipe_label,
    get_style,
    make_figure,
    make_stacked_figure,
)
from socast.tools.report.table import (
    FORMATS,
    Cell,
    ReportTable,
    format_difference,
    keep_filled,
    tabulate,
    tabulate_records,
)

BEYOND: Final = 3
"""Number of terms that are listed after the last removable one."""


def tabulate_selection(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of removed terms, and of the loss as terms are removed one after the other."""
    return keep_filled(tabulate_removed_terms(result), tabulate_steps(result))


def tabulate_removed_terms(result: RecipeEvaluation) -> ReportTable:
    """Return the terms that recursive elimination removed, with cross-validation (RFECV) and without (RFE). [kWh]"""
    selection = result.selection
    share = (selection.margin.share if selection.margin else None) or 0.0
    names = {
        "margin": f"With a margin: error shown to be at most {100.0 * share:g} % larger",
        "rfecv": "RFECV: least cross-validated error",
        "rfe": "RFE: no significant loss",
    }
    rows = [("constant columns", (Cell(", ".join(selection.constant)), ""))] if selection.constant else []
    for key, name in names.items():
        if (elimination := getattr(selection, key)) is not None:
            theirs = [term.replace("_", " ") for found in published.get_findings(key) for term in found.terms]
            removed = Cell(", ".join(elimination.removed) or "none", ", ".join(theirs) or "none")
            rows.append((name, (removed, format_difference(elimination.loss, 4))))
    note = (
        "Half of the rides choose the terms. The other half show the increase of the mean absolute error without them. "
        "RFE removes terms while no loss is significant, and few rides show hardly any. The margin asks that the "
        "one-sided 95 % interval of the loss lies below it, and takes the terms of physics last."
    )
    columns = [("terms removed", lambda cells: cells[0]), ("loss, kWh", lambda cells: cells[1])]
    return tabulate("Terms that can be removed (sections 5.2.1 and 5.2.2)", "elimination", rows, columns, (note,))


def tabulate_steps(result: RecipeEvaluation) -> ReportTable:
    """Return the loss as terms are removed one after the other, up to `BEYOND` terms after the last removable one."""
    shown = next((each for each in (result.selection.margin, result.selection.rfe) if each and each.steps), None)
    steps = (shown.steps or [])[: len(shown.removed) + BEYOND] if shown else []
    return tabulate_records(
        "Order in which terms are removed",
        {f"{i}  {step.term}": step for i, step in enumerate(steps, start=1)},
        EliminationStep,
        corner="term",
        fields=("loss", "p"),
        notes=("Loss: increase of the mean absolute error when this term and all above it are removed.",),
        formats={**FORMATS, "loss": lambda loss: format_difference(loss, 4)},
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
    return made.update_layout(
        xaxis_title_text="Terms kept [number]",
        xaxis2_title_text="Terms removed [number]",
        yaxis_title_text="Mean absolute error [kWh]",
        yaxis2={"title_text": "Loss [kWh]", "zeroline": True},
    )


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
        text=[[_format_score(score) for score in row] for row in scores],
        texttemplate="%{text}",
        colorscale=DIVERGING,
        zmin=-most,
        zmax=most,
        xgap=1,
        ygap=1,
        showscale=False,
        hovertemplate="%{y}<br>less %{x}: %{customdata:.1f} Wh<extra></extra>",
    )
    return make_figure(
        [heat],
        80 + 38 * len(names),
        x={"title_text": "Model, numbered as on the left", "type": "category", "side": "top", "showgrid": False},
        y={"title_text": "Model", "type": "category", "autorange": "reversed", "showgrid": False},
        margin={"t": 60, "b": 10},
    )


def _format_score(score: tuple[float, float | None] | None) -> str:
    """Return the text of a difference score in Wh, with a star where it is significant."""
    if score is None:
        return ""
    value, p = score
    star = "*" if p is not None and p < SIGNIFICANCE else ""
    return format_minus(f"{round(1000.0 * value):+d}{star}")
