"""Read the result of an evaluation: names for readers, orders, and the best model.

Any part of a result may be empty: an evaluation of few rides has no few-shot curves, and a model without intervals has
no coverage. Reports leave empty parts out.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from types import MappingProxyType
from typing import Final

from socast.core.evaluate.paper.published import AVERAGE, PHYSICAL, WEIGHTED
from socast.core.evaluate.paper.records import NewVehicleErrors, RecipeEvaluation
from socast.core.evaluate.records import EstimatedValue
from socast.core.vehicles import load_catalogue
from socast.tools.report.table import Cell, Figure, get_value

Column = tuple[str, Callable[[str], Cell]]
"""Heading of a column of a table, and the function of a recipe that makes its cells."""
FITTED: Final = "fitted_physical"
"""Recipe of the fitted physical model, the reference for errors on a new vehicle model."""
WAYS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "fitted_physical_others": "trained on the others only",
        "fitted_physical_refitted": "refitted with the rides seen",
    }
)
"""Variants of the recipe `FITTED` in few-shot curves -> their names for readers.

At each point of the curve, `FITTED` is the better of these variants.
"""
INTERACTIONS: Final = "hybrid_interactions"
"""Recipe of the best model of the paper."""
SEGMENTS: Final = "segment_network"
"""Recipe of the segment model, a reference that is not among the paper's models."""
ALL: Final = "all"
"""Key of all vehicle models together."""
NAMES: Final = {ALL: "all vehicle models", WEIGHTED: "Weighted average"}
"""Keys that are no vehicle model -> their names for readers."""
NOT_CLUSTERS: Final = ("total", AVERAGE)
"""Columns beside the clusters of distance."""


def compute_mean(values: Iterable[float | None]) -> float | None:
    """Return the plain mean of the values that are known, None where none is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def get_recipes(result: RecipeEvaluation) -> dict[str, str]:
    """Return the recipes of the models and their titles; the recipes alone where the result has no titles."""
    return result.recipes or {name: name for name in result.mae}


def get_title(result: RecipeEvaluation, recipe: str) -> str:
    """Return the title of a model, or its recipe where the result has no title."""
    if recipe in WAYS:
        return f"{get_title(result, FITTED)}, {WAYS[recipe]}"
    return get_recipes(result).get(recipe, recipe)


def name_recipes(result: RecipeEvaluation, recipes: Iterable[str]) -> list[tuple[str, str]]:
    """Return the title and the recipe of models, for the rows of a table."""
    return [(get_title(result, recipe), recipe) for recipe in recipes]


def name_vehicle_models(result: RecipeEvaluation, make_cell: Callable[[str, str], Cell]) -> list[Column]:
    """Return a column for each vehicle model, whose cells are made of the vehicle model and a recipe."""
    return [(get_vehicle_name(key), partial(make_cell, key)) for key in list_vehicle_models(result)]


def list_vehicle_models(result: RecipeEvaluation) -> list[str]:
    """Return the keys of the vehicle models, in the order of the result."""
    return result.about.vehicle_models or list(result.rides)


def get_vehicle_name(key: str) -> str:
    """Return the name of a vehicle model for readers: the catalogue's name without its battery, or the key.

    Examples
    --------
    >>> get_vehicle_name("kia-soul-ev-2015"), get_vehicle_name("horse")
    ('Kia Soul EV 2015', 'horse')
    """
    if key in NAMES:
        return NAMES[key]
    known = load_catalogue().get(key)
    return known.name.partition(",")[0] if known else key


def list_clusters(result: RecipeEvaluation, rows: Iterable[Mapping[str, Figure]]) -> list[str]:
    """Return the clusters of distance that have a figure in any row, in the order of the result, others last."""
    filled = {
        cluster
        for row in rows
        for cluster, value in row.items()
        if cluster not in NOT_CLUSTERS and get_value(value) is not None
    }
    order = {name: place for place, name in enumerate(result.about.clusters)}
    return sorted(filled, key=lambda name: (order.get(name, len(order)), _lower_end(name), name))


def get_average_error(result: RecipeEvaluation, recipe: str, vehicle_model: str) -> EstimatedValue:
    """Return the average error of a model on a vehicle model. [kWh]"""
    return result.mae.get(recipe, {}).get(vehicle_model, {}).get(AVERAGE, EstimatedValue())


def get_new_vehicle_errors(result: RecipeEvaluation, recipe: str, vehicle_model: str) -> NewVehicleErrors:
    """Return the errors of a model on a vehicle model left out of training."""
    return result.new_vehicle.get(recipe, {}).get(vehicle_model, NewVehicleErrors())


def compute_overall_error(result: RecipeEvaluation, recipe: str) -> float | None:
    """Return the plain mean over vehicle models of a model's average error. [kWh]"""
    return compute_mean(get_average_error(result, recipe, key).value for key in list_vehicle_models(result))


def find_least(errors: Mapping[str, float | None]) -> str | None:
    """Return the name of the least known error, None where none is known."""
    known = {name: error for name, error in errors.items() if error is not None}
    return min(known, key=known.__getitem__, default=None)


def find_best(result: RecipeEvaluation) -> str | None:
    """Return the recipe of the model with the least overall error, None where no error is known."""
    return find_least({recipe: compute_overall_error(result, recipe) for recipe in get_recipes(result)})


def select_principal(result: RecipeEvaluation) -> list[str]:
    """Return the basic and the fitted physical model, the paper's best, the best here, and the segment model."""
    chosen = {PHYSICAL, FITTED, INTERACTIONS, SEGMENTS, find_best(result)}
    return [recipe for recipe in get_recipes(result) if recipe in chosen]


def _lower_end(cluster: str) -> float:
    """Return the first number in the name of a cluster, infinity where there is none."""
    digits = cluster.removesuffix("+").partition("-")[0]
    return float(digits) if digits.replace(".", "", 1).isdigit() else float("inf")
