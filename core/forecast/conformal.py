"""Prediction intervals from earlier errors: quantiles of the standardised errors of evaluated forecasts.

A forecast comes with a standard deviation, which says where errors are larger. Their actual size follows from earlier
forecasts, whatever the distribution: from the quantiles of (outcome - forecast) / standard deviation of forecasts with
a similar distance ahead. A class of forecasts with few outcomes borrows from the classes around it, and all of them
from a prior distribution, so that there are intervals from the first day. Only forecasts whose outcome is known
contribute, so an interval is never evaluated on its own data. Where outcomes fall outside of the bounds more or less
often than intended, for example when the season changes, the bounds move until the rate is right.

References
----------
Vovk, Gammerman, Shafer, Algorithmic Learning in a Random World, Springer 2005, chapter 2. Lei, G'Sell, Rinaldo,
Tibshirani, Wasserman, Journal of the American Statistical Association 113 (2018) 1094, DOI
10.1080/01621459.2017.1307116, section 5.2, on locally varying width. Gibbs, Candès, NeurIPS 2021, arXiv:2106.00170, on
bounds that adapt. Ferguson, Annals of Statistics 1 (1973) 209, DOI 10.1214/aos/1176342360, on distributions with a
prior of given weight. Kish, Survey Sampling, Wiley 1965, section 5.4, on the number of independent members of a
cluster.
"""

from functools import cache
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
ADAPTATION_RATE: Final = 0.1
"""Widening of a bound per shift outside of it; 1/19 of that is taken back per shift inside. [1]"""
LARGEST_ADAPTATION: Final = 0.5
"""Largest widening or narrowing of a bound. [1]"""
SCORES: Final = np.linspace(-8.0, 8.0, 161)
"""Standardised errors at which the outcomes are counted; a larger one counts as the last. [1]"""
PRIOR_SCALES: Final = 1.25, 1.75, 1.25, 1.25
"""Scale of the prior distribution of the standardised error of each basis, Student's t. [1]"""
PRIOR_FREEDOM: Final = 8.0
"""Its degrees of freedom."""
PRIOR_SHIFTS: Final = 15.0
"""Number of shifts whose weight the prior has."""
BORROWED_SHIFTS: Final = 25.0
"""Number of shifts whose weight the classes around a class have together, prior included."""
SHARE_OF_NEXT: Final = 0.5
"""Weight of a class in what another one borrows, for each class of distance between both."""
DAY_CORRELATION: Final = 0.3
"""Correlation of the errors of the shifts of a day, which share the weather and the traffic. [1]"""
DAY_MEMORY: Final = 0.98
"""Weight of a day's shifts one day later."""

_EDGES: Final = np.concatenate([[-np.inf], (SCORES[1:] + SCORES[:-1]) / 2.0, [np.inf]])
_PRIOR: Final = np.array([np.diff(stdtr(PRIOR_FREEDOM, _EDGES / scale)) for scale in PRIOR_SCALES])
"""Share of the prior at each of `SCORES`, for each basis, (bases, scores)."""
_CLASSES: Final = np.arange(len(DISTANCE_CLASSES))
_SHARES: Final = SHARE_OF_NEXT ** np.abs(_CLASSES - _CLASSES[:, np.newaxis])
"""Weight of each class of distance for each, (distances, distances)."""
_ARRAYS: Final = "_counts", "_widening", "table"
BOUND_PAIR: Final = np.dtype([("lower", "f8"), ("upper", "f8")])
"""A value for each of the two bounds of an interval."""


class ErrorBounds(NamedTuple):
    """Hold the middle and the bounds of the standardised error of n forecasts, (n,) float each. [1]

    The middle is the forecast itself, moved into its bounds: the median of few errors is less certain than the model.
    """

    middle: Floats
    lower: Floats
    upper: Floats


class ConformalIntervals:
    """Learn standardised errors by class of basis and distance, and provide their quantiles.

    Attributes
    ----------
    table : Quantiles of the standardised error, (bases, distances, levels) float. [1]
    bounds : Bounds that contain the standardised error with 90 %, (bases, distances) BOUND_PAIR. [1]
    today : Since the last daily update: shifts, scores, and misses beyond the intended share, below and above.
    """

    def __init__(self) -> None:
        self.shape = BASES, len(DISTANCE_CLASSES)
        self._counts = np.zeros((*self.shape, len(SCORES)))
        self.today = DaySums(shifts=(BASES,), scores=(*self.shape, len(SCORES)), missed=(*self.shape, 2))
        self._widening = np.zeros((*self.shape, 2))  # of the lower and of the upper bound
        tables, bounds = zip(*map(_compute_first_quantiles, range(BASES)), strict=True)
        self.table, self.bounds = np.stack(tables), np.stack(bounds)

    def add_shift(self, basis: int, ahead_km: Floats, scores: Floats) -> None:
        """Count the standardised errors of one shift's forecasts, for the next daily update."""
        distance = classify(ahead_km)
        self.today.add("shifts", 1.0, (basis,))
        for place in np.unique(distance).tolist():
            of_class, bounds = scores[distance == place], self.bounds[basis, place]
            missed = np.array([np.mean(of_class < bounds["lower"]), np.mean(of_class > bounds["upper"])])
            self.today.add("scores", count_scores(of_class), (basis, place))
            self.today.add("missed", missed - LOWER_LEVEL, (basis, place))

    def apply_daily_update(self) -> None:
        """Let the shifts since the last daily update take effect."""
        shifts, scores, missed = map(self.today.get, ("shifts", "scores", "missed"))
        for basis in np.flatnonzero(shifts).tolist():
            weight = weigh_day(int(shifts[basis]))
            self._counts[basis] = DAY_MEMORY * self._counts[basis] + weight * scores[basis]
            widening = self._widening[basis] + ADAPTATION_RATE * weight * missed[basis]
            self._widening[basis] = np.clip(widening, -LARGEST_ADAPTATION, LARGEST_ADAPTATION)
            found = _compute_class_quantiles(_borrow_counts(basis, self._counts[basis]), self._widening[basis])
            self.table[basis], self.bounds[basis] = found
        self.today.clear()

    def get_quantiles(self, basis: Ints, ahead_km: Floats) -> tuple[Floats, ErrorBounds]:
        """Return the distribution of the standardised error of each forecast."""
        place = basis, classify(ahead_km)
        lower, upper = self.bounds["lower"][place], self.bounds["upper"][place]
        return np.asarray(self.table[place]), ErrorBounds(np.clip(0.0, lower, upper), lower, upper)

    def dump(self) -> Any:
        """Return the state as plain values."""
        arrays = (getattr(self, name) for name in _ARRAYS)
        return self.today.dump(), self.bounds.tobytes(), [array.tobytes() for array in arrays]

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        today, bounds, arrays = state
        self.today.load(today)
        if self.today.get("scores").min() < 0.0:
            raise ValueError("a negative number of shifts")
        self.bounds = np.frombuffer(bounds, BOUND_PAIR).reshape(self.shape).copy()
        for name, dumped in zip(_ARRAYS, arrays, strict=True):
            setattr(self, name, np.frombuffer(dumped).reshape(getattr(self, name).shape).copy())


def _borrow_counts(basis: int, counts: Floats) -> Floats:
    """Return the counts of the classes of a basis with what each borrows from the others and from the prior."""
    around = _SHARES @ counts + PRIOR_SHIFTS * _PRIOR[basis]
    return np.asarray(counts + BORROWED_SHIFTS * around / around.sum(axis=-1, keepdims=True))


def _compute_class_quantiles(counts: Floats, widening: Floats) -> tuple[Floats, Any]:
    """Return the quantiles and the bounds of the classes of a basis."""
    table, bounds = np.empty((len(counts), len(LEVELS))), np.empty(len(counts), BOUND_PAIR)
    for place in range(len(counts)):
        quantiles = compute_counted_quantiles(counts[place], SCORES, LEVELS)
        low = float(quantiles[LEVELS.index(LOWER_LEVEL)] - widening[place][0])
        high = float(quantiles[LEVELS.index(UPPER_LEVEL)] + widening[place][1])
        bounds[place] = low, max(low, high)
        table[place] = clip_to_bounds(quantiles, low, max(low, high))
    return table, bounds


@cache
def _compute_first_quantiles(basis: int) -> tuple[Floats, Any]:
    """Return the quantiles and the bounds of the classes of a basis before the first shift, from the prior alone."""
    classes = len(DISTANCE_CLASSES)
    return _compute_class_quantiles(_borrow_counts(basis, np.zeros((classes, len(SCORES)))), np.zeros((classes, 2)))


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


def clip_to_bounds(table: Floats, lower: float, upper: float) -> Floats:
    """Return quantiles that are consistent with bounds, which replace those of `LOWER_LEVEL` and `UPPER_LEVEL`.

    Examples
    --------
    >>> levels = np.array(LEVELS)
    >>> clip_to_bounds(levels, 0.15, 0.9)[[2, 3, 4, 5, 10, 11, 12]].tolist()
    [0.02, 0.15, 0.15, 0.2, 0.9, 0.9, 0.98]
    """
    at = np.array(LEVELS)
    inside = np.clip(table, lower, upper)
    outside = np.where(at <= LOWER_LEVEL, np.minimum(table, lower), np.maximum(table, upper))
    out = np.where((at > LOWER_LEVEL) & (at < UPPER_LEVEL), inside, outside)
    out[at == LOWER_LEVEL], out[at == UPPER_LEVEL] = lower, upper
    return np.asarray(out)
