"""Choose what a diagnosis names first, and what to add first: an effect that all cars lack, or what changed in some."""

from collections.abc import Collection

from msgspec.structs import replace

from socast.core.diagnose.deviation_words import find_leading_deviation
from socast.core.diagnose.records import CarDeviation, Diagnosis, NamedEffect


def find_leading(result: Diagnosis) -> NamedEffect | CarDeviation | None:
    """Return what the headline begins with; None where nothing is named.

    A missing effect comes before a deviation, but an implausible coefficient comes after a plausible one.
    """
    ranked = (result.leading, find_leading_deviation(result.deviations))
    return min((one for one in ranked if one), key=lambda one: not one.coefficient.plausible, default=None)


def find_first_addition(result: Diagnosis) -> NamedEffect | None:
    """Return the missing effect to add first: the first one of possible size whose gain is certain, else the first."""
    certain = (one for one in result.missing if one.gain_ci95 and one.gain_ci95[0] > 0.0 and _is_possible(one))
    return next(certain, result.leading)


def _is_possible(one: NamedEffect) -> bool:
    """Return whether the interval of a coefficient reaches its plausible range."""
    coefficient = one.coefficient
    if coefficient.ci95 is None or coefficient.low is None or coefficient.high is None:
        return coefficient.plausible
    return coefficient.ci95[0] <= coefficient.high and coefficient.ci95[1] >= coefficient.low


def find_addable(result: Diagnosis, tried: Collection[str] = ()) -> NamedEffect | CarDeviation | None:
    """Return what to add first of what a term of a model can hold, without effects that were tried."""
    missing = [one for one in result.missing if one.effect not in tried]
    left = replace(
        result,
        missing=missing,
        verdict=missing[0].effect if missing else None,
        deviations=[one for one in result.deviations if one.columns and one.effect not in tried],
    )
    first = find_leading(left)
    return find_first_addition(left) if isinstance(first, NamedEffect) else first
