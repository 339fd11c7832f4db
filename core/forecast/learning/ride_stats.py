"""How rides and rests go: sums over those that ended, by vehicle model.

Of each ride everything that is summed of it is kept, by pace and outside temperature: a ride tells of the two paces and
the two temperatures about it, each by how near it is (bilinear weights). Beside it stands what regressions of measured
on predicted energy are made of, and, once there are tables, of measured energy on what they make a ride of. What
follows for a planned leg is made of these sums by `core.forecast.tabulated`.
"""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from core.batch import Floats
from core.columns import ZERO_CELSIUS
from core.forecast.learning.leg_energy import PACES, TEMPERATURES, Tables, tents
from core.forecast.learning.tabulated import BESIDE, CELLS, READ, TERMS, Rests, fitted, tabulated
from core.forecast.soc_filter import NOISE
from core.totals.accumulator import AMOUNTS, EDGES, Totals
from core.totals.context import RunContext

LEAST_RIDES: Final = 40
"""Rides of a vehicle model below which nothing is expected of it."""
STANDING: Final = 60.0
"""A car that moved no farther in a rest stood: positions wander. [m]"""
_LEG: Final = [AMOUNTS.index(name) for name in ("distance", "duration", "gained", "lost")]


class Learned(NamedTuple):
    """What was summed of a vehicle model.

    Parameters
    ----------
    rides : (paces * temperatures, amounts and `BESIDE`) float
    rests : (temperatures, amounts and `BESIDE`) float
    still : (temperatures, 4) float
        Of rests, see `core.forecast.tabulated.Rests`.
    equations : (TERMS, TERMS + 1) float
        Normal equations of what the terms of a ride take, see `core.forecast.tabulated.fitted`.
    edges : (2, edges) float
        First and last of the newest ride.
    counts : (2,) float
        Rides, and rests whose energy was measured.
    """

    rides: Floats
    rests: Floats
    still: Floats
    equations: Floats
    edges: Floats
    counts: Floats

    @classmethod
    def none(cls, width: int) -> "Learned":
        """Return what there is before the first ride of so many amounts."""
        knots, columns = len(TEMPERATURES), width + len(BESIDE)
        shapes = (CELLS, columns), (knots, columns), (knots, 4), (TERMS, TERMS + 1), (2, len(EDGES)), (2,)
        return cls(*(np.zeros(shape) for shape in shapes))


class Habits:
    """What was summed of rides and rests as they ended, and the tables that were made of it the night before.

    Parameters
    ----------
    width : int
        Amounts that are summed of a ride.
    """

    def __init__(self, width: int) -> None:
        self._width = width
        self._sums: dict[str, Learned] = {}
        self.tables: dict[str, Tables] = {}

    def ridden(self, models: Sequence[str], rides: Totals, predicted: Floats, measured: Floats) -> None:
        """Learn from rides that have ended; those that waited more than they drove tell of no pace.

        Parameters
        ----------
        models : sequence of n str
            Vehicle model of each.
        rides : Totals
            Of n rides.
        predicted, measured : (n,) float
            NaN where unknown. [kWh]
        """
        minutes, km = rides.amount("duration") / 60.0, rides.amount("distance") / 1000.0
        pace = np.divide(minutes, km, out=np.full(len(km), np.inf), where=km > 0.0)
        paces, driving = tents(pace, PACES), pace <= PACES[-1]
        ambient, rows = _ambient(rides), _rows(rides, predicted, measured)
        for i, model in enumerate(models):
            own = self._of(model)
            if driving[i]:
                _add(own.rides, np.outer(paces[i], ambient[i]).ravel(), rows[i])
            if model in self.tables and np.isfinite(measured[i]):
                self._weigh(model, rides.amounts[i, _LEG], ambient[i], measured[i])
            own.edges[:] = rides.first[i], rides.last[i]
            own.counts[0] += 1.0

    def _weigh(self, model: str, leg: Floats, ambient: Floats, measured: float) -> None:
        """Add a ride to the normal equations of its terms, as the tables of the day before know them."""
        metres, seconds, gained, lost = leg[:, np.newaxis]
        tables = self.tables[model]
        terms = tables.terms(metres / 1000.0, seconds, gained, lost)
        waited = float(terms.waiting[0] * (tables.standing @ ambient))
        cells = np.outer(terms.km[0], ambient)
        expected = float((cells * tables.per_km).sum()) + waited
        weight = 1.0 / (NOISE**2 * max(expected, 0.0) + READ**2)
        row = np.concatenate([cells.ravel(), terms.extras[0]])
        self._sums[model].equations[:] += weight * np.outer(row, [*row, measured - waited])

    def rested(self, models: Sequence[str], rests: Totals, predicted: Floats, measured: Floats) -> None:
        """Learn from rests that have ended, as from rides."""
        ambient, rows = _ambient(rests), _rows(rests, predicted, measured)
        energies = np.column_stack([measured, rests.amount("duration") / 3600.0])
        stood = (rests.amount("distance") < STANDING)[:, np.newaxis]
        still = np.hstack([energies, stood * energies])
        for i, model in enumerate(models):
            own = self._of(model)
            _add(own.rests, ambient[i], rows[i])
            if np.isfinite(measured[i]):
                _add(own.still, ambient[i], still[i])
                own.counts[1] += 1.0

    def _of(self, model: str) -> Learned:
        """Return the sums of a vehicle model."""
        if model not in self._sums:
            self._sums[model] = Learned.none(self._width)
        return self._sums[model]

    def settle(self, context: RunContext) -> None:
        """Make tables of all that was learned, for forecasts by the model of `context`."""
        self.tables = {}
        for name, own in self._sums.items():
            if own.counts[0] < LEAST_RIDES:
                continue
            rests = Rests(own.rests, own.still, float(own.counts[1]))
            found = tabulated(own.rides, rests, own.edges, context)
            if found is not None:
                self.tables[name] = fitted(found, own.equations)

    def dump(self) -> Any:
        """Return the state as plain lists."""
        return tuple(
            {name: [np.asarray(part).tolist() for part in parts] for name, parts in each.items()}
            for each in (self._sums, self.tables)
        )

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned."""
        sums, tables = state
        self._sums = {name: Learned(*map(np.array, parts)) for name, parts in sums.items()}
        self.tables = {name: _table(parts) for name, parts in tables.items()}


def _table(parts: Sequence[Any]) -> Tables:
    """Return tables that were dumped."""
    values: list[Any] = [part if isinstance(part, float) else np.array(part) for part in parts]
    return Tables(*values)


def _ambient(totals: Totals) -> Floats:
    """Return the weight of each of `TEMPERATURES` at the mean outside temperature, (n, temperatures)."""
    return tents(totals.amount("ambient") / totals.amount("duration") - ZERO_CELSIUS, TEMPERATURES)


def _rows(totals: Totals, predicted: Floats, measured: Floats) -> Floats:
    """Return what is added up of each ride or rest, (n, amounts and `BESIDE`)."""
    hours, weight = totals.amount("duration") / 3600.0, 1.0 / (NOISE**2 * np.maximum(predicted, 0.0) + READ**2)
    products = predicted * predicted, predicted * hours, hours * hours, predicted * measured, hours * measured
    beside = np.column_stack([predicted, measured, hours, *(weight * product for product in products)])
    known = np.isfinite(predicted) & np.isfinite(measured)
    return np.hstack([np.nan_to_num(totals.amounts), np.where(known[:, np.newaxis], beside, 0.0)])


def _add(sums: Floats, weights: Floats, row: Floats) -> None:
    """Add a row to each sum, by its weight."""
    sums += weights[:, np.newaxis] * row
