"""Check the plans of dispatch, and parse the vehicle, the ride and the plan of an outlook query.

A query of `fleet/{vehicle}/outlook` has parameters that define a ride. Its payload may hold a plan to use instead
of the published one. A plan or ride that cannot be used gets a message with the value, the limit and the remedy.
"""

import re
from collections.abc import Mapping
from math import inf, isfinite, isnan, nan
from types import MappingProxyType
from typing import Final, NamedTuple

import msgspec

from socast.core.errors import AskError
from socast.core.files import UNREADABLE
from socast.core.wire.messages import IDENTITY, Leg, Plan, Wire

MOST_LEGS: Final = 500
"""Largest number of legs of a plan."""
PAST_S: Final = 300.0
"""Longest time since the end of a plan's shift. [s]"""
AHEAD_S: Final = 48 * 3600.0
"""Longest time until the end of a plan's shift. [s]"""
FASTEST_KMH: Final = 200.0
"""Largest mean speed of a leg. [km/h]"""
MOST_BYTES: Final = 4_000_000
"""Largest payload of a query."""
_NUMBER: Final = re.compile(r"[+-]?([0-9]+[.]?[0-9]*|[.][0-9]+)([eE][+-]?[0-9]+)?")  # `float` accepts 1_8, too
_SHOWN_CHARACTERS: Final = 40  # of a wrong value, in a message


class Refusal(NamedTuple):
    """Hold why a plan cannot be used: the name of its counter, see `find_refusal`, and a message."""

    cause: str
    message: str


class LegLimit(NamedTuple):
    """Hold the largest value of a quantity of a leg, whose smallest value is 0, and its unit."""

    most: float
    unit: str


LEG_LIMITS: Final = {
    "distance_km": LegLimit(1000.0, "kilometres"),
    "duration_s": LegLimit(24 * 3600.0, "seconds"),
    "gained_m": LegLimit(5000.0, "metres"),
    "lost_m": LegLimit(5000.0, "metres"),
}
"""Limit of each field of a ride."""
CHARGE_LIMITS: Final = {
    "duration_s": LegLimit(24 * 3600.0, "seconds"),
    "charge_to_soc_pct": LegLimit(100.0, "percent of the battery"),
}
"""Limit of each field of a charge."""


class ShownParameter(NamedTuple):
    """Hold the name and the unit of a quantity of a leg on a surface, and that unit in units of the wire."""

    name: str
    unit: str
    factor: float = 1.0


ShownParameters = Mapping[str, ShownParameter]
"""Field of a leg -> what a surface calls it; where it is not named, messages have the field of the wire."""
AS_ON_WIRE: Final[ShownParameters] = MappingProxyType({})


class _QueryPlan(Wire):
    """Hold a plan in the payload of a query, which may leave out its vehicle and time."""

    shift_end_s: float
    reserve_soc_pct: float
    legs: list[Leg]
    vehicle_id: str | None = None
    time_s: float | None = None


_query_plans: Final = msgspec.json.Decoder(_QueryPlan)


def is_outdated(plan: Plan, newest_s: float) -> bool:
    """Return whether a plan was made before the newest known one. [Unix seconds]

    Where the newest is later by more than `AHEAD_S`, its clock was wrong, and any plan replaces it; otherwise that one
    mistake would keep out every later plan.

    Examples
    --------
    >>> is_outdated(Plan("taxi-7", 60.0, 3600.0, 10.0, []), 90.0)
    True
    >>> is_outdated(Plan("taxi-7", 60.0, 3600.0, 10.0, []), 60e3 * 1000.0)
    False
    """
    return newest_s - AHEAD_S <= plan.time_s < newest_s


def find_refusal(plan: Plan, now_s: float, ahead_s: float = AHEAD_S) -> Refusal | None:
    """Return why a plan cannot be used; None where it can, even if its legs need more time than the shift has.

    Without the time of the vehicle's newest sample, NaN, any end of the shift is accepted. [Unix seconds]

    Examples
    --------
    >>> find_refusal(Plan("taxi-7", 0.0, 3600.0, 120.0, []), 0.0).message
    'reserve_soc_pct is 120, must be 0 to 100; give percent of the battery'
    >>> find_refusal(Plan("taxi-7", 0.0, 3600.0, 20.0, []), 7200.0).cause
    'plan_in_the_past'
    """
    if len(plan.legs) > MOST_LEGS:
        return Refusal(
            "too_many_legs",
            f"the plan has {len(plan.legs)} legs, at most {MOST_LEGS}; leave out what is of later shifts",
        )
    if not 0.0 <= plan.reserve_soc_pct <= 100.0:
        return Refusal(
            "out_of_range",
            f"reserve_soc_pct is {plan.reserve_soc_pct:g}, must be 0 to 100; give percent of the battery",
        )
    for number, leg in enumerate(plan.legs, 1):
        if fault := find_leg_fault(leg):
            return Refusal("out_of_range", f"leg {number} of the plan: {fault}")
    return _find_time_refusal(plan.shift_end_s, now_s, ahead_s)


def find_leg_fault(leg: Leg, shown: ShownParameters = AS_ON_WIRE) -> str | None:
    """Return a message about a ride that cannot be driven, or a charge that cannot be; None for one that can.

    Examples
    --------
    >>> find_leg_fault(Leg(18.0, 1500.0))
    >>> find_leg_fault(Leg(-3.0, 1500.0))
    'distance_km is -3, must be 0 to 1000; give kilometres'
    >>> find_leg_fault(Leg(duration_s=1800.0, charge_to_soc_pct=180.0))
    'charge_to_soc_pct is 180, must be 0 to 100; give percent of the battery'
    """
    if fault := _find_kind_fault(leg):
        return fault
    for name, limit in (CHARGE_LIMITS if leg.distance_km is None else LEG_LIMITS).items():
        value = getattr(leg, name)
        if value is not None and not 0.0 <= value <= limit.most:
            words, unit, factor = shown.get(name, ShownParameter(name, limit.unit))
            return f"{words} is {value / factor:g}, must be 0 to {limit.most / factor:g}; give {unit}"
    if leg.distance_km is not None and leg.distance_km * 3600.0 > FASTEST_KMH * leg.duration_s:
        return (
            f"{leg.distance_km:g} km in {leg.duration_s / 60.0:.3g} min are more than {FASTEST_KMH:g} km/h: "
            f"check {_name_both(shown)}"
        )
    return None


def _name_both(shown: ShownParameters) -> str:
    """Return the names of the parameters that a ride needs."""
    return " and ".join(_get_shown(name, shown).name for name in ("distance_km", "duration_s"))


def _get_shown(name: str, shown: ShownParameters) -> ShownParameter:
    """Return how a surface shows a parameter of a ride."""
    return shown.get(name, ShownParameter(name, LEG_LIMITS[name].unit))


def _find_kind_fault(leg: Leg) -> str | None:
    """Return a message about a leg that is neither a ride nor a charge, or both; None for one of them."""
    if isnan(leg.duration_s):
        return f"duration_s is not given, must be 0 to {LEG_LIMITS['duration_s'].most:g}; give seconds"
    if leg.charge_to_soc_pct is None:
        missing = "distance_km is not given; a ride needs distance_km, a charge charge_to_soc_pct"
        return missing if leg.distance_km is None else None
    for name in ("distance_km", "gained_m", "lost_m"):
        if (value := getattr(leg, name)) is not None:
            return f"{name} is {value:g} and charge_to_soc_pct {leg.charge_to_soc_pct:g}; give a ride or a charge"
    return None


def _find_time_refusal(end_s: float, now_s: float, ahead_s: float) -> Refusal | None:
    """Return why a shift cannot end when a plan says."""
    if not abs(end_s) < inf:
        return Refusal("out_of_range", f"shift_end_s is {end_s:g}, must be finite; give Unix seconds")
    hours = (end_s - now_s) / 3600.0
    if end_s < now_s - PAST_S:
        return Refusal(
            "plan_in_the_past",
            f"shift_end_s is {end_s:.12g}, {_format_hours(-hours)} h before the vehicle's newest sample, at most "
            f"{PAST_S:g} s; give the end of a shift under way, in Unix seconds",
        )
    if end_s > now_s + ahead_s:
        return Refusal(
            "plan_too_far_ahead",
            f"shift_end_s is {end_s:.12g}, {_format_hours(hours)} h after the vehicle's newest sample, at most "
            f"{ahead_s / 3600:g} h; give the end of this shift, in Unix seconds",
        )
    return None


def _format_hours(hours: float) -> str:
    """Return hours in few digits, however many there are."""
    return f"{hours:.1f}" if hours < 1e6 else f"{hours:.1e}"


def parse_vehicle(text: str) -> str:
    """Return the vehicle that a query names."""
    if IDENTITY.fullmatch(text):
        return text
    raise AskError(
        f"the vehicle is {_quote(text)}; give one name of up to 64 letters, digits and any of _ . -, such as taxi-012",
        "vehicle",
    )


def parse_parameters(text: str) -> dict[str, str]:
    """Split the parameters of a query, which `;` or `&` separates.

    Names that begin with an underscore belong to Zenoh, and are left out.

    Examples
    --------
    >>> parse_parameters("distance_km=18&duration_s=1500;_time=now()")
    {'distance_km': '18', 'duration_s': '1500'}
    """
    out: dict[str, str] = {}
    for part in filter(None, re.split("[;&]", text)):
        name, _, value = part.partition("=")
        if name in out:
            raise AskError(f"{_quote(name)} is given twice; give it once", "parameters")
        if not name.startswith("_"):
            out[name] = value
    return out


def parse_leg(given: Mapping[str, str], shown: ShownParameters = AS_ON_WIRE) -> Leg | None:
    """Return the ride that a query defines; None for a query about the shift as planned.

    Messages name the parameters as they are `shown`.

    Examples
    --------
    >>> parse_leg({"distance_km": "18", "duration_s": "1500"})
    Leg(distance_km=18.0, duration_s=1500.0, gained_m=None, lost_m=None, charge_to_soc_pct=None)
    """
    for name in given:
        if name not in LEG_LIMITS:
            raise AskError(f"{_quote(name)} is no parameter; those are {', '.join(LEG_LIMITS)}", "parameters")
    if not given:
        return None
    for name in ("distance_km", "duration_s"):
        if name not in given:
            missing, both = _get_shown(name, shown).name, _name_both(shown)
            raise AskError(f"{missing} is not given; a ride needs {both}", "parameters")
    leg = Leg(**{name: _parse_number(name, text, shown) for name, text in given.items()})
    if leg.duration_s == 0.0:
        words, unit, _ = _get_shown("duration_s", shown)
        raise AskError(f"{words} is 0, must be above 0; give {unit}", "out_of_range")
    if fault := find_leg_fault(leg, shown):
        raise AskError(fault, "out_of_range")
    return leg


def parse_plan(payload: bytes | None, vehicle_id: str) -> Plan | None:
    """Return the plan in the payload of a query; None without a payload, for the published plan.

    The JSON may leave out `vehicle_id` and `time_s`; the time is then NaN.
    """
    if not payload:
        return None
    if len(payload) > MOST_BYTES:
        raise AskError(f"the plan has {len(payload)} bytes, at most {MOST_BYTES}; give the legs that remain", "payload")
    try:
        query = _query_plans.decode(payload)
    except UNREADABLE as error:
        raise AskError(
            f"the payload is no plan: {error}; give JSON with shift_end_s, reserve_soc_pct and legs",
            "payload",
        ) from error
    if query.vehicle_id not in {None, vehicle_id}:
        raise AskError(
            f"the plan is of {_quote(str(query.vehicle_id))}, the question of {vehicle_id}; "
            "give a plan of this vehicle",
            "payload",
        )
    time_s = nan if query.time_s is None else query.time_s
    plan = Plan(vehicle_id, time_s, query.shift_end_s, query.reserve_soc_pct, query.legs)
    if refused := find_refusal(plan, nan):
        raise AskError(refused.message, refused.cause)
    return plan


def _parse_number(name: str, text: str, shown: ShownParameters) -> float:
    """Return the value of a parameter."""
    words, unit, factor = _get_shown(name, shown)
    most = LEG_LIMITS[name].most / factor
    value = float(text) if _NUMBER.fullmatch(text) else nan
    if not isfinite(value):
        raise AskError(f"{words} is {_quote(text)}, must be a number from 0 to {most:g}; give {unit}", "parameters")
    return value


def _quote(text: str) -> str:
    """Return a text in quotes, shortened where it is long."""
    return repr(text if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]}…")
