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
from math import inf, nan
from typing import Final, NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from socast.core.batch import Floats, Ints
from socast.core.errors import AskError, suggest_names
from socast.core.forecast.conformal import BY_HISTORY, OVER_CHARGE, TO_CHARGE
from socast.core.forecast.engine import ForecastEngine
from socast.core.forecast.filter_state import SOC_ESTIMATE
from socast.core.forecast.interval_columns import ChargeColumns, IntervalColumns
from socast.core.forecast.outlook import (
    DEFAULT_RESERVE,
    CarEstimate,
    EnergyAhead,
    MeanAndSd,
    PlanTimes,
    compute_end_soc,
    compute_planned_energy,
    compute_soc_sd,
    compute_temperature_weights,
    fill_from_history,
    schedule_plan,
)
from socast.core.forecast.plan_checks import find_refusal
from socast.core.forecast.plan_tracker import LONGEST_SHIFT
from socast.core.forecast.planned_legs import PlannedLegs, compute_planned_legs
from socast.core.forecast.soc_ahead import (
    SocAhead,
    SocForecast,
    estimate_after_charge,
    find_charging_since,
    forecast_soc,
    forecast_soc_ahead,
)
from socast.core.forecast.soc_filter import METER_GAIN_SD, SHIFT_GAP, write_estimate
from socast.core.vehicles.catalogue import OVERRIDES
from socast.core.wire.messages import Interval, Leg, LegOutlook, NextCharge, Outlook, Plan

SEARCHED: Final = 1000
"""Largest number of vehicles among which a misspelled name is looked for."""


class CarOutlook:
    """Hold the present estimate of a car, and compute the consequences of energies ahead of it.

    Parameters
    ----------
    shift_end : float
        Planned end of the shift, NaN without a plan. [s]

    Attributes
    ----------
    usable_kwh : float
        Usable capacity, NaN where unknown. [kWh]
    """

    def __init__(self, engine: ForecastEngine, lane: int, shift_end: float) -> None:
        cars, statistics = engine.context.cars, engine.statistics
        estimate = np.zeros(1, SOC_ESTIMATE)
        self.state = engine.state[lane]
        write_estimate(self.state, estimate[0])
        self.filtered = estimate
        kinds = cars.of_lane[[lane]]
        self.shift_begin = float(estimate["begin"][0])
        self.estimate = CarEstimate.from_filter(estimate, cars.capacity[kinds])
        self.usable_kwh = float(self.estimate.capacity[0] * np.exp(self.state["log_capacity"]))
        self.time = float(self.state["time"])
        self.pattern = statistics.get_patterns(np.array([lane]))
        usual_end = self.shift_begin + 3600.0 * self.pattern["hours"]
        end = np.array([shift_end]) if np.isfinite(shift_end) else usual_end
        now = estimate["ambient"], np.array([self.time]), end
        ambient = engine.weather.expect_ambient(*now, statistics.daily_cycle)
        awake_s = self.time - estimate["begin"]
        self.usual = statistics.compute_usual(kinds, compute_temperature_weights(ambient), awake_s)
        self.tables = statistics.get_tables(lane)
        self.model_name = cars.name(int(kinds[0]))
        self.mean_pause = inf if self.tables is None else self.tables.mean_pause
        self.conformal, self.charged_soc = statistics.conformal, statistics.charged_soc

    def forecast(
        self, begin: CarEstimate, energy: MeanAndSd, hours: Floats, basis: int, most: float, reserve: float
    ) -> SocForecast:
        """Return the charge after energies.

        Units: energy [kWh], hours [h].
        """
        n = len(hours)
        limits = np.full(n, reserve), np.full(n, most)
        return forecast_soc(begin, energy, hours, np.full(n, basis), self.usual, self.conformal, *limits)

    def compute_leg_intervals(self, legs: PlannedLegs, energy: MeanAndSd, basis: int) -> IntervalColumns:
        """Return the energy that each leg takes from the battery.

        Units: energy [kWh], returns [kWh].
        """
        zero = np.zeros(1)
        only_leg = self.estimate._replace(variance=zero, covariance=zero, soc=zero, quantum=zero, curve=zero)
        end = compute_end_soc(only_leg, energy, legs.seconds / 3600.0)
        n, energy_km = len(energy.mean), energy.mean / self.usual.energy_per_km
        _, bounds = self.conformal.get_quantiles(np.full(n, basis), energy_km)
        least = np.array([-np.inf if leg.lost_m else 0.0 for leg in legs.plan.legs])  # only descents return energy

        def compute_energy(bound: Floats) -> Floats:
            return np.asarray(np.maximum(-self.usable_kwh * (end.mean + end.sd * bound), least))

        return IntervalColumns(
            mean=compute_energy(bounds.middle), p05=compute_energy(bounds.upper), p95=compute_energy(bounds.lower)
        )


class RouteAhead(NamedTuple):
    """Hold the legs to drive until the end of the shift.

    Parameters
    ----------
    query_place : int or None
        Index of the queried leg, None without one.
    """

    legs: PlannedLegs
    in_progress: bool
    query_place: int | None

    @classmethod
    def create(
        cls, left: PlannedLegs, in_progress: bool, leg: Leg | None, now: CarOutlook, *, drives_all: bool
    ) -> "RouteAhead":
        """Return the rest of a plan, with the queried leg first, but after the leg in progress.

        Of a published plan, only the share of the legs counts for which there is time; all of a plan in a question
        (`drives_all`) are driven, and so is the queried leg.
        """
        if not drives_all:
            left = left.keep_share(float(_schedule(left, in_progress, now).kept[0]), int(in_progress))
        if leg is None:
            return cls(left, in_progress, None)
        queried = compute_planned_legs(Plan("", now.time, now.time, 0.0, [leg]), now.tables)
        sure = 1.0 / now.usual.plan_factor[0, 0]  # of plans that share is driven, but the queried leg is driven
        queried = queried._replace(energy=sure * queried.energy, begun_energy=sure * queried.begun_energy)
        return cls(left.insert(int(in_progress), queried), in_progress, int(in_progress))

    def compute_ahead(self, now: CarOutlook) -> "WayAhead":
        """Return the energy ahead by plan, as for a forecast."""
        time, riding = np.array([now.time]), np.array([self.in_progress])
        progress = self.legs.compute_progress(0.0).reshape(1)
        charging_since = find_charging_since(now.filtered, progress["came"])
        times = _schedule(self.legs, self.in_progress, now, drives_all=True)
        energy = compute_planned_energy(progress, times, time, riding, now.usual)
        return WayAhead(progress, times, charging_since, energy)

    def compute_leg_outlooks(self, now: CarOutlook, way: "WayAhead", soc: SocAhead) -> list[LegOutlook]:
        """Return the outlook of each leg."""
        is_charge = np.isfinite(self.legs.charge_to)
        legs = self._spread_time(now, way)
        only = now.usual.expect_plan(np.column_stack([legs.driving, np.zeros(len(is_charge))]))
        energy = now.compute_leg_intervals(self.legs, only, legs.basis).list_intervals()
        stretch, out = np.cumsum(is_charge), []
        for number in range(int(is_charge.sum()) + 1):
            rows = np.flatnonzero(stretch == number)
            levels = self._compute_stretch(now, way, soc, legs, rows, number)
            of_legs = zip(rows.tolist(), levels.list_intervals(), levels.risk.tolist(), strict=False)
            out += [  # the charge may have one more row
                self._describe_leg(place, energy[place], level, risk) for place, level, risk in of_legs
            ]
        return out

    def _spread_time(self, now: CarOutlook, way: "WayAhead") -> "LegTimes":
        """Return the time and the energy of each leg and of the wait before it."""
        is_charge = np.isfinite(self.legs.charge_to)
        place, hours = np.arange(len(is_charge)), self.legs.seconds / 3600.0
        waits = place >= self.in_progress + (self.query_place is not None)
        until_end = (float(way.energy.end[0]) - now.time) / 3600.0
        ahead = until_end if is_charge.any() else float(way.energy.hours[0])
        spare = max(ahead - float(hours.sum()), 0.0)
        longest = inf if is_charge.any() else now.mean_pause
        pause = np.asarray((waits & ~is_charge) * min(spare / max(int(waits.sum()), 1), longest), np.float64)
        approaches = (place >= self.in_progress) & ~is_charge
        idling = pause * now.usual.standing_power + approaches * now.usual.approach_energy
        idling[:1] += now.usual.warm_up_energy
        driving = self.legs.energy @ now.usual.weights[0]
        if is_charge.any():
            return LegTimes(hours, pause, driving, idling, TO_CHARGE)
        return LegTimes(hours, pause, driving, idling, int(way.energy.basis[0]))

    def _compute_stretch(
        self, now: CarOutlook, way: "WayAhead", soc: SocAhead, legs: "LegTimes", rows: Ints, number: int
    ) -> ChargeColumns:
        """Return the charge after each leg of a stretch between charges; a row for its end follows where known."""
        charges = np.flatnonzero(np.isfinite(self.legs.charge_to))
        begin, basis, most = now.estimate, legs.basis, float(now.estimate.soc[0])
        hours = legs.hours[rows]
        if number:
            place, basis, most = charges[number - 1], OVER_CHARGE, 1.0
            hours = np.append(0.0, hours[1:])  # the charge itself is over where the stretch begins
            passed = np.array([float((legs.hours + legs.pause)[: place + 1].sum())])
            begin = estimate_after_charge(now.estimate, self.legs.charge_to[[place]], passed, now.charged_soc)
        if number == len(charges) and soc.charged is not None:
            begin = soc.charged
        parts = np.cumsum(np.column_stack([legs.driving, legs.idling])[rows], axis=0)
        spent = now.usual.expect_plan(parts)
        timing_sd = now.usual.standing_power * np.sqrt(np.cumsum(legs.pause[rows] ** 2))
        until_leg = MeanAndSd(spent.mean, np.hypot(spent.sd, timing_sd))
        levels = ChargeColumns.from_forecast(
            now.forecast(
                begin, until_leg, np.cumsum(legs.pause[rows] + hours), basis, most, float(way.energy.reserve[0])
            )
        )
        if 0 < number < len(charges):
            return levels
        end = ChargeColumns.from_forecast(soc.end if number == len(charges) else soc.charge)
        return levels.lead_to(end, np.append(spent.mean, inf if number else way.energy.energy))

    def _describe_leg(self, place: int, energy: Interval | None, soc: Interval | None, risk: float) -> LegOutlook:
        """Return the outlook of the leg at an index."""
        leg = self.legs.plan.legs[place]
        if leg.charge_to_soc_pct is not None:
            return LegOutlook(0.0, leg.duration_s, None, soc, leg.charge_to_soc_pct)
        return LegOutlook(leg.distance_km or 0.0, leg.duration_s, energy, soc, reserve_risk=_none_if_unknown(risk))


def _schedule(legs: PlannedLegs, in_progress: bool, now: CarOutlook, *, drives_all: bool = False) -> PlanTimes:
    """Return how the rest of a shift is spent with these legs."""
    progress = legs.compute_progress(0.0).reshape(1)
    since = find_charging_since(now.filtered, progress["came"])
    time, riding = np.array([now.time]), np.array([in_progress])
    return schedule_plan(progress, time, np.zeros(1), riding, since, drives_all=drives_all)


class LegTimes(NamedTuple):
    """Hold how the time and the energy ahead are spread over n legs.

    Parameters
    ----------
    hours, pause : (n,) float
        Time of each leg and of the wait before it. [h]
    driving, idling : (n,) float
        Energy of both. [kWh]
    basis : int
        Basis of the forecasts.
    """

    hours: Floats
    pause: Floats
    driving: Floats
    idling: Floats
    basis: int


class WayAhead(NamedTuple):
    """Hold the plan of one car, with its times and its energy until the next planned charge or the end of the shift."""

    progress: NDArray[np.void]
    times: PlanTimes
    charging_since: Floats
    energy: EnergyAhead


def answer_query(engine: ForecastEngine, lane: int, leg: Leg | None, plan: Plan | None) -> Outlook:
    """Return the outlook of the rest of a shift."""
    tracker, time = engine.plans, float(engine.state["time"][lane])
    if plan is not None and (refused := find_refusal(plan, time, LONGEST_SHIFT)) is not None:
        raise AskError(refused.message, refused.cause)
    left = tracker.get_remaining_legs(lane, time, plan, engine.statistics.get_tables(lane))
    now = CarOutlook(engine, lane, nan if left is None else left.plan.shift_end_s)
    no_legs = compute_planned_legs(Plan("", now.time, now.time, 100.0 * DEFAULT_RESERVE, []), now.tables)
    in_progress = tracker.is_riding(lane) and left is not None and len(left.km) > 0 and np.isnan(left.charge_to[0])
    route = RouteAhead.create(left or no_legs, in_progress, leg, now, drives_all=plan is not None)
    way = route.compute_ahead(now)
    if left is None:
        way = way._replace(energy=_add_history(way.energy, leg is not None, now))
    ahead = way.energy
    soc = forecast_soc_ahead(
        now.estimate,
        ahead,
        way.progress,
        way.times,
        np.array([now.time]),
        way.charging_since,
        now.usual,
        now.conformal,
        now.charged_soc,
    )
    (end_interval,) = ChargeColumns.from_forecast(soc.end).list_intervals()
    (charge,) = ChargeColumns.from_forecast(soc.charge).list_intervals()
    legs = route.compute_leg_outlooks(now, way, soc)
    capacity = now.usable_kwh
    capacity_sd = capacity * float(np.hypot(np.sqrt(now.state["p_cc"]), METER_GAIN_SD))
    ended = plan is None and left is None and lane in tracker.plans
    no_energy = _explain_unknown_energy(left is not None, ahead, now.pattern, later=lane in tracker.later, ended=ended)
    return Outlook(
        vehicle_id=engine.context.vehicle_ids[lane],
        time_s=now.time,
        model=engine.context.model_label,
        soc_pct=_none_if_unknown(100.0 * float(now.estimate.soc[0])),
        soc_sd_pct=_none_if_unknown(100.0 * float(compute_soc_sd(now.estimate)[0])),
        usable_capacity_kwh=_none_if_unknown(capacity),
        usable_capacity_sd_kwh=_none_if_unknown(capacity_sd),
        consumption_scale=_none_if_unknown(float(np.exp(now.state["log_consumption"]))),
        asked=None if route.query_place is None else legs[route.query_place],
        legs=[each for number, each in enumerate(legs) if number != route.query_place],
        shift_end_s=_none_if_unknown(float(ahead.end[0])),
        soc_end_of_shift_pct=end_interval,
        reserve_soc_pct=100.0 * float(ahead.reserve[0]),
        reserve_risk=_none_if_unknown(float(soc.end.risk[0])),
        why_not=_explain_unknown_end(now, end_interval, no_energy),
        next_charge=UNSET
        if charge is None
        else NextCharge(float(soc.charge_time[0]), charge, _none_if_unknown(float(soc.charge.risk[0]))),
        waiting_energy_kwh=None if left is None else _compute_waiting_energy(now, ahead),
    )


def _compute_waiting_energy(now: CarOutlook, ahead: EnergyAhead) -> float | None:
    """Return what the car takes of the energy ahead by plan while it drives no leg. [kWh]"""
    waiting = ahead.planned[:, 1] * now.usual.plan_factor[:, 1] * np.exp(now.state["log_capacity"])
    return _none_if_unknown(float((waiting * np.exp(now.estimate.compute_mean_log_factor(ahead.hours)))[0]))


def explain_unknown_vehicle(vehicle_id: str, heard: Iterable[str]) -> AskError:
    """Return the error of a query about a vehicle that has sent nothing, with similar names of those that have."""
    names = list(islice(heard, SEARCHED))
    remedy = suggest_names(vehicle_id, names) if names else "no vehicle has sent anything"
    return AskError(f"vehicle {vehicle_id!r} has sent nothing so far: {remedy}", "unknown_vehicle")


def withhold_charge(outlook: Outlook, silent_s: float) -> Outlook:
    """Return an outlook without charges if the car has been silent for so long that its shift is over.

    The car may have driven on or charged meanwhile, so no charge is published. The energies of rides remain.
    """
    if silent_s <= SHIFT_GAP:
        return outlook
    queried, *legs = (
        each and msgspec.structs.replace(each, soc_pct=None, reserve_risk=UNSET)
        for each in (outlook.asked, *outlook.legs)
    )
    return msgspec.structs.replace(
        outlook,
        asked=queried,
        legs=legs,
        shift_end_s=None,
        soc_end_of_shift_pct=None,
        reserve_risk=None,
        next_charge=UNSET,
        waiting_energy_kwh=None,
        why_not=f"the car has been silent for {silent_s / 3600.0:.1f} h while other cars sent data, so its shift "
        "is over",
    )


def _add_history(ride: EnergyAhead, queried: bool, now: CarOutlook) -> EnergyAhead:
    """Return the energy ahead without a plan: the queried ride, if any, and the usual rest of the shift after it.

    In a shift that is longer than usual, the queried ride is all that is ahead.
    """
    unknown = np.array([np.nan])
    nothing = ride._replace(energy=unknown, km=unknown, hours=unknown, end=unknown, reserve=unknown)
    later = now.usual._replace(warm_up_energy=np.zeros(1))  # the warm-up is part of the ride's energy
    usual = fill_from_history(nothing, later, ride.end - now.shift_begin, ride.end, now.pattern)
    if np.isfinite(usual.energy[0]):
        return usual._replace(
            energy=ride.energy + usual.energy,
            sd=ride.sd,
            km=ride.km + usual.km,
            hours=ride.hours + usual.hours,
        )
    if queried and np.isfinite(now.pattern["hours"][0]):
        return ride._replace(basis=np.full(1, BY_HISTORY))
    return usual


def _explain_unknown_energy(
    planned: bool, ahead: EnergyAhead, pattern: NDArray[np.void], *, later: bool, ended: bool
) -> str | None:
    """Return why the energy ahead is unknown; None where it is known."""
    if planned or np.isfinite(ahead.energy[0]):
        return None
    plan = "the plan that is known has ended; send a new one" if ended else "no plan is known"
    plan = "the plan that is known is of a later shift" if later else plan
    if np.isfinite(pattern["hours"][0] * pattern["relative_power"][0]):
        return f"{plan}, and this shift is longer than this car's usual shifts"
    return f"{plan}, and this car has ended too few shifts to estimate the rest of this one"


def _explain_unknown_end(now: CarOutlook, end: Interval | None, no_energy: str | None) -> str | None:
    """Return why the charge at the end is unknown, the most basic reason first; None where it is known."""
    if end is not None:
        return None
    if not np.isfinite(now.estimate.soc[0]):
        return "the car reports no state of charge"
    if now.tables is None:
        if now.model_name is None:
            return "no vehicle message has told which model this car is"
        return (
            f"the vehicle model {now.model_name!r} is not in the catalogue, and its vehicle message lacks "
            f"{' or '.join(OVERRIDES)}; describe the car with `socast vehicles new`"
        )
    return no_energy or "the temperature or the energy ahead is unknown"


def _none_if_unknown(value: float) -> float | None:
    """Return a number, None where it is not finite."""
    return value if np.isfinite(value) else None
