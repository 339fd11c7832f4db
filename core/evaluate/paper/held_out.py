"""What recipes said of rides that were held out, on the same rides for all, and the errors that follow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from core.batch import Floats
from core.evaluate.paper.runs import Prediction
from core.evaluate.ride_filter import CLUSTERS, LEAST_RIDES, SCORED_CLUSTERS, EvaluatedRides
from core.stats.scores import Codes, Estimate, average_over_repeats, combine_strata, compute_group_means

MOST_UNPREDICTED: Final = 0.05
"""Share of the rides for which a recipe may have no prediction before it is left out of the comparison."""


@dataclass(frozen=True)
class HeldOutPredictions:
    """Predictions of every recipe for the same rides, over repeats or folds.

    Parameters
    ----------
    recipes : tuple of str
        Those that can be compared.
    rows : tuple of (n,) int64
        Of each repeat: positions of the rides for which all of them have a prediction.
    energy : dict of str to tuple of (n,) float
        Of each recipe and repeat. [kWh]
    bounds : dict of str to tuple of (2, n) float
        Lower and upper, of recipes that have intervals. [kWh]
    overlap : float
        Rides tested over rides trained on.
    notes : tuple of str
        What was left out, and why.
    """

    recipes: tuple[str, ...]
    rows: tuple[Codes, ...]
    energy: dict[str, tuple[Floats, ...]]
    bounds: dict[str, tuple[Floats, ...]]
    overlap: float
    notes: tuple[str, ...]

    @property
    def pooled(self) -> Codes:
        """Rides of all repeats one after another; one that was drawn twice stands twice."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *self.rows])

    def all_of(self, recipe: str) -> Floats:
        """Return the predictions for the rides of `pooled`. [kWh]"""
        return np.concatenate([np.zeros(0), *self.energy[recipe]])

    def all_bounds(self, recipe: str) -> Floats:
        """Return the bounds for the rides of `pooled`, (2, n). [kWh]"""
        return np.concatenate([np.zeros((2, 0)), *self.bounds[recipe]], axis=1)


def select_comparable(said: Mapping[str, Sequence[Prediction]], rides: int) -> HeldOutPredictions:
    """Return the predictions of those recipes that can be compared, for the rides that all of them predict.

    Parameters
    ----------
    said : mapping of str to sequence of Prediction
        Of each recipe, the repeats in order.
    rides : int
        In the table.
    """
    notes: list[str] = []
    kept: list[str] = []
    for name, predictions in said.items():
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
                notes.append(f"{name}: no prediction for {missing / of:.2%} of the rides; no recipe is judged by these")
    repeats = len(next(iter(said.values()), ()))
    told = [np.all([~np.isnan(said[name][i].energy) for name in kept], axis=0) for i in range(repeats) if kept]
    first = said[kept[0]] if kept else ()
    tested = [len(p.rows) for p in first]
    return HeldOutPredictions(
        recipes=tuple(kept),
        rows=tuple(p.rows[t] for p, t in zip(first, told, strict=True)),
        energy={name: tuple(p.energy[t] for p, t in zip(said[name], told, strict=True)) for name in kept},
        bounds={
            name: tuple(np.array([p.lower, p.upper])[:, t] for p, t in zip(said[name], told, strict=True))
            for name in kept
            if said[name] and all(p.lower is not None for p in said[name])
        },
        overlap=float(np.mean([n / (rides - n) for n in tested])) if tested else np.nan,
        notes=tuple(notes),
    )


def compute_cell_means(held: HeldOutPredictions, judged: EvaluatedRides, values: Sequence[Floats]) -> Floats:
    """Return means by repeat, vehicle model and cluster.

    Parameters
    ----------
    values : sequence of (n,) float
        Of each repeat, of the rides held out.

    Returns
    -------
    (repeats, vehicle models, clusters) float
        Of the clusters that are scored; NaN where the table has too few rides for a figure.
    """
    models, enough = len(judged.vehicle_models), judged.count()[:, :SCORED_CLUSTERS] >= LEAST_RIDES
    found = np.full((len(values), models, SCORED_CLUSTERS), np.nan)
    for repeat, (rows, value) in enumerate(zip(held.rows, values, strict=True)):
        groups = judged.model[rows] * SCORED_CLUSTERS + judged.cluster[rows]
        groups[judged.cluster[rows] >= SCORED_CLUSTERS] = -1
        found[repeat] = np.where(
            enough,
            compute_group_means(value, groups, models * SCORED_CLUSTERS).reshape(models, SCORED_CLUSTERS),
            np.nan,
        )
    return found


def compute_absolute_errors(held: HeldOutPredictions, judged: EvaluatedRides, recipe: str) -> list[Floats]:
    """Return the absolute errors of a recipe, by repeat. [kWh]"""
    return [np.abs(said - judged.energy[rows]) for rows, said in zip(held.rows, held.energy[recipe], strict=True)]


def estimate_cells(means: Floats, overlap: float) -> list[list[Estimate]]:
    """Return estimates over repeats, by vehicle model and cluster, of what `compute_cell_means` gives."""
    _, models, count = means.shape
    return [[average_over_repeats(means[:, m, c], overlap) for c in range(count)] for m in range(models)]


def average_over_clusters(found: list[list[Estimate]]) -> list[Estimate]:
    """Return the post-stratified average over clusters, of each vehicle model."""
    return [combine_strata(row) for row in found]


def average_over_vehicle_models(found: list[list[Estimate]], judged: EvaluatedRides) -> list[Estimate]:
    """Return the mean over vehicle models, weighted by their rides, of each cluster."""
    count = judged.count()
    return [combine_strata([row[c] for row in found], count[:, c].tolist()) for c in range(SCORED_CLUSTERS)]


def tabulate_estimates(found: list[list[Estimate]], judged: EvaluatedRides) -> dict[str, Any]:
    """Return a table of the paper: vehicle model to cluster to figure, `average`, and the row `average_over_vehicle_models`."""
    average = average_over_clusters(found)
    rows: dict[str, Any] = {}
    for model, row, mean in zip(judged.vehicle_models, found, average, strict=True):
        rows[model] = {**_row(row), "average": mean.figures()}
    return rows | {"weighted": _row(average_over_vehicle_models(found, judged))}


def _row(estimates: Sequence[Estimate]) -> dict[str, dict[str, float]]:
    return {name: estimate.figures() for name, estimate in zip(CLUSTERS[:SCORED_CLUSTERS], estimates, strict=True)}
