"""What is learned of a fleet: summed through the day, taken up overnight.

How rides and rests go (`core.forecast.habits`), what cars and drivers take and how long and busy each car's shifts are
(`core.forecast.scales`), how far off forecasts were (`core.forecast.conformal`) and what they were short by. All of it takes
effect when the next day begins: what a forecast rests on is a matter of the day, and not of who else was served a
moment earlier.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.batch import Floats, Ints, grown
from core.forecast.conformal import Conformal
from core.forecast.learning.car_driver import Habit, Scales
from core.forecast.learning.forecast_errors import Judged, Lean
from core.forecast.learning.leg_energy import TEMPERATURES, Tables
from core.forecast.learning.ride_stats import Habits
from core.forecast.outlook import Usual
from core.forecast.soc_filter import WARMING
from core.totals.accumulator import Totals
from core.totals.context import RunContext
from core.totals.tables import energy_by_soc, measured_energy, unfit_reason
from core.vehicles.fleet import UNKNOWN

TELLING: Final = (None, "too_long")
"""Why rides may be unfit for training and yet are learned from: errands of hours are part of shifts."""
SOAKED: Final = 3600.0
"""After a longer rest, a ride warms the car up, and is no ride like others. [s]"""
LONGEST_SILENCE: Final = 60.0
"""Time that may be missing in a rest that is learned from. [s]"""
_KNOTS: Final = len(TEMPERATURES)

Learn = Callable[[Sequence[str], Totals, Floats, Floats], None]
"""Takes vehicle models, totals, and energies that were predicted and measured."""


class Lessons:
    """What was learned, and what will be.

    Parameters
    ----------
    context : RunContext
    width : int
        Amounts that are summed of a ride.

    Attributes
    ----------
    prior : (lanes, 2) float
        Mean and variance of the logarithm of what each car will take over what is predicted, on a new shift.
    """

    def __init__(self, context: RunContext, width: int) -> None:
        self._context, self._cars = context, context.cars
        self.habits, self.scales, self.conformal, self.lean = Habits(width), Scales(), Conformal(), Lean()
        self.prior = np.zeros((0, 2))
        self._shifts = np.zeros((0, 2))
        self._took: list[tuple[int, int | None, float, float, float]] = []
        self._usual, self._names = _stacked({})
        self._place: Ints = np.zeros(0, np.int64)

    def grow(self, lanes: int) -> None:
        """Have room for so many lanes."""
        if len(self.prior) < lanes:
            self.prior = grown(self.prior, lanes, self.scales.expected(-1))
            self._shifts = grown(self._shifts, lanes, np.nan)

    def rides(self, rides: Totals, predicted: Floats) -> None:
        """Learn from rides that have ended and are fit for it."""
        if len(rides.lane):
            fit = np.array([why in TELLING for why in unfit_reason(rides, self._context)])
            plugged = rides.at_last("since_charge") - rides.amount("duration")
            fit &= ~(rides.at_last("parked") > SOAKED) & ~(plugged < WARMING)
            self._learn(self.habits.ridden, rides, predicted, measured_energy(rides, self._cars)[0], fit)

    def rests(self, rests: Totals, predicted: Floats) -> None:
        """Learn from rests that have ended: those in which the car neither charged nor fell silent."""
        if not len(rests.lane):
            return
        duration = rests.amount("duration")
        whole = rests.at_last("time") - rests.at_first("time") <= duration + LONGEST_SILENCE
        charged = rests.at_last("since_charge") < duration + LONGEST_SILENCE
        fit = whole & ~charged & (rests.at_first("time") > 0.0)
        energy = np.where(rests.amount("metered") > 0.5 * duration, measured_energy(rests, self._cars)[0], np.nan)
        by_soc = energy_by_soc(rests, self._cars)[0]
        self._learn(self.habits.rested, rests, predicted, np.where(np.isnan(energy), by_soc, energy), fit)

    def judged(self, errors: Sequence[Judged]) -> None:
        """Learn what became of forecasts."""
        for each in errors:
            self.conformal.learn(*each[:4])
            self.lean.learn(each)

    def shift(self, lane: int, took: tuple[int | None, float, float, float], habit: Habit | None) -> None:
        """Learn from a shift that has ended: its driver, what was predicted and what it took of which capacity [kWh].

        What cars and drivers take waits for the night: it is read when a driver gets in.
        """
        self._took.append((lane, *took))
        if habit is not None:
            self.scales.went(lane, habit)

    def overnight(self) -> None:
        """Let all that was learned take effect."""
        for took in self._took:
            self.scales.learn(*took)
        self._took = []
        self._settle()

    def tables(self, lane: int) -> Tables | None:
        """Return what is expected of a lane's car."""
        kind = int(self._cars.of_lane[lane]) if lane < len(self._cars.of_lane) else UNKNOWN
        return self.habits.tables.get(self._cars.name(kind) or "")

    def corrected(self, kinds: Ints, riding: NDArray[np.bool_], weights: Floats) -> tuple[Floats, Floats]:
        """Return by what predicted energy is to be multiplied, and what power added [kW], at each row, (n,) each."""
        place, mine = self._places(kinds), riding[:, np.newaxis]
        own = np.where(mine, self._usual.factor[place], self._usual.resting_factor[place])
        more = np.where(mine, self._usual.power[place], self._usual.resting_power[place])
        return np.einsum("ij,ij->i", own, weights), np.einsum("ij,ij->i", more, weights)

    def usual(self, kinds: Ints, weights: Floats) -> Usual:
        """Return what is usual of cars at the temperatures about each row."""
        place = self._places(kinds)
        of = (np.einsum("ij,ij->i", each[place], weights) for each in self._usual[4:])
        return Usual(weights, *of)

    def habits_of(self, lanes: Ints) -> tuple[Floats, Floats]:
        """Return how long the shifts of cars are [h], and how busy; NaN where too few are known."""
        return self._shifts[lanes, 0], self._shifts[lanes, 1]

    def _settle(self) -> None:
        """Make of what was learned what forecasts read."""
        self.habits.settle(self._context)
        self.conformal.settle()
        self.lean.settle()
        for lane in range(len(self.prior)):
            self.prior[lane] = self.scales.expected(lane)
            self._shifts[lane] = self.scales.habit(lane)
        self._usual, self._names = _stacked(self.habits.tables)
        self._place = np.zeros(0, np.int64)

    def _places(self, kinds: Ints) -> Ints:
        """Return the row of `_usual` of each kind of car."""
        if len(self._place) < len(self._cars.models):
            names = [self._cars.name(kind) for kind in range(len(self._cars.models))]
            self._place = np.array([self._names.get(name or "", 0) for name in names])
        return self._place[kinds]

    def _learn(self, learn: Learn, totals: Totals, predicted: Floats, measured: Floats, fit: NDArray[np.bool_]) -> None:
        """Learn from those rows that are fit, of cars whose model is known."""
        names = [self._cars.name(kind) or "" for kind in totals.at_last("kind").astype(np.int64).tolist()]
        known = np.array([name != "" for name in names])
        which = np.flatnonzero(fit & known & (totals.amount("duration") > 0.0))
        learn([names[i] for i in which.tolist()], totals.rows(which), predicted[which], measured[which])

    def dump(self) -> Any:
        """Return the state as plain values."""
        learned = self.habits.dump(), self.scales.dump(), self.conformal.dump(), self.lean.dump()
        return learned, self._took, self.prior.tobytes(), self._shifts.tobytes()

    def load(self, state: Any) -> None:
        """Take up a state that `dump` returned, once the cars are known."""
        (habits, scales, conformal, lean), took, prior, shifts = state
        self.habits.load(habits)
        self.scales.load(scales)
        self.conformal.load(conformal)
        self.lean.load(lean)
        self._usual, self._names = _stacked(self.habits.tables)
        self._place = np.zeros(0, np.int64)
        self._took = [tuple(each) for each in took]
        self.prior, self._shifts = (np.frombuffer(part).reshape(-1, 2).copy() for part in (prior, shifts))


class _Stack(NamedTuple):
    """Of `Tables`, those that rows read, by vehicle model: (models, temperatures); of the first, nothing is known."""

    factor: Floats
    power: Floats
    resting_factor: Floats
    resting_power: Floats
    standing: Floats
    approach: Floats
    all_per_km: Floats
    all_power: Floats


def _stacked(tables: Mapping[str, Tables]) -> tuple[_Stack, dict[str, int]]:
    """Return the tables of all vehicle models, and the place of each."""
    first = {"factor": 1.0, "power": 0.0, "resting_factor": 1.0, "resting_power": 0.0}
    rows = {name: [np.full(_KNOTS, first.get(name, np.nan))] for name in _Stack._fields}
    for known in tables.values():
        for name, values in rows.items():
            values.append(getattr(known, name))
    names = {name: 1 + i for i, name in enumerate(tables)}
    return _Stack(*(np.array(values) for values in rows.values())), names
