"""Test every candidate within one car, or within all cars, always and from each of its shifts on.

A change has two forms: a step, which has its full size from a shift on, and a ramp, which grows linearly from a shift
on and reaches its full size at the last shift. What the car has always had is removed from both, so that a change is a
difference between a car's own shifts.
"""

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, stdtr

from socast.core.batch import Floats, Ints
from socast.core.columns import SECONDS_PER_DAY
from socast.core.diagnose.siblings.shift_scores import Projected, ShiftScores
from socast.core.diagnose.siblings.spread import PRIOR_CARS, SiblingBase
from socast.core.diagnose.siblings.sums import Siblings

Change = Literal["step", "ramp"]
Kind = Literal["always"] | Change
LEAST_LEFT: Final = 0.01
"""Share of the squared size of a column that must be left beside the base to test it."""
LEAST_SHIFTS: Final = 3
"""Least number of shifts before and after a change."""
PRIOR_SHARE: Final = 0.05
"""Standard deviation of the size of a deviation beforehand, as a share of the energy. [1]"""
NEGATIVE: Final = 0.25
"""Probability beforehand that a change takes away what a car has always had, rather than adding."""


CERTAIN: Final = np.array(np.inf)
"""Degrees of freedom of standard errors that many windows determine."""


class Scan(NamedTuple):
    """Hold the tests of k candidates at m places: shifts from which a change begins, or one place for `always`.

    Parameters
    ----------
    begin : (m,) float
        Unix time of the first shift with the effect. [s]
    after : (m,) float
        Unix time of the shift before it. [s]
    end : float
        Unix time of the last shift. [s]
    score, information : (m, k) float
        Products with the energy and with itself, per share of the energy. Zero where a column is not testable.
    unit : (m, k) float
        Coefficient that makes the absolute energy equal to the measured energy within the scope.
    whole_score, whole_information : (m, k) float
        As `score` and `information`, without the removal of what the car has always had.
    freedom : (k,) or () float
        Degrees of freedom of the standard errors, which are few where the spread between few cars determines them.
    """

    kind: Kind
    begin: Floats
    after: Floats
    end: float
    score: Floats
    information: Floats
    unit: Floats
    whole_score: Floats
    whole_information: Floats
    freedom: Floats = CERTAIN

    @property
    def estimate(self) -> Floats:
        """Most probable sizes as shares of the energy, (m, k)."""
        return np.divide(self.score, self.information, out=np.zeros_like(self.score), where=self.information > 0.0)

    @property
    def z(self) -> Floats:
        """Sizes in standard errors, (m, k)."""
        root = np.sqrt(self.information)
        return np.divide(self.score, root, out=np.zeros_like(self.score), where=root > 0.0)

    def compute_chances(self) -> Floats:
        """Return the probability of so large a size by chance at the best place, for each candidate, (k,).

        Notes
        -----
        For the largest |z| among places, the bound of Davies from the total variation V of z over the places:

            p = 2 Φ(-z) + 2 V exp(-z²/2) / √(8π).

        With few degrees of freedom, Φ is the distribution of Student's t. Such tests have one place, and V is zero.

        References
        ----------
        Davies, Biometrika 74 (1987) 33, DOI 10.1093/biomet/74.1.33, eq. (3.4).
        """
        z = self.z
        most = np.abs(z).max(axis=0, initial=0.0)
        variation = np.abs(np.diff(z, axis=0)).sum(axis=0)
        chance = 2.0 * (stdtr(self.freedom, -most) + variation * np.exp(-0.5 * most**2) / np.sqrt(8.0 * np.pi))
        return np.asarray(np.minimum(chance, 1.0))

    def compute_evidence(self, sign: Ints, *, whole: bool = False) -> Floats:
        """Return the logarithm of the Bayes factor of each place and candidate against no effect, (m, k).

        Parameters
        ----------
        whole : bool
            Whether to use the tests without the removal of what the car has always had, which may be compared with
            those of effects that are always there.

        Notes
        -----
        The size has a half-normal prior of standard deviation τ = `PRIOR_SHARE`. With score b and information a,

            log 2 Φ(m / s) + m²/(2 s²) - log(1 + a τ²)/2,    s² = 1/(a + 1/τ²),  m = b s².
        """
        score, information = (self.whole_score, self.whole_information) if whole else (self.score, self.information)
        precise = information + 1.0 / PRIOR_SHARE**2
        middle = score / np.sqrt(precise)
        common = 0.5 * middle**2 - 0.5 * np.log(precise * PRIOR_SHARE**2) + np.log(2.0)
        chance = np.where(sign == 0, 0.5, 1.0 - NEGATIVE)
        direction = np.where(sign == 0, 1.0, sign)
        with_sign = np.log(chance) + log_ndtr(direction * middle)
        against = np.log(1.0 - chance) + log_ndtr(-direction * middle)
        return np.asarray(
            np.where(information > 0.0, common + np.logaddexp(with_sign, against), -np.inf), dtype=np.float64
        )


def scan_always(base: SiblingBase, car: int, alike: SiblingBase, cars: int) -> Scan:
    """Return the tests of the candidates within one car over all its shifts.

    Parameters
    ----------
    base : SiblingBase
        The cars of one model, with the spread between cars that was estimated without this one.

    Notes
    -----
    With v the variance of an estimate and v0 that without a spread between cars, the degrees of freedom are
    ν v² / (v - v0)² by Satterthwaite, with ν those of the spread: its prior and its cars.

    References
    ----------
    Satterthwaite, Biometrics Bulletin 2 (1946) 110, DOI 10.2307/3002019.
    """
    siblings = base.siblings
    there = siblings.car == car
    at = np.arange(siblings.size.shape[1])
    down = siblings.places.candidates.start + at
    rows = base.of_car[car][down]
    square = rows[at, down]
    found = base.project(car, rows, square, at)
    unit = _divide(siblings.measured[there].sum(), siblings.size[there].sum(axis=0))[np.newaxis]
    start = siblings.start[there]
    kept = found.information > LEAST_LEFT * square
    certain = alike.project(car, rows, square, at).information
    share = 1.0 - np.divide(found.information, certain, out=np.ones(len(at)), where=certain > 0.0)
    scan = _scale("always", start[:1], start[:1], start[-1], (found.score, found.information, kept), unit, found)
    return scan._replace(freedom=(PRIOR_CARS + cars) / np.clip(share, 1e-3, 1.0) ** 2)


def scan_changes(siblings: Siblings, scores: ShiftScores, car: int, kind: Change) -> Scan:
    """Return the tests of the candidates within one car from each of its shifts on."""
    there = np.flatnonzero(siblings.car == car)
    start = siblings.start[there]
    places, weights = build_changes(start, kind)
    if not len(places):
        none = np.zeros((0, siblings.size.shape[1]))
        return Scan(kind, start[:0], start[:0], start[-1], none, none, none, none, none)
    found = scores.project(weights)
    score, information = found.remove_whole()
    kept = information > LEAST_LEFT * (weights**2 @ scores.square)
    later = (weights > 0.0).astype(np.float64)
    unit = _divide((later @ siblings.measured[there])[:, np.newaxis], later @ siblings.size[there])
    after = start[np.maximum(places - 1, 0)]
    return _scale(kind, start[places], after, start[-1], (score, information, kept), unit, found)


def scan_group(
    bases: Sequence[SiblingBase], members: Sequence[NDArray[np.bool_]], dates: Floats, *, own_past: bool
) -> Scan:
    """Return the tests of the candidates in shifts of several cars: always, or as steps at some times.

    Parameters
    ----------
    own_past : bool
        Whether to remove what the group has always had. Not for all cars, whose past is in the base.
    """
    k, steps = bases[0].siblings.size.shape[1], max(len(dates), 1)
    score, information, whole_score, whole_information, raw, size = np.zeros((6, steps, k))
    energy = np.zeros(steps)
    for base, inside in zip(bases, members, strict=True):
        siblings = base.siblings
        weights = inside[np.newaxis].astype(np.float64)
        if len(dates):
            weights = weights * (siblings.start >= dates[:, np.newaxis])
        if not weights.any():
            continue
        found = base.project_all(weights, inside.astype(np.float64))
        parts = found.remove_whole() if own_past else (found.score, found.information)
        score, information = score + parts[0], information + parts[1]
        whole_score, whole_information = whole_score + found.score, whole_information + found.information
        at = siblings.places.candidates
        raw += weights**2 @ np.diagonal(siblings.sums[:, at, at], axis1=1, axis2=2)
        energy += weights @ siblings.measured
        size += weights @ siblings.size
    kept = information > LEAST_LEFT * raw
    start = np.concatenate([base.siblings.start[inside] for base, inside in zip(bases, members, strict=True)])
    kind: Kind = "step" if len(dates) else "always"
    begin = dates if len(dates) else np.array([start.min()])
    before = np.array([start[start < date].max(initial=start.min()) for date in begin])
    unit = np.where(kept, _divide(energy[:, np.newaxis], size), 0.0)
    square = unit**2
    tests = score * unit, information * square, unit, whole_score * unit, whole_information * square
    return Scan(kind, begin, before, float(start.max()), *tests)


def build_changes(start: Floats, kind: Change) -> tuple[Ints, Floats]:
    """Return the shifts from which a change may begin, (m,), and its size in each shift of a car, (m, shifts)."""
    places = np.arange(0 if kind == "ramp" else LEAST_SHIFTS, len(start) - LEAST_SHIFTS + 1)
    return places, make_weights(start, places, kind)


def make_weights(start: Floats, places: Ints, kind: Kind) -> Floats:
    """Return the size of a change from each place on in each shift of a car, (places, shifts)."""
    steps = (np.arange(len(start)) >= places[:, np.newaxis]).astype(np.float64)
    if kind != "ramp":
        return steps
    since = np.maximum(start - start[places][:, np.newaxis], 0.0)
    return np.asarray(since / np.maximum(start[-1] - start[places], SECONDS_PER_DAY)[:, np.newaxis])


def _divide(energy: Floats | float, size: Floats) -> Floats:
    """Return energies over sizes, zero where a candidate has no energy."""
    whole = np.broadcast_to(energy, size.shape)
    return np.divide(whole, size, out=np.zeros(size.shape), where=size > 0.0)


def _scale(
    kind: Kind,
    begin: Floats,
    after: Floats,
    end: float,
    parts: tuple[Floats, Floats, NDArray[np.bool_]],
    unit: Floats,
    found: Projected | None = None,
) -> Scan:
    """Return tests per share of the energy; zero where they are not kept."""
    score, information = parts[0].reshape(unit.shape), parts[1].reshape(unit.shape)
    unit = np.where(parts[2].reshape(unit.shape), unit, 0.0)
    whole = (score, information)
    if found is not None:
        whole = found.score.reshape(unit.shape), found.information.reshape(unit.shape)
    square = unit**2
    tests = score * unit, information * square, unit, whole[0] * unit, whole[1] * square
    return Scan(kind, begin, after, end, *tests)
