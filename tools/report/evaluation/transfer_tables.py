"""Build the tables of errors on a vehicle model that was left out of training."""

from collections.abc import Callable, Iterable

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import AVERAGE
from socast.core.evaluate.paper.records import LearningPoint, RecipeEvaluation
from socast.core.evaluate.records import EstimatedValue
from socast.tools.report.cells import (
    Cell,
    ReportTable,
    Row,
    format_energy,
    format_percent,
    format_published,
    format_published_share,
    mark_least,
)
from socast.tools.report.evaluation.result import (
    FITTED,
    WAYS,
    compute_mean,
    get_new_vehicle_errors,
    get_recipes,
    get_title,
    get_vehicle_name,
    list_vehicle_models,
)

WORSE = " ↑"
"""Mark of an error above that of the fitted physical model."""


def tabulate_transfer(result: RecipeEvaluation) -> list[ReportTable]:
    """Return Tables 12 and 13 of the paper, and the few-shot errors of each vehicle model."""
    tables = [tabulate_new_vehicle(result), tabulate_new_vehicle_relative(result)]
    tables += [tabulate_few_shot(result, key) for key in result.few_shot]
    return [table for table in tables if table.rows]


def tabulate_new_vehicle(result: RecipeEvaluation) -> ReportTable:
    """Return the mean absolute errors on vehicle models left out of training, as Table 12 of the paper."""
    names, keys = _tested(result)

    def cell(recipe: str, key: str) -> Cell:
        error, fitted = (get_new_vehicle_errors(result, name, key).mae for name in (recipe, FITTED))
        worse = error is not None and fitted is not None and error > fitted
        return Cell(
            format_energy(error) + (WORSE if worse else ""),
            format_published(published.get_new_vehicle_mae(recipe, key)),
        )

    reduced = [compute_mean(get_new_vehicle_errors(result, recipe, key).reduction for key in keys) for recipe in names]
    theirs = [format_published_share(published.get_new_vehicle_reduction(recipe, AVERAGE)) for recipe in names]
    last = [Cell(format_percent(share), paper) for share, paper in zip(reduced, theirs, strict=True)]
    stated = format_percent(published.get_statement("new_vehicle_reduction").value, 2)
    notes = (
        "Trained on all other vehicle models, tested on all rides of this one. Bold: the least of its column.",
        _training_note(result),
        f"{WORSE.strip()}: above the fitted extended physical model.",
        "Reduction: against the basic physical model, mean over vehicle models.",
        f"The paper's reductions are computed from its rounded Table 12; its text states {stated} for the fitted one.",
    )
    rows = _rows(result, names, keys, cell, "mae", last)
    heads = (*(get_vehicle_name(key) for key in keys), "reduction")
    name = "New vehicle model, none of its rides seen: mean absolute error, kWh (Table 12)"
    return ReportTable(name, "model", heads, rows, notes)


def tabulate_new_vehicle_relative(result: RecipeEvaluation) -> ReportTable:
    """Return error over consumption on vehicle models left out of training, as Table 13 of the paper. [%]"""
    names, keys = _tested(result)

    def cell(recipe: str, key: str) -> Cell:
        share = format_percent(get_new_vehicle_errors(result, recipe, key).relative)
        figure = published.get_new_vehicle_relative_error(recipe, key)
        return Cell(share, format_published_share(None if figure is None else figure.value, 0))

    rows = _rows(result, names, keys, cell, "relative", [])
    heads = tuple(get_vehicle_name(key) for key in keys)
    name = "New vehicle model, none of its rides seen: error over consumption (Table 13)"
    return ReportTable(name, "model", heads, rows, ("Bold: the least of its column.",))


def tabulate_few_shot(result: RecipeEvaluation, vehicle_model: str) -> ReportTable:
    """Return the error on a new vehicle model against the number of its rides seen in training. [kWh]"""
    points = {recipe: index_points(curve) for recipe, curve in result.few_shot[vehicle_model].items()}
    line = points.get(FITTED, {})
    rows = tuple(
        Row(
            str(n),
            tuple(_against(of.get(n), None if recipe in WAYS else line.get(n)) for recipe, of in points.items()),
        )
        for n in sorted({rides for of in points.values() for rides in of})
    )
    notes = [f"{WORSE.strip()}: above the fitted extended physical model after as many rides, the reference."]
    if any(way in points for way in WAYS):
        notes.append(f"The reference is the better of two at each point: {' and '.join(WAYS.values())}.")
    name = f"{get_vehicle_name(vehicle_model)} as a new vehicle model: mean absolute error, kWh"
    return ReportTable(name, "rides seen", tuple(get_title(result, recipe) for recipe in points), rows, tuple(notes))


def index_points(curve: Iterable[LearningPoint]) -> dict[int, EstimatedValue]:
    """Return the known errors of a curve by the number of rides seen. [kWh]"""
    return {each.rides: EstimatedValue(value=each.mae, ci95=each.ci95) for each in curve if each.mae is not None}


def _rows(
    result: RecipeEvaluation,
    names: list[str],
    keys: list[str],
    cell: Callable[[str, str], Cell],
    figure: str,
    last: list[Cell],
) -> tuple[Row, ...]:
    """Return a row for each model, with the least figure of each vehicle model emphasised."""
    columns = [
        mark_least(
            [cell(r, key) for r in names], [getattr(get_new_vehicle_errors(result, r, key), figure) for r in names]
        )
        for key in keys
    ]
    return tuple(
        Row(get_title(result, recipe), (*(column[i] for column in columns), *last[i : i + 1]))
        for i, recipe in enumerate(names)
    )


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


def _against(point: EstimatedValue | None, fitted: EstimatedValue | None) -> Cell:
    """Return an error, marked where it is above that of the fitted physical model."""
    if point is None:
        return Cell("")
    worse = fitted is not None and (point.value or 0.0) > (fitted.value or 0.0)
    return Cell(format_energy(point) + (WORSE if worse else ""))
