"""Select the figures of each section of a report, with titles and captions."""

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import plotly.graph_objects as go

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.core.stats.multiple_testing import SIGNIFICANCE
from socast.tools.report.evaluation import figures, selection_figures, transfer_figures
from socast.tools.report.evaluation.result import (
    ALL,
    FITTED,
    find_best,
    get_new_vehicle_errors,
    get_title,
    get_vehicle_name,
    list_vehicle_models,
)
from socast.tools.report.evaluation.use_tables import AXES, MANY_BINS, list_bins

PAPER_CAPTION: Final = "The paper's figures are from other data (the rides of one company), for orientation only."
"""Sentence of captions of figures that also show the paper's figures."""


class Illustration(NamedTuple):
    """Hold a figure of a report, with its title and caption.

    Parameters
    ----------
    key : str
        Unique key that is safe in HTML.
    title : str
        Title, with the paper's figure number where it has one.
    caption : str
        Description of the figure, also for readers who cannot see it.
    small : bool
        Whether the figure is one of several similar ones, which the page shows side by side where there is room.
    """

    key: str
    title: str
    caption: str
    figure: go.Figure
    small: bool = False


class Drawing(NamedTuple):
    """Hold a picture of a report that is an SVG, with its title and caption.

    Parameters
    ----------
    svg : str
        SVG that says in words what it shows.
    """

    key: str
    title: str
    caption: str
    svg: str
    small: bool = False


def build_illustrations(result: RecipeEvaluation, section: str) -> list[Illustration]:
    """Return the figures of a section that have something to show."""
    made = MAKERS.get(section)
    return [one for one in made(result) if any(_has_points(trace) for trace in one.figure.data)] if made else []


def _has_points(trace: Any) -> bool:
    """Return whether a trace has at least one visible point."""
    if trace.type == "heatmap":
        return any(value is not None for row in trace.z for value in row)
    return any(x is not None and y is not None for x, y in zip(trace.x, trace.y, strict=True))


def _data(result: RecipeEvaluation) -> list[Illustration]:
    """Return the accessory curves of all vehicle models."""
    return [
        Illustration(
            f"curve-{i}",
            f"{get_vehicle_name(key)}: accessory power against outside temperature (Figure 1)",
            "For a car whose accessory scale is 1. Open circles: mean of a bin of temperature, larger with more rides. "
            "Line: the fitted curve of five segments. Diamonds: its choke points, with their temperatures.",
            figures.draw_accessory_curve(result, key),
            small=True,
        )
        for i, key in enumerate(list_vehicle_models(result))
        if key in result.curve
    ]


def _summary(result: RecipeEvaluation) -> list[Illustration]:
    """Return the figures that compare all models."""
    winner = get_title(result, find_best(result) or "")
    return [
        Illustration(
            "average",
            "Average error of each model on each vehicle model (Figure 3)",
            "Filled: these rides, with 95 % confidence intervals. Outlines: the paper's. Least: "
            f"{winner}. {PAPER_CAPTION}",
            figures.draw_average_errors(result),
        ),
        Illustration(
            "relative",
            "Error over consumption against distance (Figure 2)",
            "All vehicle models together, weighted by their rides, on a logarithmic scale. Above: these "
            f"rides. Below, on the same scale: the paper's, computed from its tables. {PAPER_CAPTION}",
            figures.draw_relative_errors(result),
        ),
        Illustration(
            "bands",
            "Rides predicted within a band around their measured energy",
            "Share of rides whose error is within 5, 10 and 15 % of the measured energy; further right is better.",
            figures.draw_bands(result),
        ),
    ]


def _difference(result: RecipeEvaluation) -> list[Illustration]:
    """Return the difference scores of all vehicle models together and of each."""
    return [
        Illustration(
            f"difference-{i}",
            f"{get_vehicle_name(key)}: difference score",
            "Row's error less column's in Wh, mean over the same test rides: negative where the row is better. "
            f"* p < {SIGNIFICANCE}, adjusted for the number of pairs. {_dominating(result, key)}",
            selection_figures.draw_difference_matrix(result, key),
        )
        for i, key in enumerate((ALL, *list_vehicle_models(result)))
        if result.difference.get(key)
    ]


def _dominating(result: RecipeEvaluation, key: str) -> str:
    """Return a sentence that names the models that dominate a vehicle model."""
    names = [get_title(result, recipe) for recipe in result.dominates.get(key, ())]
    if not names:
        return ""
    return f"{names[0]} dominates." if len(names) == 1 else f"{' and '.join(names)} co-dominate."


def _places(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors by distance, temperature, season and driver."""
    return [
        Illustration(
            f"by-{axis}",
            f"Errors by {AXES[axis]}",
            _by_caption(len(list_bins(result, axis)) > MANY_BINS),
            figures.draw_errors_by(result, axis),
        )
        for axis in AXES
        if result.by.get(axis)
    ]


def _by_caption(ranked: bool) -> str:
    """Return the caption of errors by a property, whose values are ranked or in panels."""
    shown = "Click a name in the legend to show a further model."
    if ranked:
        return f"Each curve is sorted from least to most. {shown}"
    return f"Above: mean absolute error. Below: bias, positive where too much is predicted. {shown}"


def _reserve(result: RecipeEvaluation) -> list[Illustration]:
    """Return the coverage of intervals, and the buffers above the reserve."""
    return [
        Illustration(
            "coverage",
            "Rides inside their 90 % prediction interval",
            "Dashed: the nominal 90 %, and the 85 % that no cluster or season should fall below.",
            figures.draw_coverage(result),
        ),
        Illustration(
            "buffers",
            "Buffer that keeps rides above their reserve",
            "Energy to keep in reserve so that 95 % or 99 % of rides take no more than the prediction "
            "plus this reserve. Dashed: the company in the paper, which does not state the share of "
            f"rides. {PAPER_CAPTION}",
            figures.draw_buffers(result),
        ),
    ]


def _splits(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors by what was held out."""
    return [
        Illustration(
            "splits",
            "Average error by what is held out",
            "Mean over vehicle models. The further apart the three markers of a model, the more it "
            "depends on the cars and days of its training rides.",
            figures.draw_splits(result),
        )
    ]


def _transfer(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors on vehicle models left out of training, and after some of their rides."""
    keys = list_vehicle_models(result)
    beside = any(published.get_new_vehicle_mae(FITTED, key) for key in keys)
    left_out = [
        Illustration(
            f"new-vehicle-{i}",
            f"{get_vehicle_name(key)} left out of training (Table 12)",
            "Bars: these rides. Dashed: the fitted physical model, the reference. "
            + (f"Open diamonds: the paper's. {PAPER_CAPTION}" if beside else ""),
            transfer_figures.draw_new_vehicle(result, key),
            small=True,
        )
        for i, key in enumerate(keys)
        if any(get_new_vehicle_errors(result, recipe, key).mae is not None for recipe in result.new_vehicle)
    ]
    few = [
        Illustration(
            f"few-shot-{i}",
            f"{get_vehicle_name(key)}: error after some of its rides",
            "From no ride of the new vehicle model to many, on a logarithmic axis, with 95 % confidence intervals. "
            "Thick: the fitted physical model, the reference.",
            transfer_figures.draw_few_shot(result, key),
            small=True,
        )
        for i, key in enumerate(result.few_shot)
    ]
    return left_out + few


def _selection(result: RecipeEvaluation) -> list[Illustration]:
    """Return the errors as terms are eliminated."""
    return [
        Illustration(
            "elimination",
            "Errors as terms are removed",
            "Above: cross-validated error of the hybrid model by the number of terms left, on the rides "
            "used to choose them. Below: increase of the error as terms are removed one by one, on the "
            "other rides, with 95 % confidence intervals.",
            selection_figures.draw_elimination(result),
        )
    ]


MAKERS: Final[dict[str, Callable[[RecipeEvaluation], list[Illustration]]]] = {
    "data": _data,
    "summary": _summary,
    "difference": _difference,
    "places": _places,
    "reserve": _reserve,
    "splits": _splits,
    "transfer": _transfer,
    "selection": _selection,
}
"""Keys of sections -> functions that build their figures."""
