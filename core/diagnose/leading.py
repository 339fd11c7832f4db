"""Choose what a diagnosis names first, and what to add first: an effect that all cars lack, or what changed in some."""

from collections.abc import Collection

from msgspec.structs import replace

from socast.core.diagnose.deviation_words import find_leading_deviation
from socast.core.diagnose.records import CarDeviation, Diagnosis, NamedEffect


def find_leading(result: Diagnosis) -> NamedEffect | CarDeviation | None:
    """Return what the headline begins with; None where nothing is named.

    A missing effect comes before a deviation.
    """
    return result.leading or find_leading_deviation(result.deviations)


def find_addable(result: Diagnosis, tried: Collection[str] = ()) -> NamedEffect | CarDeviation | None:
    """Return what to add first of what a term of a model can hold, without effects that were tried."""
    missing = [one for one in result.missing if one.effect not in tried]
    left = replace(
        result,
        missing=missing,
        verdict=missing[0].effect if missing else None,
        deviations=[one for one in result.deviations if one.columns and one.effect not in tried],
    )
    return find_leading(left)
