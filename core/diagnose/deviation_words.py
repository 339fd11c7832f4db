"""Describe a deviation in one sentence: who uses how much more, since when, and why."""

from collections.abc import Sequence
from typing import Final

from socast.core.diagnose.records import CarDeviation, CauseProbability
from socast.core.formatting import format_minus, word_since
from socast.core.records import ConfidenceInterval

PERCENT: Final = 100.0
MONTH: Final = 365.25 / 12.0
"""Length of a month; of a shorter time, no rate per month is given. [days]"""
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


def has_certain_size(one: CarDeviation) -> bool:
    """Return whether the 95 % interval of the net energy of a deviation excludes zero."""
    return _excludes_zero(_get_size(one)[1])


def _excludes_zero(limits: ConfidenceInterval | None) -> bool:
    """Return whether an interval is known and excludes zero."""
    return limits is not None and limits[0] * limits[1] > 0.0


def find_leading_deviation(deviations: Sequence[CarDeviation]) -> CarDeviation | None:
    """Return the first deviation of certain size, which a diagnosis may put into its headline; None without one."""
    return next((one for one in deviations if has_certain_size(one)), None)


def is_rate_known(one: CarDeviation) -> bool:
    """Return whether a deviation lasts so long that a rate per month is no extrapolation."""
    return one.days is None or one.days >= MONTH


def name_deviating(one: CarDeviation) -> str:
    """Return who deviates in the middle of a sentence: a car, a group, or all cars."""
    return "all cars" if one.of == "all" else one.who


def word_deviation(one: CarDeviation) -> str:
    """Return a deviation as a sentence.

    Examples
    --------
    >>> word_deviation(
    ...     CarDeviation(
    ...         who="taxi-005",
    ...         kind="step",
    ...         share=0.041,
    ...         share_ci95=(0.032, 0.05),
    ...         since="2018-11-14",
    ...         since_ci90=("2018-11-12", "2018-11-16"),
    ...         causes=[
    ...             CauseProbability(effect="tyre_pressure", probability=0.6),
    ...             CauseProbability(effect="brake_drag", probability=0.4),
    ...         ],
    ...     )
    ... )
    'taxi-005 uses 4.1 ± 0.9 % more since 14 November 2018 (12 to 16 November): low tyre pressure 60 %, brake drag 40 %'
    """
    who = "All cars use" if one.of == "all" else f"{one.who} uses"
    return f"{who} {_word_size(one)}{_word_date(one)}: {_name_causes(one.causes)}"


def _word_size(one: CarDeviation) -> str:
    """Return how much more or less is used: a share of the energy; for a ramp, a rate, or the growth up to the end.

    An interval that contains zero is given by its ends, because ± would hide that it is not symmetric.
    """
    value, limits = _get_size(one)
    share = value or 0.0
    low, high = limits or (share, share)
    direction = "more" if share >= 0.0 else "less"
    half = 0.5 * PERCENT * (high - low)
    digits = 1 if half < 10.0 else 0
    size = f"{PERCENT * abs(share):.{digits}f}"
    if low < 0.0 < high:
        least, most = (low, high) if share >= 0.0 else (-high, -low)
        interval = format_minus(f"{PERCENT * least:.{digits}f} to {PERCENT * most:.{digits}f} %")
        size = f"{size} % {direction} (95 % interval {interval})"
    else:
        size = f"{size} ± {half:.{digits}f} % {direction}"
    if one.kind != "ramp":
        return size
    return f"{size} each month" if is_rate_known(one) else f"{size} after a growth over {one.days:.0f} days,"


def _get_size(one: CarDeviation) -> tuple[float | None, ConfidenceInterval | None]:
    """Return the size of a deviation with its interval: its share of the energy, or the growth of a ramp.

    The growth is that of a month, or that of the days of the ramp where these are fewer.
    """
    rate, limits = one.share_per_month, one.share_per_month_ci95
    if one.kind != "ramp" or rate is None:
        return one.share, one.share_ci95
    months = 1.0 if is_rate_known(one) or one.days is None else one.days / MONTH
    return months * rate, None if limits is None else (months * limits[0], months * limits[1])


def _word_date(one: CarDeviation) -> str:
    """Return the date of a change with its 90 % range, or a clause for what was always there."""
    if not one.since:
        return " than the others" if one.of == "group" else " than its siblings"
    return f" {word_since(one.since, one.since_ci90 or (one.since, one.since))}"


def _name_causes(causes: Sequence[CauseProbability]) -> str:
    """Return the causes of a credible set with their probabilities, in their order."""
    names = [f"{name_cause(one.effect)} {PERCENT * (one.probability or 0.0):.0f} %" for one in causes]
    if len(names) > SEVERAL:
        others = len(names) - SEVERAL
        names = [*names[:SEVERAL], "or another cause" if others == 1 else f"or one of {others} others"]
    return ", ".join(names)


def name_cause(effect: str) -> str:
    """Return an effect in words."""
    return CAUSES.get(effect, effect.replace("_", " "))
