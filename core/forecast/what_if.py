"""Answer an outlook query: the energy of a ride, and the charge that it leaves for the rest of the shift.

The queried ride comes first, after the rest of the leg in progress and a usual empty way. Then follow the other legs of
the plan, with the remaining time spread evenly before them, because a plan does not state when a leg begins. Where
these waits would be longer than usual, they have the usual length and the remaining time comes after the last leg: a
car with hours to spare mostly spends them at a charger. A plan with charges says when it does, and there the waits
may have any length. The duration of a single wait has a standard deviation equal to
its mean, as where rides are requested at any time.

Without a plan, the shift continues after the ride as the car's shifts usually do. The energies and the charge are those
of the forecast (`socast.core.forecast.outlook`): without a ride the answer equals the forecast, and with a ride it
equals the forecast that a plan with that ride would produce.
"""

from collections.abc import Iterable
from itertools import islice
from math import inf
from typing import Final, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.errors import AskError, suggest_names
from socast.core.forecast.conformal import BY_HISTORY, OVER_CHARGE, TO_CHARGE
from socast.core.forecast.engine import ForecastEngine
from socast.core.forecast.filter_state import SOC_ESTIMATE
from socast.core.forecast.learning.shift_patterns import LEAST_SHIFTS, expect_rest
from socast.core.forecast.messages import list_intervals, none_if_unknown
from socast.core.forecast.outlook import (
    DEFAULT_RESERVE,
    EnergyAhead,
    MeanAndSd,
    PlanTimes,
    compute_end_soc,
    compute_planned_energy,
    compute_soc_sd,
    fill_from_history,
    schedule_plan,
)
from socast.core.forecast.plan_tracker import LONGEST_SHIFT
from socast.core.forecast.planned_legs import PlannedLegs, compute_planned_legs
from socast.core.forecast.soc_ahead import (
    CarsNow,
    SocAhead,
    SocForecast,
    estimate_after_charge,
    find_charging_since,
    forecast_soc_ahead,
)
from socast.core.forecast.soc_filter import METER_GAIN_SD, write_estimate
from socast.core.vehicles.catalogue import OVERRIDES
from socast.core.wire.messages import Interval, Leg, LegOutlook, NextCharge, Outlook, Plan
from socast.core.wire.plan_checks import find_refusal

SEARCHED: Final = 1000
"""Largest number of vehicles among which a misspelled name is looked for."""
_ROUNDING_KWH: Final = 1e-9


class LegTimes(NamedTuple):
    """Hold how the time and the energy ahead are spread over n legs, (n,) float each.

    Parameters
    ----------
    hours, pause : Time of each leg and of the wait before it. [h]
    driving, idling : Energy of both. [kWh]
    """

    hours: Floats
    pause: Floats
    driving: Floats
    idling: Floats


class CarOutlook:
    """Answer a query about one car: its legs to drive until the end of the shift, and what they lead to.

    Attributes
    ----------
    usable_kwh : Usable capacity, NaN where unknown. [kWh]
    query_place : Index of the queried leg, None without one.
    ahead : Energy until the next planned charge, or else the end of the shift.
    """

    def __init__(self, engine: ForecastEngine, lane: int, left: PlannedLegs | None) -> None:
        cars, statistics, weather = engine.context.cars, engine.statistics, engine.weather
        self.state, filtered = engine.state[lane], np.zeros(1, SOC_ESTIMATE)
        write_estimate(self.state, filtered[0])
        self.time, lanes, kinds = float(self.state["time"]), np.array([lane]), cars.of_lane[[lane]]
        time, patterns = np.array([self.time]), statistics.patterns[lanes]
        usual_end = time + 3600.0 * expect_rest(patterns, time - filtered["begin"]).hours
        end = usual_end if left is None else np.array([left.plan.shift_end_s])
        ambient = weather.expect_ambient(filtered["ambient"], time, end, statistics.daily_cycle)
        self.now = CarsNow.create(lanes, kinds, time, filtered, ambient, statistics, cars)
        self.usable_kwh = float(self.now.estimate.capacity[0] * np.exp(self.state["log_capacity"]))
        self.tables, self.model_name = statistics.get_tables(lane), cars.name(int(kinds[0]))
        no_plan = Plan("", self.time, self.time, 100.0 * DEFAULT_RESERVE, [])
        self.is_planned, self.legs = left is not None, left or compute_planned_legs(no_plan, self.tables)
        begun = engine.plans.is_riding(lane) and len(self.legs.km) > 0
        self.in_progress = bool(begun and np.isnan(self.legs.charge_to[0]))

    def look_ahead(self, leg: Leg | None, *, drives_all: bool) -> SocAhead:
        """Return the forecasts of the charge with the queried leg first, but after the leg in progress.

        Of a published plan, only the share of the legs counts for which there is time; all of a plan in a question
        (`drives_all`) are driven, and so is the queried leg.
        """
        first, now = int(self.in_progress), self.now
        if not drives_all:
            self.legs = self.legs.keep_share(float(self._schedule(drives_all=False)[1].kept[0]), first)
        self.query_place = None if leg is None else first
        if leg is not None:
            queried = compute_planned_legs(Plan("", self.time, self.time, 0.0, [leg]), self.tables)
            sure = 1.0 / now.usual.plan_factor[0, 0]  # of plans that share is driven, but the queried leg is driven
            queried = queried._replace(energy=sure * queried.energy, begun_energy=sure * queried.begun_energy)
            self.legs = self.legs.insert(first, queried)
        progress, times = self._schedule(drives_all=True)
        of_plan = progress, times, now.time, np.array([self.in_progress]), now.usual
        self.ahead = compute_planned_energy(*of_plan, drives_home=self.is_planned)
        if not self.is_planned:
            self.ahead = _add_history(self.ahead, leg is not None, now)
        return forecast_soc_ahead(now, self.ahead, progress, times)

    def _schedule(self, *, drives_all: bool) -> tuple[NDArray[np.void], PlanTimes]:
        """Return the progress of the plan with the present legs, and how the rest of the shift is spent."""
        progress = self.legs.compute_progress(0.0).reshape(1)
        since, riding = find_charging_since(self.now.filtered, progress["came"]), np.array([self.in_progress])
        return progress, schedule_plan(progress, self.now.time, np.zeros(1), riding, since, drives_all=drives_all)

    def list_legs(self, soc: SocAhead) -> list[LegOutlook]:
        """Return the outlook of each leg."""
        is_charge = np.isfinite(self.legs.charge_to)
        basis = TO_CHARGE if is_charge.any() else int(self.ahead.basis[0])
        times = self._spread_time(is_charge)
        energies = self._compute_leg_energies(times, basis)
        stretch, out = np.cumsum(is_charge), []
        for number in range(int(is_charge.sum()) + 1):
            rows = np.flatnonzero(stretch == number)
            mean, low, high, risk = self._compute_stretch(soc, times, rows, number, basis)
            charges = list_intervals(mean, low, high)
            for place, charge, of_leg in zip(rows.tolist(), charges, risk.tolist(), strict=False):
                # the charge may have one more row
                out.append(_describe_leg(self.legs.plan.legs[place], energies[place], charge, of_leg))
        return out

    def _spread_time(self, is_charge: NDArray[np.bool_]) -> LegTimes:
        """Return the time and the energy of each leg and of the wait before it."""
        usual, place, hours = self.now.usual, np.arange(len(is_charge)), self.legs.seconds / 3600.0
        waits = place >= self.in_progress + (self.query_place is not None)
        until_end = (float(self.ahead.end[0]) - self.time) / 3600.0
        ahead = until_end if is_charge.any() else float(self.ahead.hours[0])
        spare = max(ahead - float(hours.sum()), 0.0)
        longest = inf if is_charge.any() or self.tables is None else self.tables.mean_pause
        pause = np.asarray((waits & ~is_charge) * min(spare / max(int(waits.sum()), 1), longest), np.float64)
        approaches = (place >= self.in_progress) & ~is_charge
        idling = pause * usual.standing_power + approaches * usual.approach_energy
        idling[:1] += usual.warm_up_energy
        return LegTimes(hours, pause, self.legs.energy @ usual.weights[0], idling)

    def _compute_leg_energies(self, times: LegTimes, basis: int) -> list[Interval | None]:
        """Return the energy that each leg takes from the battery. [kWh]"""
        zero, n = np.zeros(1), len(times.hours)
        energy = self.now.usual.expect_plan(self.now.usual.compute_parts(times.driving, *np.zeros((2, n))))
        only_leg = self.now.estimate._replace(variance=zero, covariance=zero, soc=zero, quantum=zero, curve=zero)
        end = compute_end_soc(only_leg, energy, times.hours)
        energy_km = energy.mean / self.now.usual.energy_per_km
        _, bounds = self.now.conformal.get_quantiles(np.full(n, basis), energy_km)
        least = np.array([-np.inf if leg.lost_m else 0.0 for leg in self.legs.plan.legs])  # only descents return energy
        falls = (-self.usable_kwh * (end.mean + end.sd * each) for each in (bounds.middle, bounds.upper, bounds.lower))
        return list_intervals(*(np.maximum(each, least) for each in falls))

    def _compute_stretch(self, soc: SocAhead, times: LegTimes, rows: Ints, number: int, basis: int) -> Floats:
        """Return the charge after each leg of a stretch between charges; a row for its end follows where known.

        It is (4, n): mean and percentiles [%], and the probability that the charge is below the reserve [1].
        """
        now, charges = self.now, np.flatnonzero(np.isfinite(self.legs.charge_to))
        begin, most, hours = now.estimate, float(now.estimate.soc[0]), times.hours[rows]
        if number:
            place, basis, most = charges[number - 1], OVER_CHARGE, 1.0
            hours = np.append(0.0, hours[1:])  # the charge itself is over where the stretch begins
            passed = np.array([float((times.hours + times.pause)[: place + 1].sum())])
            begin = estimate_after_charge(begin, self.legs.charge_to[[place]], passed, now.charged_soc)
        if number == len(charges) and soc.charged is not None:
            begin = soc.charged
        parts = now.usual.compute_parts(times.driving[rows], times.idling[rows], np.zeros(len(rows)))
        spent = now.usual.expect_plan(np.cumsum(parts, axis=0))
        timing_sd = now.usual.standing_power * np.sqrt(np.cumsum(times.pause[rows] ** 2))
        until_leg = MeanAndSd(spent.mean, np.hypot(spent.sd, timing_sd))
        of_legs = np.full(len(rows), basis), np.full(len(rows), self.ahead.reserve[0]), np.full(len(rows), most)
        levels = _stack(now.forecast_soc(begin, until_leg, np.cumsum(times.pause[rows] + hours), *of_legs))
        if not 0 < number < len(charges):
            end = _stack(soc.end if number == len(charges) else soc.charge)
            spent_until = np.append(spent.mean, inf if number else self.ahead.energy)
            levels = make_consistent(np.concatenate([levels, end]), spent_until)
        return np.asarray(levels.T * [[1.0], [1.0], [1.0], [-1.0]])

    def compute_waiting_energy(self) -> float | None:
        """Return the energy ahead beside the legs: waits, empty ways and the way home; None without a plan. [kWh]"""
        if not self.is_planned:
            return None
        parts = (self.ahead.planned * self.now.usual.plan_factor)[:, 1:]
        waiting = parts.sum(axis=1) * np.exp(self.state["log_capacity"])
        factor = np.exp(self.now.estimate.compute_mean_log_factor(self.ahead.hours))
        return none_if_unknown(float((waiting * factor)[0]))


def _stack(soc: SocForecast) -> Floats:
    """Return mean and percentiles [%] of charges, and the negative risk, all of which fall with them, (n, 4)."""
    return np.column_stack([100.0 * soc.mean, 100.0 * soc.p05, 100.0 * soc.p95, -soc.risk])


def make_consistent(charge: Floats, spent: Floats) -> Floats:
    """Return charges ahead, one point after another, that do not rise while energy is spent; NaN where unknown.

    Intervals are learned for each distance separately, so that a later one may be narrower. The last charge stays as it
    is. The ones before are raised to it where necessary, because a car below it earlier is also below it later. The
    energy until each point [kWh] falls where a descent returns more than the leg takes.

    Examples
    --------
    >>> make_consistent(np.array([50.0, 40.0, 42.0, 41.0]), np.array([1.0, 2.0, 3.0, 2.5])).tolist()
    [50.0, 42.0, 42.0, 41.0]
    """
    out = charge.copy()
    for i in reversed(range(len(out) - 1)):
        if spent[i + 1] >= spent[i] - _ROUNDING_KWH:
            out[i] = np.where(np.isnan(out[i]), out[i], np.fmax(out[i], out[i + 1]))
    return out


def _describe_leg(leg: Leg, energy: Interval | None, soc: Interval | None, risk: float) -> LegOutlook:
    """Return the outlook of a leg."""
    if leg.charge_to_soc_pct is not None:
        return LegOutlook(0.0, leg.duration_s, None, soc, leg.charge_to_soc_pct)
    return LegOutlook(leg.distance_km or 0.0, leg.duration_s, energy, soc, reserve_risk=none_if_unknown(risk))


def answer_query(engine: ForecastEngine, lane: int, leg: Leg | None, plan: Plan | None) -> Outlook:
    """Return the outlook of the rest of a shift."""
    tracker, time = engine.plans, float(engine.state["time"][lane])
    if plan is not None and (refused := find_refusal(plan, time, LONGEST_SHIFT)) is not None:
        raise AskError(refused.message, refused.cause)
    left = tracker.get_remaining_legs(lane, time, plan, engine.statistics.get_tables(lane))
    car = CarOutlook(engine, lane, left)
    soc = car.look_ahead(leg, drives_all=plan is not None)
    end, charge = (list_intervals(*(100.0 * each for each in of[:3]))[0] for of in (soc.end, soc.charge))
    legs, now, ahead = car.list_legs(soc), car.now, car.ahead
    capacity_sd = car.usable_kwh * float(np.hypot(np.sqrt(car.state["p_cc"]), METER_GAIN_SD))
    ended = plan is None and left is None and lane in tracker.plans
    no_energy = _explain_unknown_energy(car, later=lane in tracker.later, ended=ended)
    next_charge = charge and NextCharge(float(soc.charge_time[0]), charge, none_if_unknown(float(soc.charge.risk[0])))
    return Outlook(
        vehicle_id=engine.context.vehicle_ids[lane],
        time_s=time,
        model=engine.context.model_label,
        soc_pct=none_if_unknown(100.0 * float(now.estimate.soc[0])),
        soc_sd_pct=none_if_unknown(100.0 * float(compute_soc_sd(now.estimate)[0])),
        usable_capacity_kwh=none_if_unknown(car.usable_kwh),
        usable_capacity_sd_kwh=none_if_unknown(capacity_sd),
        consumption_scale=none_if_unknown(float(np.exp(car.state["log_consumption"]))),
        asked=None if car.query_place is None else legs.pop(car.query_place),
        legs=legs,
        shift_end_s=none_if_unknown(float(ahead.end[0])),
        soc_end_of_shift_pct=end,
        reserve_soc_pct=100.0 * float(ahead.reserve[0]),
        reserve_risk=none_if_unknown(float(soc.end.risk[0])),
        why_not=None if end else _explain_unknown_end(car, no_energy),
        next_charge=next_charge or UNSET,
        waiting_energy_kwh=car.compute_waiting_energy(),
    )


def explain_unknown_vehicle(vehicle_id: str, heard: Iterable[str]) -> AskError:
    """Return the error of a query about a vehicle that has sent nothing, with similar names of those that have."""
    names = list(islice(heard, SEARCHED))
    remedy = suggest_names(vehicle_id, names) if names else "no vehicle has sent anything"
    return AskError(f"vehicle {vehicle_id!r} has sent nothing so far: {remedy}", "unknown_vehicle")


def _add_history(ride: EnergyAhead, queried: bool, now: CarsNow) -> EnergyAhead:
    """Return the energy ahead without a plan: the queried ride, if any, and the usual rest of the shift after it.

    In a shift that is longer than all that are remembered, the queried ride is all that is ahead.
    """
    unknown = np.array([np.nan])
    nothing = ride._replace(energy=unknown, km=unknown, hours=unknown, end=unknown, reserve=unknown)
    later = now.usual._replace(warm_up_energy=np.zeros(1))  # the warm-up is part of the ride's energy
    usual = fill_from_history(nothing, later, ride.end - now.filtered["begin"], ride.end, now.patterns)
    if np.isfinite(usual.energy[0]):
        energy, km, hours = ride.energy + usual.energy, ride.km + usual.km, ride.hours + usual.hours
        return usual._replace(energy=energy, sd=np.hypot(ride.sd, usual.sd), km=km, hours=hours)
    if queried and np.isfinite(now.patterns["hours"][0, LEAST_SHIFTS - 1]):
        return ride._replace(basis=np.full(1, BY_HISTORY))
    return usual


def _explain_unknown_energy(car: CarOutlook, *, later: bool, ended: bool) -> str | None:
    """Return why the energy ahead is unknown; None where it is known."""
    if car.is_planned or np.isfinite(car.ahead.energy[0]):
        return None
    plan = "the plan that is known has ended; send a new one" if ended else "no plan is known"
    plan = "the plan that is known is of a later shift" if later else plan
    if np.isfinite(car.now.patterns["hours"][0, LEAST_SHIFTS - 1]):
        return f"{plan}, and this shift is already longer than every earlier one of this car that is remembered"
    return f"{plan}, and this car has ended too few shifts to estimate the rest of this one"


def _explain_unknown_end(car: CarOutlook, no_energy: str | None) -> str:
    """Return why the charge at the end is unknown, the most basic reason first."""
    if not np.isfinite(car.now.estimate.soc[0]):
        return "the car reports no state of charge"
    if car.tables is None:
        if car.model_name is None:
            return "no vehicle message has told which model this car is"
        return (
            f"the vehicle model {car.model_name!r} is not in the catalogue, and its vehicle message lacks "
            f"{' or '.join(OVERRIDES)}; describe the car with `socast vehicles new`"
        )
    return no_energy or "the temperature or the energy ahead is unknown"
