"""Boosted trees as plain arrays, as a model file holds them, and their prediction.

Each node of a tree compares a feature with a threshold and leads to the left where the feature is at most the
threshold. The values of the leaves reached in all trees are added to the baseline, and the sum is multiplied by a
column. `socast.core.fit.trees` fits the trees.
"""

from collections.abc import Mapping
from functools import cached_property
from math import isfinite
from typing import Any, Final

import msgspec
import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.compiled_cache import njit
from socast.core.errors import ModelError
from socast.core.models.features import Columns

LEAF: Final = -1
"""Feature index of a leaf, which compares nothing."""


class Trees(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, dict=True):
    """Hold boosted regression trees; the nodes of all trees follow one another.

    Parameters
    ----------
    features : tuple of str
        Columns of the ride table, or derived ones, that nodes compare.
    per : str, optional
        Column that the sum is multiplied by; 1 where there is none.
    baseline : float
        Value to which the leaves are added.
    roots : tuple of int
        First node of each tree.
    feature : tuple of int
        Feature that a node compares, an index into `features`; -1 at a leaf.
    threshold : tuple of float
        A node leads to the left where the feature is at most this; 0 at a leaf.
    left, right : tuple of int
        Next node, always of a higher index; 0 at a leaf.
    missing_left : tuple of int
        1 where an unknown (NaN) feature leads to the left, else 0.
    value : tuple of float
        Value of a leaf, 0 elsewhere. [kWh], or [kWh] over the unit of `per`.

    Raises
    ------
    ValueError
        Where the arrays are not trees, so that prediction can rely on them.
    """

    features: tuple[str, ...]
    per: str = ""
    baseline: float
    roots: tuple[int, ...]
    feature: tuple[int, ...]
    threshold: tuple[float, ...]
    left: tuple[int, ...]
    right: tuple[int, ...]
    missing_left: tuple[int, ...]
    value: tuple[float, ...]

    def __post_init__(self) -> None:
        """Refuse arrays that are not trees."""
        nodes = len(self.feature)
        lengths = {len(array) for array in (self.threshold, self.left, self.right, self.missing_left, self.value)}
        if lengths != {nodes}:
            raise ValueError(f"trees of {nodes} nodes with arrays of {sorted(lengths)} numbers: fit the model again")
        if any(not 0 <= root < nodes for root in self.roots):
            raise ValueError(f"trees whose roots are not among their {nodes} nodes: fit the model again")
        for node, (feature, left, right) in enumerate(zip(self.feature, self.left, self.right, strict=True)):
            if feature == LEAF:
                continue
            if not 0 <= feature < len(self.features):
                raise ValueError(f"tree node {node} compares feature {feature} of {len(self.features)}: fit again")
            if not (node < left < nodes and node < right < nodes):
                raise ValueError(
                    f"tree node {node} leads to {left} and {right}, not to later nodes: fit the model again"
                )
        if not all(map(isfinite, (self.baseline, *self.threshold, *self.value))):
            raise ValueError("trees with numbers that are not finite: fit the model again")

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns that it reads, derived ones among them."""
        return (*self.features, self.per) if self.per else self.features

    @cached_property
    def _arrays(self) -> tuple[Ints, Ints, Floats, Ints, Ints, Ints, Floats]:
        """The nodes as arrays for the kernel."""
        return (
            np.array(self.roots, dtype=np.int64),
            np.array(self.feature, dtype=np.int64),
            np.array(self.threshold, dtype=np.float64),
            np.array(self.left, dtype=np.int64),
            np.array(self.right, dtype=np.int64),
            np.array(self.missing_left, dtype=np.int64),
            np.array(self.value, dtype=np.float64),
        )

    def predict(self, columns: Mapping[str, Any]) -> Floats:
        """Return the sum over all trees.

        Parameters
        ----------
        columns : mapping of str to (n,) float
            At least `needs`; trees have a branch for NaN. A `DataFrame` will do.

        Returns
        -------
        (n,) float
            NaN only where `per` is NaN. [kWh]

        Raises
        ------
        ModelError
            Where a column is absent.
        """
        seen = columns if isinstance(columns, Columns) else Columns(columns)
        if missing := [name for name in self.needs if name not in seen]:
            raise ModelError(f"trees: column {missing[0]!r} is missing in the data: make the tables again")
        rows = len(seen[self.needs[0]]) if self.needs else 1
        table = np.empty((rows, len(self.features)))
        for i, name in enumerate(self.features):
            table[:, i] = seen[name]
        total = self.sum_leaves(table)
        return total * seen[self.per] if self.per else total

    def sum_leaves(self, table: Floats) -> Floats:
        """Return the baseline plus the leaves of all trees, before the multiplication by `per`.

        Parameters
        ----------
        table : (n, features) float
            A column for each feature.

        Returns
        -------
        (n,) float
            [kWh], or [kWh] over the unit of `per`.
        """
        total = np.full(len(table), self.baseline)
        _add(total, table, *self._arrays)
        return total


@njit(cache=True)
def _add(
    total: Floats,
    table: Floats,
    roots: Ints,
    feature: Ints,
    threshold: Floats,
    left: Ints,
    right: Ints,
    missing_left: Ints,
    value: Floats,
) -> None:
    """Follow each row through each tree, and add the value of the leaf that it reaches."""
    for row in range(len(table)):
        for root in roots:
            node = root
            while feature[node] >= 0:
                x = table[row, feature[node]]
                goes_left = missing_left[node] == 1 if np.isnan(x) else x <= threshold[node]
                node = left[node] if goes_left else right[node]
            total[row] += value[node]
