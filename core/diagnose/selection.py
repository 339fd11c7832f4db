"""Hold the effects that are missing in all cars, and what a model leaves beside them.

The inference (`socast.core.diagnose.inference`) decides which effects are missing and how large they are. Here their
gain on held-out days is computed, and the residual that figures show.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from socast.core import effects
from socast.core.batch import Floats
from socast.core.diagnose.candidates import Candidates, find_coefficient_limits
from socast.core.diagnose.gains import ResidualSpace, compute_correlation, compute_held_out_gain
from socast.core.diagnose.inference.posterior import Inference, LikelyCause
from socast.core.diagnose.projection import BaseProjection, orthonormalise
from socast.core.effects.declaration import VARIANT
from socast.core.stats.evidence import ClusterSums
from socast.core.stats.scores import Estimate

UNKNOWN_GAIN: Final = Estimate(0.0, float("nan"), 0.0)
"""Gain of an effect for which none was computed."""
LARGE_SHARE: Final = 0.02
"""Share of the energy from which an effect is not negligible, however small its coefficient. [1]

Ranges of coefficients are of cars in use; in mild weather, a small coefficient may still take much of the energy.
"""


@dataclass(frozen=True)
class MissingEffect:
    """Hold an effect that is missing in all cars.

    Parameters
    ----------
    column : (n, 1) float
        Its energy in each window. [kWh per unit of the coefficient]
    size : Estimate
        Its coefficient.
    probability : float
        Probability that something is missing that it explains. [1]
    causes : dict of str to float
        Effects that could explain the same, with their shares of that probability, the largest first. [1]
    evidence : float
        Logarithm of the Bayes factor against none. [1]
    gain : Estimate
        Share of the squared error of rides that it explains on held-out days beside the effects before it. [1]
    expected : bool
        Whether physics expects it in every car, so that it is no surprise.
    """

    variant: str
    column: Floats
    size: Estimate
    probability: float
    causes: dict[str, float]
    evidence: float = 0.0
    gain: Estimate = UNKNOWN_GAIN
    expected: bool = False

    @property
    def effect(self) -> str:
        """Name of the effect."""
        return self.variant.partition(VARIANT)[0]

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest plausible coefficient, which include 0."""
        return find_coefficient_limits(self.variant, 1)


@dataclass(frozen=True)
class Selection:
    """Hold missing effects beside the terms of a model.

    Parameters
    ----------
    base : BaseProjection
        Projection off the terms of the model.
    clusters : sequence of ClusterSums
        Vehicle-days and dates.
    """

    base: BaseProjection
    clusters: Sequence[ClusterSums]
    effects: tuple[MissingEffect, ...] = ()
    seed: int = 0

    def keep(self, effects: Sequence[MissingEffect]) -> "Selection":
        """Return the selection with other effects, under the same weights."""
        return replace(self, effects=tuple(effects))

    def on(self, base: BaseProjection) -> "Selection":
        """Return the selection on another projection, with other weights."""
        return replace(self, base=base)

    def build_basis(self, without: MissingEffect | None = None) -> Floats:
        """Return an orthonormal basis of the missing effects except one, (n, m)."""
        columns = [self.base.project_out(each.column) for each in self.effects if each is not without]
        return orthonormalise(np.column_stack(columns)) if columns else np.empty((len(self.base.residual), 0))

    def compute_residual(self, basis: Floats) -> Floats:
        """Return the residual off the model and off a basis, (n,)."""
        return np.asarray(self.base.residual - basis @ (basis.T @ self.base.residual))

    def build_space(self, without: MissingEffect | None = None) -> ResidualSpace:
        """Return what the model and the missing effects except one leave unexplained."""
        basis = self.build_basis(without)
        return ResidualSpace(self.base, basis, self.compute_residual(basis))

    def compute_held_out_residual(self, basis: Floats) -> Floats:
        """Return the residual of each fold of vehicle-days off a basis that is fitted to the other folds, (n,)."""
        clusters, residual = self.clusters[0], self.base.residual
        fold = clusters.assign_folds(self.seed)[clusters.code]
        left = residual.copy()
        for k in range(int(fold.max()) + 1 if basis.shape[1] else 0):
            here = fold == k
            coefficient, *_ = np.linalg.lstsq(basis[~here], residual[~here], rcond=None)
            left[here] -= basis[here] @ coefficient
        return left

    def compute_gain(self, effect: MissingEffect) -> Estimate:
        """Return the gain of an effect beside the others of the selection, see `compute_held_out_gain`."""
        space = self.build_space(effect)
        column = space.project_out(effect.column)[:, 0]
        return compute_held_out_gain(self.base, column, space.residual, effect.limits, self.clusters[0], self.seed)

    def correlate(
        self, effect: MissingEffect, candidates: Candidates, others: Sequence[str]
    ) -> list[tuple[str, float]]:
        """Return other effects with the correlation of their best forms with an effect, off the model."""
        own = self.base.project_out(effect.column)[:, 0]
        pairs = []
        for name in others:
            if name not in candidates.names or name == effect.effect:
                continue
            at = np.flatnonzero(candidates.effects == candidates.names.index(name))
            values = [compute_correlation(own, other) for other in self.base.project_out(candidates.columns[:, at]).T]
            pairs.append((name, max(values, key=abs)))
        return sorted(pairs, key=lambda pair: -abs(pair[1]))


def list_missing(inference: Inference) -> list[MissingEffect]:
    """Return the effects that are missing in all cars at all times.

    An effect whose 95 % interval lies below its plausible range is negligible, unless it takes `LARGE_SHARE` of the
    energy. One that physics expects is missing if its interval lies above the lower end of that range.
    """
    measured = float(inference.columns.measured.sum())
    found = [
        MissingEffect(
            one.variant, one.column[:, np.newaxis], one.size.estimate, one.probability, one.causes, one.evidence
        )
        for one in inference.findings
        if one.is_likely and one.form is None and not one.family.is_scoped and _is_large(one, measured)
    ]
    for one in inference.expected:
        low, _ = one.size.estimate.interval
        if one.is_likely and low >= _find_least(one.effect):
            found.append(
                MissingEffect(
                    one.effect,
                    one.column[:, np.newaxis],
                    one.size.estimate,
                    one.probability,
                    {one.effect: 1.0},
                    one.evidence,
                    expected=True,
                )
            )
    return found


def list_scoped(inference: Inference, *, dated: bool = True) -> list[MissingEffect]:
    """Return what was found within scopes: in single cars, in groups, or, where the dates are known, since a date."""
    return [
        MissingEffect(
            one.variant, one.column[:, np.newaxis], one.size.estimate, one.probability, one.causes, one.evidence
        )
        for one in inference.findings
        if one.is_likely and one.family.is_scoped and (dated or one.when.since is None)
    ]


def _is_large(cause: LikelyCause, measured: float) -> bool:
    """Return whether a cause takes `LARGE_SHARE`, or its coefficient reaches its plausible range, by absolute value.

    Units: measured [kWh].
    """
    size = cause.size.estimate
    if abs(size.value) * float(np.abs(cause.column).sum()) >= LARGE_SHARE * measured:
        return True
    return max(abs(limit) for limit in size.interval) >= _find_least(cause.variant)


def _find_least(effect: str) -> float:
    """Return the smallest plausible coefficient of an effect, by absolute value; 0 where either sign is plausible."""
    declared = effects.get(effect)
    low, high = declared.low, declared.high
    return 0.0 if low < 0.0 < high else min(abs(low), abs(high))


def select_missing(
    base: BaseProjection, inference: Inference, clusters: Sequence[ClusterSums], seed: int = 0, least_gain: float = 0.0
) -> Selection:
    """Return the missing effects in the order in which to add them.

    One effect is chosen at each step: first those whose gain beside the effects already chosen is certain; among these,
    those that physics does not expect in every car; then the one with the largest Bayes factor against none.

    Parameters
    ----------
    least_gain : float
        Gain below which an effect is left out; 0 for no limit. [1]

    Notes
    -----
    The gain is computed with the weights of the model as given, as `socast add` does; figures have weights that are
    computed beside the effects.
    """
    given = Selection(base, clusters, (), seed)
    left = list_missing(inference)
    ranked: list[MissingEffect] = []
    while left:
        beside = given.keep(ranked)
        left = [replace(each, gain=beside.compute_gain(each)) for each in left]
        if least_gain > 0.0:
            left = [each for each in left if each.gain.value >= least_gain]
        left.sort(key=_order)
        ranked += left[:1]
        left = left[1:]
    if not ranked:
        return given
    return Selection(base.reweight(np.column_stack([each.column for each in ranked])), clusters, tuple(ranked), seed)


def _order(each: MissingEffect) -> tuple[bool, bool, float]:
    """Return a key that sorts effects into the order of `select_missing`."""
    return each.gain.interval[0] <= 0.0, each.expected, -each.evidence
