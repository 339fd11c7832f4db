"""Select the loads that differ between rides or days, and what the data do not tell apart from them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats
from socast.core.diagnose.error_location.floors import DISTORTED, FLOORS
from socast.core.diagnose.error_location.location_model import LocationModel
from socast.core.stats.variances import Variances, estimate_variances, find_interval

Place = tuple[int, int]
"""Level and kind."""

LEAST_GAIN: Final = 12.0
"""Least fall of the criterion for a load to be selected: with 12 candidates, chance reaches it in less than 1 % of
data sets. [1]
"""
RIVAL: Final = 6.0
"""Difference of the criterion below which two loads are not told apart: odds of 20 to 1. [1]"""
TRIALS: Final = 4
"""Number of loads, of the steepest criterion, that are tried in each step."""
MOST_LOADS: Final = 6
"""Largest number of loads."""


@dataclass(frozen=True)
class SelectedLoad:
    """Hold a load that differs between the units of a level.

    Parameters
    ----------
    size_kw, low_kw, high_kw : float
        Standard deviation of the sizes, as a mean power, and its 95 % interval. [kW]
    """

    place: Place
    size_kw: float
    low_kw: float
    high_kw: float
    gain: float


class LoadSearch:
    """Select loads one by one, each beside the others."""

    def __init__(self, located: LocationModel) -> None:
        self.located = located
        self.shape = len(located.levels.names), len(located.kinds.kinds)
        self._least = located.model.find_errors(np.zeros(self.shape))
        names = [(level, kind.name) for level in located.levels.names for kind in located.kinds.kinds]
        self._always = [divmod(names.index(each), self.shape[1]) for each in DISTORTED if each in names]
        floors = [FLOORS[level][kind] for level, kind in DISTORTED if (level, kind) in names]
        scale = located.joint.criterion.scale
        self._most = {
            place: (floor * float(located.kinds.power[place[1]])) ** 2 / scale
            for place, floor in zip(self._always, floors, strict=True)
        }

    def select(self) -> list[SelectedLoad]:
        """Return the selected loads, the largest first."""
        return sorted(self.measure(self._choose()), key=lambda load: -load.size_kw)

    def measure(self, chosen: Sequence[Place]) -> list[SelectedLoad]:
        """Return the sizes of loads beside each other."""
        best = self.fit(chosen)
        loads = []
        for place in chosen:
            others = [each for each in chosen if each != place]
            gain = self.fit(others, best).criterion.value - best.criterion.value
            low, high = self._find_interval(chosen, best, place)
            loads.append(SelectedLoad(place, float(best.deviations[place]), low, high, gain))
        return loads

    def fit(self, places: Sequence[Place], start: Variances | None = None) -> Variances:
        """Return the most probable variances of some loads alone."""
        kinds, free, most = self._restrict(places)
        model = self.located.model.keep(kinds)
        begin = self.located.joint.relative if start is None else start.relative
        first = np.where(free, np.maximum(begin[:, kinds], self._least[:, kinds]), 0.0)
        found = estimate_variances(model, free, first, most)
        relative = np.zeros(self.shape)
        relative[:, kinds] = found.relative
        return Variances(relative, found.criterion)

    def find_limit(self, place: Place, best: Variances) -> tuple[float, float, float]:
        """Return the size of a load that was not selected, and its 95 % interval, beside selected ones as they are."""
        chosen = [divmod(int(at), self.shape[1]) for at in np.flatnonzero(best.relative)]
        kinds, *_ = self._restrict([*chosen, place])
        at = place[0], kinds.index(place[1])
        free = np.zeros((self.shape[0], len(kinds)), dtype=bool)
        free[at] = True
        start = best.relative[:, kinds].copy()
        start[at] = self._least[place]
        model = self.located.model.keep(kinds)
        found = estimate_variances(model, free, start)
        return (float(found.deviations[at]), *find_interval(model, found, free, at))

    def find_rivals(self, place: Place, chosen: Sequence[Place], best: Variances) -> list[Place]:
        """Return the places of the same level or kind that explain the data about as well as a load does."""
        level, kind = place
        others = [each for each in chosen if each != place]
        near = [(level, k) for k in range(self.shape[1])] + [(i, kind) for i in range(self.shape[0])]
        free = [each for each in dict.fromkeys(near) if each not in chosen]
        return [each for each in free if self.replace(place, each, others, best) < RIVAL]

    def replace(self, place: Place, rival: Place, others: Sequence[Place], best: Variances) -> float:
        """Return how much the criterion rises with a rival in the stead of a load."""
        start = best.relative.copy()
        start[rival] = start[place]
        found = self.fit([*others, rival], Variances(start, best.criterion))
        return found.criterion.value - best.criterion.value

    def _choose(self) -> list[Place]:
        """Return the loads without which the criterion is worse by `LEAST_GAIN`."""
        chosen: list[Place] = []
        found = self.fit(chosen)
        while len(chosen) < MOST_LOADS:
            slope = -self.located.model.evaluate(found.relative).gradient * self._least
            slope[tuple(np.array(chosen, dtype=int).reshape(-1, 2).T)] = -np.inf
            order = np.argsort(-slope, axis=None)[:TRIALS]
            steep = [divmod(int(at), self.shape[1]) for at in order if slope.flat[at] > 0.0]
            trials = {place: self.fit([*chosen, place], found) for place in steep}
            best = min(steep, key=lambda place: trials[place].criterion.value, default=None)
            if best is None or found.criterion.value - trials[best].criterion.value < LEAST_GAIN:
                break
            chosen, found = [*chosen, best], trials[best]
            chosen, found = self._drop(chosen, found)
        return chosen

    def _drop(self, chosen: list[Place], found: Variances) -> tuple[list[Place], Variances]:
        """Return the loads without those that the last one has made superfluous."""
        for place in chosen[:-1]:
            without = self.fit([each for each in chosen if each != place], found)
            if without.criterion.value - found.criterion.value < LEAST_GAIN:
                return [each for each in chosen if each != place], without
        return chosen, found

    def _find_interval(self, places: Sequence[Place], best: Variances, place: Place) -> tuple[float, float]:
        """Return the 95 % interval of the size of a load beside others. [kW]"""
        kinds, free, most = self._restrict(places)
        here = Variances(best.relative[:, kinds], best.criterion)
        at = place[0], kinds.index(place[1])
        return find_interval(self.located.model.keep(kinds), here, free, at, most)

    def _restrict(self, places: Sequence[Place]) -> tuple[list[int], NDArray[np.bool_], Floats]:
        """Return the kinds of some places, which variances of these kinds are free, and their limits."""
        kinds = sorted({kind for _, kind in (*places, *self._always)}) or [0]
        free = np.zeros((self.shape[0], len(kinds)), dtype=bool)
        most = np.full(free.shape, np.inf)
        for place in (*places, *self._always):
            at = place[0], kinds.index(place[1])
            free[at] = True
            if place not in places:
                most[at] = self._most[place]
        return kinds, free, most
