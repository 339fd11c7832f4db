"""Select the effects that a model lacks, one at a time, and test each again beside the others.

Each step computes the probability of every cause (`posterior`), selects the most probable effect, removes what it
explains, and looks for the next one. It ends where no effect or an unknown one is more probable than any effect. An
effect that is not significant beside a later one was a proxy for it and is dropped.

The gain of an effect is that with a plausible coefficient. What an effect would explain beyond has another cause.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Final

import numpy as np

from socast.core.batch import Floats
from socast.core.diagnose.candidates import Candidates
from socast.core.diagnose.posterior.causes import SelectedForm, compute_cause_evidence
from socast.core.diagnose.posterior.probabilities import NONE, UNKNOWN, Causes, compute_probabilities
from socast.core.diagnose.projection import BaseProjection, orthonormalise
from socast.core.diagnose.ranking import (
    Ranking,
    ResidualSpace,
    compute_correlation,
    compute_held_out_gain,
    rank_candidates,
)
from socast.core.stats.evidence import ClusterSums, Evidence, compute_worst_case_evidence
from socast.core.stats.scores import Estimate

NEEDED: Final = 0.05
"""Probability above which an effect is dropped again beside the others."""


@dataclass(frozen=True)
class SelectedEffect:
    """Hold an effect that was selected as missing.

    Parameters
    ----------
    candidates : Candidates
        The candidates from which it was selected, everywhere or within a scope.
    probability : float
        Its probability when it was selected. [1]
    causes : Causes, optional
        The probabilities of all causes when it was selected; None for an effect within a scope.
    """

    candidates: Candidates
    at: int
    probability: float
    causes: Causes | None = None

    @property
    def variant(self) -> str:
        """Name of the effect or of its variant."""
        return self.candidates.variants[self.at]

    @property
    def effect(self) -> str:
        """Name of the effect."""
        return self.candidates.names[int(self.candidates.effects[self.at])]

    @property
    def column(self) -> Floats:
        """Energy of the effect in each window, (n, 1). [kWh per unit of the coefficient]"""
        return self.candidates.columns[:, [self.at]]


@dataclass(frozen=True)
class MissingEffect:
    """Hold the results for a selected effect beside all other selected effects.

    Parameters
    ----------
    gain : Estimate
        Of rides, with a coefficient within the plausible range.
    """

    selected: SelectedEffect
    evidence: Evidence
    gain: Estimate


@dataclass(frozen=True)
class SelectionSettings:
    """Hold the settings of a forward selection.

    Parameters
    ----------
    least_gain : float
        Share of the squared error of rides that an effect must explain on held-out days; 0 for no limit. [1]
    """

    least_gain: float = 0.0
    max_effects: int = 6
    seed: int = 0


class ForwardSelection:
    """Select missing effects step by step.

    Parameters
    ----------
    base : BaseProjection
        Projection off the terms of the model.
    settings : SelectionSettings
        Least gain, maximum number of effects, and seed.

    Attributes
    ----------
    dropped : set of (str, tuple of str)
        Effects, with their scopes, that were selected and dropped again.
    remaining : Causes or None
        Causes of what remains beside the selected effects; None before the selection.
    """

    def __init__(
        self,
        base: BaseProjection,
        candidates: Candidates,
        clusters: Sequence[ClusterSums],
        settings: SelectionSettings,
    ) -> None:
        self.base, self.candidates, self.clusters, self.settings = base, candidates, clusters, settings
        self._given = base
        self.selected: list[SelectedEffect] = []
        self.dropped: set[tuple[str, tuple[str, ...]]] = set()
        self.remaining: Causes | None = None

    def build_basis(self, without: SelectedEffect | None = None) -> Floats:
        """Return an orthonormal basis of the selected effects except one, (n, m)."""
        columns = [self.base.project_out(each.column) for each in self.selected if each is not without]
        return orthonormalise(np.column_stack(columns)) if columns else np.empty((len(self.base.residual), 0))

    def compute_residual(self, basis: Floats) -> Floats:
        """Return the residual off the model and off a basis, (n,)."""
        return np.asarray(self.base.residual - basis @ (basis.T @ self.base.residual))

    def build_space(self, without: SelectedEffect | None = None) -> ResidualSpace:
        """Return what the model and the selected effects except one leave unexplained."""
        basis = self.build_basis(without)
        return ResidualSpace(self.base, basis, self.compute_residual(basis))

    def compute_held_out_residual(self, basis: Floats) -> Floats:
        """Return the residual of each fold of vehicle-days off a basis that is fitted to the other folds, (n,)."""
        clusters, residual = self.clusters[0], self.base.residual
        fold = clusters.assign_folds(self.settings.seed)[clusters.code]
        left = residual.copy()
        for k in range(int(fold.max()) + 1 if basis.shape[1] else 0):
            here = fold == k
            coefficient, *_ = np.linalg.lstsq(basis[~here], residual[~here], rcond=None)
            left[here] -= basis[here] @ coefficient
        return left

    def rank(self, candidates: Candidates | None = None, without: SelectedEffect | None = None) -> Ranking:
        """Return the ranking of candidates, by default all, on what the selected effects except one leave."""
        return rank_candidates(
            self.build_space(without), candidates or self.candidates, self.clusters, self.settings.seed
        )

    def infer_causes(self) -> Causes:
        """Return the probability of each cause of what the model and the effects selected everywhere leave."""
        forms = [
            SelectedForm(each.variant, each.causes.forms[each.effect].coefficient)
            for each in self.selected
            if each.causes is not None
        ]
        return compute_probabilities(compute_cause_evidence(self.base, self.candidates, forms))

    def select_all(self) -> Causes:
        """Select effects until none, or an unknown one, is more probable than any effect, or none is worthwhile."""
        first = self.infer_causes()
        self.remaining = causes = first
        while True:
            if causes.first in {NONE, UNKNOWN} or len(self.selected) == self.settings.max_effects:
                return first
            at = self.candidates.variants.index(causes.forms[causes.first].variant)
            best = SelectedEffect(self.candidates, at, causes.leading[causes.first], causes)
            if not (self.is_new(best) and self.is_worthwhile(best)):
                return first
            self.select(best)
            self.remaining = causes = self.infer_causes()

    def select(self, effect: SelectedEffect) -> None:
        """Select an effect, and drop those that are not significant beside it."""
        self.selected.append(effect)
        for other in list(self.selected[:-1]):
            evidence, _, _ = self.compare_with_others(other)
            if evidence.p[0] > NEEDED:
                self.selected.remove(other)
                self.dropped.add((other.effect, other.candidates.scope))
        if self.selected:
            self.base = self.base.reweight(np.column_stack([each.column for each in self.selected]))

    def compare_with_others(self, effect: SelectedEffect) -> tuple[Evidence, Floats, Floats]:
        """Return the evidence for an effect beside the other selected ones, its column off them, and their residual."""
        space = self.build_space(effect)
        column = space.project_out(effect.column)
        sign, least = effect.candidates.sign[[effect.at]], effect.candidates.least_coefficients[[effect.at]]
        evidence = compute_worst_case_evidence(space.residual, column, sign, self.clusters, least)
        return evidence, column[:, 0], space.residual

    def list_missing_effects(self) -> list[MissingEffect]:
        """Return the results for each selected effect, in the order of selection."""
        missing = []
        for effect in self.selected:
            evidence, _, _ = self.compare_with_others(effect)
            least = effect.candidates.least_coefficients[[effect.at]]
            missing.append(
                MissingEffect(effect, evidence.allow_for_distortion(least), self.compute_gain_beside(effect))
            )
        return missing

    def correlate(self, effect: SelectedEffect, others: Sequence[str]) -> list[tuple[str, float]]:
        """Return other effects with the correlation of their forms with an effect, off the model, the largest first."""
        if effect.causes is None:
            return []
        forms = effect.causes.forms
        names = [name for name in others if name in forms and name != effect.effect]
        at = [effect.candidates.variants.index(forms[name].variant) for name in names]
        off = self.base.project_out(effect.candidates.columns[:, [effect.at, *at]])
        pairs = [(name, compute_correlation(off[:, 0], off[:, 1 + i])) for i, name in enumerate(names)]
        return sorted(pairs, key=lambda pair: -abs(pair[1]))

    def compute_gain(self, column: Floats, residual: Floats, limits: tuple[float, float]) -> Estimate:
        """Return the gain of a column on a residual, see `compute_held_out_gain`."""
        return compute_held_out_gain(self.base, column, residual, limits, self.clusters[0], self.settings.seed)

    def compute_gain_beside(self, effect: SelectedEffect) -> Estimate:
        """Return the gain of an effect beside the other selected ones, with the weights of the model as given.

        `socast add` and the list of candidates use these weights too, so that all three state one gain.
        """
        given = copy(self)
        given.base = self._given
        _, column, residual = given.compare_with_others(effect)
        return given.compute_gain(column, residual, effect.candidates.get_limits(effect.at))

    def measure_candidates(self, ranking: Ranking) -> dict[str, Estimate]:
        """Return the gain of each effect that can be told from the model, each alone beside what is selected."""
        residual = self.compute_residual(self.build_basis())
        best = zip(ranking.candidates.names, ranking.best.tolist(), strict=True)
        return {
            name: self.compute_gain(ranking.projected[:, at], residual, ranking.candidates.get_limits(at))
            for name, at in best
            if at >= 0
        }

    def is_worthwhile(self, effect: SelectedEffect) -> bool:
        """Return whether an effect explains the least gain on held-out days, beside the selected ones."""
        if not self.settings.least_gain > 0.0:
            return True
        return self.compute_gain_beside(effect).value >= self.settings.least_gain

    def is_new(self, effect: SelectedEffect) -> bool:
        """Return whether an effect is neither selected nor dropped."""
        known = {(each.effect, each.candidates.scope) for each in self.selected} | self.dropped
        return (effect.effect, effect.candidates.scope) not in known
