"""Describe a deviation in one sentence: who uses how much more, since when, and why."""

from collections.abc import Mapping, Sequence
from datetime import date
from typing import Any, Final

PERCENT: Final = 100.0
SEVERAL: Final = 3
"""Number of causes above which a sentence names only the most probable ones."""
CAUSES: Final = {
    "tyre_pressure": "low tyre pressure",
    "brake_drag": "brake drag",
    "roof_load": "a load on the roof",
    "standby": "standby power",
    "age": "worn drivetrain or battery",
}
"""Words for effects whose names read badly in a sentence."""


def word_deviation(one: Mapping[str, Any]) -> str:
    """Return a deviation as a sentence.

    Parameters
    ----------
    one : mapping
        Entry of `deviations` in a diagnosis.

    Examples
    --------
    >>> word_deviation({
    ...     "who": "taxi-005", "kind": "step", "share": 0.041, "share_ci95": [0.032, 0.05], "since": "2018-11-14",
    ...     "since_ci90": ["2018-11-12", "2018-11-16"],
    ...     "causes": [{"effect": "tyre_pressure", "probability": 0.6}, {"effect": "brake_drag", "probability": 0.4}],
    ... })
    'taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018 (12 to 16 November): low tyre pressure 60 %, brake drag 40 %'
    """
    who = "All cars use" if one.get("of") == "all" else f"{one.get('who')} uses"
    return f"{who} {_word_size(one)}{_word_date(one)}: {_name_causes(one.get('causes') or ())}"


def _word_size(one: Mapping[str, Any]) -> str:
    """Return how much more or less is used: a share of the energy, or a rate for a ramp."""
    ramp = one.get("kind") == "ramp"
    name = "share_per_month" if ramp else "share"
    share = float(one.get(name) or 0.0)
    low, high = (share if end is None else end for end in one.get(f"{name}_ci95") or (share, share))
    direction = "more" if share >= 0.0 else "less"
    half = 0.5 * PERCENT * (high - low)
    digits = 1 if half < 10.0 else 0
    size = f"{PERCENT * abs(share):.{digits}f} ± {half:.{digits}f} % {direction}"
    return f"{size} each month" if ramp else size


def _word_date(one: Mapping[str, Any]) -> str:
    """Return the date of a change with its 90 % range, or a clause for what was always there."""
    if not one.get("since"):
        return " than the others" if one.get("of") == "group" else " than its siblings"
    since = date.fromisoformat(str(one["since"]))
    low, high = (date.fromisoformat(str(each)) for each in one.get("since_ci90") or (one["since"], one["since"]))
    first = f"{low.day}" if (low.year, low.month) == (high.year, high.month) else _format_date(low, high)
    return f" since {_format_date(since)} ({first} to {_format_date(high, since)})"


def _format_date(day: date, beside: date | None = None) -> str:
    """Return a date in words, without its year where that of another date is the same."""
    year = "" if beside is not None and beside.year == day.year else f" {day.year}"
    return f"{day.day} {day:%B}{year}"


def _name_causes(causes: Sequence[Mapping[str, Any]]) -> str:
    """Return the causes of a credible set with their probabilities, the most probable first."""
    names = [
        f"{_name_cause(str(one.get('effect')))} {PERCENT * (one.get('probability') or 0.0):.0f} %" for one in causes
    ]
    if len(names) > SEVERAL:
        names = [*names[:SEVERAL], f"or one of {len(names) - SEVERAL} others"]
    return ", ".join(names)


def _name_cause(effect: str) -> str:
    """Return an effect in words."""
    return CAUSES.get(effect, effect.replace("_", " "))
