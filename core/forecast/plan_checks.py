"""Whether what dispatch plans can be used, and if not, why."""

from typing import Final, NamedTuple

from core.wire.messages import Leg, Plan

MOST_LEGS: Final = 500
"""Legs of a plan."""
PAST_S: Final = 300.0
"""How long ago a shift may have ended that a plan speaks of. [s]"""
AHEAD_S: Final = 48 * 3600.0
"""How far ahead it may end. [s]"""
FASTEST_KMH: Final = 200.0
"""Average speed of a leg."""


class Refusal(NamedTuple):
    """Why a plan is not used.

    Parameters
    ----------
    cause : str
        What it is counted under: `out_of_range`, `too_many_legs`, `plan_in_the_past` or `plan_too_far_ahead`.
    words : str
        Value, limit and remedy.
    """

    cause: str
    words: str


class Limit(NamedTuple):
    """Between zero and what a quantity of a leg may be, and what it is told in."""

    most: float
    unit: str


LEG_LIMITS: Final = {
    "distance_km": Limit(1000.0, "kilometres"),
    "duration_s": Limit(24 * 3600.0, "seconds"),
    "gained_m": Limit(5000.0, "metres"),
    "lost_m": Limit(5000.0, "metres"),
}
"""Field of a leg -> its limit."""


def older(plan: Plan, newest_s: float) -> bool:
    """Tell whether a plan was made before the newest one that is known.

    A newest one that is of more than `AHEAD_S` later was made by a wrong clock: whatever comes next replaces it. Else
    that one mistake would keep out every plan to come.

    Examples
    --------
    >>> older(Plan("taxi-7", 60.0, 3600.0, 10.0, []), 90.0)
    True
    >>> older(Plan("taxi-7", 60.0, 3600.0, 10.0, []), 60e3 * 1000.0)
    False
    """
    return newest_s - AHEAD_S <= plan.time_s < newest_s


def refusal(plan: Plan, now_s: float, ahead_s: float = AHEAD_S) -> Refusal | None:
    """Return why a plan cannot be used; None where it can.

    Legs that need more time than the shift has are no reason.

    Parameters
    ----------
    plan : Plan
    now_s : float
        Time of the vehicle's newest sample; NaN where it is not known, and then any end of the shift will do.
        [Unix seconds]
    ahead_s : float
        How far ahead the shift may end. [s]

    Returns
    -------
    Refusal or None

    Examples
    --------
    >>> refusal(Plan("taxi-7", 0.0, 3600.0, 120.0, []), 0.0).words
    'reserve_soc_pct is 120, must be 0 to 100; give percent of the battery'
    >>> refusal(Plan("taxi-7", 0.0, 3600.0, 20.0, []), 7200.0).cause
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
        if words := beyond(leg):
            return Refusal("out_of_range", f"leg {number} of the plan: {words}")
    return _untimely(plan.shift_end_s, now_s, ahead_s)


def beyond(leg: Leg) -> str | None:
    """Return, in words, what of a leg cannot be driven; None where all can.

    Examples
    --------
    >>> beyond(Leg(18.0, 1500.0))
    >>> beyond(Leg(-3.0, 1500.0))
    'distance_km is -3, must be 0 to 1000; give kilometres'
    """
    for name, (most, unit) in LEG_LIMITS.items():
        value = getattr(leg, name)
        if value is not None and not 0.0 <= value <= most:
            return f"{name} is {value:g}, must be 0 to {most:g}; give {unit}"
    if leg.distance_km * 3600.0 > FASTEST_KMH * leg.duration_s:
        return (
            f"{leg.distance_km:g} km in {leg.duration_s:g} s are more than {FASTEST_KMH:g} km/h; "
            "give kilometres as distance_km and seconds as duration_s"
        )
    return None


def _untimely(end_s: float, now_s: float, ahead_s: float) -> Refusal | None:
    """Return why a shift cannot end when a plan says."""
    if not abs(end_s) < float("inf"):
        return Refusal("out_of_range", f"shift_end_s is {end_s:g}, must be finite; give Unix seconds")
    hours = (end_s - now_s) / 3600.0
    if end_s < now_s - PAST_S:
        return Refusal(
            "plan_in_the_past",
            f"shift_end_s is {end_s:.12g}, {_short(-hours)} h before the vehicle's newest sample, at most "
            f"{PAST_S:g} s; give the end of a shift under way, in Unix seconds",
        )
    if end_s > now_s + ahead_s:
        return Refusal(
            "plan_too_far_ahead",
            f"shift_end_s is {end_s:.12g}, {_short(hours)} h after the vehicle's newest sample, at most "
            f"{ahead_s / 3600:g} h; give the end of this shift, in Unix seconds",
        )
    return None


def _short(hours: float) -> str:
    """Return hours in few digits, however many there are."""
    return f"{hours:.1f}" if hours < 1e6 else f"{hours:.1e}"
