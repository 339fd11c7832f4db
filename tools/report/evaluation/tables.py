"""Build the tables of the rides and of the errors: Tables 2 to 11 of the paper, and which models differ."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Final

from socast.core.evaluate.paper import published
from socast.core.evaluate.paper.published import AVERAGE, PHYSICAL, WEIGHTED, PublishedFigure
from socast.core.evaluate.paper.records import DifferenceScore, EstimateTable, EvaluatedTable, Numbers, RecipeEvaluation
from socast.core.stats.multiple_testing import CO_DOMINANCE_MARGIN, SIGNIFICANCE
from socast.tools.report.evaluation.result import (
    Column,
    get_average_error,
    get_recipes,
    get_title,
    get_vehicle_name,
    list_clusters,
    list_vehicle_models,
    name_recipes,
    name_vehicle_models,
)
from socast.tools.report.table import (
    UNKNOWN,
    Cell,
    ReportTable,
    format_cluster,
    format_count,
    format_energy,
    format_percent,
    format_published,
    format_published_share,
    format_signed,
    get_value,
    keep_filled,
    tabulate,
)

INTERVAL_NOTE: Final = (
    "± is half of the 95 % confidence interval; for the average, it is post-stratified by cluster. A "
    "cluster of fewer than 10 rides has no figure."
)
"""Note below tables of errors by cluster."""
WEIGHTED_NOTE: Final = (
    "Weighted average: over vehicle models, by all their rides; the others share the weight of one without a figure "
    "equally. This is the rule of the paper's rows."
)
"""Note below tables that have a weighted row."""
DOMINATES: Final[Mapping[str, str]] = MappingProxyType({"dominates": "●", "dominates_average": "○"})
"""Marks of models that dominate or co-dominate: in the mean over rides, in the average over clusters."""
DOMINATES_NOTE: Final = (
    "●: no model is significantly better by the difference score on the same test rides, and the 95 % interval of the "
    f"difference from the best one ends below {CO_DOMINANCE_MARGIN:.0%} of its error. A single ● in a column marks the "
    "model that dominates; several mark models that co-dominate. ○: the same for the average over clusters instead of "
    "the mean over rides."
)
"""Note that explains the marks `DOMINATES`."""


def tabulate_errors(result: RecipeEvaluation, recipe: str) -> ReportTable:
    """Return the mean absolute errors of a model by vehicle model and cluster, as Tables 5 to 11 of the paper. [kWh]"""
    number_there = published.get_table_number(recipe)
    where = f" (Table {number_there})" if number_there else " (not in the paper)"
    return tabulate_by_cluster(
        result,
        result.mae.get(recipe, {}),
        f"{get_title(result, recipe)}: mean absolute error, kWh{where}",
        partial(published.get_mae, recipe),
        (INTERVAL_NOTE, WEIGHTED_NOTE),
    )


def tabulate_summaries(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables that compare all models: average and relative errors, bias, root mean square and bands."""
    return keep_filled(
        tabulate_average_errors(result),
        tabulate_reductions(result),
        tabulate_relative_errors(result),
        tabulate_bias_and_rmse(result),
        tabulate_bands(result),
    )


def tabulate_average_errors(result: RecipeEvaluation) -> ReportTable:
    """Return the average error of each model on each vehicle model, as Figure 3 of the paper. [kWh]"""

    def make_cell(key: str, recipe: str) -> Cell:
        error = get_average_error(result, recipe, key)
        marks = "".join(mark for score, mark in DOMINATES.items() if recipe in getattr(result, score).get(key, ()))
        theirs = format_published(published.get_mae(recipe, key, AVERAGE))
        return Cell(f"{format_energy(error)} {marks}".rstrip(), theirs, value=error.value)

    notes = ["Bold: the least of its column. ± is half of the 95 % confidence interval."]
    if result.dominates:
        notes.append(DOMINATES_NOTE)
        notes += [_said(result, finding) for finding in published.get_findings("dominates")]
    rows = name_recipes(result, [recipe for recipe in get_recipes(result) if result.mae.get(recipe)])
    title, columns = "Average error over clusters, kWh (Figure 3)", name_vehicle_models(result, make_cell)
    return tabulate(title, "model", rows, columns, tuple(notes))


def tabulate_reductions(result: RecipeEvaluation) -> ReportTable:
    """Return by how much the average error of each model is below that of the basic physical model. [%]"""
    others = {recipe: shares for recipe, shares in result.reduction.items() if recipe != PHYSICAL}
    stated = format_percent(published.get_statement("reduction").value, 2)
    note = (
        f"The paper's percentages are computed from its rounded averages. Its text states {stated} for the "
        "hybrid model with interaction terms, averaged over its four vehicle models."
    )
    heads = [(key, get_vehicle_name(key)) for key in list_vehicle_models(result)]
    title = "Reduction of the average error against the basic physical model"
    return _tabulate_shares(result, title, others, [*heads, (AVERAGE, "average")], published.get_reduction, (note,))


def tabulate_relative_errors(result: RecipeEvaluation) -> ReportTable:
    """Return error over consumption by cluster of distance, as Figure 2 of the paper. [%]"""
    note = (
        "The paper shows these as a curve only. Its figures here are computed from the weighted rows of Tables 4 to 11."
    )
    heads = [(cluster, format_cluster(cluster)) for cluster in list_clusters(result, result.relative.values())]
    title = "Error over consumption, all vehicle models together (Figure 2)"
    return _tabulate_shares(result, title, result.relative, heads, published.get_relative_error, (note,))


def tabulate_bias_and_rmse(result: RecipeEvaluation) -> ReportTable:
    """Return bias and root mean square error of each model on each vehicle model. [kWh]"""

    def make_cell(key: str, recipe: str) -> Cell:
        rmse, bias = (of.get(recipe, {}).get(key) for of in (result.rmse, result.bias))
        return Cell(f"{format_energy(rmse)} ({format_signed(bias)})")

    rows = name_recipes(result, [r for r in get_recipes(result) if result.bias.get(r) or result.rmse.get(r)])
    note = "In parentheses, bias: mean of predicted less measured. A ride counts once for each draw that tests it."
    columns = name_vehicle_models(result, make_cell)
    return tabulate("Root mean square error and bias, kWh", "model", rows, columns, (note,))


def tabulate_bands(result: RecipeEvaluation) -> ReportTable:
    """Return the share of rides that each model predicts within bands of relative error. [%]"""
    heads = {limit: f"within ±{limit} %" for row in result.bands.values() for limit in row}
    title = "Rides predicted within a band around their measured energy"
    return _tabulate_shares(result, title, result.bands, list(heads.items()))


def tabulate_differences(result: RecipeEvaluation, vehicle_model: str) -> ReportTable:
    """Return the difference scores of all pairs of models on a vehicle model. [kWh]"""
    scores = result.difference.get(vehicle_model, {})

    def make_cell(b: str, a: str) -> Cell:
        known = get_difference(scores, a, b)
        if known is None:
            return Cell("" if a == b else UNKNOWN)
        value, p = known
        significant = p is not None and p < SIGNIFICANCE
        return Cell(f"{format_signed(value)}{'*' if significant else ''}", strong=significant)

    compared = list(enumerate(list_compared(result, scores), start=1))
    rows = [(f"{i}  {get_title(result, recipe)}", recipe) for i, recipe in compared]
    columns: list[Column] = [(str(i), partial(make_cell, recipe)) for i, recipe in compared]
    note = f"Row's error less column's, so negative where the row's model is better. * significant, p < {SIGNIFICANCE}."
    return tabulate(f"Difference score, {get_vehicle_name(vehicle_model)}, kWh", "model", rows, columns, (note,))


def list_compared(result: RecipeEvaluation, scores: Mapping[str, DifferenceScore]) -> list[str]:
    """Return the models that are compared with any other."""
    return [a for a in get_recipes(result) if any(get_difference(scores, a, b) for b in get_recipes(result))]


def get_difference(scores: Mapping[str, DifferenceScore], a: str, b: str) -> tuple[float, float | None] | None:
    """Return the error of a model less that of another [kWh], and its p-value; None where the pair is unknown."""
    for key, sign in ((f"{a}|{b}", 1.0), (f"{b}|{a}", -1.0)):
        if key in scores and (value := scores[key].value) is not None:
            return sign * value, scores[key].p
    return None


def _tabulate_shares(
    result: RecipeEvaluation,
    title: str,
    shares: Numbers,
    heads: Sequence[tuple[str, str]],
    paper: Callable[[str, str], float | None] = lambda _recipe, _column: None,
    notes: tuple[str, ...] = (),
) -> ReportTable:
    """Return a table of shares in percent of each model, beside those that follow from the paper."""

    def make_cell(column: str, recipe: str) -> Cell:
        return Cell(format_percent(shares[recipe].get(column)), format_published_share(paper(recipe, column)))

    rows = name_recipes(result, [recipe for recipe in get_recipes(result) if recipe in shares])
    return tabulate(title, "model", rows, [(head, partial(make_cell, column)) for column, head in heads], notes)


def _said(result: RecipeEvaluation, finding: published.PaperFinding) -> str:
    """Return a sentence with a finding of the paper: the vehicle model, the models and what it says of them."""
    key = finding.vehicle_model
    where = "" if key is None else f" on the {published.load_paper().vehicle_models[key].name}"
    return f"The paper{where}: {', '.join(get_title(result, recipe) for recipe in finding.recipes)}: {finding.says}."


MEASURED_BY: Final = MappingProxyType({"vi": "voltage and current", "soc": "state of charge"})
"""Sources of the measured energy of a ride -> their names for readers."""


AVERAGE_NOTE: Final = "* Unweighted mean over the clusters that have a figure."
"""Note below tables that have a column of averages."""


def tabulate_data(result: RecipeEvaluation) -> list[ReportTable]:
    """Return the tables of the rides by cluster of distance, and of their mean consumption, that have a row. [kWh]"""
    consumption = tabulate_by_cluster(
        result, result.consumption, "Mean consumption of a ride, kWh (Table 3)", published.get_consumption
    )
    tested = tabulate_by_cluster(
        result,
        result.test_consumption,
        "Mean consumption of a ride in the test sets, kWh (Table 4)",
        published.get_test_consumption,
        ("± is half of the 95 % confidence interval over the repeated draws.",),
    )
    return keep_filled(tabulate_ride_filter(result), tabulate_rides(result), consumption, tested)


def tabulate_ride_filter(result: RecipeEvaluation) -> ReportTable:
    """Return the number of rides, and how many the filter left out for which reason."""
    about, total = result.about, result.about.rides
    removed, all_rides = (published.get_statement(name).value for name in ("rides_removed", "rides"))
    counts = {"rides": total} | {
        f"left out: {reason.replace('_', ' ')}": count for reason, count in about.unfit.items()
    }
    counts |= {"left out, all": sum(about.unfit.values()) or None, "evaluated": about.fit}
    their_counts = {"rides": format_count(all_rides), "left out, all": format_count(removed)}
    their_shares = {"left out, all": _share(removed, all_rides)}

    def make_share(name: str) -> Cell:
        return Cell("" if name == "rides" else _share(counts[name] or 0, total), their_shares.get(name, ""))

    rows = [(name, name) for name, count in counts.items() if count is not None]
    columns = (
        ("count", lambda name: Cell(format_count(counts[name]), their_counts.get(name, ""))),
        ("share", make_share),
    )
    totals = ("left out, all", "evaluated")
    return tabulate("Rides and the filter (section 3)", "rides", rows, columns, _origin(about), totals=totals)


def tabulate_rides(result: RecipeEvaluation) -> ReportTable:
    """Return the number of rides by vehicle model and cluster of distance, as Table 2 of the paper."""

    def make_cell(cluster: str, key: str) -> Cell:
        theirs = published.get_ride_count(key, cluster)
        return Cell(format_count(result.rides[key].get(cluster)), "" if theirs is None else format_count(theirs.value))

    columns = [*list_clusters(result, result.rides.values()), "total"]
    rows = [(get_vehicle_name(key), key) for key in list_vehicle_models(result) if key in result.rides]
    note = "Table 2 of the paper adds up to the rides before any was removed."
    heads = [(format_head(each), partial(make_cell, each)) for each in columns]
    return tabulate("Rides by distance (Table 2)", "vehicle model", rows, heads, (note,))


def tabulate_by_cluster(
    result: RecipeEvaluation,
    energies: EstimateTable | Numbers,
    title: str,
    paper: Callable[[str, str], PublishedFigure | None],
    notes: tuple[str, ...] = (),
) -> ReportTable:
    """Return a table of energies by vehicle model and cluster of distance. [kWh]

    The table has an average column and a weighted row where the evaluation has figures for them.

    Parameters
    ----------
    paper : callable
        Returns the paper's figure of a vehicle model and a cluster, None where the paper has none.
    """

    def make_cell(cluster: str, key: str) -> Cell:
        value, figure = energies[key].get(cluster), paper(key, cluster)
        if get_value(value) is None and figure is None:
            return Cell("")
        return Cell(format_energy(value), format_published(figure))

    columns = list_clusters(result, energies.values())
    if any(AVERAGE in row for row in energies.values()):
        columns, notes = [*columns, AVERAGE], (AVERAGE_NOTE, *notes)
    rows = [(get_vehicle_name(key), key) for key in (*list_vehicle_models(result), WEIGHTED) if key in energies]
    heads = [(format_head(each), partial(make_cell, each)) for each in columns]
    return tabulate(title, "vehicle model", rows, heads, notes, totals=(get_vehicle_name(WEIGHTED),))


def format_head(column: str) -> str:
    """Return the heading of a column that is a cluster, an average or a total."""
    return {AVERAGE: "average *", "total": "total"}.get(column) or format_cluster(column)


def _share(value: float, total: float | None) -> str:
    """Return a value as a share of the total, `UNKNOWN` where that is unknown."""
    return format_percent(value / total) if total else UNKNOWN


def _origin(about: EvaluatedTable) -> tuple[str, ...]:
    """Return notes on the dates of the rides, the source of their energy, and how test sets were drawn."""
    notes: list[str] = []
    if about.first_date:
        cars = "" if about.vehicles is None else f", {format_count(about.vehicles)} cars"
        notes.append(f"From {about.first_date} to {about.last_date}{cars}.")
    if about.energy_source:
        used = {MEASURED_BY.get(name, name): share for name, share in about.energy_source.items() if share}
        shares = ", ".join(f"{name} {format_percent(share)}" for name, share in used.items())
        notes.append(f"Energy measured by: {shares}.")
    if about.repeats is not None:
        share = format_percent(about.test_share, 0)
        drawn = f"{about.repeats} draws of {share} test rides within each cluster and vehicle model"
        notes.append(f"{drawn}, seed {about.seed}.")
    return tuple(notes)
