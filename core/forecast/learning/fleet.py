"""Statistics of a fleet: collected through the day, applied by the daily update.

They hold what driving, waiting and the climate take (`energy_regression`), what is done of plans (`plan_outcomes`), the
consumption factors of cars and drivers (`car_driver`), each car's newest shifts (`shift_patterns`), and the errors of
forecasts (`socast.core.forecast.conformal` and `forecast_errors`). All of them take effect when the next day begins. So
a forecast depends on the day, and not on which other cars sent samples a moment earlier.
"""

from collections.abc import Sequence
from itertools import chain
from math import exp, isfinite
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, Stateful, grown, replace_nan, sum_weighted, take_lanes
from socast.core.cleaning.meters import FROZEN_SOC
from socast.core.columns import ZERO_CELSIUS
from socast.core.forecast.conformal import BASES, TO_CHARGE, ConformalIntervals, weigh_day
from socast.core.forecast.filter_state import LOG_FACTOR_PRIOR
from socast.core.forecast.learning.car_driver import ConsumptionFactors
from socast.core.forecast.learning.charged_soc import ChargedSoc
from socast.core.forecast.learning.consumption_terms import (
    STRETCH_AMOUNTS,
    TEMPERATURES,
    WARM_UP,
    CoefficientPrior,
    compute_stretch_amounts,
    compute_warm_up_left,
    make_prior,
    predict_energy,
)
from socast.core.forecast.learning.daily_cycle import DailyCycle
from socast.core.forecast.learning.energy_regression import EnergyRegressions, StretchRows
from socast.core.forecast.learning.forecast_errors import ShiftErrors
from socast.core.forecast.learning.leg_energy import LegEnergyTables
from socast.core.forecast.learning.plan_outcomes import PLAN_PARTS, PlanOutcomes
from socast.core.forecast.learning.shift_patterns import NO_SHIFTS, SHIFT_PATTERNS, remember_shift
from socast.core.forecast.outlook import UsualConsumption, compute_temperature_weights
from socast.core.forecast.soc_filter import WARM_UP_TIME
from socast.core.totals.accumulator import Totals, join_totals
from socast.core.totals.context import RunContext
from socast.core.totals.measured_energy import BY_SOC, compute_largest_energy, measure_energy
from socast.core.totals.tables import has_unsettled_clock, unfit_reason
from socast.core.vehicles.fleet import UNKNOWN

ACCEPTED_UNFITNESS: Final = (None, "too_long")
"""Reasons for which a ride may be unfit for training and still counts: errands of hours belong to shifts."""
LONGEST_SOAK: Final = 3600.0
"""After a longer idle period the car warms up on its ride, which is then not representative. [s]"""
LONGEST_GAP: Final = 60.0
"""Time that may be missing in an idle period that counts. [s]"""
_USUAL: Final = (
    *("standing_power", "approach_energy", "warm_up_energy", "energy_per_km", "mean_power", "driving_energy_per_km"),
)
"""What `LegEnergyTables` hold at each temperature, and `UsualConsumption` at that of a row."""
_STACKED: Final[dict[str, tuple[int, ...]]] = {
    **dict.fromkeys((*_USUAL, "ride_pace", "level", "level_sd"), ()),
    "rates": (STRETCH_AMOUNTS,),
    "parts_covariance": (2, 2),
}
"""What is looked up in `LegEnergyTables` of many cars -> its shape at each temperature."""


class ShiftEnergy(NamedTuple):
    """Hold the energy of a shift that has ended.

    Parameters
    ----------
    driver : Code of the only driver, None where unknown or more than one.
    predicted_kwh, used_kwh : Energy as predicted, and by the charge; the second is NaN where it is unknown. [kWh]
    capacity_kwh : Nominal usable capacity. [kWh]
    model : Vehicle model, empty where it is unknown.
    level : Level of the tables that predicted it, see `LegEnergyTables`. [1]
    ambient_c : Mean outside temperature. [°C]
    hours : Duration. [h]
    """

    lane: int
    driver: int | None
    predicted_kwh: float
    used_kwh: float
    capacity_kwh: float
    model: str
    level: float
    ambient_c: float
    hours: float


class FleetStatistics:
    """Collect statistics of a fleet, and apply them once a day.

    Attributes
    ----------
    prior : (lanes,) LOG_FACTOR_PRIOR
        Logarithm of the consumption factor of each car at the beginning of a shift.
    errors : dict of int to list of ShiftErrors
        Errors of the forecasts of each lane since the last daily update, None where its clock leapt.
    interval_outcomes : (bases, 3) int
        Numbers of evaluated forecasts with the outcome below, inside and above their published interval.
    """

    def __init__(self, context: RunContext) -> None:
        self._context, self._cars = context, context.cars
        self.energies, self.factors, self.conformal = EnergyRegressions(), ConsumptionFactors(), ConformalIntervals()
        self.daily_cycle, self.charged_soc, self.plan_outcomes = DailyCycle(), ChargedSoc(), PlanOutcomes()
        self.interval_outcomes: Ints = np.zeros((BASES, 3), np.int64)
        self.prior = np.zeros(0, LOG_FACTOR_PRIOR)
        self.patterns = np.zeros(0, SHIFT_PATTERNS)
        self._shifts: list[ShiftEnergy] = []  # until the daily update, as the next ones
        self.errors: dict[int, list[ShiftErrors] | None] = {}
        self._tables: list[LegEnergyTables | None] = []  # of each kind of car, None for unknown vehicle models
        self._stacked = _stack_tables(self._tables)

    def grow(self, lanes: int) -> None:
        """Make room for a number of lanes."""
        if len(self.prior) < lanes:
            prior = np.array(tuple(self.factors.expect(-1)), LOG_FACTOR_PRIOR)
            self.prior = grown(self.prior, lanes, prior)
            self.patterns = grown(self.patterns, lanes, NO_SHIFTS)

    def add_stretches(self, rides: Totals, idle: Totals, begin: Floats) -> None:
        """Add rides and idle periods that have ended, in their order, if they are representative.

        Units: begin [s] of the shifts of the rides, and then of the idle periods.
        """
        parts = [self._find_fit_rides(rides, begin[: len(rides.lane)]), self._find_fit_idle_periods(idle)]
        both = join_totals((rides, idle), rides)
        order = np.argsort(both.at, kind="stable")
        self._add(both.rows(order), np.concatenate(parts)[order], begin[order])

    def _find_fit_rides(self, rides: Totals, begin: Floats) -> NDArray[np.bool_]:
        """Return which rides are fit for training, and began neither just after charging nor after a rest."""
        fit = np.array([why in ACCEPTED_UNFITNESS for why in unfit_reason(rides, self._context)], np.bool_)
        plugged = rides.at_last("since_charge") - rides.amount("duration")
        rested = (rides.at_last("parked") > LONGEST_SOAK) & (rides.at_first("time") - begin > WARM_UP_TIME)
        return fit & ~rested & ~(plugged < WARM_UP_TIME)

    def _find_fit_idle_periods(self, idle: Totals) -> NDArray[np.bool_]:
        """Return in which idle periods the car neither charged nor fell silent."""
        duration = idle.amount("duration")
        whole = idle.at_last("time") - idle.at_first("time") <= duration + LONGEST_GAP
        charged = idle.at_last("since_charge") < duration + LONGEST_GAP
        return np.asarray(whole & ~charged & ~has_unsettled_clock(idle) & (idle.at_first("time") > 0.0))

    def add_errors(self, lane: int, errors: Sequence[ShiftErrors]) -> None:
        """Add the errors of evaluated forecasts of a lane, for the daily update."""
        known = self.errors.setdefault(lane, [])
        if known is not None:
            known += errors
        for each in errors:
            self.interval_outcomes[each.basis] += each.outcomes

    def distrust(self, lane: int) -> None:
        """Drop the errors of a lane's day, because its clock leapt: when anything happened is unknown."""
        self.errors[lane] = None

    def _learn_errors(self) -> None:
        """Learn from the errors of forecasts whose cars are trusted."""
        for each in chain.from_iterable(errors or () for errors in self.errors.values()):
            records = each.records
            self.plan_outcomes.add_shift(np.column_stack([records[name] for name in PLAN_PARTS]), each.done)
            if each.basis != TO_CHARGE:  # recorded with a forecast for the end of the shift
                self.daily_cycle.add_shift(records["time"], records["ambient_c"])
            if len(rows := np.flatnonzero(np.isfinite(each.scores))):
                self.conformal.add_shift(each.basis, records["ahead_km"][rows], each.scores[rows])
        self.errors = {}

    def add_shift(self, energy: ShiftEnergy) -> None:
        """Add a shift that has ended, for the daily update: consumption factors are read when a driver is named."""
        self._shifts.append(energy)

    def apply_daily_update(self) -> None:
        """Let everything that was collected take effect."""
        self.energies.apply_daily_update(self._find_prior)
        self._tables = []
        self._learn_shifts()
        self._learn_errors()
        for part in (self.conformal, self.daily_cycle, self.charged_soc, self.plan_outcomes):
            part.apply_daily_update()
        for lane in range(len(self.prior)):
            self.prior[lane] = self.factors.expect(lane)

    def _learn_shifts(self) -> None:
        """Learn the factors of cars and drivers, and the patterns of shifts, from those that have ended."""
        if not self._shifts:
            return
        self._update_kinds()
        kinds = self._cars.of_lane[[energy.lane for energy in self._shifts]]
        ambient = np.array([energy.ambient_c for energy in self._shifts]) + ZERO_CELSIUS
        weights = compute_temperature_weights(ambient)
        power = sum_weighted(self._stacked["mean_power"][kinds], weights).tolist()
        weight = weigh_day(sum(isfinite(energy.used_kwh) for energy in self._shifts))
        for energy, usual_kw in zip(self._shifts, power, strict=True):
            # what the tables have learned of the level since is not learned of the car as well
            predicted = energy.predicted_kwh * exp(self.energies.get_level(energy.model) - energy.level)
            known = energy.lane, energy.driver, predicted, energy.used_kwh, energy.capacity_kwh
            self.factors.add_shift(*known, energy.ambient_c, weight)
            if (relative_power := predicted / (usual_kw * energy.hours)) > 0.0:  # false without tables
                remember_shift(self.patterns[energy.lane], energy.hours, relative_power)
        self._shifts = []

    def get_tables(self, lane: int, kind: int | None = None) -> LegEnergyTables | None:
        """Return the tables of the vehicle model of a kind of car, by default that of a lane; None without tables."""
        if kind is None:
            kind = int(self._cars.of_lane[lane]) if lane < len(self._cars.of_lane) else UNKNOWN
        self._update_kinds()
        return self._tables[kind]

    def predict_energies(self, totals: Totals, weights: Floats, out: NDArray[np.void]) -> None:
        """Write the energies of rides and idle periods so far by the tables, NaN of unknown vehicle models, to events.

        Units: weights [1] of the knots of temperature.
        """
        self._update_kinds()
        kinds, energy = totals.kinds, np.empty(len(weights))
        predict_energy(_compute_amounts(totals), kinds, weights, self._stacked["rates"], energy)
        out["predicted"], out["level"] = energy, self._stacked["level"][kinds, 0]
        out["warm_up"] = self._interpolate("warm_up_energy", kinds, weights)
        out["level_sd"] = self._interpolate("level_sd", kinds, weights)

    def compute_usual(self, kinds: Ints, weights: Floats, awake_s: Floats) -> UsualConsumption:
        """Return the usual consumption of cars at the temperature of each row, some time after they woke. [s]"""
        self._update_kinds()
        usual = {name: self._interpolate(name, kinds, weights) for name in _USUAL}
        usual["warm_up_energy"] = usual["warm_up_energy"] * compute_warm_up_left(awake_s)
        usual["level_sd"] = self._interpolate("level_sd", kinds, weights)
        usual["ride_pace"] = self._stacked["ride_pace"][kinds, 0]
        plans, n = self.plan_outcomes, len(kinds)
        return UsualConsumption(
            weights,
            **usual,
            covariance=sum_weighted(self._stacked["parts_covariance"][kinds], weights),
            plan_factor=np.broadcast_to(plans.factor, (n, len(PLAN_PARTS))),
            plan_covariance=np.broadcast_to(plans.covariance, (n, *plans.covariance.shape)),
            plan_spread=np.full(n, plans.variance),
        )

    def _interpolate(self, name: str, kinds: Ints, weights: Floats) -> Floats:
        """Return what the tables of kinds of car hold, at the temperature of each row."""
        return sum_weighted(self._stacked[name][kinds], weights)

    def _update_kinds(self) -> None:
        """Let every kind of car have tables, also those that appeared since the last daily update."""
        first = len(self._tables)
        if first < len(self._cars.models):
            self._tables += [self._make_tables(kind) for kind in range(first, len(self._cars.models))]
            self._stacked = _stack_tables(self._tables)

    def _make_tables(self, kind: int) -> LegEnergyTables | None:
        """Return the tables of a kind of car, None for unknown vehicle models."""
        prior = self._make_prior(kind)
        return None if prior is None else self.energies.build_tables(self._cars.name(kind) or "", prior)

    def _make_prior(self, kind: int) -> CoefficientPrior | None:
        """Return what physics expects of a kind of car, None for unknown vehicle models."""
        model = self._cars.models[kind]
        scale = float(self._cars.parameters_of(np.array([kind])).accessory_scale[0])
        return None if model is None else make_prior(model, scale)

    def _find_prior(self, name: str) -> CoefficientPrior | None:
        """Return what physics expects of the first car of a vehicle model, None where no catalogue has it any more."""
        kinds = (kind for kind in range(len(self._cars.models)) if self._cars.name(kind) == name)
        return next((prior for kind in kinds if (prior := self._make_prior(kind)) is not None), None)

    def _add(self, totals: Totals, fit: NDArray[np.bool_], begin: Floats) -> None:
        """Add those rows that are fit, of cars whose model is known, with energies that their batteries can hold."""
        measured = measure_energy(totals, self._cars)
        fit = fit & ~(np.abs(measured.energy) > compute_largest_energy(totals, self._cars))
        kinds = totals.kinds.tolist()
        known = np.array([self._cars.models[kind] is not None for kind in kinds])
        which = np.flatnonzero(fit & known & (totals.amount("duration") > 0.0))
        if len(which):
            kept = totals.rows(which)
            amounts = _compute_amounts(kept)
            left = [compute_warm_up_left(each - begin[which]) for each in (kept.at_first("time"), kept.at_last("time"))]
            amounts[:, WARM_UP] = left[0] - left[1]
            still = kept.at_first("soc") == kept.at_last("soc")
            believed = np.where(still, FROZEN_SOC * self._cars.capacity[kept.kinds], 0.0)
            rows = StretchRows(
                kept.lane,
                kept.ride >= 0,
                amounts,
                compute_temperature_weights(kept.amount("ambient") / kept.amount("duration")),
                measured.energy[which],
                measured.sd[which],
                np.where(measured.source[which] == BY_SOC, believed, np.nan),
            )
            self.energies.add([self._cars.name(kinds[i]) or "" for i in which.tolist()], rows, self._find_prior)

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order; call it after the daily update."""
        self.factors.keep(lanes)
        self.prior, self.patterns = take_lanes(self.prior, lanes), take_lanes(self.patterns, lanes)

    def _get_parts(self) -> tuple[Stateful, ...]:
        """Return what learns, in the order of the state."""
        learned = self.energies, self.factors, self.conformal
        return *learned, self.daily_cycle, self.charged_soc, self.plan_outcomes

    def dump(self) -> Any:
        """Return the state as plain values."""
        arrays = self.prior.tobytes(), self.patterns.tobytes(), self.interval_outcomes.tobytes()
        errors = [(lane, of_lane and [each.dump() for each in of_lane]) for lane, of_lane in self.errors.items()]
        return [part.dump() for part in self._get_parts()], self._shifts, errors, *arrays

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned, once the cars are known."""
        parts, shifts, errors, prior, patterns, outcomes = state
        for part, dumped in zip(self._get_parts(), parts, strict=True):
            part.load(dumped)
        self._tables = []
        self._shifts = [ShiftEnergy(*each) for each in shifts]
        self.errors = {int(lane): of_lane and [*map(ShiftErrors.load, of_lane)] for lane, of_lane in errors}
        self.prior = np.frombuffer(prior, LOG_FACTOR_PRIOR).copy()
        self.patterns = np.frombuffer(patterns, SHIFT_PATTERNS).copy()
        self.interval_outcomes = np.frombuffer(outcomes, np.int64).reshape(BASES, 3).copy()


def _stack_tables(tables: Sequence[LegEnergyTables | None]) -> dict[str, Floats]:
    """Return what the tables of all kinds of car hold, by its name, (kinds, temperatures, ...); NaN without tables."""
    stacked = {}
    for name, of_knot in _STACKED.items():
        shape = len(TEMPERATURES), *of_knot
        values = [np.nan if of_kind is None else getattr(of_kind, name) for of_kind in tables]
        stacked[name] = np.array([np.broadcast_to(value, shape) for value in values]).reshape(-1, *shape)
    return stacked


def _compute_amounts(totals: Totals) -> Floats:
    """Return the amounts of rides and idle periods, (n, amounts)."""
    km, hours = totals.amount("distance") / 1000.0, totals.amount("duration") / 3600.0
    gained, lost = (replace_nan(totals.amount(name), 0.0) for name in ("gained", "lost"))
    out = np.empty((len(km), STRETCH_AMOUNTS))
    compute_stretch_amounts(totals.ride >= 0, km, hours, gained, lost, out)
    return out
