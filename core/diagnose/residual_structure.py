"""Measure whether the residual has structure that neither the model nor the selected effects explain.

Four tests look for structure:

- Boosted trees predict the residual from the features of each window, on vehicle-days that they have not seen, before
  and after the effects are selected.
- Plain shapes are tested for significance and for a gain that is not negligible beside that of the selected effects. A
  shape is a carrier (time, distance, speed, braking, ...) times a function of a feature (temperature, sun, rain, ...).
- In place of each selected effect, a similar plain shape may explain clearly more; the effect may then be a proxy.
- Vehicle-days may differ from each other by more than chance, because a property of the day is unknown, such as the
  state of the road.
"""

from typing import Final, NamedTuple

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from socast.core.batch import Floats, Ints
from socast.core.diagnose.dataset import Windows
from socast.core.diagnose.gains import LEAST_GAIN, LEAST_LEFT, compute_window_gains, explain_by_columns
from socast.core.diagnose.plain_shapes import build_plain_shapes, compute_window_sun_sine
from socast.core.diagnose.selection import MissingEffect, Selection
from socast.core.fit.ride_blocks import get_numbers
from socast.core.stats.clustered import sum_over_clusters
from socast.core.stats.evidence import ClusterSums
from socast.core.stats.multiple_testing import adjust_false_discovery
from socast.core.stats.scores import Estimate

LEAST_TAKEN: Final = 0.8
"""Share of what trees can predict that the selected effects must explain for no structure to remain."""
LEVEL: Final = 0.03
"""Probability below which a shape is significant."""
LIKE: Final = 0.4
"""Correlation above which a shape is similar to a selected effect."""
CLEARLY: Final = 3.0
"""Standard errors by which a shape must explain more than an effect to cast doubt on it."""
SURE: Final = 2.0
"""Standard errors by which the share that trees predict, or that a shape explains, must exceed zero."""
LEAST_PREDICTED: Final = 0.005
"""Share of the squared error that trees must predict for it to count."""
SURE_OF_DAYS: Final = 3.0
"""Standard errors by which vehicle-days must differ more than by chance."""
UNEVEN: Final = 1.3
"""Least ratio of the variance of days to that of chance that counts, because real days always differ slightly."""
DAILY: Final = ("duration_s", "effect_rolling", "effect_aero_drag")
"""Carriers by which vehicle-days are compared: time, distance and speed."""
TREE_FOLDS: Final = 4

FEATURES: Final[tuple[tuple[str, str], ...]] = (
    ("ambient_c", "°C"),
    ("average_speed_kmh", "km/h"),
    ("precipitation_mm_h", "mm/h"),
    ("wind_speed_kmh", "km/h"),
    ("soc_start_pct", "%"),
    ("battery_temperature_c", "°C"),
    ("elapsed_s", "s"),
    ("parked_s", "s"),
    ("occupants", "1"),
    ("odometer_km", "km"),
    ("start_s", "s"),
)
"""Features of a window on which an error may depend, with their units."""


class ResidualStructure(NamedTuple):
    """Hold the structure of the residual that remains after the selected effects.

    Parameters
    ----------
    before, after : float
        Share of the squared error that trees predict on held-out vehicle-days, without and with the selected effects.
        [1]
    error : float
        Standard error of `after`. [1]
    explained : float
        Share of the squared error of windows that the selected effects explain on held-out vehicle-days. [1]
    shape, q : str, float
        The significant shape with the largest gain, or else the shape with the least probability; its probability,
        adjusted over all shapes. [1]
    gain, gain_error : float
        Its share of the squared error on held-out vehicle-days, and the standard error of this share. [1]
    days : float
        Variance between vehicle-days, over that of chance, along the carrier where it is largest; about 1 or below
        where nothing is missing. [1]
    most_days : float
        Largest such ratio that chance explains. [1]
    better : dict of str to str
        Name of a selected effect -> the plain shape that explains clearly more in its place.
    """

    before: float
    after: float
    error: float
    explained: float
    shape: str
    q: float
    gain: float
    gain_error: float
    days: float
    most_days: float
    better: dict[str, str]

    @property
    def taken(self) -> float:
        """Share of what trees or the strongest shape can explain that the selected effects explain. [1]"""
        by_trees = 1.0 - max(self.after, 0.0) / self.before if self.before > 0.0 and self.is_predictable else 1.0
        by_shape = self.explained / (self.explained + self.gain) if self.has_shape else 1.0
        return max(min(by_trees, by_shape), 0.0)

    @property
    def is_predictable(self) -> bool:
        """Whether trees predict any of the residual after the effects are selected."""
        return self.after > max(LEAST_PREDICTED, SURE * self.error)

    @property
    def has_shape(self) -> bool:
        """Whether a plain shape is significant, and explains a certain share on held-out days."""
        return self.q < LEVEL and self.gain > max(LEAST_GAIN, SURE * self.gain_error)

    @property
    def exists(self) -> bool:
        """Whether the residual has structure."""
        return bool(self.signs)

    @property
    def signs(self) -> list[str]:
        """Evidence for structure: `trees`, `shape`, `better`, `days`."""
        return [
            *(["trees"] if self.is_predictable and self.taken < LEAST_TAKEN else []),
            *(["shape"] if self.has_shape and self.taken < LEAST_TAKEN else []),
            *(["better"] if self.better else []),
            *(["days"] if self.days > self.most_days else []),
        ]


def measure_residual_structure(selection: Selection) -> ResidualStructure:
    """Return the structure that remains after what is named."""
    base, clusters, missing = selection.base, selection.clusters, selection.effects
    off = selection.build_basis()
    left = selection.compute_residual(off)
    features = collect_features(base.windows)
    before = compute_predictable_share(features, base.residual, clusters[0], selection.seed)
    after = compute_predictable_share(features, left, clusters[0], selection.seed) if missing else before
    shapes = PlainShapes(selection)
    explained = float((base.residual**2 - selection.compute_held_out_residual(off) ** 2).sum())
    share = max(explained / max(float(base.residual @ base.residual), 1e-300), 0.0)
    better = {each.effect: shape for each in missing if (shape := shapes.find_replacement(each))}
    shape, q, gain = shapes.find_strongest(off, left)
    days = compute_day_variance_ratio(selection, left)
    most = max(1.0 + SURE_OF_DAYS * float(np.sqrt(2.0 / clusters[0].count)), UNEVEN)
    return ResidualStructure(
        before.value, after.value, after.error, share, shape, q, gain.value, gain.error, days, most, better
    )


def collect_features(windows: Windows) -> Floats:
    """Return the features of each window and the elevation of the sun, NaN where unknown, (n, features)."""
    table = windows.table
    columns = [get_numbers(table, name) for name, _ in FEATURES]
    return np.column_stack([*columns, compute_window_sun_sine(windows)])


def compute_predictable_share(features: Floats, left: Floats, clusters: ClusterSums, seed: int) -> Estimate:
    """Return the share of a squared residual that trees predict on held-out days. [1]"""
    fold = clusters.assign_folds(seed)[clusters.code] % TREE_FOLDS
    predicted = np.zeros(len(left))
    for k in range(int(fold.max()) + 1):
        there = np.isfinite(features[fold != k]).any(axis=0)
        trees = HistGradientBoostingRegressor(
            max_iter=30, learning_rate=0.1, max_leaf_nodes=8, min_samples_leaf=60, l2_regularization=20.0
        )
        predicted[fold == k] = trees.fit(features[fold != k][:, there], left[fold != k]).predict(
            features[fold == k][:, there]
        )
    return sum_over_clusters(
        clusters.sum_by_cluster(left**2 - (left - predicted) ** 2) / max(float(left @ left), 1e-300)
    )


def compute_day_variance_ratio(selection: Selection, left: Floats) -> float:
    """Return the variance between vehicle-days over that of chance, for the carrier where it is largest. [1]

    Notes
    -----
    For a carrier c, the mean over vehicle-days of (sum of c r)^2 / (sum of c^2), over the mean of r^2.
    """
    clusters, table = selection.clusters[0], selection.base.windows.table
    carriers = np.column_stack([np.nan_to_num(get_numbers(table, name), nan=0.0) for name in DAILY])
    weighted = selection.base.apply_weights(carriers)
    size = clusters.sum_by_cluster(weighted**2)
    score = clusters.sum_by_cluster(weighted * left[:, np.newaxis]) ** 2
    ratio = np.divide(score, size, out=np.zeros_like(size), where=size > 0.0)
    return float(ratio.mean(axis=0).max() / max(float(np.mean(left**2)), 1e-300))


class PlainShapes:
    """Test plain shapes, off the terms of a model.

    Parameters
    ----------
    selection : Selection
        A selection of effects on the windows of the shapes.
    """

    def __init__(self, selection: Selection) -> None:
        self.selection = selection
        shapes = build_plain_shapes(selection.base)
        self.names, self.projected = shapes.names, shapes.columns

    def find_strongest(self, off: Floats, left: Floats) -> tuple[str, float, Estimate]:
        """Return the significant shape with the largest gain on a residual, its q, and its gain."""
        shapes, free = self._off(off)
        if not len(free):
            return "", 1.0, Estimate(0.0, 0.0, np.inf)
        either = np.zeros(len(free), dtype=np.int64)
        clusters, seed = self.selection.clusters, self.selection.seed
        evidence, gain = explain_by_columns(left, shapes, either, clusters, seed)
        q = adjust_false_discovery(evidence.p)
        best = int(np.argmax(np.where(q < LEVEL, gain, -1.0))) if (q < LEVEL).any() else int(np.argmin(q))
        of_days = compute_window_gains(left, shapes[:, [best]], either[:1], clusters[0], seed)[:, 0]
        return self.names[free[best]], float(q[best]), sum_over_clusters(of_days)

    def find_replacement(self, named: MissingEffect) -> str:
        """Return the shape that explains clearly more than a selected effect in its place, or an empty text."""
        selection = self.selection
        space = selection.build_space(named)
        left = space.residual
        column = space.project_out(named.column)
        shapes, free = self._off(space.basis)
        size = np.sqrt((shapes**2).sum(axis=0) * float((column**2).sum()))
        alike = np.abs(column[:, 0] @ shapes) > LIKE * size
        if not alike.any():
            return ""
        either = np.zeros(int(alike.sum()), dtype=np.int64)
        mine = compute_window_gains(left, column, either[:1], selection.clusters[0], selection.seed)
        more = compute_window_gains(left, shapes[:, alike], either, selection.clusters[0], selection.seed) - mine
        ahead = np.array([each.value / each.error if each.error else 0.0 for each in map(sum_over_clusters, more.T)])
        best = int(np.argmax(ahead))
        return self.names[free[np.flatnonzero(alike)[best]]] if ahead[best] > CLEARLY else ""

    def _off(self, off: Floats) -> tuple[Floats, Ints]:
        """Return the shapes off a basis of effects that are identifiable beside it, and their places."""
        shapes = self.projected - off @ (off.T @ self.projected)
        free = np.flatnonzero((shapes**2).sum(axis=0) > LEAST_LEFT * (self.projected**2).sum(axis=0))
        return shapes[:, free], free
