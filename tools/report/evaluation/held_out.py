"""Show the errors where cars, dates or vehicle models are held out: tables and figures."""

from collections.abc import Iterable
from functools import partial
from typing import Any, Final

import plotly.graph_objects as go

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import AVERAGE
from socast.core.evaluate.paper.records import LearningPoint, RecipeEvaluation
from socast.core.evaluate.records import EstimatedValue
from socast.tools.report.evaluation.result import (
    FITTED,
    WAYS,
    Column,
    compute_mean,
    find_least,
    get_new_vehicle_errors,
    get_recipes,
    get_title,
    get_vehicle_name,
    list_vehicle_models,
    name_recipes,
    name_vehicle_models,
)
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
from socast.tools.report.table import (
    Cell,
    ReportTable,
    format_change,
    format_energy,
    format_percent,
    format_published,
    format_published_share,
    keep_filled,
    tabulate,
)

SPLITS: Final = ("ride", "vehicle", "date")
"""Units that are held out together; the paper holds out the first one."""
WORSE = " ↑"
"""Mark of an error above that of the fitted physical model."""
NO_RIDES = 0.3
"""Position of zero rides on a logarithmic axis of rides seen."""


def tabulate_all_splits(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of average errors by what was held out, and of the changes on each vehicle model."""
    present = [split for split in SPLITS if result.splits.get(split)]
    if not present:
        return []
    changed = [tabulate_changes(result, split) for split in present[1:] if present[0] == SPLITS[0]]
    return [tabulate_splits(result, present), *changed]


def tabulate_splits(result: RecipeEvaluation, present: list[str]) -> ReportTable:
    """Return the average errors of all splits side by side. [kWh]"""
    means = {recipe: compute_means_by_split(result, recipe, present) for recipe in get_recipes(result)}

    def make_error(place: int, recipe: str) -> Cell:
        return Cell(format_energy(means[recipe][place]), value=means[recipe][place])

    def make_change(place: int, recipe: str) -> Cell:
        return Cell(format_change(means[recipe][place], means[recipe][0]))

    columns: list[Column] = [(f"by {split}", partial(make_error, i)) for i, split in enumerate(present)]
    for place, split in enumerate(present[1:], start=1):
        columns.append((f"{split} against {present[0]}", partial(make_change, place)))
    notes = (
        "Mean over vehicle models of the average error; bold: the least of its column.",
        "By ride: drawn within each cluster, as in the paper; rides of one car on one day are in both sets.",
        "By vehicle: whole cars are held out. By date: the last dates are.",
        describe_best_models(result, present),
    )
    rows = name_recipes(result, [recipe for recipe, errors in means.items() if errors[0] is not None])
    return tabulate("Held out by ride, by vehicle, by date: average error, kWh", "model", rows, columns, notes)


def tabulate_changes(result: RecipeEvaluation, split: str) -> ReportTable:
    """Return by how much errors grow on each vehicle model where cars or dates are held out instead of rides. [%]"""

    def make_cell(key: str, recipe: str) -> Cell:
        return Cell(format_change(_error(result, split, recipe, key), _error(result, SPLITS[0], recipe, key)))

    rows = name_recipes(result, [each for each in get_recipes(result) if result.splits.get(split, {}).get(each)])
    title = f"Held out by {split}: average error against that by ride"
    return tabulate(title, "model", rows, name_vehicle_models(result, make_cell))


def describe_best_models(result: RecipeEvaluation, present: list[str]) -> str:
    """Return a sentence that names the best model of each split."""
    winners: dict[str, str] = {}
    for place, split in enumerate(present):
        errors = {recipe: compute_means_by_split(result, recipe, present)[place] for recipe in get_recipes(result)}
        if (best := find_least(errors)) is not None:
            winners[split] = get_title(result, best)
    if len(set(winners.values())) <= 1:
        return f"The same model is best by each: {next(iter(winners.values()), 'none')}."
    return "They differ on the best model: " + "; ".join(f"by {s}, {name}" for s, name in winners.items()) + "."


def compute_means_by_split(result: RecipeEvaluation, recipe: str, present: list[str]) -> list[float | None]:
    """Return the mean error of a model by each split. [kWh]"""
    shared = [
        key
        for key in list_vehicle_models(result)
        if all(_error(result, split, recipe, key) is not None for split in present)
    ]
    return [compute_mean(_error(result, split, recipe, key) for key in shared) for split in present]


def _error(result: RecipeEvaluation, split: str, recipe: str, key: str) -> float | None:
    """Return the average error of a model on a vehicle model by a split. [kWh]"""
    return result.splits.get(split, {}).get(recipe, {}).get(key)


def tabulate_transfer(result: RecipeEvaluation) -> list[ReportTable]:
    """Return Tables 12 and 13 of the paper, and the few-shot errors of each vehicle model."""
    few = [tabulate_few_shot(result, key) for key in result.few_shot]
    return keep_filled(tabulate_new_vehicle(result), tabulate_new_vehicle_relative(result), *few)


def tabulate_new_vehicle(result: RecipeEvaluation) -> ReportTable:
    """Return the mean absolute errors on vehicle models left out of training, as Table 12 of the paper."""
    recipes, keys = _tested(result)

    def make_error(key: str, recipe: str) -> Cell:
        error, fitted = (get_new_vehicle_errors(result, name, key).mae for name in (recipe, FITTED))
        theirs = format_published(published.get_new_vehicle_mae(recipe, key))
        return Cell(format_energy(error) + _mark_worse(error, fitted), theirs, value=error)

    def make_reduction(recipe: str) -> Cell:
        share = compute_mean(get_new_vehicle_errors(result, recipe, key).reduction for key in keys)
        return Cell(format_percent(share), format_published_share(published.get_new_vehicle_reduction(recipe, AVERAGE)))

    stated = format_percent(published.get_statement("new_vehicle_reduction").value, 2)
    notes = (
        "Trained on all other vehicle models, tested on all rides of this one. Bold: the least of its column.",
        _training_note(result),
        f"{WORSE.strip()}: above the fitted extended physical model.",
        "Reduction: against the basic physical model, mean over vehicle models.",
        f"The paper's reductions are computed from its rounded Table 12; its text states {stated} for the fitted one.",
    )
    title = "New vehicle model, none of its rides seen: mean absolute error, kWh (Table 12)"
    errors: list[Column] = [(get_vehicle_name(key), partial(make_error, key)) for key in keys]
    columns = [*errors, ("reduction", make_reduction)]
    return tabulate(title, "model", name_recipes(result, recipes), columns, notes)


def tabulate_new_vehicle_relative(result: RecipeEvaluation) -> ReportTable:
    """Return error over consumption on vehicle models left out of training, as Table 13 of the paper. [%]"""
    recipes, keys = _tested(result)

    def make_cell(key: str, recipe: str) -> Cell:
        share, figure = (
            get_new_vehicle_errors(result, recipe, key).relative,
            published.get_new_vehicle_relative_error(recipe, key),
        )
        theirs = format_published_share(None if figure is None else figure.value, 0)
        return Cell(format_percent(share), theirs, value=share)

    title = "New vehicle model, none of its rides seen: error over consumption (Table 13)"
    columns: list[Column] = [(get_vehicle_name(key), partial(make_cell, key)) for key in keys]
    return tabulate(title, "model", name_recipes(result, recipes), columns, ("Bold: the least of its column.",))


def tabulate_few_shot(result: RecipeEvaluation, vehicle_model: str) -> ReportTable:
    """Return the error on a new vehicle model against the number of its rides seen in training. [kWh]"""
    points = {recipe: index_points(curve) for recipe, curve in result.few_shot[vehicle_model].items()}
    fitted = points.get(FITTED, {})

    def make_cell(recipe: str, rides: int) -> str:
        point, reference = points[recipe].get(rides), None if recipe in WAYS else fitted.get(rides)
        if point is None:
            return ""
        return format_energy(point) + _mark_worse(point.value, reference.value if reference else None)

    notes = [f"{WORSE.strip()}: above the fitted extended physical model after as many rides, the reference."]
    if any(way in points for way in WAYS):
        notes.append(f"The reference is the better of two at each point: {' and '.join(WAYS.values())}.")
    rows = [(str(n), n) for n in sorted({rides for of in points.values() for rides in of})]
    columns = [(get_title(result, recipe), partial(make_cell, recipe)) for recipe in points]
    title = f"{get_vehicle_name(vehicle_model)} as a new vehicle model: mean absolute error, kWh"
    return tabulate(title, "rides seen", rows, columns, tuple(notes))


def _mark_worse(error: float | None, fitted: float | None) -> str:
    """Return the mark of an error above that of the fitted physical model."""
    return WORSE if error is not None and fitted is not None and error > fitted else ""


def index_points(curve: Iterable[LearningPoint]) -> dict[int, EstimatedValue]:
    """Return the known errors of a curve by the number of rides seen. [kWh]"""
    return {each.rides: EstimatedValue(value=each.mae, ci95=each.ci95) for each in curve if each.mae is not None}


def _tested(result: RecipeEvaluation) -> tuple[list[str], list[str]]:
    """Return the models and the vehicle models that have an error on a vehicle model left out of training."""
    errors = result.new_vehicle
    names = [recipe for recipe in get_recipes(result) if errors.get(recipe)]
    return names, [key for key in list_vehicle_models(result) if any(key in errors[recipe] for recipe in names)]


def _training_note(result: RecipeEvaluation) -> str:
    """Return a sentence about the vehicle models that no model for a new vehicle model was trained on."""
    left_out = result.about.left_out_of_training
    if not left_out:
        return "The paper leaves the LEAF out of training for the other cars; here all others train."
    names = ", ".join(get_vehicle_name(key) for key in left_out)
    return f"Never trained on: {names}. The paper leaves the LEAF out of training."


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
    made = make_figure(
        traces,
        90 + 32 * len(errors),
        x={"title_text": "Mean absolute error [kWh]", "rangemode": "tozero"},
        y={"title_text": "Model", "type": "category", "autorange": "reversed"},
    )
    if FITTED in errors:
        add_reference_line(made, "fitted physical", errors[FITTED])
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
    made = make_figure(
        traces, 360, showlegend=True, y={"title_text": "Mean absolute error [kWh]", "rangemode": "tozero"}
    )
    ticks = sorted(numbers)
    made.update_xaxes(
        title_text="Rides of the new vehicle model seen [number]",
        type="log",
        tickvals=[n or NO_RIDES for n in ticks],
        ticktext=[str(n) for n in ticks],
    )
    return made
