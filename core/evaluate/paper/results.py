"""Collect predictions for held-out rides, the same for all recipes, and tabulate an evaluation from them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

from socast.core.batch import Floats
from socast.core.evaluate.paper.published import PHYSICAL
from socast.core.evaluate.paper.records import DifferenceScore, EstimateTable, EvaluatedTable, Numbers, TestedDifference
from socast.core.evaluate.paper.runs import Prediction
from socast.core.evaluate.records import EstimatedValue, hold_estimate
from socast.core.evaluate.ride_filter import (
    CLUSTERS,
    LEAST_RIDES,
    SCORED_CLUSTERS,
    EvaluatedRides,
    compute_instrument_shares,
)
from socast.core.stats import multiple_testing
from socast.core.stats.scores import Codes, Estimate, average_over_repeats, combine_strata, compute_group_means

MOST_UNPREDICTED: Final = 0.05
"""Share of rides without a prediction above which a recipe is left out of the comparison."""


Measured = TypeVar("Measured")
ALL: Final = "all"
"""Key of all vehicle models together in the difference score."""

Cells = list[list[Estimate]]
"""Estimates by vehicle model and cluster."""


@dataclass(frozen=True)
class HeldOutPredictions:
    """Hold the predictions of every recipe for the same rides, over repeats or folds.

    Parameters
    ----------
    rows : tuple of (n,) int64
        For each repeat the positions of the rides that all recipes predict.
    energy : dict of str to tuple of (n,) float
        Predicted energy by recipe and repeat. [kWh]
    bounds : dict of str to tuple of (2, n) float
        Lower and upper bounds, by recipe with intervals and repeat. [kWh]
    overlap : float
        Number of tested rides over number of training rides.
    notes : tuple of str
        Recipes that were left out, and why; predictions that stopped at the limit of their model.
    """

    recipes: tuple[str, ...]
    rows: tuple[Codes, ...]
    energy: dict[str, tuple[Floats, ...]]
    bounds: dict[str, tuple[Floats, ...]]
    overlap: float
    notes: tuple[str, ...]

    @property
    def pooled(self) -> Codes:
        """Rides of all repeats in sequence; a ride that was drawn twice occurs twice."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *self.rows])

    def all_of(self, recipe: str) -> Floats:
        """Return the predictions for the rides of `pooled`. [kWh]"""
        return np.concatenate([np.zeros(0), *self.energy[recipe]])

    def all_bounds(self, recipe: str) -> Floats:
        """Return the bounds for the rides of `pooled`, (2, n). [kWh]"""
        return np.concatenate([np.zeros((2, 0)), *self.bounds[recipe]], axis=1)

    def measure(self, evaluated: EvaluatedRides, of: Callable[[Floats, Floats], Measured]) -> dict[str, Measured]:
        """Return a measure of the measured and predicted energies of the rides of `pooled`, for each recipe."""
        energy = evaluated.energy[self.pooled]
        return {recipe: of(energy, self.all_of(recipe)) for recipe in self.recipes}


def select_comparable(by_recipe: Mapping[str, Sequence[Prediction]], rides: int) -> HeldOutPredictions:
    """Return the predictions of comparable recipes, for the rides that all of them predict."""
    notes: list[str] = []
    kept: list[str] = []
    for name, predictions in by_recipe.items():
        silent = [np.isnan(p.energy) for p in predictions]
        missing, of = sum(int(s.sum()) for s in silent), sum(len(s) for s in silent)
        if problem := next((p.problem for p in predictions if p.problem), ""):
            notes.append(f"{name}: {problem}")
        elif missing > MOST_UNPREDICTED * of:
            notes.append(
                f"{name}: no prediction for {missing / of:.1%} of the rides, over the limit of {MOST_UNPREDICTED:.0%}"
            )
        else:
            kept.append(name)
            if missing:
                notes.append(
                    f"{name}: no prediction for {missing / of:.2%} of the rides; no recipe is evaluated by these"
                )
            if limited := sum(p.limited for p in predictions):
                notes.append(f"{name}: {word_limited(limited, of)}")
    repeats = len(next(iter(by_recipe.values()), ()))
    predicted = [
        np.all([~np.isnan(by_recipe[name][i].energy) for name in kept], axis=0) for i in range(repeats) if kept
    ]
    first = by_recipe[kept[0]] if kept else ()
    tested = [len(p.rows) for p in first]
    return HeldOutPredictions(
        recipes=tuple(kept),
        rows=tuple(p.rows[t] for p, t in zip(first, predicted, strict=True)),
        energy={name: tuple(p.energy[t] for p, t in zip(by_recipe[name], predicted, strict=True)) for name in kept},
        bounds={
            name: tuple(np.array([p.lower, p.upper])[:, t] for p, t in zip(by_recipe[name], predicted, strict=True))
            for name in kept
            if by_recipe[name] and all(p.lower is not None for p in by_recipe[name])
        },
        overlap=float(np.mean([n / (rides - n) for n in tested])) if tested else np.nan,
        notes=tuple(notes),
    )


def word_limited(limited: int, rides: int) -> str:
    """Return that predictions stopped at the limit of their model."""
    return f"{limited:,} of {rides:,} predictions are more than a ride can take, and count as the limit of the model"


def compute_cell_means(held: HeldOutPredictions, evaluated: EvaluatedRides, values: Sequence[Floats]) -> Floats:
    """Return means by repeat, vehicle model and cluster.

    Returns
    -------
    (repeats, vehicle models, clusters) float
        Means of the scored clusters; NaN where the table has fewer than `LEAST_RIDES` rides.
    """
    models, enough = len(evaluated.vehicle_models), evaluated.count()[:, :SCORED_CLUSTERS] >= LEAST_RIDES
    cells = np.full((len(values), models, SCORED_CLUSTERS), np.nan)
    for repeat, (rows, value) in enumerate(zip(held.rows, values, strict=True)):
        groups = evaluated.model[rows] * SCORED_CLUSTERS + evaluated.cluster[rows]
        groups[evaluated.cluster[rows] >= SCORED_CLUSTERS] = -1
        cells[repeat] = np.where(
            enough,
            compute_group_means(value, groups, models * SCORED_CLUSTERS).reshape(models, SCORED_CLUSTERS),
            np.nan,
        )
    return cells


def compute_absolute_errors(held: HeldOutPredictions, evaluated: EvaluatedRides, recipe: str) -> list[Floats]:
    """Return the absolute errors of a recipe, by repeat. [kWh]"""
    return [
        np.abs(predicted - evaluated.energy[rows])
        for rows, predicted in zip(held.rows, held.energy[recipe], strict=True)
    ]


def estimate_cells(means: Floats, overlap: float) -> Cells:
    """Return estimates over repeats, by vehicle model and cluster, from the means of `compute_cell_means`."""
    _, models, count = means.shape
    return [[average_over_repeats(means[:, m, c], overlap) for c in range(count)] for m in range(models)]


def estimate_held_out(held: HeldOutPredictions, evaluated: EvaluatedRides, values: Sequence[Floats]) -> Cells:
    """Return the means of values of held-out rides, by vehicle model and cluster (Tables 4 to 11)."""
    return estimate_cells(compute_cell_means(held, evaluated, values), held.overlap)


def average_over_clusters(cells: Cells) -> list[Estimate]:
    """Return the post-stratified average over clusters, for each vehicle model."""
    return [combine_strata(row) for row in cells]


def average_over_vehicle_models(cells: Cells, evaluated: EvaluatedRides) -> list[Estimate]:
    """Return the mean over vehicle models for each cluster, weighted as in the paper by all their rides."""
    rides = evaluated.count().sum(axis=1).tolist()
    columns = [[row[c] for row in cells] for c in range(SCORED_CLUSTERS)]
    return [
        combine_strata(column, weigh_vehicle_models(rides, [not isnan(each.value) for each in column]).tolist())
        for column in columns
    ]


def weigh_vehicle_models(rides: Sequence[float], known: Sequence[bool]) -> Floats:
    """Return the weight of each vehicle model in the weighted row of a cluster.

    Returns
    -------
    (vehicle models,) float
        Weights, in rides; 0 where there is no figure. They add up to all rides, unless no vehicle model has a figure.

    Notes
    -----
    The paper prints the weighted rows of Tables 4 to 11 and Figure 2, and not their weights. Its cluster cells
    determine the rule. The weights are constant: a vehicle model weighs by its total of Table 2, in every cluster.
    Where it has no figure in a cluster, the others take equal parts of its weight, so that the weights always add up to
    all rides. The rule has no fitted number. It gives 33 of the 40 printed cells to the last digit, and the other seven
    as exactly as their rounded cells allow.

    Other rules give fewer cells: weights by the rides in the cluster 5, equal weights 7. The same totals give 25 where
    the weight of an absent vehicle model is divided in proportion, and then none of the cluster 20-25 km. With such a
    division no filter of rides can give the rows either: they need 9.1 to 10.6 % of the weight on the Model X, which
    has at most 8.0 % of the rides that remain. Totals without the clusters above 20 or 25 km give the same 33 cells,
    because they differ by 0.03 % at most; the total of Table 2 is the plainest of these.

    Examples
    --------
    >>> weigh_vehicle_models([600, 300, 100], [True, True, False]).tolist()
    [650.0, 350.0, 0.0]
    """
    total, present = np.array(rides, dtype=np.float64), np.array(known, dtype=bool)
    if not present.any():
        return np.zeros(len(total))
    return np.where(present, total + total[~present].sum() / present.sum(), 0.0)


def tabulate_estimates(cells: Cells, evaluated: EvaluatedRides) -> EstimateTable:
    """Return a table of the paper: vehicle model to cluster to figure, with `average`, and the row `weighted`."""
    average = average_over_clusters(cells)
    rows = {
        model: {**_row(row), "average": hold_estimate(mean)}
        for model, row, mean in zip(evaluated.vehicle_models, cells, average, strict=True)
    }
    return rows | {"weighted": _row(average_over_vehicle_models(cells, evaluated))}


def _row(estimates: Sequence[Estimate]) -> dict[str, EstimatedValue]:
    """Return estimates by cluster."""
    return {name: hold_estimate(estimate) for name, estimate in zip(CLUSTERS[:SCORED_CLUSTERS], estimates, strict=True)}


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
    means: Mapping[str, Sequence[float]], vehicle_models: Sequence[str], reference: str = PHYSICAL
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
    ridden, scored, models = {}, {}, len(evaluated.vehicle_models)
    for r in held.recipes:
        errors = compute_absolute_errors(held, evaluated, r)
        each = zip(held.rows, errors, strict=True)
        ridden[r] = np.array([compute_group_means(error, evaluated.model[rows], models) for rows, error in each])
        scored[r] = compute_cell_means(held, evaluated, errors)
    pairs = multiple_testing.list_pairs(held.recipes)
    by_model: list[tuple[dict[Any, Estimate], dict[Any, Estimate]]] = []
    for m in range(models):
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
