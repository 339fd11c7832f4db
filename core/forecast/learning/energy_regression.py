"""Learn what driving, waiting and the climate take: one Bayesian regression of each vehicle model, updated daily.

The measured energy of each ride and idle period is regressed on its terms
(`socast.core.forecast.learning.consumption_terms`) with the expectation of physics as prior,

    energy = terms · coefficients + g · (energy by the tables of the day) + noise.

The rides of a car on one day share its weather, its driver and its state. Their common relative deviation g is a random
effect with the standard deviation `DAY_SD`, which the normal equations integrate out: many rides of one car on one day
tell little of the level, but much of how driving differs from waiting. The noise of a row is the measurement
uncertainty of its energy, and a part that grows with the energy. All that rows leave behind are sums. Older days lose
weight.

Where the display measures and has not moved, it may be stuck, and each short ride appears to take nothing. Such rows
wait until the display moves, and are dropped if the car should have used too much meanwhile.

References
----------
Gelman et al., Bayesian Data Analysis, 3rd edition, section 14.8, ISBN 978-1-4398-4095-5. Henderson, Biometrics 31
(1975) 423, DOI 10.2307/2529430, on random effects in normal equations.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np

from socast.core.batch import Floats, Ints
from socast.core.forecast.conformal import DAY_MEMORY
from socast.core.forecast.learning.consumption_terms import (
    CITY_PACE,
    EXPANSION,
    STRETCH_AMOUNTS,
    TERMS,
    WAITING,
    WARM_UP,
    CoefficientPrior,
    compute_stretch_amounts,
)
from socast.core.forecast.learning.leg_energy import LegEnergyTables, UsualMix
from socast.core.forecast.soc_filter import ENERGY_SD
from socast.core.totals.day_sums import DaySums

DAY_SD: Final = 0.12
"""Standard deviation of the energy of a car on a day over that of the fleet: car, driver and day. [1]"""
LEAST_SD: Final = 0.02
"""Least standard uncertainty of a measured energy: a meter of an idle car may show exactly nothing. [kWh]"""
LARGEST_RESIDUAL_SDS: Final = 4.0
"""A row with a larger residual has less weight: as much as if its residual was this one. [standard deviations]"""
USUAL_KM: Final = 20.0
USUAL_HOURS: Final = 1.2
USUAL_RIDES: Final = 5.0
"""Kilometres of rides, hours of waiting between them, and rides, that the usual mix begins with."""
_SIZE: Final = len(TERMS)

FindPrior = Callable[[str], CoefficientPrior | None]
"""Returns what physics expects of a vehicle model, None where that is unknown."""


@cache
def make_first_mix() -> UsualMix:
    """Return the usual mix before any rides, which the sums of rides complete."""
    rides, idle = np.zeros((1, STRETCH_AMOUNTS)), np.zeros(STRETCH_AMOUNTS)
    one = np.ones(1)
    hours = USUAL_KM * CITY_PACE / 60.0 * one
    compute_stretch_amounts(np.ones(1, np.bool_), USUAL_KM * one, hours, 0.0 * one, 0.0 * one, rides)
    idle[WAITING] = USUAL_HOURS
    return UsualMix(rides[0], idle, USUAL_RIDES)


class StretchRows(NamedTuple):
    """Hold n rides or idle periods that have ended.

    Parameters
    ----------
    riding : Whether it is a ride, (n,) bool.
    amounts, weights : Amounts, and weights of the knots of temperature [1], (n, amounts) and (n, temperatures) float.
    energy, sd : Measured energy and its standard uncertainty, NaN where unknown, (n,) float. [kWh]
    most_still : Energy up to which a display is believed that has not moved, 0 where it has, and NaN where voltage and
        current measured, (n,) float. [kWh]
    """

    lane: Ints
    riding: Any
    amounts: Floats
    weights: Floats
    energy: Floats
    sd: Floats
    most_still: Floats

    def rows(self, which: Ints) -> "StretchRows":
        """Return some of the rows."""
        return StretchRows(**{name: column[which] for name, column in self._asdict().items()})


class ModelSums:
    """Hold the normal equations of a vehicle model, and the coefficients of the last daily update."""

    def __init__(self, mean: Floats) -> None:
        self.mean, self.level = mean.copy(), 0.0
        shapes: dict[str, tuple[int, ...]] = {
            "matrix": (_SIZE, _SIZE),
            "right": (_SIZE,),
            "terms": (_SIZE,),  # of all rows
            "rides": (STRETCH_AMOUNTS,),
            "idle": (STRETCH_AMOUNTS,),
            "counts": (2,),  # of rides, and of idle periods
        }
        self.known, self.today = DaySums(**shapes), DaySums(**shapes)
        self._cars: dict[int, Floats] = {}  # sums of the day of each lane
        self._waiting: dict[int, Floats] = {}  # rows of lanes whose display has not moved; none where it is stuck

    def add(self, rows: StretchRows) -> None:
        """Add rides and idle periods for the next daily update, in their order."""
        for i, lane in enumerate(rows.lane.tolist()):
            terms = rows.amounts[i] @ np.tensordot(rows.weights[i], EXPANSION, 1)
            self.today.add("terms", terms)
            self.today.add("rides" if rows.riding[i] else "idle", rows.amounts[i])
            self.today.add("counts", 1.0, (0 if rows.riding[i] else 1,))
            if np.isfinite(energy := float(rows.energy[i])) and np.isfinite(sd := float(rows.sd[i])):
                predicted = float(terms @ self.mean)
                expected = max(predicted, 0.0)
                variance = max(sd, LEAST_SD) ** 2 + ENERGY_SD**2 * expected
                off = abs(energy - predicted) / np.hypot(np.sqrt(variance), DAY_SD * expected)
                weight = min(1.0, LARGEST_RESIDUAL_SDS / max(off, 1e-9)) / variance
                row = np.concatenate([terms, [expected, energy, weight]])
                most_still = float(rows.most_still[i])
                if most_still > 0.0:
                    self._let_wait(lane, row, most_still)
                else:
                    waiting = self._waiting.pop(lane, ()) if most_still == 0.0 else ()
                    for each in (*waiting, row):
                        self._add_row(lane, each)

    def _let_wait(self, lane: int, row: Floats, most: float) -> None:
        """Let a row wait until the display moves, or drop those that wait if it should have moved before."""
        waiting = self._waiting.get(lane)
        if waiting is None or len(waiting):
            waiting = np.vstack([row] if waiting is None else [waiting, row])
            self._waiting[lane] = waiting[:0] if waiting[:, _SIZE].sum() > most else waiting

    def _add_row(self, lane: int, row: Floats) -> None:
        """Add a row to the normal equations, where the deviation of the lane's day is integrated out."""
        terms, (expected, energy, weight) = row[:_SIZE], row[_SIZE:].tolist()
        before = self._cars.setdefault(lane, np.zeros(_SIZE + 2))
        after = before + weight * expected * np.concatenate([terms, [expected, energy]])
        matrix, right = weight * np.outer(terms, terms), weight * energy * terms
        for sums, sign in ((before, 1.0), (after, -1.0)):
            shared = sign * sums[:_SIZE] / (DAY_SD**-2.0 + sums[_SIZE])
            matrix += np.outer(shared, sums[:_SIZE])
            right += shared * sums[_SIZE + 1]
        self._cars[lane] = after
        self.today.add("matrix", matrix)
        self.today.add("right", right)

    def apply_daily_update(self, prior: CoefficientPrior) -> None:
        """Let the rows of the day take effect."""
        if not self.today.get("counts").any():
            return
        for lane, waiting in self._waiting.items():
            for row in waiting:
                self._add_row(lane, row)
        self.known.age(DAY_MEMORY, self.today)
        self.forget_day()
        before, terms = self.mean, self.known.get("terms")
        self.mean = self.solve(prior)[0]
        energies = float(terms @ self.mean), float(terms @ before)
        if min(energies) > 0.0:
            self.level += float(np.log(energies[0] / energies[1]))

    def forget_day(self) -> None:
        """Drop the rows of the day."""
        self.today.clear()
        self._cars, self._waiting = {}, {}

    def solve(self, prior: CoefficientPrior) -> tuple[Floats, Floats]:
        """Return mean and covariance of the coefficients."""
        precision = np.diag(prior.sd**-2.0)
        covariance = np.asarray(np.linalg.inv(self.known.get("matrix") + precision), np.float64)
        return covariance @ (self.known.get("right") + precision @ prior.mean), covariance

    def get_mix(self) -> UsualMix:
        """Return the usual mix of rides and idle periods, without the warm-up of their shifts."""
        first = make_first_mix()
        rides, idle = first.rides + self.known.get("rides"), first.idle + self.known.get("idle")
        rides[WARM_UP] = idle[WARM_UP] = 0.0
        return UsualMix(rides, idle, first.idle_periods + float(self.known.get("counts")[1]))

    def dump(self) -> Any:
        """Return the state as plain values."""
        of_lanes = ([(lane, each.tobytes()) for lane, each in part.items()] for part in (self._cars, self._waiting))
        return self.known.dump(), self.today.dump(), *of_lanes, self.mean.tobytes(), self.level

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        known, today, cars, waiting, mean, self.level = state
        self.known.load(known)
        self.today.load(today)
        self._cars = {int(lane): np.frombuffer(sums).copy() for lane, sums in cars}
        self._waiting = {int(lane): np.frombuffer(rows).reshape(-1, _SIZE + 3).copy() for lane, rows in waiting}
        self.mean = np.frombuffer(mean).copy()


class EnergyRegressions:
    """Hold the regression of each vehicle model, by its name."""

    def __init__(self) -> None:
        self._models: dict[str, ModelSums] = {}

    def add(self, models: Sequence[str], rows: StretchRows, find_prior: FindPrior) -> None:
        """Add rides and idle periods of cars of vehicle models, in their order."""
        for name in dict.fromkeys(models):
            if name not in self._models:
                if (prior := find_prior(name)) is None:
                    continue
                self._models[name] = ModelSums(prior.mean)
            self._models[name].add(rows.rows(np.flatnonzero([model == name for model in models])))

    def apply_daily_update(self, find_prior: FindPrior) -> None:
        """Let the rows of the day take effect."""
        for name, sums in self._models.items():
            if (prior := find_prior(name)) is not None:
                sums.apply_daily_update(prior)
            sums.forget_day()

    def get_level(self, model: str) -> float:
        """Return how much the level of a vehicle model has changed since its first tables, as a logarithm."""
        return self._models[model].level if model in self._models else 0.0

    def build_tables(self, model: str, prior: CoefficientPrior) -> LegEnergyTables:
        """Return the tables of a vehicle model, from physics alone where none of its rides is known."""
        sums = self._models.get(model)
        if (
            sums is None or not sums.known.get("counts").any()
        ):  # whenever in a day a car appears, it has the same tables
            return LegEnergyTables.create(prior.mean, np.diag(prior.sd**2.0), make_first_mix(), 0.0)
        return LegEnergyTables.create(*sums.solve(prior), sums.get_mix(), sums.level)

    def dump(self) -> Any:
        """Return the state as plain values, ordered by name; the order of appearance depends on the batches."""
        return {name: each.dump() for name, each in sorted(self._models.items())}

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned."""
        self._models = {name: ModelSums(np.zeros(_SIZE)) for name in state}
        for name, sums in self._models.items():
            sums.load(state[name])
