"""Rank candidate effects by the error that they explain on days to which their coefficients were not fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.diagnose.candidates import Candidates
from socast.core.diagnose.projection import BaseProjection
from socast.core.stats.evidence import ClusterSums, Evidence, compute_worst_case_evidence
from socast.core.stats.held_out_gain import cross_fit, fit_other_folds, measure_gain
from socast.core.stats.multiple_testing import adjust_false_discovery, combine_by_simes
from socast.core.stats.scores import Estimate

LEAST_LEFT: Final = 0.03
"""Share of a candidate's size that the model must be unable to explain for the candidate to be identifiable."""
LEAST_GAIN: Final = 0.002
"""Share of the squared error that an effect must explain on held-out vehicle-days to be reported."""
LEVEL: Final = 0.05
"""Accepted share of false effects among those that are significant."""


@dataclass(frozen=True)
class ResidualSpace:
    """Hold what a model and the effects selected so far leave unexplained.

    Parameters
    ----------
    base : BaseProjection
        Projection off the terms of the model.
    basis : (n, m) float
        Orthonormal basis of the selected effects, off the model. [1]
    residual : (n,) float
        Weighted residual off the model and the selected effects. [1]
    """

    base: BaseProjection
    basis: Floats
    residual: Floats

    def project_out(self, columns: Floats) -> Floats:
        """Return the part of energy columns that neither the model nor the selected effects explain."""
        projected = self.base.project_out(columns)
        projected -= self.basis @ (self.basis.T @ projected)
        return projected


@dataclass(frozen=True)
class Ranking:
    """Hold the evidence and the gain of all candidates in one step of the diagnosis.

    Parameters
    ----------
    projected : (n, k) float
        Weighted candidates off the model. [1 per unit of the coefficient]
    left : (k,) float
        Share of the size of each candidate that is off the model. [1]
    best : (names,) int64
        For each effect, its variant with the largest held-out gain; -1 where none is identifiable.
    q : (names,) float
        Probability adjusted over all effects; NaN where no variant is identifiable. [1]
    """

    candidates: Candidates
    projected: Floats
    evidence: Evidence
    left: Floats
    best: Ints
    q: Floats

    def list_significant(self) -> list[int]:
        """Return the best variants of the significant effects, the most significant first.

        The order is not that of the gain, because a gain on a few days is less certain than one on many days.
        """
        significant = [int(v) for v, q in zip(self.best, self.q, strict=True) if v >= 0 and q < LEVEL]
        return sorted(significant, key=lambda v: float(self.evidence.p[v]))


def rank_candidates(
    space: ResidualSpace, candidates: Candidates, clusters: Sequence[ClusterSums], seed: int
) -> Ranking:
    """Return how much of a residual each candidate explains.

    Parameters
    ----------
    clusters : sequence of ClusterSums
        Vehicle-days first, which define the folds; then other clusterings over which errors may depend on each other.
    """
    projected = space.project_out(candidates.columns)
    size = (space.base.apply_weights(candidates.columns) ** 2).sum(axis=0)
    left = np.divide((projected**2).sum(axis=0), size, out=np.zeros(len(size)), where=size > 0.0)
    evidence, gain = explain_by_columns(
        space.residual, projected, candidates.sign, clusters, seed, candidates.least_coefficients
    )
    identifiable = left > LEAST_LEFT
    count = len(candidates.names)
    best, p = np.full(count, -1, dtype=np.int64), np.full(count, np.nan)
    for e in range(count):
        variants = np.flatnonzero((candidates.effects == e) & identifiable)
        if len(variants):
            best[e] = variants[np.argmax(gain[variants])]
            p[e] = combine_by_simes(evidence.p[variants])
    return Ranking(candidates, projected, evidence, left, best, adjust_false_discovery(p))


def explain_by_columns(
    residual: Floats,
    columns: Floats,
    sign: Ints,
    clusters: Sequence[ClusterSums],
    seed: int,
    least: Floats | None = None,
) -> tuple[Evidence, Floats]:
    """Return the evidence for each of k columns, and its gain on vehicle-days to which it was not fitted, (k,)."""
    evidence = compute_worst_case_evidence(residual, columns, sign, clusters, least)
    return evidence, compute_window_gains(residual, columns, sign, clusters[0], seed).sum(axis=0)


def compute_held_out_gain(
    base: BaseProjection, column: Floats, residual: Floats, limits: tuple[float, float], days: ClusterSums, seed: int
) -> Estimate:
    """Return the gain of a candidate on rides of vehicle-days to which it was not fitted.

    Parameters
    ----------
    column, residual : (n,) float
        Candidate and residual, weighted and off what it is tested beside.
    """
    after = residual - column * cross_fit(column, residual, days.assign_folds(seed)[days.code], limits)
    before, then = (base.windows.by_ride(base.convert_to_energy(values)) for values in (residual, after))
    return measure_gain(before, then, base.windows.day_of_ride)


def compute_window_gains(residual: Floats, columns: Floats, sign: Ints, clusters: ClusterSums, seed: int) -> Floats:
    """Return the fall of the squared error by each candidate on vehicle-days to which it was not fitted.

    Parameters
    ----------
    sign : (k,) int
        Sign of the coefficient that physics demands. A coefficient of the other sign counts as zero.

    Notes
    -----
    The terms of the model are projected off over all days at once. Refitted without the coldest day, a model would
    extrapolate to it, and its failure there would be credited to any effect that resembles it. `socast add` refits
    everything without the days on which it evaluates.
    """
    size = clusters.sum_by_cluster(columns**2)
    cross = clusters.sum_by_cluster(columns * residual[:, np.newaxis])
    coefficient = fit_other_folds(size, cross, clusters.assign_folds(seed))
    coefficient = np.where(sign * coefficient < 0.0, 0.0, coefficient)
    return np.asarray((2.0 * coefficient * cross - coefficient**2 * size) / (residual @ residual))


def compute_correlation(one: Floats, other: Floats) -> float:
    """Return the correlation of two projected candidates, 0 where one of them is zero. [1]"""
    size = float(np.sqrt((one @ one) * (other @ other)))
    return float(one @ other) / size if size > 0.0 else 0.0
