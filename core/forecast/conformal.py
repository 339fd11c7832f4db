"""Prediction intervals from earlier errors: quantiles of the standardised errors of evaluated forecasts.

A forecast comes with a standard deviation, which says where errors are larger. Their actual size follows from earlier
forecasts, whatever the distribution: from the quantiles of (outcome - forecast) / standard deviation of forecasts with
a similar distance ahead. A class of forecasts with few outcomes borrows from the other classes, and all of them from a
prior distribution, so that there are intervals from the first day. Only forecasts whose outcome is known contribute, so
an interval is never evaluated on its own data.

References
----------
Vovk, Gammerman, Shafer, Algorithmic Learning in a Random World, Springer 2005, chapter 2. Lei, G'Sell, Rinaldo,
Tibshirani, Wasserman, Journal of the American Statistical Association 113 (2018) 1094, DOI
10.1080/01621459.2017.1307116, section 5.2, on locally varying width. Ferguson, Annals of Statistics 1 (1973) 209, DOI
10.1214/aos/1176342360, on distributions with a prior of given weight. Kish, Survey Sampling, Wiley 1965, section 5.4,
on the number of independent members of a cluster.
"""

from typing import Any, Final, NamedTuple

import numpy as np
from scipy.special import stdtr

from socast.core.batch import Floats, Ints, replace_nan
from socast.core.stats.conformal import compute_counted_quantiles
from socast.core.totals.day_sums import DaySums

BY_PLAN, BY_HISTORY, TO_CHARGE, OVER_CHARGE = range(4)
"""Bases of a forecast: the plan; the earlier shifts of the car; the plan, for the charge at the beginning of the next
planned charge; the plan, for the end of the shift with planned charges before it."""
BASES: Final = 4
"""Number of bases of a forecast."""
DISTANCE_CLASSES: Final = (0.0, 0.3, 1.5, 6.0, 15.0, 30.0, 60.0)
"""Lower limit of each class of the distance that the energy ahead, idle periods included, would usually drive. [km]"""
LEVELS: Final = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
"""Probabilities of the stored quantiles."""
LOWER_LEVEL: Final = 0.05
"""Probability of the lower bound of an interval."""
UPPER_LEVEL: Final = 0.95
"""Probability of the upper bound of an interval."""
SCORES: Final = np.linspace(-8.0, 8.0, 161)
"""Standardised errors at which the outcomes are counted; a larger one counts as the last. [1]"""
PRIOR_SCALE: Final = 1.25
"""Scale of the prior distribution of the standardised error, Student's t. [1]"""
PRIOR_FREEDOM: Final = 8.0
"""Its degrees of freedom."""
PRIOR_SHIFTS: Final = 15.0
"""Number of shifts whose weight the prior has."""
BORROWED_SHIFTS: Final = 50.0
"""Number of shifts whose weight all classes of a basis have together for each of them, prior included."""
LEAST_UNKNOWN: Final = 0.01
"""A smaller share of the variance that earlier errors say nothing of is none. [1]"""
DAY_CORRELATION: Final = 0.3
"""Correlation of the errors of the shifts of a day, which share the weather and the traffic. [1]"""
DAY_MEMORY: Final = 0.98
"""Weight of a day's shifts one day later."""

_EDGES: Final = np.concatenate([[-np.inf], (SCORES[1:] + SCORES[:-1]) / 2.0, [np.inf]])
_PRIOR: Final = np.diff(stdtr(PRIOR_FREEDOM, _EDGES / PRIOR_SCALE))
"""Share of the prior at each of `SCORES`, (scores,)."""


class ErrorBounds(NamedTuple):
    """Hold the middle and the bounds of the standardised error of n forecasts, (n,) float each. [1]

    The middle is the forecast itself, moved into its bounds: so the figures of an answer add up.
    """

    middle: Floats
    lower: Floats
    upper: Floats


class ConformalIntervals:
    """Learn standardised errors by class of basis and distance, and provide their quantiles.

    Attributes
    ----------
    table : Quantiles of the standardised error, (bases, distances, levels) float. [1]
    today : Since the last daily update: shifts, and scores.
    """

    def __init__(self) -> None:
        self.shape = BASES, len(DISTANCE_CLASSES)
        self._counts = np.zeros((*self.shape, len(SCORES)))
        self.today = DaySums(shifts=(BASES,), scores=(*self.shape, len(SCORES)))
        self.table = np.tile(_FIRST, (*self.shape, 1))

    def add_shift(self, basis: int, ahead_km: Floats, scores: Floats) -> None:
        """Count the standardised errors of one shift's forecasts, for the next daily update."""
        distance = classify(ahead_km)
        self.today.add("shifts", 1.0, (basis,))
        for place in np.unique(distance).tolist():
            self.today.add("scores", count_scores(scores[distance == place]), (basis, place))

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        shifts, scores = map(self.today.get, ("shifts", "scores"))
        for basis in np.flatnonzero(shifts).tolist():
            weight = weigh_day(int(shifts[basis]))
            self._counts[basis] = DAY_MEMORY * self._counts[basis] + weight * scores[basis]
            self.table[basis] = _compute_class_quantiles(self._counts[basis])
        self.today.clear()

    def get_quantiles(self, basis: Ints, ahead_km: Floats, unknown: Floats | None = None) -> tuple[Floats, ErrorBounds]:
        """Return the distribution of the standardised error of each forecast.

        `unknown` is the share of the variance of each that earlier errors say nothing of, as in weather that no car has
        seen. By that share the quantiles move outwards to those of the prior. [1]
        """
        table = self.table[basis, classify(ahead_km)]
        if unknown is not None and len(rows := np.flatnonzero(unknown > LEAST_UNKNOWN)):
            known = table[rows]
            mixed = known + unknown[rows, np.newaxis] * (_FIRST - known)
            table[rows] = np.where(_IS_UPPER, np.maximum(known, mixed), np.minimum(known, mixed))
        lower, upper = (table[:, LEVELS.index(level)] for level in (LOWER_LEVEL, UPPER_LEVEL))
        return table, ErrorBounds(np.clip(0.0, lower, upper), lower, upper)

    def dump(self) -> Any:
        """Return the state as plain values."""
        return self.today.dump(), self._counts.tobytes(), self.table.tobytes()

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        today, counts, table = state
        self.today.load(today)
        if self.today.get("scores").min() < 0.0:
            raise ValueError("a negative number of shifts")
        self._counts = np.frombuffer(counts).reshape(self._counts.shape).copy()
        self.table = np.frombuffer(table).reshape(self.table.shape).copy()


def _compute_class_quantiles(counts: Floats) -> Floats:
    """Return the quantiles of the classes of a basis, with what each borrows from all of them and from the prior."""
    around = counts.sum(axis=0) + PRIOR_SHIFTS * _PRIOR
    borrowed = BORROWED_SHIFTS * around / around.sum()
    return np.stack([compute_counted_quantiles(of_class + borrowed, SCORES, LEVELS) for of_class in counts])


_FIRST: Final = _compute_class_quantiles(np.zeros((1, len(SCORES))))[0]
"""Quantiles of the prior, (levels,). [1]"""
_IS_UPPER: Final = np.array(LEVELS) > 0.5


def weigh_day(shifts: int) -> float:
    """Return the weight of each of the shifts of a day, whose errors are correlated.

    Examples
    --------
    >>> weigh_day(1), round(200 * weigh_day(200), 1)
    (1.0, 3.3)
    """
    return 1.0 / (1.0 + (shifts - 1) * DAY_CORRELATION)


def count_scores(scores: Floats) -> Floats:
    """Return the share of scores at each of `SCORES`; one between two of them counts for both, by its distance."""
    width = SCORES[1] - SCORES[0]
    at = (np.clip(scores, SCORES[0], SCORES[-1]) - SCORES[0]) / width
    low = np.minimum(at.astype(np.int64), len(SCORES) - 2)
    share = np.minimum(at - low, 1.0)  # the last score may be rounded to beyond its place
    counts = np.bincount(low, 1.0 - share, len(SCORES)) + np.bincount(low + 1, share, len(SCORES))
    return np.asarray(counts / len(scores))


def classify(ahead_km: Floats) -> Ints:
    """Return the class of each distance that the energy ahead would usually drive [km]; NaN counts as 0."""
    return np.maximum(np.searchsorted(DISTANCE_CLASSES, replace_nan(ahead_km), side="right") - 1, 0)
