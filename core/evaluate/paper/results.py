"""Compute the tables of an evaluation from predictions."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats
from socast.core.evaluate.paper.held_out import (
    HeldOutPredictions,
    average_over_clusters,
    average_over_vehicle_models,
    compute_absolute_errors,
    compute_cell_means,
    estimate_cells,
)
from socast.core.evaluate.paper.records import DifferenceScore, EvaluatedTable, Numbers, TestedDifference
from socast.core.evaluate.ride_filter import CLUSTERS, SCORED_CLUSTERS, EvaluatedRides, compute_instrument_shares
from socast.core.stats import multiple_testing
from socast.core.stats.scores import Estimate, average_over_repeats, combine_strata, compute_group_means

REFERENCE: Final = "basic_physical"
"""Recipe to which reductions refer."""
ALL: Final = "all"
"""Key of all vehicle models together in the difference score."""

Cells = list[list[Estimate]]
"""Estimates by vehicle model and cluster."""


class ComparedRecipes(NamedTuple):
    """Hold the differences between recipes, and which recipes dominate: parts of `RecipeEvaluation`."""

    difference: dict[str, dict[str, DifferenceScore]]
    dominates: dict[str, list[str]]
    dominates_average: dict[str, list[str]]


def describe_evaluation(evaluated: EvaluatedRides, seed: int, repeats: int, test_share: float) -> EvaluatedTable:
    """Return which rides were evaluated, and how they were split."""
    dates = evaluated.rides["date"]
    return EvaluatedTable(
        rides=evaluated.read,
        fit=len(evaluated.rides),
        unfit=evaluated.unfit,
        seed=seed,
        repeats=repeats,
        test_share=test_share,
        vehicle_models=list(evaluated.vehicle_models),
        clusters=list(CLUSTERS[:SCORED_CLUSTERS]),
        first_date=str(dates.min()),
        last_date=str(dates.max()),
        energy_source=compute_instrument_shares(evaluated.rides),
        vehicles=evaluated.rides["vehicle_id"].nunique(),
    )


def count_rides(evaluated: EvaluatedRides) -> dict[str, dict[str, int]]:
    """Return the number of rides by vehicle model and cluster, with `total` (Table 2)."""
    return {
        name: {**dict(zip(CLUSTERS, row.tolist(), strict=True)), "total": int(row.sum())}
        for name, row in zip(evaluated.vehicle_models, evaluated.count(), strict=True)
    }


def compute_consumption(evaluated: EvaluatedRides) -> Numbers:
    """Return the mean energy of rides by vehicle model and cluster, with `average` (Table 3). [kWh]"""
    models, many = len(evaluated.vehicle_models), len(CLUSTERS)
    means = compute_group_means(evaluated.energy, evaluated.model * many + evaluated.cluster, models * many)
    return {
        name: {**dict(zip(CLUSTERS, row.tolist(), strict=True)), "average": float(row[~np.isnan(row)].mean())}
        for name, row in zip(evaluated.vehicle_models, means.reshape(models, many), strict=True)
    }


def estimate_consumption(held: HeldOutPredictions, evaluated: EvaluatedRides) -> Cells:
    """Return the mean energy of held-out rides, by vehicle model and cluster (Table 4). [kWh]"""
    energy = [evaluated.energy[rows] for rows in held.rows]
    return estimate_cells(compute_cell_means(held, evaluated, energy), held.overlap)


def estimate_errors(held: HeldOutPredictions, evaluated: EvaluatedRides) -> dict[str, Cells]:
    """Return the mean absolute error of each recipe, by vehicle model and cluster (Tables 5 to 11). [kWh]"""
    return {
        r: estimate_cells(
            compute_cell_means(held, evaluated, compute_absolute_errors(held, evaluated, r)), held.overlap
        )
        for r in held.recipes
    }


def compute_errors_over_consumption(errors: Mapping[str, Cells], used: Cells, evaluated: EvaluatedRides) -> Numbers:
    """Return error over consumption by cluster, over all vehicle models (Figure 2). [1]"""
    means = average_over_vehicle_models(used, evaluated)
    return {
        recipe: {
            name: error.value / mean.value
            for name, error, mean in zip(
                CLUSTERS[:SCORED_CLUSTERS], average_over_vehicle_models(cells, evaluated), means, strict=True
            )
        }
        for recipe, cells in errors.items()
    }


def compute_reductions(
    means: Mapping[str, Sequence[float]], vehicle_models: Sequence[str], reference: str = REFERENCE
) -> Numbers:
    """Return by which share the error of each recipe is below the reference's, and the mean over vehicle models.

    Parameters
    ----------
    means : mapping of str to (vehicle models,) float
        Errors of each recipe. Without the reference the result is empty. [kWh]
    """
    if reference not in means:
        return {}
    errors = np.array(means[reference], dtype=np.float64)
    reductions = {}
    for recipe, values in means.items():
        shares = 1.0 - np.array(values, dtype=np.float64) / errors
        known = shares[~np.isnan(shares)]
        average = float(known.mean()) if len(known) else np.nan
        reductions[recipe] = {**dict(zip(vehicle_models, shares.tolist(), strict=True)), "average": average}
    return reductions


def compare_recipes(held: HeldOutPredictions, evaluated: EvaluatedRides) -> ComparedRecipes:
    """Return the difference scores of each vehicle model and of all together, and which recipes dominate there."""
    ridden = {r: _per_ride(held, evaluated, compute_absolute_errors(held, evaluated, r)) for r in held.recipes}
    scored = {r: compute_cell_means(held, evaluated, compute_absolute_errors(held, evaluated, r)) for r in held.recipes}
    pairs = multiple_testing.list_pairs(held.recipes)
    by_model: list[tuple[dict[Any, Estimate], dict[Any, Estimate]]] = []
    for m in range(len(evaluated.vehicle_models)):
        rides = {(a, b): average_over_repeats(ridden[a][:, m] - ridden[b][:, m], held.overlap) for a, b in pairs}
        average = {
            (a, b): combine_strata(
                [
                    average_over_repeats(scored[a][:, m, c] - scored[b][:, m, c], held.overlap)
                    for c in range(SCORED_CLUSTERS)
                ]
            )
            for a, b in pairs
        }
        by_model.append((rides, average))
    weights = evaluated.count().sum(axis=1).tolist()
    together = (
        {pair: combine_strata([of[0][pair] for of in by_model], weights) for pair in pairs},
        {pair: combine_strata([of[1][pair] for of in by_model]) for pair in pairs},
    )
    result = ComparedRecipes({}, {}, {})
    names = [*evaluated.vehicle_models, ALL]
    for i, (name, (rides, average)) in enumerate(zip(names, [*by_model, together], strict=True)):
        of_model = slice(i, i + 1) if name != ALL else slice(None)
        result.difference[name] = _pairs(rides, average)
        mean = {r: _mean(ridden[r][:, of_model], weights[of_model]) for r in held.recipes}
        result.dominates[name] = multiple_testing.select_dominating(mean, rides)
        mean = {
            r: combine_strata(average_over_clusters(estimate_cells(scored[r][:, of_model], held.overlap))).value
            for r in held.recipes
        }
        result.dominates_average[name] = multiple_testing.select_dominating(mean, average)
    return result


def _per_ride(held: HeldOutPredictions, evaluated: EvaluatedRides, values: Sequence[Floats]) -> Floats:
    """Return means over the rides of each vehicle model, (repeats, vehicle models)."""
    models = len(evaluated.vehicle_models)
    return np.array(
        [
            compute_group_means(value, evaluated.model[rows], models)
            for rows, value in zip(held.rows, values, strict=True)
        ]
    )


def _mean(values: Floats, weights: Sequence[float]) -> float:
    """Return the mean of known values over repeats, then over vehicle models weighted by their rides."""
    parts = [average_over_repeats(values[:, m], 0.0) for m in range(values.shape[1])]
    return combine_strata(parts, weights).value


def _pairs(rides: Mapping[Any, Estimate], average: Mapping[Any, Estimate]) -> dict[str, DifferenceScore]:
    """Return the differences of all pairs, by `a|b`."""
    p, p_average = multiple_testing.adjust_differences(rides), multiple_testing.adjust_differences(average)
    return {
        "|".join(pair): DifferenceScore(
            value=rides[pair].value,
            ci95=rides[pair].ci95,
            p=p[pair],
            average=TestedDifference(value=average[pair].value, ci95=average[pair].ci95, p=p_average[pair]),
        )
        for pair in rides
    }


def compute_pooled_average(held: HeldOutPredictions, evaluated: EvaluatedRides, recipe: str) -> list[float]:
    """Return the error over all folds together, averaged over clusters, for each vehicle model. [kWh]

    A cluster counts where the table has enough rides and the folds held out any of them.
    """
    rows = held.pooled
    error = np.abs(held.all_of(recipe) - evaluated.energy[rows])
    once = HeldOutPredictions(held.recipes, (rows,), {}, {}, held.overlap, ())
    means: Floats = compute_cell_means(once, evaluated, [error])[0]
    return [float(row[~np.isnan(row)].mean()) if np.any(~np.isnan(row)) else np.nan for row in means]
