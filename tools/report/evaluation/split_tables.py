"""Build the tables of errors where whole cars or the last dates are held out instead of single rides."""

from typing import Final

from socast.core.evaluate.paper.records import RecipeEvaluation
from socast.tools.report.cells import Cell, ReportTable, Row, format_change, format_energy, mark_least
from socast.tools.report.evaluation.result import (
    compute_mean,
    find_least,
    get_recipes,
    get_title,
    get_vehicle_name,
    list_vehicle_models,
)

SPLITS: Final = ("ride", "vehicle", "date")
"""Units that are held out together; the paper holds out the first one."""


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
    names = [recipe for recipe, errors in means.items() if errors[0] is not None]
    columns = [
        mark_least([Cell(format_energy(means[r][i])) for r in names], [means[r][i] for r in names])
        for i in range(len(present))
    ]
    rows = tuple(
        Row(
            get_title(result, recipe),
            (
                *(column[place] for column in columns),
                *(Cell(format_change(value, means[recipe][0])) for value in means[recipe][1:]),
            ),
        )
        for place, recipe in enumerate(names)
    )
    heads = (*(f"by {split}" for split in present), *(f"{split} against {present[0]}" for split in present[1:]))
    notes = (
        "Mean over vehicle models of the average error; bold: the least of its column.",
        "By ride: drawn within each cluster, as in the paper; rides of one car on one day are in both sets.",
        "By vehicle: whole cars are held out. By date: the last dates are.",
        describe_best_models(result, present),
    )
    return ReportTable("Held out by ride, by vehicle, by date: average error, kWh", "model", heads, rows, notes)


def tabulate_changes(result: RecipeEvaluation, split: str) -> ReportTable:
    """Return by how much errors grow on each vehicle model where cars or dates are held out instead of rides. [%]"""
    keys = list_vehicle_models(result)
    rows = tuple(
        Row(
            get_title(result, recipe),
            tuple(
                Cell(format_change(_error(result, split, recipe, key), _error(result, SPLITS[0], recipe, key)))
                for key in keys
            ),
        )
        for recipe in get_recipes(result)
        if result.splits.get(split, {}).get(recipe)
    )
    heads = tuple(get_vehicle_name(key) for key in keys)
    return ReportTable(f"Held out by {split}: average error against that by ride", "model", heads, rows)


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
