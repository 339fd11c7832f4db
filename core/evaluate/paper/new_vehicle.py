"""Evaluate recipes on a vehicle model without training data, and after a few of its rides: section 5.3 of the paper.

With no rides, a recipe's fit over all vehicle models together (`*`) predicts, using the catalogue data of the new one.
The paper also leaves the LEAF out of every training set; `untrained` vehicle models do the same here.
The recipe is then given 1, 3, 10, 30 and 100 rides drawn at random from the new vehicle model, the same for every
learner. The rides of the largest draw are excluded from the test at every point, so all points of a draw cover the same
rides. Intervals cover the variation between draws only.

The benchmark is the fitted physical model, either as trained on the others or refitted with the new rides, whichever
has the smaller error at each point. This choice uses the test errors and so favours the benchmark.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from math import inf
from typing import Any, Final, NamedTuple
from zlib import crc32

import numpy as np

from socast.core.batch import Floats
from socast.core.errors import SettingsError, SocastError
from socast.core.evaluate.paper.published import PHYSICAL, find_paper_key
from socast.core.evaluate.paper.records import LearningPoint, NewVehicleErrors
from socast.core.evaluate.paper.results import HeldOutPredictions, compute_pooled_average, compute_reductions
from socast.core.evaluate.paper.runs import EvaluatedRecipe, FittedModel
from socast.core.evaluate.ride_filter import LEAST_RIDES, SCORED_CLUSTERS, EvaluatedRides
from socast.core.stats.scores import average_over_repeats, compute_group_means
from socast.core.stats.splits import Positions, Split

RIDE_COUNTS: Final = (0, 1, 3, 10, 30, 100)
"""Numbers of rides of the new vehicle model that are used."""
DRAWS: Final = 10
"""Number of random draws."""
BENCHMARK: Final = "fitted_physical"
"""Recipe of the benchmark, and the key of its curve."""
BENCHMARK_UNCHANGED: Final = "fitted_physical_others"
"""Key of the benchmark as trained on the other vehicle models."""
BENCHMARK_REFITTED: Final = "fitted_physical_refitted"
"""Key of the benchmark refitted with the new rides."""


class Learner(NamedTuple):
    """Describe a recipe and the way in which it uses a few rides.

    Parameters
    ----------
    way : {"unchanged", "refitted", "adapted"}
        The rides are ignored; added to the training rides before a new fit; or passed to the recipe's `adapt`.
    """

    name: str
    recipe: EvaluatedRecipe
    way: str


def select_untrained(keys: Collection[str], evaluated: EvaluatedRides) -> tuple[str, ...]:
    """Return the vehicle models whose rides no other vehicle model is predicted from.

    Parameters
    ----------
    keys : collection of str
        Vehicle models of the rides, or of the paper: `nissan-leaf` stands for every LEAF of the catalogue.
    """
    named = {key: [m for m in evaluated.vehicle_models if key in (m, find_paper_key(m))] for key in keys}
    if unknown := [key for key, kinds in named.items() if not kinds]:
        raise SettingsError(
            f"no ride is of vehicle model {unknown[0]!r}, which is to be left out of training; name some of "
            f"{', '.join(evaluated.vehicle_models)}"
        )
    chosen = {name for kinds in named.values() for name in kinds}
    return tuple(name for name in evaluated.vehicle_models if name in chosen)


def split_by_vehicle_model(evaluated: EvaluatedRides, untrained: Collection[str] = ()) -> dict[str, Split]:
    """Return, for each vehicle model, the split that trains on the others and tests on all of its rides.

    Parameters
    ----------
    untrained : collection of str
        Vehicle models that no split trains on, as the paper leaves out the LEAF; they are tested.

    Returns
    -------
    dict of str to Split
        Without the vehicle models that have no others to train on, or too few rides to test.
    """
    trained = np.isin(evaluated.model, [i for i, name in enumerate(evaluated.vehicle_models) if name not in untrained])
    splits = {
        name: Split(np.flatnonzero(trained & (evaluated.model != i)), np.flatnonzero(evaluated.model == i))
        for i, name in enumerate(evaluated.vehicle_models)
        if np.any(evaluated.count()[i, :SCORED_CLUSTERS] >= LEAST_RIDES)
    }
    return {name: split for name, split in splits.items() if len(split.train)}


def compute_tables_12_and_13(
    held: Mapping[str, HeldOutPredictions], evaluated: EvaluatedRides
) -> dict[str, dict[str, NewVehicleErrors]]:
    """Return the errors of each recipe on left-out vehicle models, and their means as `average`."""
    recipes = (
        [r for r in next(iter(held.values())).recipes if all(r in h.recipes for h in held.values())] if held else []
    )
    at = {name: evaluated.vehicle_models.index(name) for name in held}
    means = {r: [compute_pooled_average(held[name], evaluated, r)[at[name]] for name in held] for r in recipes}
    rides_of = [np.flatnonzero(evaluated.model == i) for i in at.values()]
    used = [_average(evaluated.energy[rows], evaluated, rows) for rows in rides_of]
    reduced = compute_reductions(means, list(held))
    tables = {}
    for recipe in recipes:
        rows: dict[str, dict[str, Any]] = {}
        for i, name in enumerate(held):
            error = means[recipe][i]
            rows[name] = {"mae": error, "relative": error / used[i]}
            if PHYSICAL in means:
                rows[name] |= {"basic": means[PHYSICAL][i], "reduction": reduced[recipe][name]}
        mean = {key: float(np.mean([row[key] for row in rows.values()])) for key in next(iter(rows.values()))}
        tables[recipe] = {name: NewVehicleErrors(**row) for name, row in (rows | {"average": mean}).items()}
    return tables


def list_learners(recipes: Mapping[str, EvaluatedRecipe]) -> list[Learner]:
    """Return the benchmark in both ways, and every recipe that can adapt."""
    learners = []
    if BENCHMARK in recipes:
        learners = [
            Learner(BENCHMARK_UNCHANGED, recipes[BENCHMARK], "unchanged"),
            Learner(BENCHMARK_REFITTED, recipes[BENCHMARK], "refitted"),
        ]
    return learners + [Learner(name, recipe, "adapted") for name, recipe in recipes.items() if hasattr(recipe, "adapt")]


def select_ride_counts(rides: int) -> tuple[int, ...]:
    """Return the numbers of rides that leave at least half of the rides for the test.

    Examples
    --------
    >>> select_ride_counts(1000), select_ride_counts(30)
    ((0, 1, 3, 10, 30, 100), (0, 1, 3, 10))
    """
    return tuple(count for count in RIDE_COUNTS if 2 * count <= rides)


def draw_rides(of_model: Positions, name: str, seed: int, number: int) -> list[Positions]:
    """Return rides in random orders: learners get the first ones; those after the largest count are the test."""
    return [np.random.default_rng([seed, crc32(name.encode()), draw]).permutation(of_model) for draw in range(number)]


def plan_learning_curves(
    learners: Sequence[Learner], evaluated: EvaluatedRides, splits: Mapping[str, Split], seed: int
) -> dict[tuple[str, str], Callable[[], Any]]:
    """Return the calls that compute the curves on splits of `split_by_vehicle_model`, by vehicle model and learner."""
    return {
        (name, learner.name): partial(
            compute_learning_curve, learner, evaluated, split, draw_rides(split.test, name, seed, DRAWS)
        )
        for name, split in splits.items()
        for learner in learners
    }


def compute_learning_curve(
    learner: Learner, evaluated: EvaluatedRides, split: Split, orders: Sequence[Positions]
) -> Floats | str:
    """Return the errors of a learner, (draws, counts) [kWh], or the reason why there are none."""
    counts = select_ride_counts(len(split.test))
    test_rides = evaluated.drop_answers()
    try:
        start = learner.recipe.fit(evaluated.rides.iloc[split.train])
        curve = np.empty((len(orders), len(counts)))
        for i, order in enumerate(orders):
            tested = np.sort(order[counts[-1] :])
            for j, count in enumerate(counts):
                model = _train(learner, start, evaluated, split, np.sort(order[:count]))
                error = np.abs(model.predict_energy(test_rides.iloc[tested]) - evaluated.energy[tested])
                curve[i, j] = _average(error, evaluated, tested)
    except SocastError as problem:
        return str(problem)
    return curve


def _train(
    learner: Learner, start: FittedModel, evaluated: EvaluatedRides, split: Split, new: Positions
) -> FittedModel:
    """Return the model of a learner after some rides of the new vehicle model."""
    if learner.way == "unchanged" or not len(new):
        return start
    if learner.way == "refitted":
        return learner.recipe.fit(evaluated.rides.iloc[np.concatenate([split.train, new])])
    adaptable: Any = learner.recipe
    return adaptable.adapt(start, evaluated.rides.iloc[new])


def _average(values: Floats, evaluated: EvaluatedRides, rows: Positions) -> float:
    """Return the mean over clusters of values of rides of one vehicle model."""
    known = ~np.isnan(values)
    enough = evaluated.count()[evaluated.model[rows[0]], :SCORED_CLUSTERS] >= LEAST_RIDES
    means = compute_group_means(values[known], evaluated.cluster[rows[known]], SCORED_CLUSTERS)[enough]
    return float(np.nanmean(means)) if np.any(~np.isnan(means)) else np.nan


def tabulate_learning_curves(
    curves: Mapping[tuple[str, str], Floats | str],
) -> tuple[dict[str, dict[str, list[LearningPoint]]], list[str]]:
    """Return the curves by vehicle model and learner, and notes on those that failed."""
    table: dict[str, dict[str, list[LearningPoint]]] = {}
    notes = []
    for (name, learner), errors in curves.items():
        if isinstance(errors, str):
            notes.append(f"{learner} on a few rides of {name}: {errors}")
            continue
        points = [average_over_repeats(errors[:, j], 0.0) for j in range(errors.shape[1])]
        table.setdefault(name, {})[learner] = [
            LearningPoint(rides=count, mae=point.value, ci95=point.ci95)
            for count, point in zip(RIDE_COUNTS, points, strict=False)
        ]
    return {name: _select_benchmark(rows) | rows for name, rows in table.items()}, notes


def _select_benchmark(rows: Mapping[str, list[LearningPoint]]) -> dict[str, list[LearningPoint]]:
    """Return the benchmark: at each point the smaller error of both ways."""
    if BENCHMARK_UNCHANGED not in rows or BENCHMARK_REFITTED not in rows:
        return {}
    pairs = zip(rows[BENCHMARK_UNCHANGED], rows[BENCHMARK_REFITTED], strict=True)
    return {BENCHMARK: [min(pair, key=lambda point: inf if point.mae is None else point.mae) for pair in pairs]}
