"""Prediction intervals from earlier errors: quantiles of the standardised errors of evaluated forecasts.

A forecast comes with a standard deviation, which says where errors are larger. Their actual size follows from earlier
forecasts, whatever the distribution: from the quantiles of (outcome - forecast) / standard deviation of forecasts with
a similar distance ahead and a similar outside temperature. Only forecasts whose outcome is known contribute, so an
interval is never evaluated on its own data. Where outcomes fall outside of the bounds more or less often than intended,
for example when the season changes, the bounds move until the rate is right.

References
----------
Vovk, Gammerman, Shafer, Algorithmic Learning in a Random World, Springer 2005, chapter 2. Lei, G'Sell, Rinaldo,
Tibshirani, Wasserman, Journal of the American Statistical Association 113 (2018) 1094, DOI
10.1080/01621459.2017.1307116, section 5.2, on locally varying width. Gibbs, Candès, NeurIPS 2021, arXiv:2106.00170, on
bounds that adapt.
"""

from collections import deque
from collections.abc import Sequence
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, Ints

BY_PLAN: Final = 0
"""Basis of a forecast: the plan."""
BY_HISTORY: Final = 1
"""Basis of a forecast: the earlier shifts of the car."""
BASES: Final = 2
"""Number of bases of a forecast."""
DISTANCE_CLASSES: Final = (0.0, 0.3, 1.5, 6.0, 15.0, 30.0, 60.0)
"""Lower limit of each class of the distance that the energy ahead, idle periods included, would usually drive. [km]"""
TEMPERATURE_CLASSES: Final = (-273.15, -10.0, 0.0, 10.0, 20.0)
"""Lower limit of each class of the outside temperature. [°C]"""
LEVELS: Final = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
"""Probabilities of the stored quantiles."""
LOWER_LEVEL: Final = 0.05
"""Probability of the lower bound of an interval."""
UPPER_LEVEL: Final = 0.95
"""Probability of the upper bound of an interval."""
ADAPTATION_RATE: Final = 0.02
"""Change of a bound's probability per shift outside of it; 1/19 of that per shift inside."""
ADAPTATION_LIMITS: Final = -0.045, 0.05
"""Limits of the change of a bound's probability, for a class of distance and again for one of temperature."""
LARGEST_BOUND_LEVEL: Final = 0.12
"""Largest probability of a bound, counted from its own end."""
SUFFICIENT_SHIFTS: Final = 50
"""Number of shifts from which a class uses its own data only; with fewer it borrows from neighbouring classes."""
LEAST_SHIFTS: Final = 20
"""Number of shifts, of all classes, below which there are no intervals."""
REMEMBERED_SHIFTS: Final = 400
"""Number of newest shifts that a class remembers."""

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
    """Learn standardised errors by class, and provide their quantiles.

    A class is (basis, distance, temperature), where the basis is `BY_PLAN` or `BY_HISTORY`.

    Attributes
    ----------
    table : (bases, distances, temperatures, levels) float
        Quantiles of the standardised error, NaN where too little is known. [1]
    bounds : (bases, distances, temperatures) BOUND_PAIR
        Bounds that contain the standardised error with 90 %, NaN where too little is known. [1]
    """

    def __init__(self, bases: int = BASES) -> None:
        self.shape = bases, len(DISTANCE_CLASSES), len(TEMPERATURE_CLASSES)
        self._scores: dict[tuple[int, ...], deque[Floats]] = {}
        self.table = np.full((*self.shape, len(LEVELS)), np.nan)
        self.bounds = _make_pairs(self.shape, np.nan)
        self._moved_by_distance = _make_pairs((bases, len(DISTANCE_CLASSES)), 0.0)
        self._moved_by_temperature = _make_pairs((bases, len(TEMPERATURE_CLASSES)), 0.0)

    def add_shift(self, basis: int, ahead_km: Floats, ambient_c: Floats, scores: Floats) -> None:
        """Remember the standardised errors of one shift's forecasts.

        Parameters
        ----------
        basis : int
        ahead_km : (n,) float
            Distance that the energy ahead would usually drive. [km]
        ambient_c : (n,) float
            Outside temperature. [°C]
        scores : (n,) float
            Standardised errors. [1] Each class that the shift touches counts it as one shift.
        """
        distance, temperature = classify(ahead_km, ambient_c)
        for place in sorted(set(zip(distance.tolist(), temperature.tolist(), strict=True))):
            of_class = scores[(distance == place[0]) & (temperature == place[1])]
            bounds = self.bounds[basis, *place]
            if np.isfinite(bounds["lower"]):
                missed = {"lower": np.mean(of_class < bounds["lower"]), "upper": np.mean(of_class > bounds["upper"])}
                for side, share in missed.items():
                    step = ADAPTATION_RATE * (LOWER_LEVEL - share)
                    for moved, at in zip(
                        (self._moved_by_distance[side], self._moved_by_temperature[side]), place, strict=True
                    ):
                        moved[basis, at] = np.clip(moved[basis, at] + step, *ADAPTATION_LIMITS)
            self._scores.setdefault((basis, *place), deque(maxlen=REMEMBERED_SHIFTS)).append(of_class)

    def update_quantiles(self) -> None:
        """Compute the quantiles and bounds of every class from the remembered shifts."""
        for place in np.ndindex(self.shape):
            shifts = self._find_nearest_shifts(place)
            lower, upper = (self._compute_bound_level(place, side) for side in ("lower", "upper"))
            quantiles = np.full(len(LEVELS) + 2, np.nan)
            if len(shifts) >= LEAST_SHIFTS:
                quantiles = compute_quantiles(shifts, (*LEVELS, lower, 1.0 - upper))
            *_, low, high = quantiles
            self.bounds[place] = low, high
            self.table[place] = clip_to_bounds(quantiles[: len(LEVELS)], low, high)

    def _compute_bound_level(self, place: tuple[int, ...], side: str) -> float:
        """Return the probability of a bound of a class, counted from its own end."""
        basis, distance, temperature = place
        moved = self._moved_by_distance[side][basis, distance] + self._moved_by_temperature[side][basis, temperature]
        return float(np.clip(LOWER_LEVEL + moved, LEVELS[0], LARGEST_BOUND_LEVEL))

    def get_quantiles(self, basis: Ints, ahead_km: Floats, ambient_c: Floats) -> tuple[Floats, ErrorBounds]:
        """Return the distribution of the standardised error of each forecast.

        Parameters
        ----------
        basis : (n,) int
        ahead_km : (n,) float
            Distance that the energy ahead would usually drive. [km]
        ambient_c : (n,) float
            Outside temperature. [°C]

        Returns
        -------
        (n, levels) float
            Quantiles of `LEVELS`.
        ErrorBounds
        """
        place = basis, *classify(ahead_km, ambient_c)
        lower, upper = self.bounds["lower"][place], self.bounds["upper"][place]
        return np.asarray(self.table[place]), ErrorBounds(np.clip(0.0, lower, upper), lower, upper)

    def dump(self) -> Any:
        """Return the state as plain values."""
        scores = [(place, [shift.tobytes() for shift in shifts]) for place, shifts in self._scores.items()]
        moved = self._moved_by_distance.tobytes(), self._moved_by_temperature.tobytes()
        return scores, self.table.tolist(), self.bounds.tobytes(), *moved

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        scores, table, bounds, by_distance, by_temperature = state
        self._scores = {
            tuple(place): deque(map(np.frombuffer, shifts), maxlen=REMEMBERED_SHIFTS) for place, shifts in scores
        }
        bases, distances, temperatures = self.shape
        self.table = np.array(table, dtype=np.float64)
        self.bounds = np.frombuffer(bounds, BOUND_PAIR).reshape(self.shape).copy()
        self._moved_by_distance = np.frombuffer(by_distance, BOUND_PAIR).reshape(bases, distances).copy()
        self._moved_by_temperature = np.frombuffer(by_temperature, BOUND_PAIR).reshape(bases, temperatures).copy()

    def _find_nearest_shifts(self, place: tuple[int, ...]) -> list[Floats]:
        """Return the shifts of a class, and of the classes around it, nearest first, until there are enough."""
        basis, distance, temperature = place
        shifts: list[Floats] = []
        for near in list_nearest_classes(distance, temperature):
            if len(shifts) >= SUFFICIENT_SHIFTS:
                break
            shifts += self._scores.get((basis, *near), ())
        return shifts


def _make_pairs(shape: tuple[int, ...], value: float) -> NDArray[np.void]:
    """Return pairs of bounds that all have one value."""
    pairs = np.empty(shape, BOUND_PAIR)
    pairs["lower"] = pairs["upper"] = value
    return pairs


@cache
def list_nearest_classes(distance: int, temperature: int) -> list[tuple[int, int]]:
    """Return all classes of distance and temperature, sorted by how near they are to one of them.

    Parameters
    ----------
    distance, temperature : int
        Index of the class of distance and of temperature.
    """
    every = np.ndindex(len(DISTANCE_CLASSES), len(TEMPERATURE_CLASSES))
    far = sorted((abs(d - distance) * 2 + abs(t - temperature), d, t) for d, t in every)
    return [(d, t) for _, d, t in far]


def classify(ahead_km: Floats, ambient_c: Floats) -> tuple[Ints, Ints]:
    """Return the classes of distance and temperature of forecasts.

    Parameters
    ----------
    ahead_km : (n,) float
        Distance that the energy ahead would usually drive, NaN counts as 0. [km]
    ambient_c : (n,) float
        Outside temperature, NaN counts as 15 °C. [°C]

    Returns
    -------
    (n,) int
        Index of the class of distance.
    (n,) int
        Index of the class of temperature.
    """
    distance = np.searchsorted(DISTANCE_CLASSES, np.nan_to_num(ahead_km), side="right") - 1
    temperature = np.searchsorted(TEMPERATURE_CLASSES, np.nan_to_num(ambient_c, nan=15.0), side="right") - 1
    return np.maximum(distance, 0), np.maximum(temperature, 0)


def clip_to_bounds(table: Floats, lower: float, upper: float) -> Floats:
    """Return quantiles that are consistent with given bounds.

    Parameters
    ----------
    table : (levels,) float
        Quantiles of `LEVELS`.
    lower, upper : float
        Quantiles of `LOWER_LEVEL` and `UPPER_LEVEL`, which replace those of the table. The others are clipped.

    Returns
    -------
    (levels,) float

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


def compute_quantiles(shifts: Sequence[Sequence[float] | Floats], levels: Sequence[float]) -> Floats:
    """Return the quantiles of the scores of shifts; each shift has the same weight, whatever its number of scores.

    The outer quantiles are widened for the finite number of shifts, so that the next score lies inside as often as the
    levels say.

    Parameters
    ----------
    shifts : sequence of (scores,) float
    levels : sequence of float
        Probabilities.

    Returns
    -------
    (levels,) float

    Examples
    --------
    >>> compute_quantiles([(float(i),) for i in range(-50, 51)], (LOWER_LEVEL, UPPER_LEVEL)).round(1).tolist()
    [-45.9, 45.9]
    """
    scores, sizes = np.concatenate(shifts), np.array([len(shift) for shift in shifts])
    weight = np.repeat(1.0 / sizes, sizes)
    order = np.argsort(scores, kind="stable")
    count = float(len(shifts))
    at = (np.cumsum(weight[order]) - 0.5 * weight[order]) / count
    wider = np.clip(0.5 + (np.array(levels) - 0.5) * (1.0 + 1.0 / count), 0.0, 1.0)
    return np.asarray(np.interp(wider, at, scores[order]))
