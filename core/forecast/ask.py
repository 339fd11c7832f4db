"""What is asked of the rest of a shift: from text to a leg and a plan, or to words that tell what is wrong.

A question is a query of `fleet/{vehicle}/outlook`. Its parameters tell of a ride, and its payload, if any, holds a plan
that is to be answered instead of the one that is known.
"""

import re
from collections.abc import Mapping
from math import isfinite, nan
from typing import Final

import msgspec

from core.errors import AskError
from core.forecast.plan_checks import LEG_LIMITS, beyond, refusal
from core.wire.messages import IDENTITY, Leg, Plan, Wire

MOST_BYTES: Final = 4_000_000
"""Size of a payload."""
_NUMBER: Final = re.compile(r"[+-]?([0-9]+[.]?[0-9]*|[.][0-9]+)([eE][+-]?[0-9]+)?")  # `float` takes 1_8, too
_SHOWN: Final = 40  # characters of a wrong value that are told back


class _AskedPlan(Wire):
    """A plan whose vehicle and time need not be told."""

    shift_end_s: float
    reserve_soc_pct: float
    legs: list[Leg]
    vehicle_id: str | None = None
    time_s: float | None = None


_plans: Final = msgspec.json.Decoder(_AskedPlan)


def asked_vehicle(text: str) -> str:
    """Return the vehicle that is asked about.

    Raises
    ------
    AskError
        Where the text names none, or several.
    """
    if IDENTITY.fullmatch(text):
        return text
    raise AskError(
        f"the vehicle is {_short(text)}; give one name of up to 64 letters, digits and any of _ . -, such as taxi-012",
        "vehicle",
    )


def parameters(text: str) -> dict[str, str]:
    """Take the parameters of a query apart, whether `;` or `&` is between them.

    Names that begin with an underscore are Zenoh's own, and left out.

    Raises
    ------
    AskError
        Where one is given twice.

    Examples
    --------
    >>> parameters("distance_km=18&duration_s=1500;_time=now()")
    {'distance_km': '18', 'duration_s': '1500'}
    """
    out: dict[str, str] = {}
    for part in filter(None, re.split("[;&]", text)):
        name, _, value = part.partition("=")
        if name in out:
            raise AskError(f"{_short(name)} is given twice; give it once", "parameters")
        if not name.startswith("_"):
            out[name] = value
    return out


def asked_leg(given: Mapping[str, str]) -> Leg | None:
    """Return the ride that is asked for; None where none is, but the shift as planned.

    Parameters
    ----------
    given : mapping of str to str
        `distance_km` and `duration_s`; `gained_m` and `lost_m`, which are unknown where they are left out.

    Raises
    ------
    AskError
        Where a parameter is unknown, missing, no number, or beyond its limit.

    Examples
    --------
    >>> asked_leg({"distance_km": "18", "duration_s": "1500"})
    Leg(distance_km=18.0, duration_s=1500.0, gained_m=None, lost_m=None)
    """
    for name in given:
        if name not in LEG_LIMITS:
            raise AskError(f"{_short(name)} is no parameter; those are {', '.join(LEG_LIMITS)}", "parameters")
    if not given:
        return None
    for name in ("distance_km", "duration_s"):
        if name not in given:
            raise AskError(f"{name} is not given; a ride needs distance_km and duration_s", "parameters")
    leg = Leg(**{name: _number(name, text) for name, text in given.items()})
    if leg.duration_s == 0.0:
        raise AskError("duration_s is 0, must be above 0; give seconds", "out_of_range")
    if words := beyond(leg):
        raise AskError(words, "out_of_range")
    return leg


def asked_plan(payload: bytes | None, vehicle_id: str) -> Plan | None:
    """Return the plan that is to be answered; None where there is no payload, for the plan that is known.

    Parameters
    ----------
    payload : bytes or None
        A `Plan` as JSON; `vehicle_id` and `time_s` may be left out, and the time is then NaN.
    vehicle_id : str
        That is asked about.

    Raises
    ------
    AskError
        Where it is no plan, or one of another vehicle, or one that cannot be used whatever the time is. Whether it is
        of the past is for whoever knows the time to tell (`core.forecast.plan_checks.refusal`).
    """
    if not payload:
        return None
    if len(payload) > MOST_BYTES:
        raise AskError(f"the plan has {len(payload)} bytes, at most {MOST_BYTES}; give the legs that remain", "payload")
    try:
        told = _plans.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise AskError(
            f"the payload is no plan: {error}; give JSON with shift_end_s, reserve_soc_pct and legs",
            "payload",
        ) from error
    if told.vehicle_id not in {None, vehicle_id}:
        raise AskError(
            f"the plan is of {_short(str(told.vehicle_id))}, the question of {vehicle_id}; give a plan of this vehicle",
            "payload",
        )
    time_s = nan if told.time_s is None else told.time_s
    plan = Plan(vehicle_id, time_s, told.shift_end_s, told.reserve_soc_pct, told.legs)
    if refused := refusal(plan, nan):
        raise AskError(refused.words, refused.cause)
    return plan


def _number(name: str, text: str) -> float:
    """Return what a parameter says."""
    most, unit = LEG_LIMITS[name]
    value = float(text) if _NUMBER.fullmatch(text) else nan
    if not isfinite(value):
        raise AskError(f"{name} is {_short(text)}, must be a number from 0 to {most:g}; give {unit}", "parameters")
    return value


def _short(text: str) -> str:
    """Return a text in quotes, with its end left out where it is long."""
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…")
