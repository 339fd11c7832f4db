"""Intervals from errors that were made: quantiles of standardised errors of earlier forecasts.

A forecast comes with a standard deviation, which says where it errs more; how far it really errs is what its
predecessors tell, whatever the errors are distributed like: the quantiles of (outcome - forecast) / deviation of
forecasts that were made before, of about the same distance ahead and at about the same temperature. Only forecasts
whose outcome came after them are learned from, so an interval is never judged on what it was made of. Where outcomes
fall outside more or less often than they should, as when a season changes, the bounds move until they do not.

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
from typing import Any, Final

import numpy as np

from core.batch import Floats, Ints

DISTANCES: Final = (0.0, 0.3, 1.5, 6.0, 15.0, 30.0, 60.0)
"""Where each class of what is ahead begins: the kilometres that its energy, rests included, would usually do. [km]"""
TEMPERATURES: Final = (-273.15, -10.0, 0.0, 10.0, 20.0)
"""Where each class of the outside temperature begins. [°C]"""
LEVELS: Final = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
"""Probabilities of the quantiles that are kept."""
BOUNDS: Final = 0.05, 0.95
"""Probabilities of the bounds of an interval."""
PACE: Final = 0.02
"""By how much a bound's probability moves with each shift that is outside of it, or 1/19 of that where it is inside."""
FARTHEST: Final = -0.045, 0.05
"""How far a bound's probability may move for a class of distance, and again for one of temperature."""
MOST_OUTSIDE: Final = 0.12
"""Largest probability of a bound, from its own end."""
ENOUGH: Final = 50
"""Shifts that a class of its own takes; with fewer it borrows from its neighbours."""
LEAST: Final = 20
"""Shifts, of all classes, below which there are no intervals."""
KEPT: Final = 400
"""Shifts that a class remembers, the newest."""


class Conformal:
    """Standardised errors by class, and their quantiles.

    A class is (kind, distance, temperature), where `kind` tells forecasts by plan (0) from those by habit (1).

    Attributes
    ----------
    table : (kinds, distances, temperatures, levels) float
        Quantiles of the standardised error, NaN where too little is known. [1]
    bounds : (kinds, distances, temperatures, 2) float
        Likewise between which the standardised error lies with 90 %.
    """

    def __init__(self, kinds: int = 2) -> None:
        self.shape = kinds, len(DISTANCES), len(TEMPERATURES)
        self._scores: dict[tuple[int, ...], deque[Floats]] = {}
        self.table = np.full((*self.shape, len(LEVELS)), np.nan)
        self.bounds = np.full((*self.shape, 2), np.nan)
        self._moved = np.zeros((*self.shape[:2], 2)), np.zeros((self.shape[0], self.shape[2], 2))

    def learn(self, kind: int, ahead_km: Floats, ambient_c: Floats, scores: Floats) -> None:
        """Remember the standardised errors of one shift's forecasts; each class of it counts as one shift."""
        distance, temperature = classes(ahead_km, ambient_c)
        for place in sorted(set(zip(distance.tolist(), temperature.tolist(), strict=True))):
            mine = scores[(distance == place[0]) & (temperature == place[1])]
            low, high = self.bounds[kind, *place]
            if np.isfinite(low):
                missed = np.array([np.mean(mine < low), np.mean(mine > high)])
                for moved, which in zip(self._moved, place, strict=True):
                    moved[kind, which] = np.clip(moved[kind, which] + PACE * (BOUNDS[0] - missed), *FARTHEST)
            self._scores.setdefault((kind, *place), deque(maxlen=KEPT)).append(mine)

    def settle(self) -> None:
        """Make quantiles of all that was remembered."""
        for place in np.ndindex(self.shape):
            shifts = self._near(place)
            kind, distance, temperature = place
            moved = self._moved[0][kind, distance] + self._moved[1][kind, temperature]
            below, above = np.clip(BOUNDS[0] + moved, LEVELS[0], MOST_OUTSIDE).tolist()
            found = np.full(len(LEVELS) + 2, np.nan)
            if len(shifts) >= LEAST:
                found = quantiles(shifts, (*LEVELS, below, 1.0 - above))
            self.table[place], self.bounds[place] = agreeing(found[:-2], *found[-2:]), found[-2:]

    def quantiles(self, kind: Ints, ahead_km: Floats, ambient_c: Floats) -> tuple[Floats, Floats]:
        """Return the quantiles of each forecast, (n, levels); and its middle, within its bounds, and these, (n, 3).

        The middle is the forecast itself, the median of few errors being less sure than the model.
        """
        place = kind, *classes(ahead_km, ambient_c)
        low, high = np.moveaxis(self.bounds[place], -1, 0)
        return np.asarray(self.table[place]), np.column_stack([np.clip(0.0, low, high), low, high])

    def dump(self) -> Any:
        """Return the state as plain values."""
        scores = [(place, [shift.tobytes() for shift in shifts]) for place, shifts in self._scores.items()]
        return scores, self.table.tolist(), self.bounds.tolist(), *(moved.tolist() for moved in self._moved)

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        scores, *tables = state
        self._scores = {tuple(place): deque(map(np.frombuffer, shifts), maxlen=KEPT) for place, shifts in scores}
        self.table, self.bounds, *moved = (np.array(table, dtype=np.float64) for table in tables)
        self._moved = moved[0], moved[1]

    def _near(self, place: tuple[int, ...]) -> list[Floats]:
        """Return the shifts of a class; of those around it too, the nearest first, until there are enough."""
        kind, *own = place
        found: list[Floats] = []
        for d, t in around(*own):
            if len(found) >= ENOUGH:
                break
            found += self._scores.get((kind, d, t), ())
        return found


@cache
def around(distance: int, temperature: int) -> list[tuple[int, int]]:
    """Return all classes of distance and temperature, those nearest to one first."""
    every = np.ndindex(len(DISTANCES), len(TEMPERATURES))
    far = sorted((abs(d - distance) * 2 + abs(t - temperature), d, t) for d, t in every)
    return [(d, t) for _, d, t in far]


def classes(ahead_km: Floats, ambient_c: Floats) -> tuple[Ints, Ints]:
    """Return the classes of distance and temperature, (n,) each; the unknown is in the first."""
    distance = np.searchsorted(DISTANCES, np.nan_to_num(ahead_km), side="right") - 1
    temperature = np.searchsorted(TEMPERATURES, np.nan_to_num(ambient_c, nan=15.0), side="right") - 1
    return np.maximum(distance, 0), np.maximum(temperature, 0)


def agreeing(table: Floats, low: float, high: float) -> Floats:
    """Return quantiles, (levels,), of which those of `BOUNDS` are these, and the others as far as they agree with that.

    Examples
    --------
    >>> levels = np.array(LEVELS)
    >>> agreeing(levels, 0.15, 0.9)[[2, 3, 4, 5, 10, 11, 12]].tolist()
    [0.02, 0.15, 0.15, 0.2, 0.9, 0.9, 0.98]
    """
    at = np.array(LEVELS)
    inside = np.clip(table, low, high)
    outside = np.where(at <= BOUNDS[0], np.minimum(table, low), np.maximum(table, high))
    out = np.where((at > BOUNDS[0]) & (at < BOUNDS[1]), inside, outside)
    out[at == BOUNDS[0]], out[at == BOUNDS[1]] = low, high
    return np.asarray(out)


def quantiles(shifts: Sequence[Sequence[float] | Floats], levels: Sequence[float]) -> Floats:
    """Return the quantiles of the scores of shifts, each shift counting as one whatever its number of scores.

    The outer ones are further out by as much as so few shifts ask for, so that the next one is inside as often as said.

    Examples
    --------
    >>> quantiles([(float(i),) for i in range(-50, 51)], BOUNDS).round(1).tolist()
    [-45.9, 45.9]
    """
    scores, sizes = np.concatenate(shifts), np.array([len(shift) for shift in shifts])
    weight = np.repeat(1.0 / sizes, sizes)
    order = np.argsort(scores, kind="stable")
    count = float(len(shifts))
    at = (np.cumsum(weight[order]) - 0.5 * weight[order]) / count
    wider = np.clip(0.5 + (np.array(levels) - 0.5) * (1.0 + 1.0 / count), 0.0, 1.0)
    return np.asarray(np.interp(wider, at, scores[order]))
