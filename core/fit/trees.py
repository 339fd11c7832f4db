"""Fit boosted trees with scikit-learn, and export them as plain arrays.

The trees are few, small and shrunk. A person can therefore read them, and a few rides cannot determine a leaf. They
explain only the residual of a physical model.
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
"""Fewest rides in a leaf."""
LEARNING_RATE: Final = 0.15
SHRINKAGE: Final = 5.0
"""Shrinkage of a leaf: the number of additional rides with the answer 0."""
_BINS: Final = 63
"""Number of candidate thresholds of each feature."""
_MOST: Final = float(np.finfo(np.float64).max)
"""Replacement for an infinite threshold, which JSON cannot represent: every known value goes left."""


def make_booster(learning_rate: float = LEARNING_RATE, trees: int = TREES) -> HistGradientBoostingRegressor:
    """Return an unfitted estimator of boosted trees: least squares, deterministic, without early stopping.

    Parameters
    ----------
    learning_rate : float
        Factor on the answer of each tree. [1]
    trees : int
        Number of trees.

    Returns
    -------
    HistGradientBoostingRegressor
        Estimator of scikit-learn.
    """
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
    """Return trees that predict a target.

    Parameters
    ----------
    table : (n, features) float
        Features of the rides, NaN where unknown.
    names : tuple of str
        Names of the features. The trees omit features that are unknown in all rides, or equal in all rides.
    target : (n,) float
        Value to predict, relative to the column `per` if that is given.
    weight : (n,) float
        Weight of each ride, inversely proportional to the variance of its error.
    per : str
        Column that multiplies the answer, see `core.models.trees.Trees`.

    Returns
    -------
    Trees
        Trees as plain arrays.
    """
    telling = [i for i in range(len(names)) if _tells(table[:, i])]
    if not telling:
        return make_constant_trees(float(np.average(target, weights=weight)), per)
    coarse = np.column_stack([_coarse(table[:, i]) for i in telling])
    with threadpool_limits(1):
        model = make_booster().fit(coarse, target, sample_weight=weight / weight.mean())
    return export_trees(model, tuple(names[i] for i in telling), per)


def make_constant_trees(answer: float, per: str = "") -> Trees:
    """Return trees without features, which always give the same answer.

    Parameters
    ----------
    answer : float
        Constant answer.
    per : str
        Column that multiplies the answer, see `core.models.trees.Trees`.

    Returns
    -------
    Trees
        Trees with a baseline only.
    """
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
    """Return whether a feature differs between rides."""
    known = column[~np.isnan(column)]
    return len(known) > 0 and (known.min() < known.max() or len(known) < len(column))


def _coarse(column: Floats) -> Floats:
    """Return a feature rounded to at most `_BINS` values, because scikit-learn's binning is slow with weights."""
    known = ~np.isnan(column)
    values = np.unique(np.quantile(column[known], np.linspace(0.0, 1.0, _BINS)))
    rounded = column.copy()
    rounded[known] = values[np.searchsorted((values[1:] + values[:-1]) / 2.0, column[known])]
    return rounded


def export_trees(model: HistGradientBoostingRegressor, features: tuple[str, ...], per: str = "") -> Trees:
    """Return the trees of a fitted estimator, which predict the same values.

    Parameters
    ----------
    model : HistGradientBoostingRegressor
        Estimator fitted to numbers only, without categories.
    features : tuple of str
        Names of its columns.
    per : str
        Column that multiplies the answer, see `core.models.trees.Trees`.

    Returns
    -------
    Trees
        Trees as plain arrays.
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
