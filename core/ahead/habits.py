"""How rides and rests go: sums over those that ended, by vehicle model.

Of each ride everything that is summed of it is kept, by pace and outside temperature: a ride tells of the two paces and
the two temperatures about it, each by how near it is (bilinear weights). Beside it stands what regressions of measured
on predicted energy are made of. What follows for a planned leg is made of these sums by `core.ahead.tabulated`.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from core.ahead.expected import PACES, TEMPERATURES, Tables, tents
from core.ahead.soc import NOISE
from core.ahead.tabulated import BESIDE, CELLS, READ, Rests, tabulated, with_extras
from core.batch import Floats
from core.cars import Cars
from core.columns import ZERO_CELSIUS
from core.models import Model
from core.sums import AMOUNTS

LEAST_RIDES: Final = 40
"""Rides of a vehicle model below which nothing is expected of it."""
STANDING: Final = 60.0
"""A car that moved no farther in a rest stood: positions wander. [m]"""
_DURATION: Final = AMOUNTS.index("duration")
_DISTANCE: Final = AMOUNTS.index("distance")
_AMBIENT: Final = AMOUNTS.index("ambient")
_GAINED: Final = AMOUNTS.index("gained")
_LOST: Final = AMOUNTS.index("lost")


class Habits:
    """What was summed of rides and rests, by vehicle model.

    Parameters
    ----------
    width : int
        Amounts that are summed of a ride.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._rides: dict[str, Floats] = {}
        self._rests: dict[str, Floats] = {}
        self._edges: dict[str, Floats] = {}
        self._extras: dict[str, Floats] = {}
        self._still: dict[str, Floats] = {}
        self._rested: dict[str, float] = {}
        self._count: dict[str, int] = {}
        self.tables: dict[str, Tables] = {}

    def ride(self, model: str, amounts: Floats, edges: Floats, predicted: float, measured: float) -> None:
        """Learn from a ride that has ended: its amounts, its edges (2, edges), its predicted and measured energy."""
        duration, distance = amounts[_DURATION], amounts[_DISTANCE]
        pace, ambient = duration / 60.0 / (distance / 1000.0), amounts[_AMBIENT] / duration - ZERO_CELSIUS
        weights = np.outer(tents(np.array([pace]), PACES)[0], tents(np.array([ambient]), TEMPERATURES)[0])
        sums = self._rides.setdefault(model, np.zeros((CELLS, self._width + len(BESIDE))))
        _add(sums, weights.ravel(), amounts, duration, predicted, measured)
        if model in self.tables and np.isfinite(measured):
            self._learn_extras(model, amounts, measured)
        self._edges[model] = edges
        self._count[model] = self._count.get(model, 0) + 1

    def _learn_extras(self, model: str, amounts: Floats, measured: float) -> None:
        """Learn what hills and the ride's beginning add, from what the tables of the day before leave of a ride."""
        told = (amounts[[i]] for i in (_DISTANCE, _DURATION, _GAINED, _LOST))
        km, seconds, gained, lost = told
        plain, extras = self.tables[model].parts(km / 1000.0, seconds, gained, lost)
        ambient = amounts[_AMBIENT] / amounts[_DURATION] - ZERO_CELSIUS
        expected = float(plain[0] @ tents(np.array([ambient]), TEMPERATURES)[0])
        weight = 1.0 / (NOISE**2 * max(expected, 0.0) + READ**2)
        sums = self._extras.setdefault(model, np.zeros((3, 4)))
        sums += weight * np.outer(extras[0], [*extras[0], measured - expected])

    def rest(self, model: str, amounts: Floats, predicted: float, measured: float) -> None:
        """Learn from a rest that has ended."""
        duration = amounts[_DURATION]
        weights = tents(np.array([amounts[_AMBIENT] / duration - ZERO_CELSIUS]), TEMPERATURES)[0]
        sums = self._rests.setdefault(model, np.zeros((len(TEMPERATURES), self._width + len(BESIDE))))
        _add(sums, weights, amounts, duration, predicted, measured)
        if np.isfinite(measured):
            still = self._still.setdefault(model, np.zeros((len(TEMPERATURES), 4)))
            stood = amounts[_DISTANCE] < STANDING
            still += weights[:, np.newaxis] * [measured, duration / 3600.0, stood * measured, stood * duration / 3600.0]
            self._rested[model] = self._rested.get(model, 0.0) + 1.0

    def settle(self, model: Model, cars: Cars, effects: Sequence[str]) -> None:
        """Make tables of all that was learned, for forecasts by this model."""
        self.tables = {}
        for name, rides in self._rides.items():
            if self._count[name] < LEAST_RIDES:
                continue
            rests = Rests(self._rests.get(name), self._still.get(name), self._rested.get(name, 0.0))
            found = tabulated(rides, rests, self._edges[name], model, cars, effects)
            if found is not None:
                self.tables[name] = with_extras(found, self._extras.get(name))

    def dump(self) -> Any:
        """Return the state as plain lists."""
        parts = [{name: sums.tolist() for name, sums in d.items()} for d in self._sums()]
        return parts, self._count, self._rested

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned; `settle` then makes the tables."""
        parts, self._count, self._rested = state
        for own, each in zip(self._sums(), parts, strict=True):
            own.clear()
            own.update({name: np.array(values) for name, values in each.items()})

    def _sums(self) -> tuple[dict[str, Floats], ...]:
        """Return all that is summed."""
        return self._rides, self._rests, self._edges, self._extras, self._still


def _add(sums: Floats, weights: Floats, amounts: Floats, duration: float, predicted: float, measured: float) -> None:
    """Add a ride or rest to the sums of the cells that it tells of."""
    beside = np.zeros(len(BESIDE))
    if np.isfinite(predicted) and np.isfinite(measured):
        hours, weight = duration / 3600.0, 1.0 / (NOISE**2 * max(predicted, 0.0) + READ**2)
        products = predicted**2, predicted * hours, hours**2, predicted * measured, hours * measured
        beside[:] = predicted, measured, hours, *(weight * product for product in products)
    sums += weights[:, np.newaxis] * np.concatenate([np.nan_to_num(amounts), beside])
