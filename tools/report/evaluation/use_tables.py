"""Build the tables for users of a model: errors by condition, prediction intervals, and the reserve it needs."""

from collections.abc import Mapping
from statistics import quantiles
from types import MappingProxyType
from typing import Final

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.records import BinErrors, IntervalCoverage, RecipeEvaluation
from socast.core.formatting import format_range
from socast.core.records import list_shown
from socast.tools.report.cells import (
    Cell,
    ReportTable,
    Row,
    format_cluster,
    format_count,
    format_energy,
    format_percent,
    format_signed,
    mark_least,
)
from socast.tools.report.evaluation.result import (
    get_recipes,
    get_title,
    get_vehicle_name,
    list_clusters,
    list_vehicle_models,
    select_principal,
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
    axes = [axis for axis in AXES if result.by.get(axis)]
    tables = [
        tabulate_spread(result, axis)
        if len(list_bins(result, axis)) > MANY_BINS
        else tabulate_errors_by_bin(result, axis)
        for axis in axes
    ]
    return [table for table in tables if table.rows]


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
    rows = tuple(
        Row(
            format_bin(axis, label),
            (Cell(_rides(by_recipe, label)), *(_error_and_bias(bins.get(label)) for bins in by_recipe.values())),
        )
        for label in list_bins(result, axis)
    )
    heads = ("predictions", *(get_title(result, recipe) for recipe in by_recipe))
    note = "In parentheses, bias: mean of predicted less measured."
    return ReportTable(
        f"Mean absolute error by {AXES[axis]}, kWh", f"{AXES[axis]}{UNITS.get(axis, '')}", heads, rows, (note,)
    )


def tabulate_spread(result: RecipeEvaluation, axis: str) -> ReportTable:
    """Return how the errors of each model spread over the bins of a property, such as drivers. [kWh]"""
    rows = []
    for recipe in get_recipes(result):
        errors = [each.mae for each in get_bins(result, axis, recipe) if each.mae is not None]
        if len(errors) > 1:
            deciles = quantiles(errors, n=10, method="inclusive")
            figures = (min(errors), deciles[0], deciles[4], deciles[8], max(errors))
            rows.append(
                Row(
                    get_title(result, recipe),
                    (Cell(format_count(len(errors))), *(Cell(format_energy(f)) for f in figures)),
                )
            )
    heads = (f"{AXES[axis]}s", "least", "10 % are below", "half are below", "90 % are below", "most")
    return ReportTable(f"Mean absolute error by {AXES[axis]}, kWh", "model", heads, tuple(rows))


def tabulate_reserve(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of the coverage of intervals, and of the buffers that keep rides above their reserve."""
    tables = (
        tabulate_coverage(result),
        tabulate_coverage_unseen(result),
        tabulate_buffers(result),
        tabulate_buffers_by_cluster(result),
    )
    return [table for table in tables if table.rows]


def get_coverage(result: RecipeEvaluation) -> dict[str, IntervalCoverage]:
    """Return the coverage of the models that have intervals, in their order."""
    return {recipe: result.coverage[recipe] for recipe in get_recipes(result) if recipe in result.coverage}


def tabulate_coverage(result: RecipeEvaluation) -> ReportTable:
    """Return the share of rides inside their 90 % interval: overall, by cluster of distance, by season."""
    coverage = get_coverage(result)
    distances = list_clusters(result, (each.cluster for each in coverage.values()))
    seasons = list(dict.fromkeys(season for each in coverage.values() for season in each.season))
    rows = tuple(
        Row(
            get_title(result, recipe),
            (
                _covered(each.overall, *COVERAGE_RANGE),
                *(_covered(each.cluster.get(c), LEAST_COVERAGE) for c in distances),
                *(_covered(each.season.get(s), LEAST_COVERAGE) for s in seasons),
                Cell(format_energy(each.width_kwh)),
            ),
        )
        for recipe, each in coverage.items()
    )
    heads = ("overall", *(format_cluster(c) for c in distances), *seasons, "width, kWh")
    low, high = COVERAGE_RANGE
    note = (
        f"↓ or ↑: outside of {format_percent(low, 0)} to {format_percent(high, 0)} overall, "
        f"or below {format_percent(LEAST_COVERAGE, 0)} in a cluster or season. Width: mean of upper less lower end."
    )
    return ReportTable("Rides inside their 90 % prediction interval", "model", heads, rows, (note,))


def tabulate_coverage_unseen(result: RecipeEvaluation) -> ReportTable:
    """Return the coverage of intervals by vehicle model, and for unseen cars, dates and vehicle models. [%]"""
    coverage = get_coverage(result)
    keys = [key for key in list_vehicle_models(result) if any(key in each.vehicle_model for each in coverage.values())]
    unseen = {
        kind: shown.head
        for kind, shown in list_shown(IntervalCoverage).items()
        if any(getattr(each, kind) is not None for each in coverage.values())
    }
    rows = tuple(
        Row(
            get_title(result, recipe),
            (
                *(_covered(each.vehicle_model.get(key), LEAST_COVERAGE) for key in keys),
                *(_covered(getattr(each, kind), *COVERAGE_RANGE) for kind in unseen),
            ),
        )
        for recipe, each in coverage.items()
    )
    heads = (*(get_vehicle_name(key) for key in keys), *unseen.values())
    return ReportTable(
        "Rides inside their 90 % prediction interval, by vehicle model and where something is unseen",
        "model",
        heads,
        rows if heads else (),
        ("An interval applies to rides like those of its calibration; unseen cars, days and models differ.",),
    )


def tabulate_buffers(result: RecipeEvaluation) -> ReportTable:
    """Return the buffers that keep 95 % and 99 % of rides above their reserve. [kWh]"""
    buffers = {recipe: result.buffer_kwh[recipe] for recipe in get_recipes(result) if result.buffer_kwh.get(recipe)}
    shares = list(dict.fromkeys(share for row in buffers.values() for share in row))
    values = [[row.get(share) for row in buffers.values()] for share in shares]
    columns = [mark_least([Cell(format_energy(value)) for value in column], column) for column in values]
    rows = tuple(Row(get_title(result, recipe), tuple(c[i] for c in columns)) for i, recipe in enumerate(buffers))
    statement = published.get_statement("buffer")
    note = (
        f"The company in the paper reached {statement.value:g} kWh with the hybrid model with interaction "
        "terms, on other data than these; the paper does not state the share of rides that this covers. "
        "Bold: the least."
    )
    heads = tuple(f"{share} % of rides" for share in shares)
    return ReportTable("Buffer that keeps rides above their reserve, kWh", "model", heads, rows, (note,))


def tabulate_buffers_by_cluster(result: RecipeEvaluation) -> ReportTable:
    """Return the buffers of the principal models by distance, for the largest share of rides. [kWh]"""
    every = result.buffer_by_cluster
    buffers = {recipe: every[recipe] for recipe in select_principal(result) if every.get(recipe)}
    most = max((share for of in buffers.values() for row in of.values() for share in row), key=float, default="")
    at = {recipe: {cluster: row.get(most) for cluster, row in of.items()} for recipe, of in buffers.items()}
    distances = list_clusters(result, at.values())
    rows = tuple(
        Row(get_title(result, recipe), tuple(Cell(format_energy(row.get(c))) for c in distances))
        for recipe, row in at.items()
    )
    heads = tuple(format_cluster(c) for c in distances)
    return ReportTable(f"Buffer for {most} % of rides by distance, kWh", "model", heads, rows)


def _rides(by_recipe: Mapping[str, Mapping[str, BinErrors]], label: str) -> str:
    """Return the number of predictions in a bin, from the first model that states it."""
    return format_count(next((entries[label].n for entries in by_recipe.values() if label in entries), None))


def _error_and_bias(entry: BinErrors | None) -> Cell:
    """Return a cell with a mean absolute error, and the bias in parentheses."""
    return Cell("" if entry is None else f"{format_energy(entry.mae)} ({format_signed(entry.bias)})")


def _covered(share: float | None, least: float, most: float = 1.0) -> Cell:
    """Return a share, marked where it is outside of its limits."""
    mark = "" if share is None or least <= share <= most else " ↓" if share < least else " ↑"
    return Cell(f"{format_percent(share)}{mark}", strong=bool(mark))
