"""A vehicle model that was never seen: trained on all others, and then shown a few rides, section 5.3 of the paper.

At no rides a recipe's fit over all vehicle models together (`*`) predicts, with the new one's own figures from the
catalogue. Then it is shown 1, 3, 10, 30 and 100 rides, drawn at random from those of the new vehicle model, the same
ones for every learner; the rides of the largest draw are kept out of the test at every point, so that all points of a
draw are of the same rides. The intervals are over draws alone.

The line to beat is the fitted physical model: as trained on the others, or refitted with the new rides among them,
whichever is better at each point. That is chosen with hindsight, in its favour.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, NamedTuple, Protocol
from zlib import crc32

import numpy as np
import pandas as pd

from core.batch import Floats
from core.errors import SocastError
from core.evaluate.paper.held_out import HeldOutPredictions
from core.evaluate.paper.results import REFERENCE, compute_pooled_average, compute_reductions
from core.evaluate.paper.runs import EvaluatedRecipe, FittedModel
from core.evaluate.ride_filter import LEAST_RIDES, SCORED_CLUSTERS, EvaluatedRides
from core.stats.scores import average_over_repeats, compute_group_means
from core.stats.splits import Positions, Split

RIDE_COUNTS: Final = (0, 1, 3, 10, 30, 100)
"""Rides of the new vehicle model that are shown."""
DRAWS: Final = 10
"""How often they are drawn anew."""
BENCHMARK: Final = "fitted_physical"
"""Recipe of the line to beat, and that line."""
BENCHMARK_UNCHANGED: Final = "fitted_physical_others"
"""It as it was trained on the others, whatever is shown."""
BENCHMARK_REFITTED: Final = "fitted_physical_refitted"
"""It refitted with the new rides among those of the others."""


class Adaptable(Protocol):
    """A recipe whose models can be told of a few rides of a vehicle model that they do not know."""

    def adapt(self, model: Any, rides: pd.DataFrame) -> FittedModel:
        """Return the model, changed as these rides suggest."""


class Learner(NamedTuple):
    """Who learns from a few rides, and how.

    Parameters
    ----------
    name : str
        In results.
    recipe : Fittable
    way : {"unchanged", "refitted", "adapted"}
        The rides are ignored; added to those of the others and all fitted anew; or given to the recipe's `adapt`.
    """

    name: str
    recipe: EvaluatedRecipe
    way: str


def split_by_vehicle_model(judged: EvaluatedRides) -> dict[str, Split]:
    """Return, for each vehicle model, the split that trains on all others; none where there are no others."""
    if len(judged.vehicle_models) < 2:
        return {}
    return {
        name: Split(np.flatnonzero(judged.model != i), np.flatnonzero(judged.model == i))
        for i, name in enumerate(judged.vehicle_models)
        if np.any(judged.count()[i, :SCORED_CLUSTERS] >= LEAST_RIDES)
    }


def compute_tables_12_and_13(
    held: Mapping[str, HeldOutPredictions], judged: EvaluatedRides
) -> dict[str, dict[str, dict[str, float]]]:
    """Return, of each recipe and left-out vehicle model, `mae`, `relative`, `basic` and `reduction`, and their means.

    Parameters
    ----------
    held : mapping of str to HeldOut
        By vehicle model left out: what was predicted of its rides.
    judged : Judged
    """
    recipes = (
        [r for r in next(iter(held.values())).recipes if all(r in h.recipes for h in held.values())] if held else []
    )
    at = {name: judged.vehicle_models.index(name) for name in held}
    means = {r: [compute_pooled_average(held[name], judged, r)[at[name]] for name in held] for r in recipes}
    used = [_consumption(judged, i) for i in at.values()]
    reduced = compute_reductions(means, list(held))
    found: dict[str, dict[str, dict[str, float]]] = {}
    for recipe in recipes:
        rows = {}
        for i, name in enumerate(held):
            figures = {"mae": means[recipe][i], "relative": means[recipe][i] / used[i]}
            if REFERENCE in means:
                figures |= {"basic": means[REFERENCE][i], "reduction": reduced[recipe][name]}
            rows[name] = figures
        keys = next(iter(rows.values()))
        found[recipe] = rows | {"average": {key: float(np.mean([row[key] for row in rows.values()])) for key in keys}}
    return found


def _consumption(judged: EvaluatedRides, model: int) -> float:
    """Return the mean energy of a ride, averaged over the clusters that are scored. [kWh]"""
    own = judged.model == model
    means = compute_group_means(judged.energy[own], judged.cluster[own], SCORED_CLUSTERS)
    return float(means[judged.count()[model, :SCORED_CLUSTERS] >= LEAST_RIDES].mean())


def list_learners(recipes: Mapping[str, EvaluatedRecipe]) -> list[Learner]:
    """Return who takes part: the line to beat in both ways, and every recipe that can adapt."""
    found = []
    if BENCHMARK in recipes:
        found = [
            Learner(BENCHMARK_UNCHANGED, recipes[BENCHMARK], "unchanged"),
            Learner(BENCHMARK_REFITTED, recipes[BENCHMARK], "refitted"),
        ]
    return found + [Learner(name, recipe, "adapted") for name, recipe in recipes.items() if hasattr(recipe, "adapt")]


def select_ride_counts(rides: int) -> tuple[int, ...]:
    """Return how many rides are shown, so that at least half of them are left to test on.

    >>> select_ride_counts(1000), select_ride_counts(30)
    ((0, 1, 3, 10, 30, 100), (0, 1, 3, 10))
    """
    return tuple(count for count in RIDE_COUNTS if 2 * count <= rides)


def draw_rides(own: Positions, name: str, seed: int, number: int) -> list[Positions]:
    """Return rides in random order, of which the first are shown and those after the largest count are tested."""
    return [np.random.default_rng([seed, crc32(name.encode()), draw]).permutation(own) for draw in range(number)]


def plan_learning_curves(
    learners: Sequence[Learner], judged: EvaluatedRides, seed: int
) -> dict[tuple[str, str], Callable[[], Any]]:
    """Return the calls that make the curves, by vehicle model and learner."""
    return {
        (name, learner.name): partial(
            compute_learning_curve, learner, judged, split, draw_rides(split.test, name, seed, DRAWS)
        )
        for name, split in split_by_vehicle_model(judged).items()
        for learner in learners
    }


def compute_learning_curve(
    learner: Learner, judged: EvaluatedRides, split: Split, orders: Sequence[Positions]
) -> Floats | str:
    """Return the errors of a learner, (draws, counts) in kWh, or why there are none.

    Parameters
    ----------
    learner : Learner
    judged : Judged
    split : Split
        Trains on the others, tests on the new vehicle model.
    orders : sequence of (n,) int64
        Of `draw_rides`.
    """
    shown = select_ride_counts(len(split.test))
    asked = judged.questions()
    try:
        start = learner.recipe.fit(judged.rides.iloc[split.train])
        found = np.empty((len(orders), len(shown)))
        for i, order in enumerate(orders):
            tested = np.sort(order[shown[-1] :])
            for j, count in enumerate(shown):
                model = _train(learner, start, judged, split, np.sort(order[:count]))
                error = np.abs(model.predict(asked.iloc[tested]) - judged.energy[tested])
                found[i, j] = _average(error, judged, tested)
    except SocastError as problem:
        return str(problem)
    return found


def _train(learner: Learner, start: FittedModel, judged: EvaluatedRides, split: Split, new: Positions) -> FittedModel:
    """Return a model that was shown some rides."""
    if learner.way == "unchanged" or not len(new):
        return start
    if learner.way == "refitted":
        return learner.recipe.fit(judged.rides.iloc[np.concatenate([split.train, new])])
    adaptable: Any = learner.recipe
    return adaptable.adapt(start, judged.rides.iloc[new])


def _average(error: Floats, judged: EvaluatedRides, tested: Positions) -> float:
    """Return the mean over clusters, of rides of one vehicle model. [kWh]"""
    known = ~np.isnan(error)
    enough = judged.count()[judged.model[tested[0]], :SCORED_CLUSTERS] >= LEAST_RIDES
    means = compute_group_means(error[known], judged.cluster[tested[known]], SCORED_CLUSTERS)[enough]
    return float(np.nanmean(means)) if np.any(~np.isnan(means)) else np.nan


def tabulate_learning_curves(found: Mapping[tuple[str, str], Floats | str]) -> tuple[dict[str, Any], list[str]]:
    """Return the curves by vehicle model and learner, and notes of what failed."""
    table: dict[str, Any] = {}
    notes = []
    for (name, learner), errors in found.items():
        if isinstance(errors, str):
            notes.append(f"{learner} on a few rides of {name}: {errors}")
            continue
        points = [average_over_repeats(errors[:, j], 0.0).figures() for j in range(errors.shape[1])]
        table.setdefault(name, {})[learner] = [
            {"rides": count, "mae": point["value"], "ci95": point["ci95"]}
            for count, point in zip(RIDE_COUNTS, points, strict=False)
        ]
    return {name: _select_benchmark(rows) | rows for name, rows in table.items()}, notes


def _select_benchmark(rows: Mapping[str, list[dict[str, Any]]]) -> dict[str, list[dict[str, Any]]]:
    """Return the line to beat: at each point the better of both ways."""
    if BENCHMARK_UNCHANGED not in rows or BENCHMARK_REFITTED not in rows:
        return {}
    pairs = zip(rows[BENCHMARK_UNCHANGED], rows[BENCHMARK_REFITTED], strict=True)
    return {BENCHMARK: [min(pair, key=lambda point: float(point["mae"])) for pair in pairs]}
