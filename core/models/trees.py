"""Boosted trees as plain arrays: what a model file holds of them, and their prediction.

A tree asks at each node whether a feature is at most a threshold, and goes left where it is. The answers of all trees
are added to the baseline, and the sum is multiplied with a column. Fitting is `core.fit.trees`.
"""

from collections.abc import Mapping
from functools import cached_property
from math import isfinite
from typing import Any, Final

import msgspec
import numpy as np
from numba import njit

from core.batch import Floats, Ints
from core.errors import ModelError
from core.models.features import Columns

LEAF: Final = -1
"""Feature of a node that asks nothing."""


class Trees(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, dict=True):
    """Boosted regression trees; the nodes of all trees one after the other.

    Parameters
    ----------
    features : tuple of str
        Columns of the ride table, or derived ones, that nodes ask about.
    per : str, optional
        Column that the sum is multiplied with; 1 where there is none.
    baseline : float
        What the trees' answers are added to.
    roots : tuple of int
        First node of each tree.
    feature : tuple of int
        What a node asks about, an index into `features`; -1 at a leaf.
    threshold : tuple of float
        Left where the feature is at most this; 0 at a leaf.
    left, right : tuple of int
        The next node, always further on; 0 at a leaf.
    missing_left : tuple of int
        1 where an unknown (NaN) feature goes left, else 0.
    value : tuple of float
        Answer of a leaf, 0 elsewhere. [kWh], or [kWh] over the unit of `per`.

    Raises
    ------
    ValueError
        Where the arrays are no trees: prediction may then trust them.
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
        """Refuse arrays that are no trees."""
        nodes = len(self.feature)
        lengths = {len(array) for array in (self.threshold, self.left, self.right, self.missing_left, self.value)}
        if lengths != {nodes}:
            raise ValueError(f"trees of {nodes} nodes with arrays of {sorted(lengths)} numbers: fit the model anew")
        if any(not 0 <= root < nodes for root in self.roots):
            raise ValueError(f"trees whose roots are not among their {nodes} nodes: fit the model anew")
        for node, (feature, left, right) in enumerate(zip(self.feature, self.left, self.right, strict=True)):
            if feature == LEAF:
                continue
            if not 0 <= feature < len(self.features):
                raise ValueError(f"tree node {node} asks about feature {feature} of {len(self.features)}: fit anew")
            if not (node < left < nodes and node < right < nodes):
                raise ValueError(f"tree node {node} leads to {left} and {right}, not further on: fit the model anew")
        if not all(map(isfinite, (self.baseline, *self.threshold, *self.value))):
            raise ValueError("trees with numbers that are not finite: fit the model anew")

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns that it reads, derived ones among them."""
        return (*self.features, self.per) if self.per else self.features

    @cached_property
    def _arrays(self) -> tuple[Ints, Ints, Floats, Ints, Ints, Ints, Floats]:
        """The nodes, for the kernel."""
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
        """Return the sum of the trees' answers.

        Parameters
        ----------
        columns : mapping of str to (n,) float
            At least `needs`; NaN is an answer of its own. A `DataFrame` will do.

        Returns
        -------
        (n,) float
            NaN only where `per` is. [kWh]

        Raises
        ------
        ModelError
            Where a column is absent.
        """
        seen = columns if isinstance(columns, Columns) else Columns(columns)
        if missing := [name for name in self.needs if name not in seen]:
            raise ModelError(f"trees: column {missing[0]!r} is missing in the data: make the tables anew")
        rows = len(seen[self.needs[0]]) if self.needs else 1
        table = np.empty((rows, len(self.features)))
        for i, name in enumerate(self.features):
            table[:, i] = seen[name]
        total = self.answer(table)
        return total * seen[self.per] if self.per else total

    def answer(self, table: Floats) -> Floats:
        """Return the sum of the trees' answers, (n,), before it is multiplied; `table` has a column a feature."""
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
    """Walk each row down each tree, and add what it is answered."""
    for row in range(len(table)):
        for root in roots:
            node = root
            while feature[node] >= 0:
                x = table[row, feature[node]]
                goes_left = missing_left[node] == 1 if np.isnan(x) else x <= threshold[node]
                node = left[node] if goes_left else right[node]
            total[row] += value[node]
