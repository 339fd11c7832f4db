"""Fit boosted trees with scikit-learn's regression trees, and export them as plain arrays.

The trees are few, small and shrunk. A person can therefore read them, and a few rides cannot determine a leaf. They
explain only the residual of a physical model.

Each tree is a `DecisionTreeRegressor`, whose nodes are public (`tree_`). The loop around it is least-squares boosting
(Friedman 2001, algorithm 2) with a ridge on the leaves. Each tree searches its splits among a random part of many rides
(Friedman 2002), so that the time of a fit hardly grows with the rides. Features enter as the number of their bin, so a
threshold between two bins becomes the edge between them, exactly.

References
----------
Friedman, Annals of Statistics 29 (2001) 1189, "Greedy Function Approximation: A Gradient Boosting Machine", DOI
10.1214/aos/1013203451. Friedman, Computational Statistics and Data Analysis 38 (2002) 367, "Stochastic Gradient
Boosting", DOI 10.1016/S0167-9473(01)00065-2. Chen and Guestrin, KDD 2016, eq. (5), on the ridge, DOI
10.1145/2939672.2939785.
"""

from collections.abc import Sequence
from math import ceil
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from socast.core.batch import Floats
from socast.core.models.trees import LEAF, Trees

if TYPE_CHECKING:
    from sklearn.tree import DecisionTreeRegressor

TREES: Final = 40
LEAVES: Final = 12
_LEAST_LEAF_RIDES: Final = 40
"""Fewest rides in a leaf."""
LEARNING_RATE: Final = 0.15
SHRINKAGE: Final = 5.0
"""Shrinkage of a leaf: the number of additional rides with the answer 0."""
_SEARCHED_RIDES: Final = 5000
"""Most rides among which the splits of a tree are searched; all rides determine its answers."""
_BINS: Final = 63
"""Largest number of bins of each feature."""
_MOST: Final = float(np.finfo(np.float64).max)
"""Threshold above every known value, as JSON cannot represent infinity: every known value goes left."""


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

    Notes
    -----
    With residual r and weights w of mean 1, a leaf answers `LEARNING_RATE` times sum(w r) / (sum(w) + `SHRINKAGE`).
    """
    telling = [i for i in range(len(names)) if _tells(table[:, i])]
    edges = [compute_bin_edges(table[:, i]) for i in telling]
    bins = np.column_stack([np.empty((len(table), 0)), *map(assign_bins, table[:, telling].T, edges)])
    baseline = float(np.average(target, weights=weight))
    with threadpool_limits(1):
        grown = boost(bins.astype(np.float32), target - baseline, weight / weight.mean()) if telling else []
    return export_trees(grown, edges, tuple(names[i] for i in telling), baseline, per)


def boost(bins: NDArray[np.float32], target: Floats, weight: Floats) -> "list[tuple[DecisionTreeRegressor, Floats]]":
    """Return boosted trees, each with the answer of every node; fewer than `TREES` where nothing is left to split.

    Parameters
    ----------
    bins : (n, features) float32
        Bin of each feature, NaN where unknown.
    """
    from sklearn.tree import DecisionTreeRegressor  # noqa: PLC0415 - takes a second to import; most recipes have no trees

    left, grown = target.copy(), []
    for number in range(TREES):
        rides = np.arange(len(left))
        if len(left) > _SEARCHED_RIDES:
            rides = np.random.default_rng(number).permutation(rides)[:_SEARCHED_RIDES]
        least = ceil(_LEAST_LEAF_RIDES * len(rides) / len(left))
        tree = DecisionTreeRegressor(max_leaf_nodes=LEAVES, min_samples_leaf=least, random_state=0)
        tree.fit(bins[rides], left[rides], sample_weight=weight[rides])
        if tree.tree_.node_count == 1:
            break
        leaf = tree.tree_.apply(bins)
        count = tree.tree_.node_count
        sums, size = np.bincount(leaf, weight * left, count), np.bincount(leaf, weight, count)
        answer = LEARNING_RATE * sums / (size + SHRINKAGE)
        left -= answer[leaf]
        grown.append((tree, answer))
    return grown


def compute_bin_edges(column: Floats) -> Floats:
    """Return the ascending edges between the bins of a feature, at most `_BINS` - 1.

    The bins hold about the same number of rides. A value on an edge belongs to the bin below.
    """
    known = column[~np.isnan(column)]
    values: Floats = np.unique(np.quantile(known, np.linspace(0.0, 1.0, _BINS)))
    return (values[1:] + values[:-1]) / 2.0


def assign_bins(column: Floats, edges: Floats) -> Floats:
    """Return the bin of each value, from 0; NaN where the value is unknown.

    Examples
    --------
    >>> assign_bins(np.array([1.0, 2.0, 2.5, np.nan]), np.array([2.0])).tolist()
    [0.0, 0.0, 1.0, nan]
    """
    return np.where(np.isnan(column), np.nan, np.searchsorted(edges, column).astype(np.float64))


def _tells(column: Floats) -> bool:
    """Return whether a feature differs between rides."""
    known = column[~np.isnan(column)]
    return len(known) > 0 and (known.min() < known.max() or len(known) < len(column))


def export_trees(
    grown: "Sequence[tuple[DecisionTreeRegressor, Floats]]",
    edges: Sequence[Floats],
    features: tuple[str, ...],
    baseline: float,
    per: str = "",
) -> Trees:
    """Return boosted trees as plain arrays that compare the features themselves in place of their bins."""
    nodes = [tree.tree_ for tree, _ in grown]
    count = [each.node_count for each in nodes]
    roots = np.cumsum([0, *count])[: len(count)]
    shift = np.repeat(roots, count)
    left, right = (_join_trees([getattr(each, name) for each in nodes]) for name in ("children_left", "children_right"))
    leaf = left < 0
    feature = np.where(leaf, LEAF, _join_trees([each.feature for each in nodes])).astype(int).tolist()
    bounds = _join_trees([each.threshold for each in nodes]).tolist()
    missing = _join_trees([each.missing_go_to_left for each in nodes])
    return Trees(
        features=features if grown else (),
        per=per,
        baseline=baseline,
        roots=tuple(roots.tolist()),
        feature=tuple(feature),
        threshold=tuple(
            0.0 if f == LEAF else _find_threshold(b, edges[f]) for f, b in zip(feature, bounds, strict=True)
        ),
        left=tuple(np.where(leaf, 0, left + shift).astype(int).tolist()),
        right=tuple(np.where(leaf, 0, right + shift).astype(int).tolist()),
        missing_left=tuple(np.where(leaf, 0, missing).astype(int).tolist()),
        value=tuple(np.where(leaf, _join_trees([answer for _, answer in grown]), 0.0).tolist()),
    )


def _join_trees(arrays: Sequence[Floats]) -> Floats:
    """Return the arrays of all trees in sequence."""
    return np.concatenate([np.zeros(0), *arrays])


def _find_threshold(bound: float, edges: Floats) -> float:
    """Return the value of a feature that separates bins up to a bound from those above."""
    return float(edges[int(bound)]) if bound < len(edges) else _MOST
