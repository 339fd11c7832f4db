"""Compute the inner products of everything that may be missing, with base and random effects integrated out.

With V the covariance of the windows, C the columns of the alternatives, each per standard deviation of its coefficient,
and y the measured energy, A = C'V^-1 C and g = C'V^-1 y. All follow from the sums of the vehicle-days.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import csc_array
from scipy.special import log_ndtr

from socast.core.batch import Floats, Ints
from socast.core.diagnose.inference.scopes import Family
from socast.core.diagnose.inference.window_columns import WindowColumns
from socast.core.diagnose.inference.window_model import WindowModel
from socast.core.stats.random_effects import link_units

LEAST_LEFT: Final = 0.01
"""Share of the squared size of a column that the base must be unable to explain."""
LEAST_DATES: Final = 2.0
"""Effective number of dates on which an alternative within a scope must act; what acts on one is an episode. [1]"""
LEAST_SHARE: Final = 0.002
"""Share of the energy that an effect of twice its standard deviation must be able to take."""
KEPT: Final = 40
"""Largest number of alternatives of a family that are compared; the others are far less probable."""
FIXED: Final = 1e12
"""Precision of the coefficients of known effects then, so that none makes itself unidentifiable. [1]"""
FREE: Final = 1e-4
"""Precision of the coefficients of the base when it is asked what they could explain. [1]"""


@dataclass(frozen=True)
class Alternatives:
    """Hold k alternatives.

    Parameters
    ----------
    family, effect, place : (k,) int64
        Family of each, its column of `WindowColumns.effects`, and its place within the family.
    size : (k,) float
        Standard deviation of the coefficient beforehand. [unit of the coefficient]
    limits : (2, k) float
        Smallest and largest plausible coefficient, in standard deviations beforehand. [1]
    log_odds : (k,) float
        Logarithm of the prior odds of each against none.
    weight : (k, d) float
        Size on each vehicle-day. [1]
    own : (k, k) float
        A.
    match : (k,) float
        g.
    identified : frozenset of int
        Effects of all cars that the terms of the base cannot imitate, as columns of `WindowColumns.effects`.
    """

    family: Ints
    effect: Ints
    place: Ints
    size: Floats
    limits: Floats
    log_odds: Floats
    weight: Floats
    own: Floats
    match: Floats
    identified: frozenset[int]

    def build_column(self, columns: WindowColumns, at: int) -> Floats:
        """Return the energy of an alternative in each window, per standard deviation of its coefficient. [kWh]"""
        return columns.effects[:, self.effect[at]] * self.weight[at][columns.day] * self.size[at]


def weigh_alone(own: Floats, match: Floats, limits: tuple[float, float]) -> Floats:
    """Return the log evidence of each alternative alone, against none, with a coefficient within limits."""
    precise = 1.0 + own
    mean, sd = match / precise, 1.0 / np.sqrt(precise)
    within = log_share_within(limits, mean, sd) - log_share_within(limits)
    return np.asarray(0.5 * match * mean - 0.5 * np.log(precise) + within)


def log_share_within(
    limits: tuple[Floats | float, Floats | float] | Floats, mean: Floats | float = 0.0, sd: Floats | float = 1.0
) -> Floats:
    """Return the logarithm of the share of normal distributions that lies within limits.

    Examples
    --------
    >>> np.exp(log_share_within((-1.0, 1.0))).round(3).item()
    0.683
    """
    low, high = (np.asarray((limit - mean) / sd) for limit in limits)
    is_above = low > 0.0  # the lower tail keeps more digits
    low, high = np.where(is_above, -high, low), np.where(is_above, -low, high)
    below, whole = log_ndtr(low), log_ndtr(high)
    return np.asarray(whole + np.log1p(-np.exp(np.minimum(below - whole, -1e-12))))


def select_alternatives(model: WindowModel, families: list[Family], kept: Alternatives | None = None) -> Alternatives:
    """Return the most probable alternatives of each family beside the known effects of a model.

    Parameters
    ----------
    kept : Alternatives, optional
        Alternatives that are compared in any case.
    """
    columns = model.columns
    sums = _Products(model)
    free = factorise_free(model)
    energy = np.zeros((len(columns.start), columns.effects.shape[1]))
    np.add.at(energy, columns.day, np.abs(columns.effects))
    measured = columns.sum_days(np.abs(columns.measured))
    found: list[tuple[int, int, int, float, float]] = []
    identified: set[int] = set()
    for number, family in enumerate(families):
        weight = np.array([place.weight for place in family.places])
        amount = (weight > 0.0).astype(np.float64) @ measured[family.days]
        adding = link_units(columns.date_of_day[family.days])
        of_family: list[tuple[float, int, int, float]] = []
        for effect in family.effects:
            size = family.size * columns.find_largest(effect)
            able = 2.0 * size * (weight @ energy[family.days, effect]) >= LEAST_SHARE * amount
            if family.is_scoped:
                able &= count_dates(weight * energy[family.days, effect], adding) >= LEAST_DATES
            own, match, left = sums.project(effect, family.days, weight, size, free)
            good = able & (left > LEAST_LEFT)
            if (left > LEAST_LEFT).any() and not family.is_scoped:
                identified.add(effect)
            evidence = weigh_alone(own, match, family.limits)
            of_family += [(float(evidence[at]), effect, at, size) for at in np.flatnonzero(good).tolist()]
        of_family.sort(key=lambda each: -each[0])
        odds = float(np.log(family.prior / (1.0 - family.prior)))
        again = set()
        if kept is not None:
            rows = np.flatnonzero(kept.family == number).tolist()
            again = {(int(kept.effect[at]), int(kept.place[at])) for at in rows}
        for rank, (_, effect, at, size) in enumerate(of_family):
            if rank < KEPT or family.is_unknown or (effect, at) in again:
                share = -float(np.log(len(of_family)))
                if family.is_unknown:
                    share = columns.unknown[effect - len(columns.names)].log_share
                found.append((number, effect, at, size, odds + share))
    family_of, effect_of, place_of = (np.array([row[i] for row in found], dtype=np.int64) for i in range(3))
    weights = np.zeros((len(found), len(columns.start)))
    for row, (number, _, at, _, _) in enumerate(found):
        weights[row, families[number].days] = families[number].places[at].weight
    size_of = np.array([row[3] for row in found])
    alone = _Products(model.add(np.zeros((len(columns.residual), 0)))) if model.known.size else sums
    own, match = alone.multiply(effect_of, weights, size_of)
    return Alternatives(
        family=family_of,
        effect=effect_of,
        place=place_of,
        size=size_of,
        limits=np.array([families[number].limits for number in family_of.tolist()]).reshape(-1, 2).T,
        log_odds=np.array([row[4] for row in found]),
        weight=weights,
        own=own,
        match=match,
        identified=frozenset(identified),
    )


def count_dates(energy: Floats, adding: csc_array) -> Floats:
    """Return the effective number of dates of each row, the squared sum over the sum of squares; (k, d) to (k,)."""
    of_date = (adding @ energy.T).T
    return np.asarray(of_date.sum(axis=1) ** 2 / np.maximum((of_date**2).sum(axis=1), 1e-300))


def factorise_free(model: WindowModel) -> Floats:
    """Return the factor of the system in which the coefficients of the base are nearly free."""
    size = model.size
    precision = np.where(np.arange(size) < model.shared, FREE, 1.0)
    precision[model.locate_known()] = FIXED
    return np.asarray(np.linalg.cholesky(model.total[:size, :size] + np.diag(precision)))


class _Products:
    """Hold the sums of the vehicle-days of a model with all effects of the library beside its columns."""

    def __init__(self, model: WindowModel) -> None:
        self.model = model
        columns = model.columns
        self.sums = model.sum_days(columns.effects)
        self.first = self.sums.shape[1] - 1 - columns.effects.shape[1]
        source, self.place = model.coordinates
        self.source = source.copy()
        self.source[-1] = self.sums.shape[1] - 1
        self.lower = np.linalg.cholesky(np.eye(model.size) + model.total[: model.size, : model.size])
        self.along = solve_triangular(self.lower, model.total[: model.size, model.size], lower=True)
        self._beside: dict[int, Floats] = {}

    def get_beside(self, effect: int) -> Floats:
        """Return the products of an effect with the coefficients and the energy on each vehicle-day, (d, F + 1)."""
        if effect not in self._beside:
            days = len(self.place)
            out = np.zeros((days, self.model.size + 1))
            out[np.arange(days)[:, np.newaxis], self.place] = self.sums[:, self.source, self.first + effect]
            self._beside[effect] = out * self.model.scale
        return self._beside[effect]

    def project(
        self, effect: int, days: Ints, weight: Floats, size: float, free: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return A and g of an effect at each place alone, and the share of its size that a free base leaves."""
        beside = weight @ self.get_beside(effect)[days] * size
        raw = weight**2 @ self.sums[days, self.first + effect, self.first + effect] * size**2
        along = solve_triangular(self.lower, beside[:, :-1].T, lower=True)
        own, match = raw - (along**2).sum(axis=0), beside[:, -1] - along.T @ self.along
        loose = solve_triangular(free, beside[:, :-1].T, lower=True)
        left = 1.0 - (loose**2).sum(axis=0) / np.maximum(raw, 1e-300)
        return np.maximum(own, 0.0), match, np.where(raw > 0.0, left, 0.0)

    def multiply(self, effect: Ints, weight: Floats, size: Floats) -> tuple[Floats, Floats]:
        """Return A and g of alternatives beside each other."""
        k = len(effect)
        own, beside = np.zeros((k, k)), np.zeros((k, self.model.size + 1))
        rows = {name: np.flatnonzero(effect == name) for name in sorted(set(effect.tolist()))}
        for one, at in rows.items():
            beside[at] = weight[at] @ self.get_beside(one)
            later = np.flatnonzero(effect >= one)
            of_day = self.sums[:, self.first + one, self.first + effect[later]]
            part = weight[at] @ (weight[later].T * of_day)
            own[at[:, np.newaxis], later] = part
            own[later[:, np.newaxis], at] = part.T
        beside *= size[:, np.newaxis]
        along = solve_triangular(self.lower, beside[:, :-1].T, lower=True)
        return own * np.outer(size, size) - along.T @ along, beside[:, -1] - along.T @ self.along
