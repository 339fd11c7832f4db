"""The search for the effects that a model lacks: one at a time, each looked at again beside the others.

The best effect is named, what it explains is taken off, and the next is looked for. An effect that is no longer needed
once another is named was a stand-in for it, and is dropped again. Two effects that explain the same days equally well
are one finding: a group.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats
from core.diagnose.candidates import Candidates, list_input_columns
from core.diagnose.evidence import ClusterSums, Evidence, compute_worst_case_evidence
from core.diagnose.projection import BaseProjection, orthonormalise
from core.diagnose.ranking import LEVEL, Ranking, compute_correlation, rank_candidates, sum_over_clusters

Mask = NDArray[np.bool_]

INDISTINGUISHABLE: Final = 0.7
"""Correlation, off the model, from which on data do not tell two candidates apart."""
EXPLAINED_AWAY: Final = 0.4
"""Correlation from which on a rival that is not needed once the other is named is one of its group too."""
CLEARLY: Final = 2.0
"""Standard errors by which a rival must be worse on held-out days to be told apart all the same."""
FORCES: Final = frozenset({"acceleration", "traction"})
"""Columns that rest on changes of speed and height between samples."""
FAITHFUL: Final = 0.4
"""Share of the variance of what rests on forces that is true: of samples every 3 s, off a model, some two fifths."""
DOUBT: Final = 0.05
"""Probability by chance below which a rival casts doubt on a name."""
NEEDED: Final = 0.05
"""Probability by chance above which an effect is dropped again beside the others."""


@dataclass(frozen=True)
class SelectedEffect:
    """An effect that was found missing.

    Parameters
    ----------
    asked : Asked
        Where it was found, everywhere or in some place.
    at : int
        Its column there.
    q : float
        Of its name when it was found, adjusted for all that was asked.
    """

    asked: Candidates
    at: int
    q: float

    @property
    def variant(self) -> str:
        """Name of the effect, or of its variant."""
        return self.asked.variants[self.at]

    @property
    def effect(self) -> str:
        """Name of the effect."""
        return self.asked.names[int(self.asked.effects[self.at])]

    @property
    def column(self) -> Floats:
        """What it takes of each window, (n, 1). [kWh per unit]"""
        return self.asked.columns[:, [self.at]]

    @property
    def rows(self) -> Mask:
        """Windows that it was looked for in, (n,)."""
        return np.asarray(self.asked.measured != 0.0)


@dataclass(frozen=True)
class MissingEffect:
    """What is known of a named effect, beside all others that are named.

    Parameters
    ----------
    selected : SelectedEffect
    evidence : Evidence
        Of it alone.
    gain, gain_error : float
        Fall of the squared error on held-out vehicle-days, as a share, and its standard error: of rides or of windows,
        where it is larger.
    of : {"rides", "windows"}
        Of which.
    rivals : list of (str, float)
        Effects that data do not tell it from, with their correlation.
    """

    selected: SelectedEffect
    evidence: Evidence
    gain: float
    gain_error: float
    of: str
    rivals: list[tuple[str, float]]


class ForwardSelection:
    """Effects named so far, and what they leave.

    Parameters
    ----------
    base : Base
    asked : Asked
        Everywhere.
    clusters : sequence of Clusters
    least_gain : float
        Share of the squared error of rides, or of windows, that an effect must explain on held-out days to be named.
    most : int
        Effects that are named at most.
    seed : int
    """

    def __init__(
        self,
        base: BaseProjection,
        asked: Candidates,
        clusters: Sequence[ClusterSums],
        least_gain: float,
        most: int,
        seed: int,
    ) -> None:
        self.base, self.asked, self.clusters = base, asked, clusters
        self._first = base
        self.least_gain, self.most, self.seed = least_gain, most, seed
        self.selected: list[SelectedEffect] = []
        self.dropped: set[tuple[str, tuple[str, ...]]] = set()

    def build_basis(self, without: SelectedEffect | None = None) -> Floats:
        """Return an orthonormal basis of the effects named so far, but for one, (n, m)."""
        columns = [self.base.project_out(each.column) for each in self.selected if each is not without]
        return orthonormalise(np.column_stack(columns)) if columns else np.empty((len(self.base.residual), 0))

    def compute_residual(self, off: Floats) -> Floats:
        """Return what the model and a basis leave, (n,)."""
        return np.asarray(self.base.residual - off @ (off.T @ self.base.residual))

    def compute_held_out_residual(self, off: Floats) -> Floats:
        """Return what is left of each fold of vehicle-days by a basis that was fitted to the others, (n,)."""
        residual, fold = self.base.residual, self.clusters[0].assign_folds(self.seed)[self.clusters[0].code]
        left = residual.copy()
        for k in range(int(fold.max()) + 1 if off.shape[1] else 0):
            here = fold == k
            fitted, *_ = np.linalg.lstsq(off[~here], residual[~here], rcond=None)
            left[here] -= off[here] @ fitted
        return left

    def rank(self, asked: Candidates | None = None, without: SelectedEffect | None = None) -> Ranking:
        """Return how candidates rank on what is left."""
        off = self.build_basis(without)
        return rank_candidates(
            self.base, self.compute_residual(off), asked or self.asked, self.clusters, off, self.seed
        )

    def select_all(self) -> None:
        """Name effects until none is significant and worth it."""
        while len(self.selected) < self.most:
            ranked = self.rank()
            found = (
                SelectedEffect(ranked.asked, v, float(ranked.q[ranked.asked.effects[v]])) for v in ranked.significant()
            )
            best = next((named for named in found if self.is_new(named) and self.is_worthwhile(named)), None)
            if best is None:
                return
            self.select(best)

    def select(self, named: SelectedEffect) -> None:
        """Name an effect, and drop those that are not needed beside it."""
        self.selected.append(named)
        for other in list(self.selected[:-1]):
            evidence, _, _ = self.compare_with_others(other)
            if evidence.p[0] > NEEDED:
                self.selected.remove(other)
                self.dropped.add((other.effect, other.asked.scope))
        if self.selected:
            self.base = self.base.reweight(np.column_stack([each.column for each in self.selected]))

    def compare_with_others(self, named: SelectedEffect) -> tuple[Evidence, Floats, Floats]:
        """Return the evidence for a named effect beside the others, its column off them, and what they leave."""
        off = self.build_basis(named)
        column = self.base.project_out(named.column)
        column -= off @ (off.T @ column)
        left = self.compute_residual(off)
        sign, least = named.asked.sign[[named.at]], named.asked.least_coefficients[[named.at]]
        return compute_worst_case_evidence(left, column, sign, self.clusters, least), column[:, 0], left

    def list_missing_effects(self) -> list[MissingEffect]:
        """Return what is known of each named effect, most gain first."""
        found = []
        for named in self.selected:
            evidence, column, left = self.compare_with_others(named)
            gain = self.compute_gain(column, left, int(named.asked.sign[named.at]))
            least = named.asked.least_coefficients[[named.at]]
            found.append(MissingEffect(named, evidence.allow_for_distortion(least), *gain, self._rivals(named)))
        return sorted(found, key=lambda finding: -finding.gain)

    def compute_gain(
        self, column: Floats, left: Floats, sign: int, rows: Mask | None = None
    ) -> tuple[float, float, str]:
        """Return the fall of the squared error on held-out vehicle-days, its error, and of what, see `Finding`.

        As a share of all squared error, or of that of some rows.
        """
        windows, clusters = self.base.windows, self.clusters[0]
        rows = np.ones(len(left), np.bool_) if rows is None else rows
        after = left - column * self.cross_fit_coefficients(column, left, sign)
        of_windows = sum_over_clusters(
            clusters.sum_by_cluster(left**2 - after**2) / max(float(left[rows] @ left[rows]), 1e-300)
        )
        before, then = (windows.by_ride(self.base.convert_to_energy(values)) for values in (left, after))
        fall = np.bincount(windows.day_of_ride, before**2 - then**2)
        here = before[windows.by_ride(rows.astype(np.float64)) > 0.0]
        of_rides = sum_over_clusters(fall / max(float(here @ here), 1e-300))
        return (*of_rides, "rides") if of_rides[0] >= of_windows[0] else (*of_windows, "windows")

    def cross_fit_coefficients(self, column: Floats, left: Floats, sign: int) -> Floats:
        """Return for each window the coefficient of an effect by the other folds of vehicle-days, (n,)."""
        clusters = self.clusters[0]
        folds = clusters.assign_folds(self.seed)
        size, cross = clusters.sum_by_cluster(column**2), clusters.sum_by_cluster(column * left)
        rest = size.sum() - np.bincount(folds, size), cross.sum() - np.bincount(folds, cross)
        fitted = np.divide(rest[1], rest[0], out=np.zeros_like(rest[1]), where=rest[0] > 0.0)
        return np.asarray(np.where(sign * fitted < 0.0, 0.0, fitted)[folds][clusters.code])

    def is_worthwhile(self, named: SelectedEffect) -> bool:
        """Tell whether an effect explains enough on held-out days, beside those named so far.

        Of the squared error where it was looked for: that of one car cannot explain others'.
        """
        _, column, left = self.compare_with_others(named)
        return self.compute_gain(column, left, int(named.asked.sign[named.at]), named.rows)[0] >= self.least_gain

    def is_new(self, named: SelectedEffect) -> bool:
        """Tell whether an effect is not named yet, and was not dropped before."""
        taken = {(each.effect, each.asked.scope) for each in self.selected} | self.dropped
        return (named.effect, named.asked.scope) not in taken

    def _rivals(self, named: SelectedEffect) -> list[tuple[str, float]]:
        """Return the effects that would do as well in the place of a named one, with their correlation.

        A doubt needs less than a name: rivals need not be there beyond all that was asked, only beyond chance. And a
        rival that is known less exactly than the named effect may be the cause although it explains less.
        """
        fair = copy(self)  # weights that were found beside the named effect would favour it
        fair.base = self._first
        instead, beside = fair.rank(named.asked, without=named), fair.rank(named.asked)
        mine = instead.gains[:, named.at]
        taken = {each.effect for each in self.selected}
        found = []
        for effect, other in enumerate(instead.best.tolist()):
            if other < 0 or instead.asked.names[effect] in taken or instead.evidence.p[other] > DOUBT:
                continue
            r = compute_correlation(instead.projected[:, named.at], instead.projected[:, other])
            behind, error = sum_over_clusters(mine - instead.gains[:, other])
            away = abs(r) > EXPLAINED_AWAY and not beside.q[effect] < LEVEL
            alike = (abs(r) > INDISTINGUISHABLE or away) and behind < CLEARLY * error
            if alike or self._blurred(named.variant, instead, named.at, other):
                found.append((instead.asked.names[effect], r))
        return sorted(found, key=lambda pair: -abs(pair[1]))

    @staticmethod
    def _blurred(variant: str, ranked: Ranking, mine: int, other: int) -> bool:
        """Tell whether a rival explains less than a named effect only because it is known less exactly.

        Notes
        -----
        Be G what the rival would explain if it were known exactly, and ρ the share of its variance that is true. As it
        is, it explains ρ G, and an effect that stands in for it r*^2 G, where r*^2 = r^2/ρ by their correlation r. So
        the rival may be the cause where r^2 times what it explains, over what the other does, is ρ^2 or more.
        Attenuation by errors in variables: Fuller, Measurement Error Models, Wiley 1987, section 1.1.
        """
        if not is_inexact(ranked.asked.variants[other]) or is_inexact(variant):
            return False
        r = compute_correlation(ranked.projected[:, mine], ranked.projected[:, other])
        explained, least = float(ranked.gains[:, other].sum()), FAITHFUL**2 * float(ranked.gains[:, mine].sum())
        return r > 0.0 and explained > 0.0 and r**2 * explained > least


def is_inexact(variant: str) -> bool:
    """Tell whether an effect rests on forces, which samples every few seconds tell inexactly.

    Examples
    --------
    >>> is_inexact("cold_regen_limit"), is_inexact("cold_rolling")
    (True, False)
    """
    return not FORCES.isdisjoint(list_input_columns(variant))
