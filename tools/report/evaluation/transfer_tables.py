"""Build the tables of errors on a vehicle model that was left out of training."""

from collections.abc import Callable, Mapping
from typing import Any

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import AVERAGE
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
    Result,
    compute_mean,
    get_mapping,
    get_number,
    get_part,
    get_recipes,
    get_title,
    get_vehicle_name,
    list_vehicle_models,
)

WORSE = " ↑"
"""Mark of an error above that of the fitted physical model."""


def tabulate_transfer(result: Result) -> list[ReportTable]:
    """Return Tables 12 and 13 of the paper, and the few-shot errors of each vehicle model."""
    tables = [tabulate_new_vehicle(result), tabulate_new_vehicle_relative(result)]
    tables += [tabulate_few_shot(result, key) for key in get_mapping(result, "few_shot")]
    return [table for table in tables if table.rows]


def tabulate_new_vehicle(result: Result) -> ReportTable:
    """Return the mean absolute errors on vehicle models left out of training, as Table 12 of the paper.

    Returns
    -------
    ReportTable
        Errors by vehicle model [kWh], and the mean reduction against the basic physical model [%].
    """
    names, keys = _tested(result)

    def cell(recipe: str, key: str) -> Cell:
        error, fitted = _left_out(result, recipe, key, "mae"), _left_out(result, FITTED, key, "mae")
        worse = error is not None and fitted is not None and error > fitted
        return Cell(
            format_energy(error) + (WORSE if worse else ""),
            format_published(published.get_new_vehicle_mae(recipe, key)),
        )

    reduced = [compute_mean(_left_out(result, recipe, key, "reduction") for key in keys) for recipe in names]
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


def tabulate_new_vehicle_relative(result: Result) -> ReportTable:
    """Return error over consumption on vehicle models left out of training, as Table 13 of the paper.

    Units: returns [%].
    """
    names, keys = _tested(result)

    def cell(recipe: str, key: str) -> Cell:
        share = format_percent(_left_out(result, recipe, key, "relative"))
        figure = published.get_new_vehicle_relative_error(recipe, key)
        return Cell(share, format_published_share(None if figure is None else figure.value, 0))

    rows = _rows(result, names, keys, cell, "relative", [])
    heads = tuple(get_vehicle_name(key) for key in keys)
    name = "New vehicle model, none of its rides seen: error over consumption (Table 13)"
    return ReportTable(name, "model", heads, rows, ("Bold: the least of its column.",))


def tabulate_few_shot(result: Result, vehicle_model: str) -> ReportTable:
    """Return the error on a new vehicle model against the number of its rides seen in training.

    Returns
    -------
    ReportTable
        Mean absolute errors, one row per number of rides and one column per model. [kWh]
    """
    names = list(get_mapping(result, "few_shot", vehicle_model))
    points = {recipe: get_few_shot_errors(result, vehicle_model, recipe) for recipe in names}
    line = points.get(FITTED, {})
    rows = tuple(
        Row(
            str(n),
            tuple(_against(points[recipe].get(n), None if recipe in WAYS else line.get(n)) for recipe in names),
        )
        for n in sorted({rides for of in points.values() for rides in of})
    )
    notes = [f"{WORSE.strip()}: above the fitted extended physical model after as many rides, the reference."]
    if any(way in names for way in WAYS):
        notes.append(f"The reference is the better of two at each point: {' and '.join(WAYS.values())}.")
    name = f"{get_vehicle_name(vehicle_model)} as a new vehicle model: mean absolute error, kWh"
    return ReportTable(name, "rides seen", tuple(get_title(result, recipe) for recipe in names), rows, tuple(notes))


def get_few_shot_errors(result: Result, vehicle_model: str, recipe: str) -> dict[int, Mapping[str, Any]]:
    """Return the few-shot errors of a model on a vehicle model."""
    made: dict[int, Mapping[str, Any]] = {}
    for point in get_part(result, "few_shot", vehicle_model, recipe) or ():
        rides, error = get_number(get_part(point, "rides")), get_part(point, "mae")
        if rides is not None and get_number(error) is not None:
            made[int(rides)] = {"value": get_number(error), "ci95": get_number(get_part(point, "ci95"))}
    return made


def _rows(
    result: Result,
    names: list[str],
    keys: list[str],
    cell: Callable[[str, str], Cell],
    figure: str,
    last: list[Cell],
) -> tuple[Row, ...]:
    """Return a row for each model, with the least figure of each vehicle model emphasised."""
    columns = [
        mark_least([cell(r, key) for r in names], [_left_out(result, r, key, figure) for r in names]) for key in keys
    ]
    return tuple(
        Row(get_title(result, recipe), (*(column[i] for column in columns), *last[i : i + 1]))
        for i, recipe in enumerate(names)
    )


def _tested(result: Result) -> tuple[list[str], list[str]]:
    """Return the models and the vehicle models that have an error on a vehicle model left out of training."""
    errors = get_mapping(result, "new_vehicle")
    names = [recipe for recipe in get_recipes(result) if get_mapping(errors, recipe)]
    return names, [
        key for key in list_vehicle_models(result) if any(key in get_mapping(errors, recipe) for recipe in names)
    ]


def _left_out(result: Result, recipe: str, key: str, figure: str) -> float | None:
    """Return a figure of a model on a vehicle model left out of training."""
    return get_number(get_part(result, "new_vehicle", recipe, key, figure))


def _training_note(result: Result) -> str:
    """Return a sentence about the vehicle models that no model for a new vehicle model was trained on."""
    left_out = get_part(result, "about", "left_out_of_training") or ()
    if not left_out:
        return "The paper leaves the LEAF out of training for the other cars; here all others train."
    names = ", ".join(get_vehicle_name(key) for key in left_out)
    return f"Never trained on: {names}. The paper leaves the LEAF out of training."


def _against(point: Mapping[str, Any] | None, fitted: Mapping[str, Any] | None) -> Cell:
    """Return an error, marked where it is above that of the fitted physical model."""
    if point is None:
        return Cell("")
    worse = fitted is not None and point["value"] > fitted["value"]
    return Cell(format_energy(point) + (WORSE if worse else ""))
