"""Build the tables for users of a model: errors by condition, prediction intervals, and the reserve it needs."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import quantiles
from types import MappingProxyType
from typing import Final

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import BinErrors, IntervalCoverage, RecipeEvaluation
from socast.core.formatting import format_range
from socast.core.records import list_shown
from socast.tools.report.evaluation.result import (
    Column,
    get_recipes,
    get_title,
    get_vehicle_name,
    list_clusters,
    list_vehicle_models,
    name_recipes,
    select_principal,
)
from socast.tools.report.table import (
    Cell,
    ReportTable,
    format_cluster,
    format_count,
    format_energy,
    format_percent,
    format_signed,
    keep_filled,
    tabulate,
)

AXES: Final[Mapping[str, str]] = MappingProxyType(
    {"distance": "distance", "temperature": "outside temperature", "season": "season", "driver": "driver"}
)
"""Properties by which errors are reported -> their names for readers."""

UNITS: Final[Mapping[str, str]] = MappingProxyType({"distance": ", km", "temperature": ", °C"})
"""Units of these properties for headings; properties without a unit are missing."""

MANY_BINS: Final = 20
"""Number of bins above which only the spread over bins is reported."""

NOMINAL: Final = 0.9
"""Nominal coverage of prediction intervals."""
LEAST_COVERAGE: Final = 0.85
"""Least coverage of a 90 % interval in any cluster or season."""
COVERAGE_RANGE: Final = (0.88, 0.92)
"""Range of the coverage of a 90 % interval over all rides."""


def tabulate_places(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of errors by distance, temperature, season and driver."""
    return keep_filled(
        *(
            tabulate_spread(result, axis)
            if len(list_bins(result, axis)) > MANY_BINS
            else tabulate_errors_by_bin(result, axis)
            for axis in AXES
            if result.by.get(axis)
        )
    )


def list_bins(result: RecipeEvaluation, axis: str) -> list[str]:
    """Return the names of the bins of a property, in the order of the result."""
    return list(dict.fromkeys(each.bin for recipe in get_recipes(result) for each in get_bins(result, axis, recipe)))


def format_bin(axis: str, name: str) -> str:
    """Return the name of a bin for readers.

    Examples
    --------
    >>> format_bin("distance", "0-5"), format_bin("temperature", "-10 to -5")
    ('0 to 5', '−10 to −5')
    """
    return (format_range(name) if axis in UNITS else name).removesuffix(" °C")


def get_bins(result: RecipeEvaluation, axis: str, recipe: str) -> list[BinErrors]:
    """Return the errors of a model in each bin of a property; empty where the result has none."""
    return result.by.get(axis, {}).get(recipe, [])


def tabulate_errors_by_bin(result: RecipeEvaluation, axis: str) -> ReportTable:
    """Return mean absolute error and bias of the principal models in each bin of a property. [kWh]"""
    by_recipe = {
        recipe: {each.bin: each for each in bins}
        for recipe in select_principal(result)
        if (bins := get_bins(result, axis, recipe))
    }

    def count(label: str) -> str:
        return format_count(next((bins[label].n for bins in by_recipe.values() if label in bins), None))

    def show_errors(recipe: str, label: str) -> str:
        entry = by_recipe[recipe].get(label)
        return "" if entry is None else f"{format_energy(entry.mae)} ({format_signed(entry.bias)})"

    of_recipes = [(get_title(result, recipe), partial(show_errors, recipe)) for recipe in by_recipe]
    return tabulate(
        f"Mean absolute error by {AXES[axis]}, kWh",
        f"{AXES[axis]}{UNITS.get(axis, '')}",
        [(format_bin(axis, label), label) for label in list_bins(result, axis)],
        [("predictions", count), *of_recipes],
        ("In parentheses, bias: mean of predicted less measured.",),
    )


def tabulate_spread(result: RecipeEvaluation, axis: str) -> ReportTable:
    """Return how the errors of each model spread over the bins of a property, such as drivers. [kWh]"""
    rows: list[tuple[str, Sequence[float]]] = []
    for recipe in get_recipes(result):
        errors = [each.mae for each in get_bins(result, axis, recipe) if each.mae is not None]
        if len(errors) > 1:
            deciles = quantiles(errors, n=10, method="inclusive")
            figures = (len(errors), min(errors), deciles[0], deciles[4], deciles[8], max(errors))
            rows.append((get_title(result, recipe), figures))
    heads = (f"{AXES[axis]}s", "least", "10 % are below", "half are below", "90 % are below", "most")
    columns = [
        (head, lambda figures, i=i: format_energy(figures[i]) if i else format_count(figures[i]))
        for i, head in enumerate(heads)
    ]
    return tabulate(f"Mean absolute error by {AXES[axis]}, kWh", "model", rows, columns)


def tabulate_reserve(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of the coverage of intervals, and of the buffers that keep rides above their reserve."""
    return keep_filled(
        tabulate_coverage(result),
        tabulate_coverage_unseen(result),
        tabulate_buffers(result),
        tabulate_buffers_by_cluster(result),
    )


def get_coverage(result: RecipeEvaluation) -> dict[str, IntervalCoverage]:
    """Return the coverage of the models that have intervals, in their order."""
    return {recipe: result.coverage[recipe] for recipe in get_recipes(result) if recipe in result.coverage}


def tabulate_coverage(result: RecipeEvaluation) -> ReportTable:
    """Return the share of rides inside their 90 % interval: overall, by cluster of distance, by season."""
    coverage = get_coverage(result)
    distances = list_clusters(result, (each.cluster for each in coverage.values()))
    seasons = dict.fromkeys(season for each in coverage.values() for season in each.season)
    low, high = COVERAGE_RANGE
    note = (
        f"↓ or ↑: outside of {format_percent(low, 0)} to {format_percent(high, 0)} overall, "
        f"or below {format_percent(LEAST_COVERAGE, 0)} in a cluster or season. Width: mean of upper less lower end."
    )
    rows = [(get_title(result, recipe), each) for recipe, each in coverage.items()]
    return tabulate(
        "Rides inside their 90 % prediction interval",
        "model",
        rows,
        [
            ("overall", lambda each: _covered(each.overall, *COVERAGE_RANGE)),
            *((format_cluster(cluster), partial(_show_covered, "cluster", cluster)) for cluster in distances),
            *((season, partial(_show_covered, "season", season)) for season in seasons),
            ("width, kWh", lambda each: format_energy(each.width_kwh)),
        ],
        (note,),
    )


def tabulate_coverage_unseen(result: RecipeEvaluation) -> ReportTable:
    """Return the coverage of intervals by vehicle model, and for unseen cars, dates and vehicle models. [%]"""
    coverage = get_coverage(result)
    keys = [key for key in list_vehicle_models(result) if any(key in each.vehicle_model for each in coverage.values())]

    def show(kind: str, each: IntervalCoverage) -> Cell:
        return _covered(getattr(each, kind), *COVERAGE_RANGE)

    columns: list[tuple[str, Callable[[IntervalCoverage], Cell | str]]] = [
        (get_vehicle_name(key), partial(_show_covered, "vehicle_model", key)) for key in keys
    ]
    columns += [
        (shown.head, partial(show, kind))
        for kind, shown in list_shown(IntervalCoverage).items()
        if any(getattr(each, kind) is not None for each in coverage.values())
    ]
    return tabulate(
        "Rides inside their 90 % prediction interval, by vehicle model and where something is unseen",
        "model",
        [(get_title(result, recipe), each) for recipe, each in coverage.items() if columns],
        columns,
        ("An interval applies to rides like those of its calibration; unseen cars, days and models differ.",),
    )


def tabulate_buffers(result: RecipeEvaluation) -> ReportTable:
    """Return the buffers that keep 95 % and 99 % of rides above their reserve. [kWh]"""

    def make_cell(share: str, recipe: str) -> Cell:
        buffer = result.buffer_kwh[recipe].get(share)
        return Cell(format_energy(buffer), value=buffer)

    recipes = [recipe for recipe in get_recipes(result) if result.buffer_kwh.get(recipe)]
    shares = dict.fromkeys(share for recipe in recipes for share in result.buffer_kwh[recipe])
    columns: list[Column] = [(f"{share} % of rides", partial(make_cell, share)) for share in shares]
    note = (
        f"The company in the paper reached {published.get_statement('buffer').value:g} kWh with the hybrid model with "
        "interaction terms, on other data than these; the paper does not state the share of rides that this covers. "
        "Bold: the least."
    )
    title = "Buffer that keeps rides above their reserve, kWh"
    return tabulate(title, "model", name_recipes(result, recipes), columns, (note,))


def tabulate_buffers_by_cluster(result: RecipeEvaluation) -> ReportTable:
    """Return the buffers of the principal models by distance, for the largest share of rides. [kWh]"""
    every = result.buffer_by_cluster
    buffers = {recipe: every[recipe] for recipe in select_principal(result) if every.get(recipe)}
    most = max((share for of in buffers.values() for row in of.values() for share in row), key=float, default="")
    at = {recipe: {cluster: row.get(most) for cluster, row in of.items()} for recipe, of in buffers.items()}
    columns = [
        (format_cluster(c), lambda recipe, c=c: format_energy(at[recipe].get(c)))
        for c in list_clusters(result, at.values())
    ]
    return tabulate(f"Buffer for {most} % of rides by distance, kWh", "model", name_recipes(result, at), columns)


def _show_covered(kind: str, name: str, each: IntervalCoverage) -> Cell:
    """Return the share of rides of a cluster, a season or a vehicle model inside their interval."""
    return _covered(getattr(each, kind).get(name), LEAST_COVERAGE)


def _covered(share: float | None, least: float, most: float = 1.0) -> Cell:
    """Return a share, marked where it is outside of its limits."""
    mark = "" if share is None or least <= share <= most else " ↓" if share < least else " ↑"
    return Cell(f"{format_percent(share)}{mark}", strong=bool(mark))
