"""Measure the error that columns explain on days to which their coefficients were not fitted."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.diagnose.projection import BaseProjection
from socast.core.stats.evidence import (
    ClusterSums,
    Evidence,
    compute_worst_case_evidence,
    cross_fit,
    fit_other_folds,
    measure_gain,
)
from socast.core.stats.scores import Estimate

LEAST_LEFT: Final = 0.03
"""Share of a candidate's size that the model must be unable to explain for the candidate to be identifiable."""
LEAST_GAIN: Final = 0.002
"""Share of the squared error that an effect must explain on held-out vehicle-days to be added."""
LEVEL: Final = 0.05
"""p-value below which an effect is added."""


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
