"""Write the messages of dispatch for a shift: the car, its rides, and its plans."""

from operator import attrgetter
from typing import Final

import numpy as np

from socast.core.wire.messages import Leg, Message, Plan, Ride, Vehicle, Wire, encode
from socast.tools.simulator.cars import Car
from socast.tools.simulator.conditions import Conditions
from socast.tools.simulator.settings import STEP
from socast.tools.simulator.shift import Interlude, Shift

RESERVE: Final = 10.0
"""State of charge that dispatch keeps as a reserve. [%]"""


def make_dispatch(
    name: str,
    model: str,
    car: Car,
    shift: Shift,
    conditions: Conditions,
    rng: np.random.Generator,
    nominal_kwh: float | None = None,
    period_s: float | None = None,
) -> list[Message]:
    """Return the messages besides telemetry: the car, its rides, and its plan, renewed as each ride ends."""
    serviced = np.datetime64("2018-01-01") - int(car.odometer / 1000 / 110)
    about = Vehicle(
        vehicle_id=name,
        time_s=shift.time,
        model=model,
        in_service_date=str(serviced),
        nominal_capacity_kwh=nominal_kwh,
        period_s=period_s,
    )
    messages = [_message("vehicle", about, shift.time)]
    if not rng.uniform() < conditions.no_plan:
        messages += _make_plans(name, car, shift, conditions, rng)
    for trip in shift.trips:
        begin, end = shift.time + STEP * trip.begin, shift.time + STEP * trip.end
        who = {"vehicle_id": name, "ride_id": trip.ride_id, "driver_id": trip.driver_id}
        messages.append(_message("ride", Ride(time_s=begin, event="start", **who), begin))
        messages.append(_message("ride", Ride(time_s=end, event="end", **who), end))
    return sorted(messages, key=attrgetter("receipt_ns"))


def _make_plans(name: str, car: Car, shift: Shift, conditions: Conditions, rng: np.random.Generator) -> list[Message]:
    """Return the plans of a shift: at its begin, as each ride ends, and as each passenger fails to come."""
    planned = [each for each in shift.interludes if each.distance_km is not None or conditions.planned_charges]
    renewed = [(0, 0), *((trip.end, done + 1) for done, trip in enumerate(shift.trips))]
    renewed += [(each.end, each.before) for each in planned]
    replaced = np.flatnonzero(rng.uniform(size=len(shift.trips) + 1) < conditions.replans)
    dreams = {done: _dream(car, len(shift.trips) - done, rng) for done in replaced.tolist()}
    messages = []
    for step, done in sorted(renewed):
        when = shift.time + STEP * step
        known = next((place for place in dreams if place > done), len(shift.trips) + 1)
        legs = _list_legs(shift, planned, step, done, known)
        legs += dreams[known] if known in dreams else list(shift.unstarted_legs)
        messages.append(_plan_message(name, shift, when, legs))
    return messages


def _list_legs(shift: Shift, planned: list[Interlude], step: int, done: int, known: int) -> list[Leg]:
    """Return the legs after a step, from trip `done` up to the trip `known`, from which others are planned."""
    legs: list[Leg] = []
    for place in range(done, min(known, len(shift.trips) + 1)):
        legs += [_leg(each) for each in planned if each.before == place and each.end > step]
        if place < len(shift.trips) and (leg := shift.trips[place].planned):
            legs.append(leg)
    return legs


def _leg(interlude: Interlude) -> Leg:
    """Return the leg of an interlude."""
    if interlude.distance_km is not None:
        return Leg(distance_km=interlude.distance_km, duration_s=interlude.duration_s)
    return Leg(duration_s=interlude.duration_s, charge_to_soc_pct=interlude.charge_to_pct)


def _dream(car: Car, rides: int, rng: np.random.Generator) -> list[Leg]:
    """Return rides that dispatch plans and will replace: about as many and as long as the true ones."""
    count = max(0, rides + int(rng.integers(-2, 3)))
    km = np.clip(rng.lognormal(np.log(car.ride_median), car.ride_spread, count), 350, 34e3) / 1000.0
    return [Leg(distance_km=round(each, 2), duration_s=round(120.0 + 155.0 * each)) for each in km.tolist()]


def _plan_message(name: str, shift: Shift, when: float, legs: list[Leg]) -> Message:
    """Return a plan."""
    end = shift.time + shift.length
    plan = Plan(vehicle_id=name, time_s=when, shift_end_s=end, reserve_soc_pct=RESERVE, legs=legs)
    return _message("plan", plan, when)


def _message(kind: str, value: Wire, when: float) -> Message:
    """Return a message about a car."""
    identity = value.vehicle_id  # type: ignore[attr-defined]
    return Message(f"fleet/{identity}/{kind}", encode(value), _receipt(when))


def _receipt(when: float) -> int:
    """Return the time of receipt of what was sent 50 ms before. [ns]"""
    return int(when * 1e9) + 50_000_000
