"""Boosted trees fitted by scikit-learn, and taken out of it as plain arrays.

The trees are few, small and shrunk, so that a person can read them and nothing is learned of a few rides: what they are
asked for is only what a model of the physics has left.
"""

from typing import Any, Final

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor
from threadpoolctl import threadpool_limits

from core.batch import Floats
from core.models.trees import LEAF, Trees

TREES: Final = 40
LEAVES: Final = 12
_LEAST_LEAF_RIDES: Final = 40
"""Rides that a leaf stands for, at the least."""
LEARNING_RATE: Final = 0.15
SHRINKAGE: Final = 5.0
"""Rides that a leaf is shrunk by, as if that many had been answered with 0."""
_BINS: Final = 63
"""Thresholds that are tried of each feature."""
_MOST: Final = float(np.finfo(np.float64).max)
"""Stands for an infinite threshold, which no JSON has: all that is known goes left."""


def make_booster(learning_rate: float = LEARNING_RATE, trees: int = TREES) -> HistGradientBoostingRegressor:
    """Return the estimator, unfitted: least squares, without early stopping, the same for the same rides."""
    return HistGradientBoostingRegressor(
        max_iter=trees,
        learning_rate=learning_rate,
        max_leaf_nodes=LEAVES,
        min_samples_leaf=_LEAST_LEAF_RIDES,
        l2_regularization=SHRINKAGE,
        max_bins=_BINS,
        early_stopping=False,
        random_state=0,
    )


def fit_trees(table: Floats, names: tuple[str, ...], target: Floats, weight: Floats, per: str = "") -> Trees:
    """Return trees that answer with the target.

    Parameters
    ----------
    table : (n, features) float
        NaN where unknown.
    names : tuple of str
        Of the features. Those that tell nothing, as they are unknown or the same in all rides, are left out.
    target : (n,) float
        What to answer; of `per`, where that is given.
    weight : (n,) float
        Of each ride, over its error's variance.
    per : str
        See `core.models.trees.Trees`.
    """
    telling = [i for i in range(len(names)) if _tells(table[:, i])]
    if not telling:
        return make_constant_trees(float(np.average(target, weights=weight)), per)
    coarse = np.column_stack([_coarse(table[:, i]) for i in telling])
    with threadpool_limits(1):
        model = make_booster().fit(coarse, target, sample_weight=weight / weight.mean())
    return export_trees(model, tuple(names[i] for i in telling), per)


def make_constant_trees(answer: float, per: str = "") -> Trees:
    """Return trees that ask nothing."""
    none: tuple[Any, ...] = ()
    return Trees(
        features=none,
        per=per,
        baseline=answer,
        roots=none,
        feature=none,
        threshold=none,
        left=none,
        right=none,
        missing_left=none,
        value=none,
    )


def _tells(column: Floats) -> bool:
    """Tell whether a feature differs between rides."""
    known = column[~np.isnan(column)]
    return len(known) > 0 and (known.min() < known.max() or len(known) < len(column))


def _coarse(column: Floats) -> Floats:
    """Return a feature rounded to one of at most `BINS` values: where scikit-learn bins it, weights make that slow."""
    known = ~np.isnan(column)
    values = np.unique(np.quantile(column[known], np.linspace(0.0, 1.0, _BINS)))
    rounded = column.copy()
    rounded[known] = values[np.searchsorted((values[1:] + values[:-1]) / 2.0, column[known])]
    return rounded


def export_trees(model: HistGradientBoostingRegressor, features: tuple[str, ...], per: str = "") -> Trees:
    """Return the trees of a fitted estimator, whose predictions they repeat.

    Parameters
    ----------
    model : HistGradientBoostingRegressor
        Of numbers only, no categories.
    features : tuple of str
        Names of its columns.
    per : str
        See `core.models.trees.Trees`.
    """
    nodes: list[Any] = [stage[0].nodes for stage in model._predictors]  # noqa: SLF001 - there is no public way
    roots = np.cumsum([0, *(len(tree) for tree in nodes[:-1])])
    every = np.concatenate(nodes)
    shift = np.repeat(roots, [len(tree) for tree in nodes])
    leaf = every["is_leaf"].astype(bool)
    return Trees(
        features=features,
        per=per,
        baseline=float(np.ravel(model._baseline_prediction)[0]),  # noqa: SLF001
        roots=tuple(roots.tolist()),
        feature=tuple(np.where(leaf, LEAF, every["feature_idx"]).astype(int).tolist()),
        threshold=tuple(np.where(leaf, 0.0, np.clip(every["num_threshold"], -_MOST, _MOST)).tolist()),
        left=tuple(np.where(leaf, 0, every["left"] + shift).astype(int).tolist()),
        right=tuple(np.where(leaf, 0, every["right"] + shift).astype(int).tolist()),
        missing_left=tuple(np.where(leaf, 0, every["missing_go_to_left"]).astype(int).tolist()),
        value=tuple(np.where(leaf, every["value"], 0.0).tolist()),
    )
