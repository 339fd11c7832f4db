"""Which of several effects that fit explains most of days that it was not fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from core.batch import Floats, Ints
from core.diagnose.candidates import Candidates
from core.diagnose.evidence import ClusterSums, Evidence, compute_worst_case_evidence
from core.diagnose.projection import BaseProjection
from core.stats.multiple_testing import adjust_false_discovery

LEAST_LEFT: Final = 0.03
"""Share of a candidate's size that the model must be unable to take up, for it to be told from the model."""
LEAST_GAIN: Final = 0.002
"""Share of the squared error that anything must explain on held-out vehicle-days to be worth its place."""
LEVEL: Final = 0.05
"""Share of false names among those that are significant."""


@dataclass(frozen=True)
class Ranking:
    """What a step of diagnosis found of all candidates.

    Parameters
    ----------
    asked : Asked
    projected : (n, k) float
        Candidates off the model, weighted.
    evidence : Evidence
    left : (k,) float
        Share of each candidate's size that is off the model.
    best : (names,) int64
        For each effect, its variant of most held-out gain; -1 where none can be told from the model.
    q : (names,) float
        Adjusted over effects; NaN where none can be told from the model.
    gains : (clusters, k) float
        Fall of the squared weighted error on held-out vehicle-days, as a share of all of it.
    """

    asked: Candidates
    projected: Floats
    evidence: Evidence
    left: Floats
    best: Ints
    q: Floats
    gains: Floats

    def compute_gain(self, at: int) -> tuple[float, float]:
        """Return the held-out gain of a candidate, and its standard error."""
        return sum_over_clusters(self.gains[:, at])

    def significant(self) -> list[int]:
        """Return the best variants of the effects that are there beyond chance, the surest first.

        Not that of the largest gain: a gain that a few days make is less sure than one of many.
        """
        found = [int(v) for v, q in zip(self.best, self.q, strict=True) if v >= 0 and q < LEVEL]
        return sorted(found, key=lambda v: float(self.evidence.p[v]))


def rank_candidates(
    base: BaseProjection, residual: Floats, asked: Candidates, clusters: Sequence[ClusterSums], off: Floats, seed: int
) -> Ranking:
    """Return what each candidate explains of a residual.

    Parameters
    ----------
    base : Base
    residual : (n,) float
        Weighted, off the model and the effects named so far.
    asked : Asked
    clusters : sequence of Clusters
        Vehicle-days, by which folds are dealt, and others over which errors may depend on each other.
    off : (n, m) float
        Orthonormal basis of the effects named so far.
    seed : int
        Of the dealing into folds.
    """
    projected = base.project_out(asked.columns)
    projected -= off @ (off.T @ projected)
    size = (base.apply_weights(asked.columns) ** 2).sum(axis=0)
    left = np.divide((projected**2).sum(axis=0), size, out=np.zeros(len(size)), where=size > 0.0)
    evidence = compute_worst_case_evidence(residual, projected, asked.sign, clusters, asked.least_coefficients)
    gains = compute_held_out_gains(residual, projected, asked.sign, clusters[0], seed)
    told = left > LEAST_LEFT
    best, p = np.full(len(asked.names), -1, dtype=np.int64), np.full(len(asked.names), np.nan)
    for e in range(len(asked.names)):
        mine = np.flatnonzero((asked.effects == e) & told)
        if len(mine):
            best[e] = mine[np.argmax(gains[:, mine].sum(axis=0))]
            p[e] = combine_by_simes(evidence.p[mine])
    q = np.full(len(p), np.nan)
    q[best >= 0] = adjust_false_discovery(p[best >= 0])
    return Ranking(asked, projected, evidence, left, best, q, gains)


def compute_held_out_gains(
    residual: Floats, candidates: Floats, sign: Ints, clusters: ClusterSums, seed: int
) -> Floats:
    """Return the fall of the squared error by each candidate on vehicle-days that its coefficient was not fitted to.

    Returns
    -------
    (clusters, k) float
        As a share of all squared error. A coefficient of the sign that physics forbids counts as none.

    Notes
    -----
    The model's own terms are projected off over all days at once: refitted without the coldest day, a model
    extrapolates to it, and its failure there would be credited to whatever effect mimics that. `socast add` refits
    everything without the days that it is judged on.
    """
    fold = clusters.assign_folds(seed)
    size = clusters.sum_by_cluster(candidates**2)
    cross = clusters.sum_by_cluster(candidates * residual[:, np.newaxis])
    by_fold = np.eye(int(fold.max()) + 1)[fold].T
    size_rest, cross_rest = size.sum(axis=0) - by_fold @ size, cross.sum(axis=0) - by_fold @ cross
    fitted = np.divide(cross_rest, size_rest, out=np.zeros_like(cross_rest), where=size_rest > 0.0)
    fitted = np.where(sign * fitted < 0.0, 0.0, fitted)[fold]
    return np.asarray((2.0 * fitted * cross - fitted**2 * size) / (residual @ residual))


def combine_by_simes(p: Floats) -> float:
    """Return the probability that several tests of one effect find it by chance (Simes 1986).

    Examples
    --------
    >>> combine_by_simes(np.array([0.02, 0.5, 0.03]))
    0.045
    """
    ordered = np.sort(p)
    return float(np.min(ordered * len(p) / np.arange(1, len(p) + 1)))


def compute_correlation(one: Floats, other: Floats) -> float:
    """Return the correlation of two projected candidates."""
    size = float(np.sqrt((one @ one) * (other @ other)))
    return float(one @ other) / size if size > 0.0 else 0.0


def sum_over_clusters(values: Floats) -> tuple[float, float]:
    """Return the sum over clusters and its standard error."""
    count = len(values)
    spread = float(((values - values.mean()) ** 2).sum()) * count / max(count - 1, 1)
    return float(values.sum()), float(np.sqrt(spread))
