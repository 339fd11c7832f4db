"""Estimate how much rides, days and cars differ: a linear model with random effects at nested levels.

The energy of window w of ride r on day d is

    y_w = x_w'b + z_w'u_r + z_w'u_d + ... + e_w,    e_w ~ N(0, φ / weight_w),    u ~ N(0, φ diag(δ)),

with coefficients b without a prior, and random effects u of each unit of each level on the columns z. δ are relative
variances. Only sums of products of columns, Q'WQ of each ride, are needed. `SweepStep` integrates over the random
effects of a unit, and the sums of its units are those of the level above.

`MixedModel` evaluates the restricted likelihood (REML). Per unit, it holds only the rows of the sums that belong to
random effects, so that one evaluation with its gradient takes milliseconds for a thousand rides.

`socast.core.stats.variances` estimates the variances.

References
----------
Patterson, Thompson, Biometrika 58 (1971) 545, DOI 10.1093/biomet/58.3.545: restricted likelihood. Laird, Ware,
Biometrics 38 (1982) 963, DOI 10.2307/2529876: random effects.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.sparse import csc_array

from socast.core.batch import Floats, Ints
from socast.core.stats.random_effects import SweepStep, get_diagonals, link_units, number_units, sum_products, sum_units

SINGULAR: Final = 1e-10
"""Squared size of a combination of fixed columns, relative to the largest one, below which it counts as zero. [1]"""


class Criterion(NamedTuple):
    """Hold the restricted likelihood at some variances.

    Parameters
    ----------
    value : float
        Minus twice the logarithm of the restricted likelihood, up to a constant.
    gradient : (levels, s) float
        Derivatives by the relative variances δ.
    scale : float
        Most probable variance φ of a window of weight 1.
    coefficients : (p,) float
        Coefficients b.
    """

    value: float
    gradient: Floats
    scale: float
    coefficients: Floats


@dataclass(frozen=True)
class FixedColumns:
    """Hold the columns of the coefficients b, in which groups of windows may have columns of their own.

    Parameters
    ----------
    columns : (n, k) float
        Columns of each window.
    group : (n,) int64
        Group of each window, such as its car, in ascending order.
    place : (groups, k) int64
        Coefficient of each column in each group; -1 where the column is absent.
    """

    columns: Floats
    group: Ints
    place: Ints

    @property
    def coefficients(self) -> int:
        """Number of coefficients p."""
        return int(self.place.max(initial=-1)) + 1


class MixedModel:
    """Evaluate and maximise the restricted likelihood of windows with random effects at nested levels.

    Parameters
    ----------
    effects : (n, s) float
        Columns z of the random effects. Their sizes should be similar.
    fixed : FixedColumns
        Columns of the coefficients. They must be linearly independent.
    measured : (n,) float
        Energies y.
    weight : (n,) float
        Weight of each window.
    levels : sequence of (n,) int64
        Unit of each window at each level, from the lowest level up. The windows of a unit belong to one unit of the
        level above. The windows of a unit of the lowest level are adjacent and belong to one group of `fixed`.

    Raises
    ------
    ValueError
        If levels are not nested.
    """

    def __init__(
        self, effects: Floats, fixed: FixedColumns, measured: Floats, weight: Floats, levels: Sequence[Ints]
    ) -> None:
        self.size = effects.shape[1]
        self._p = fixed.coefficients
        self._levels = _nest(levels, fixed.group)
        columns = np.column_stack([effects, fixed.columns, measured])
        products = sum_products(columns, weight, number_units(levels[0]))
        energy = np.full((len(fixed.place), 1), self._p)
        self._place = np.column_stack([fixed.place, energy])
        self._grids = [np.ix_(place, place) for place in self._place]
        self._own = products[:, : self.size, : self.size].copy()
        self._beside = products[:, : self.size, self.size :].copy()
        of_groups = sum_units(products[:, self.size :, self.size :], self._levels[0].group)
        self._total = self._assemble(of_groups)
        lengths = np.linalg.eigvalsh(self._total[: self._p, : self._p])
        self._null = int((lengths <= SINGULAR * lengths.max(initial=0.0)).sum())
        self.freedom = len(measured) - self._p + self._null

    def keep(self, effects: Sequence[int]) -> "MixedModel":
        """Return the model with some of the columns of random effects only, which is faster to evaluate."""
        kept = copy(self)
        at = np.asarray(effects, dtype=np.int64)
        kept.size, kept._own, kept._beside = len(at), self._own[:, at][:, :, at], self._beside[:, at]  # noqa: SLF001
        return kept

    def condense(self, relative: Floats) -> "MixedModel":
        """Return the model of the highest level alone, after integration over lower effects of known variances.

        Its criterion lacks the determinants of the lower levels, which are constant.
        """
        steps = self._sweep(np.vstack([relative, np.zeros(self.size)]))
        lower = zip(steps[:-1], self._levels[:-1], strict=True)
        condensed = copy(self)
        condensed._levels = self._levels[-1:]  # noqa: SLF001
        condensed._own, condensed._beside = steps[-1].own, steps[-1].beside  # noqa: SLF001
        condensed._total = self._total - sum(self._sum_squares(step, level) for step, level in lower)  # noqa: SLF001
        return condensed

    def evaluate(self, relative: Floats) -> Criterion:
        """Return the restricted likelihood and its gradient."""
        steps, p = self._sweep(relative), self._p
        total = self._total - sum(
            self._sum_squares(step, level) for step, level in zip(steps, self._levels, strict=True)
        )
        inverse, of_fixed = _invert(total[:p, :p], self._null)
        coefficients = inverse @ total[:p, p]
        rss = float(total[p, p] - total[:p, p] @ coefficients)
        logarithm = of_fixed + sum(step.log_determinant for step in steps)
        outer = np.append(-coefficients, 1.0)
        by_total = self.freedom / rss * np.outer(outer, outer)
        by_total[:p, :p] += inverse
        gradient = self._pass_back(steps, by_total)
        return Criterion(self.freedom * np.log(rss) + logarithm, gradient, rss / self.freedom, coefficients)

    def expect_effects(self, relative: Floats) -> list[Floats]:
        """Return the expected random effects of each unit of each level, (units, s) each."""
        coefficients = self.evaluate(relative).coefficients
        residual = np.append(-coefficients, 1.0)
        steps = self._sweep(relative)
        out: list[Floats] = []
        above: Floats | None = None
        for level, step in zip(reversed(self._levels), reversed(steps), strict=True):
            local = residual[np.newaxis].repeat(len(step.beside), axis=0)
            if not level.is_global:
                padded = np.append(residual, 0.0)
                local = padded[self._place[level.group]]
            left = (step.beside @ local[:, :, np.newaxis])[..., 0]
            if above is not None and level.parent is not None:
                left = left - (step.own @ above[level.parent][:, :, np.newaxis])[..., 0]
            effects = (step.inner @ left[:, :, np.newaxis])[..., 0]
            out.append(effects)
            above = effects if above is None or level.parent is None else effects + above[level.parent]
        return out[::-1]

    def find_errors(self, relative: Floats) -> Floats:
        """Return about the standard errors of the relative variances, each as if estimated alone, (levels, s)."""
        out, own = [], self._own
        for level, variance in zip(self._levels, relative, strict=True):
            sums = get_diagonals(own)
            out.append(1.0 / np.sqrt(0.5 * np.maximum(np.sum((sums / (1.0 + variance * sums)) ** 2, axis=0), 1e-300)))
            if level.parent is not None:
                own = sum_units(own, level.parent)
        return np.array(out)

    def _sweep(self, relative: Floats) -> list[SweepStep]:
        """Return the integration over the effects of each level, from the lowest level up."""
        steps, own, beside = [], self._own, self._beside
        for level, variance in zip(self._levels, relative, strict=True):
            step = SweepStep.of(own, beside, variance)
            steps.append(step)
            if level.above is not None:
                left = self._spread(step.beside_left, level.group) if level.spreads else step.beside_left
                own, beside = sum_units(step.own_left, level.above), sum_units(left, level.above)
        return steps

    def _assemble(self, of_groups: Floats) -> Floats:
        """Return the sums of groups at the places of their coefficients, (p + 1, p + 1)."""
        total = np.zeros((self._p + 2, self._p + 2))
        for sums, grid in zip(of_groups, self._grids, strict=True):
            total[grid] += sums  # absent columns, which are zero, fall on the last place
        return total[:-1, :-1]

    def _spread(self, beside: Floats, group: Ints) -> Floats:
        """Return sums beside all coefficients, from those beside the coefficients of each group."""
        out = np.zeros((*beside.shape[:2], self._p + 2))
        for g, place in enumerate(self._place):
            rows = np.flatnonzero(group == g)
            out[np.ix_(rows, np.arange(beside.shape[1]), place)] += beside[rows]
        return out[..., :-1]

    def _sum_squares(self, step: SweepStep, level: "_Level") -> Floats:
        """Return the sums of N'BN over the units of a level, at the places of the coefficients."""
        if level.is_global:
            return step.taken
        k = step.beside.shape[2]
        parts = [(step.beside[rows].reshape(-1, k), step.gain[rows].reshape(-1, k)) for rows in level.groups]
        return self._assemble(np.array([beside.T @ gain for beside, gain in parts]))

    def _pass_back(self, steps: list[SweepStep], by_total: Floats) -> Floats:
        """Return the derivatives of the criterion by the relative variances, from the highest level down."""
        padded = np.zeros((self._p + 2, self._p + 2))
        padded[:-1, :-1] = by_total
        by_own: Floats | None = None
        by_beside: Floats | None = None
        gradient = np.zeros((len(steps), self.size))
        for i in range(len(steps) - 1, -1, -1):
            level, step = self._levels[i], steps[i]
            if level.parent is not None and by_own is not None and by_beside is not None:
                by_own, by_beside = by_own[level.parent], by_beside[level.parent]
                if level.spreads:
                    by_beside = self._gather(by_beside, level.group)
            times = self._multiply(step, level, by_total, padded)
            if i == 0:
                gradient[i] = step.differentiate(times, by_own, by_beside)
            else:
                gradient[i], by_own, by_beside = step.pass_back(times, by_own, by_beside)
        return gradient

    def _gather(self, by_beside: Floats, group: Ints) -> Floats:
        """Return derivatives by sums beside the coefficients of each unit's group, from those beside all."""
        padded = np.concatenate([by_beside, np.zeros((*by_beside.shape[:2], 1))], axis=2)
        place = self._place[group] % padded.shape[2]
        return np.asarray(np.take_along_axis(padded, place[:, np.newaxis, :], axis=2))

    def _multiply(self, step: SweepStep, level: "_Level", by_total: Floats, padded: Floats) -> Floats:
        """Return N G of each unit, with G the derivatives of the criterion by the sums of the coefficients."""
        if level.is_global:
            return np.asarray(step.beside @ by_total)
        pairs = zip(level.groups, self._grids, strict=True)
        return np.concatenate([step.beside[rows] @ padded[grid] for rows, grid in pairs])


class _Level(NamedTuple):
    """Hold a level: how its units are made of those below and belong to those above.

    Parameters
    ----------
    parent : (units,) int64 or None
        Unit of the level above.
    above : csc_array or None
        Matrix of `link_units` that adds up the units by those of the level above.
    group : (units,) int64
        Group of each unit; not used where units span groups.
    groups : list of slice
        Units of each group.
    is_global : bool
        Whether sums are beside all coefficients, because a unit spans groups.
    spreads : bool
        Whether units of the level above are the lowest that span groups.
    """

    parent: Ints | None
    above: csc_array | None
    group: Ints
    groups: list[slice]
    is_global: bool
    spreads: bool


def _invert(products: Floats, null: int) -> tuple[Floats, float]:
    """Return the inverse of the products of fixed columns and the log of their determinant, both off a null space.

    Columns of cars and columns that all cars share may be collinear. Their null space has the dimension `null`.
    """
    if not null:
        return np.asarray(np.linalg.inv(products)), float(np.linalg.slogdet(products)[1])
    lengths, axes = np.linalg.eigh(products)
    lengths, axes = lengths[null:], axes[:, null:]
    return np.asarray(axes / lengths @ axes.T), float(np.log(lengths).sum())


def _nest(levels: Sequence[Ints], group: Ints) -> list[_Level]:
    """Return the levels with their units numbered; raise ValueError where they are not nested."""
    codes = [number_units(level) for level in levels]
    if np.any(np.diff(codes[0]) < 0):
        raise ValueError("the windows of a unit of the lowest level are not adjacent")
    spans = np.logical_or.accumulate([bool(np.any(group[_find_first(unit)][unit] != group)) for unit in codes]).tolist()
    if spans[0]:
        raise ValueError("a unit of the lowest level spans groups")
    out: list[_Level] = []
    for i, unit in enumerate(codes):
        first, parent = _find_first(unit), None
        if i + 1 < len(codes):
            parent = codes[i + 1][first]
            if np.any(parent[unit] != codes[i + 1]):
                raise ValueError(f"level {i} is not nested in level {i + 1}")
        edges = np.searchsorted(group[first], np.arange(int(group.max()) + 2))
        spreads = not spans[i] and parent is not None and spans[i + 1]
        groups = [slice(start, stop) for start, stop in pairwise(edges.tolist())]
        above = None if parent is None else link_units(parent)
        out.append(_Level(parent, above, group[first], groups, spans[i], spreads))
    return out


def _find_first(unit: Ints) -> Ints:
    """Return the first window of each unit, (units,)."""
    return np.asarray(np.unique(unit, return_index=True)[1], dtype=np.int64)
