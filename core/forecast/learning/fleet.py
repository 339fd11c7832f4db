"""Statistics of a fleet: collected through the day, applied by the daily update.

They hold the consumption of rides and idle periods (`ride_stats`), the consumption factors of cars and drivers and the
usual pattern of each car's shifts (`car_driver`), and the errors of forecasts (`socast.core.forecast.conformal` and
`forecast_errors`). All of them take effect when the next day begins. So a forecast depends on the day, and not on which
other cars sent samples a moment earlier.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints, grown, take_lanes
from socast.core.forecast.conformal import BASES, TO_CHARGE, ConformalIntervals
from socast.core.forecast.filter_state import LOG_FACTOR_PRIOR
from socast.core.forecast.learning.car_driver import ConsumptionFactors, ShiftPattern
from socast.core.forecast.learning.charged_soc import ChargedSoc
from socast.core.forecast.learning.daily_cycle import DailyCycle
from socast.core.forecast.learning.energy_correction import EnergyCorrection
from socast.core.forecast.learning.first_tables import make_first_tables
from socast.core.forecast.learning.forecast_errors import ShiftErrors
from socast.core.forecast.learning.leg_energy import TEMPERATURES, LegEnergyTables
from socast.core.forecast.learning.ride_stats import RideStatistics
from socast.core.forecast.outlook import UsualConsumption, compute_temperature_weights
from socast.core.forecast.soc_filter import WARM_UP_TIME
from socast.core.totals.accumulator import Totals
from socast.core.totals.context import RunContext
from socast.core.totals.measured_energy import compute_largest_energy, measure_energy
from socast.core.totals.tables import unfit_reason
from socast.core.vehicles.fleet import UNKNOWN

ACCEPTED_UNFITNESS: Final = (None, "too_long")
"""Reasons for which a ride may be unfit for training and still counts: errands of hours belong to shifts."""
LONGEST_SOAK: Final = 3600.0
"""After a longer idle period the car warms up on its ride, which is then not representative. [s]"""
LONGEST_GAP: Final = 60.0
"""Time that may be missing in an idle period that counts. [s]"""
SHIFT_PATTERN: Final = np.dtype([("hours", "f8"), ("relative_power", "f8")])
"""Usual duration [h] and intensity [1] of a car's shifts, NaN where too few are known."""
_KNOTS: Final = len(TEMPERATURES)

AddTotals = Callable[[Sequence[str], Totals, Floats, Floats], None]
"""Takes vehicle models, totals, and predicted and measured energies."""


class ShiftEnergy(NamedTuple):
    """Hold the energy of a shift that has ended.

    Parameters
    ----------
    driver : int or None
        Code of the only driver, None where unknown or more than one.
    predicted_kwh, model_kwh, used_kwh : float
        Energy as predicted and corrected, as predicted by the model alone, and by the charge. [kWh]
    capacity_kwh : float
        Nominal usable capacity. [kWh]
    model : str
        Vehicle model, empty where it is unknown.
    hours : float
        Duration. [h]
    ambient : float
        Mean outside temperature. [K]
    is_corrected : bool
        Whether learned tables corrected all of the predicted energy.
    """

    lane: int
    driver: int | None
    predicted_kwh: float
    model_kwh: float
    used_kwh: float
    capacity_kwh: float
    model: str
    hours: float
    ambient: float
    is_corrected: bool


class EnergyCorrections(NamedTuple):
    """Hold how tables change the energy that the model predicts of n rides or idle periods, (n,) float each.

    Parameters
    ----------
    factor : Factor of the predicted energy. [1]
    power : Power to add. [kW]
    per_km : Energy to add for each kilometre driven. [kWh/km]
    level_sd : Standard deviation of the level of the tables, 0 for learned tables. [1]
    """

    factor: Floats
    power: Floats
    per_km: Floats
    level_sd: Floats


class FleetStatistics:
    """Collect statistics of a fleet, and apply them once a day.

    Parameters
    ----------
    width : int
        Number of amounts that are summed of a ride.

    Attributes
    ----------
    prior : (lanes,) LOG_FACTOR_PRIOR
        Logarithm of the consumption factor of each car at the beginning of a shift.
    interval_outcomes : (bases, 3) int
        Numbers of evaluated forecasts with the outcome below, inside and above their published interval.
    """

    def __init__(self, context: RunContext, width: int) -> None:
        self._context, self._cars = context, context.cars
        self.rides, self.factors = RideStatistics(width), ConsumptionFactors()
        self.conformal, self.correction = ConformalIntervals(), EnergyCorrection(BASES)
        self.daily_cycle, self.charged_soc = DailyCycle(), ChargedSoc()
        self.interval_outcomes: Ints = np.zeros((BASES, 3), np.int64)
        self.prior = np.zeros(0, LOG_FACTOR_PRIOR)
        self._patterns = np.zeros(0, SHIFT_PATTERN)
        self._shifts: list[ShiftEnergy] = []  # until the daily update, as the next ones
        self._new_patterns: list[tuple[int, ShiftPattern]] = []
        self._tables: list[LegEnergyTables | None] = []  # of each kind of car, None for unknown vehicle models
        self._rows = _stack_tables(self._tables)

    def grow(self, lanes: int) -> None:
        """Make room for a number of lanes."""
        if len(self.prior) < lanes:
            prior = np.array(tuple(self.factors.expect(-1)), LOG_FACTOR_PRIOR)
            self.prior = grown(self.prior, lanes, prior)
            self._patterns = grown(self._patterns, lanes, np.array((np.nan, np.nan), SHIFT_PATTERN))

    def add_rides(self, rides: Totals, predicted: Floats) -> None:
        """Add rides that have ended, if they are representative; `predicted` is in kWh."""
        if len(rides.lane):
            fit = np.array([why in ACCEPTED_UNFITNESS for why in unfit_reason(rides, self._context)])
            plugged = rides.at_last("since_charge") - rides.amount("duration")
            fit &= ~(rides.at_last("parked") > LONGEST_SOAK) & ~(plugged < WARM_UP_TIME)
            self._add(self.rides.add_rides, rides, predicted, measure_energy(rides, self._cars).energy, fit)

    def add_idle_periods(self, idle: Totals, predicted: Floats) -> None:
        """Add idle periods that have ended, if the car neither charged nor fell silent; `predicted` is in kWh."""
        if not len(idle.lane):
            return
        duration = idle.amount("duration")
        whole = idle.at_last("time") - idle.at_first("time") <= duration + LONGEST_GAP
        charged = idle.at_last("since_charge") < duration + LONGEST_GAP
        fit = whole & ~charged & (idle.at_first("time") > 0.0)
        self._add(self.rides.add_idle_periods, idle, predicted, measure_energy(idle, self._cars).energy, fit)

    def add_errors(self, errors: Sequence[ShiftErrors]) -> None:
        """Add the errors of evaluated forecasts."""
        for each in errors:
            self.conformal.add_shift(each.basis, each.ahead_km, each.ahead_c, each.scores)
            self.correction.add_shift(each.basis, each.parts)
            if each.basis != TO_CHARGE:  # recorded with a forecast for the end of the shift
                self.daily_cycle.add_shift(each.time, each.ambient_c)
            self.interval_outcomes[each.basis] += each.outcomes

    def add_shift(self, energy: ShiftEnergy, pattern: ShiftPattern | None) -> None:
        """Add a shift that has ended.

        The consumption factors wait for the daily update, because they are read when a driver is named.
        """
        self._shifts.append(energy)
        if pattern is not None:
            self._new_patterns.append((energy.lane, pattern))

    def apply_daily_update(self) -> None:
        """Let everything that was collected take effect."""
        self.rides.update_tables(self._context)
        self._tables = []
        for energy in self._shifts:
            if (predicted := self.correct_prediction(energy)) is not None:
                self.factors.add_shift(energy.lane, energy.driver, predicted, energy.used_kwh, energy.capacity_kwh)
        for lane, pattern in self._new_patterns:
            self.factors.add_pattern(lane, pattern)
        self._shifts, self._new_patterns = [], []
        self.conformal.apply_daily_update()
        self.correction.apply_daily_update()
        self.daily_cycle.apply_daily_update()
        self.charged_soc.apply_daily_update()
        for lane in range(len(self.prior)):
            self.prior[lane] = self.factors.expect(lane)
            self._patterns[lane] = self.factors.get_usual_pattern(lane)

    def correct_prediction(self, energy: ShiftEnergy) -> float | None:
        """Return the predicted energy of a shift, from which factors are learned; None where they cannot be. [kWh]

        Without learned tables, the used over the predicted energy tells about the tables, and not about the car. Where
        the tables were learned since, they correct what the model predicted.
        """
        if energy.is_corrected:
            return energy.predicted_kwh
        learned = self.rides.tables.get(energy.model)
        if learned is None:
            return None
        weights = compute_temperature_weights(np.array([energy.ambient]))
        factor, power = (np.einsum("ij,ij->i", each[np.newaxis], weights)[0] for each in learned.get_ride_correction())
        return float(factor) * energy.model_kwh + float(power) * energy.hours

    def get_tables(self, lane: int, kind: int | None = None) -> LegEnergyTables | None:
        """Return the tables of the vehicle model of a kind of car, by default that of a lane; None without tables."""
        if kind is None:
            kind = int(self._cars.of_lane[lane]) if lane < len(self._cars.of_lane) else UNKNOWN
        self._update_kinds()
        return self._tables[kind]

    def compute_corrections(self, kinds: Ints, riding: NDArray[np.bool_], weights: Floats) -> "EnergyCorrections":
        """Return the corrections of the predicted energy at each row."""
        self._update_kinds()
        ride = riding[:, np.newaxis]
        factor = np.where(ride, self._rows.ride_factor[kinds], self._rows.idle_factor[kinds])
        power = np.where(ride, self._rows.ride_power[kinds], self._rows.idle_power[kinds])
        return EnergyCorrections(
            np.asarray(np.einsum("ij,ij->i", factor, weights)),
            np.asarray(np.einsum("ij,ij->i", power, weights)),
            self._rows.driven_energy_per_km[kinds, 0],
            self._rows.level_sd[kinds, 0],
        )

    def compute_usual(self, kinds: Ints, weights: Floats) -> UsualConsumption:
        """Return the usual consumption of cars at the temperature of each row."""
        self._update_kinds()

        def interpolate(table: Floats) -> Floats:
            return np.asarray(np.einsum("ij,ij->i", table[kinds], weights))

        return UsualConsumption(
            weights=weights,
            standing_power=interpolate(self._rows.standing_power),
            approach_energy=interpolate(self._rows.approach_energy),
            energy_per_km=interpolate(self._rows.energy_per_km),
            mean_power=interpolate(self._rows.mean_power),
            driving_energy_per_km=interpolate(self._rows.driving_energy_per_km),
            ride_pace=self._rows.ride_pace[kinds, 0],
            relative_sd=interpolate(self._rows.relative_sd),
            factor=np.einsum("nk,bpk->nbp", weights, self.correction.factor),
            covariance=np.einsum("nk,bkpq->nbpq", weights, self.correction.covariance),
        )

    def get_patterns(self, lanes: Ints) -> NDArray[np.void]:
        """Return the usual duration and intensity of the shifts of cars, (n,) SHIFT_PATTERN."""
        return self._patterns[lanes]

    def _update_kinds(self) -> None:
        """Let every kind of car have tables, also those that appeared since the last daily update."""
        first = len(self._tables)
        if first < len(self._cars.models):
            self._tables += [self._make_tables(kind) for kind in range(first, len(self._cars.models))]
            self._rows = _stack_tables(self._tables)

    def _make_tables(self, kind: int) -> LegEnergyTables | None:
        """Return the learned tables of a kind of car, or those before its first rides; None for unknown models."""
        model, learned = self._cars.models[kind], self.rides.tables.get(self._cars.name(kind) or "")
        if learned is not None or model is None:
            return learned
        return make_first_tables(model, float(self._cars.parameters_of(np.array([kind])).accessory_scale[0]))

    def _add(self, add: AddTotals, totals: Totals, predicted: Floats, measured: Floats, fit: NDArray[np.bool_]) -> None:
        """Add those rows that are fit, of cars whose model is known, with energies that their batteries can hold."""
        most = compute_largest_energy(totals, self._cars)
        fit = fit & ~(np.abs(predicted) > most) & ~(np.abs(measured) > most)
        names = [self._cars.name(kind) or "" for kind in totals.at_last("kind").astype(np.int64).tolist()]
        known = np.array([name != "" for name in names])
        which = np.flatnonzero(fit & known & (totals.amount("duration") > 0.0))
        add([names[i] for i in which.tolist()], totals.rows(which), predicted[which], measured[which])

    def keep(self, lanes: Ints) -> None:
        """Keep the state of some lanes only, in their order; call it after the daily update."""
        self.factors.keep(lanes)
        self.prior, self._patterns = take_lanes(self.prior, lanes), take_lanes(self._patterns, lanes)

    def dump(self) -> Any:
        """Return the state as plain values."""
        learning = self.rides, self.factors, self.conformal, self.correction
        parts = [part.dump() for part in (*learning, self.daily_cycle, self.charged_soc)]
        arrays = self.prior.tobytes(), self._patterns.tobytes(), self.interval_outcomes.tobytes()
        return parts, self._shifts, self._new_patterns, *arrays

    def load(self, state: Any) -> None:
        """Replace the state by one that `dump` returned, once the cars are known."""
        (rides, factors, conformal, correction, daily_cycle, charged), shifts, new, prior, patterns, outcomes = state
        self.rides.load(rides)
        self.factors.load(factors)
        self.conformal.load(conformal)
        self.correction.load(correction)
        self.daily_cycle.load(daily_cycle)
        self.charged_soc.load(charged)
        self._tables = []
        self._shifts = [ShiftEnergy(*each) for each in shifts]
        self._new_patterns = [(lane, ShiftPattern(*pattern)) for lane, pattern in new]
        self.prior = np.frombuffer(prior, LOG_FACTOR_PRIOR).copy()
        self._patterns = np.frombuffer(patterns, SHIFT_PATTERN).copy()
        self.interval_outcomes = np.frombuffer(outcomes, np.int64).reshape(BASES, 3).copy()


class _StackedTables(NamedTuple):
    """Hold tables by kind of car and temperature, (kinds, temperatures)."""

    ride_factor: Floats
    ride_power: Floats
    idle_factor: Floats
    idle_power: Floats
    standing_power: Floats
    approach_energy: Floats
    energy_per_km: Floats
    mean_power: Floats
    driving_energy_per_km: Floats
    ride_pace: Floats
    relative_sd: Floats
    driven_energy_per_km: Floats
    level_sd: Floats


def _stack_tables(tables: Sequence[LegEnergyTables | None]) -> _StackedTables:
    """Return the stacked tables of all kinds of car."""
    unknown = {"ride_factor": 1.0, "idle_factor": 1.0}
    unknown |= dict.fromkeys(("ride_power", "idle_power", "driven_energy_per_km", "level_sd"), 0.0)
    columns = {
        name: [
            np.full(_KNOTS, unknown.get(name, np.nan) if of_kind is None else getattr(of_kind, name))
            for of_kind in tables
        ]
        for name in _StackedTables._fields
    }
    return _StackedTables(**{name: np.array(values).reshape(-1, _KNOTS) for name, values in columns.items()})
