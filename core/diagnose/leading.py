"""Choose what a diagnosis names first: the effect that all cars lack, or what changed in some of them."""

from msgspec.structs import replace

from socast.core.diagnose.deviation_words import find_leading_deviation
from socast.core.diagnose.records import CarDeviation, Diagnosis, NamedEffect


def find_leading(result: Diagnosis) -> NamedEffect | CarDeviation | None:
    """Return what the headline, the next step and the workbench begin with; None where nothing is named.

    A missing effect comes before a deviation, but an implausible coefficient comes after a plausible one.
    """
    ranked = (result.leading, find_leading_deviation(result.deviations))
    return min((one for one in ranked if one), key=lambda one: not one.coefficient.plausible, default=None)


def find_addable(result: Diagnosis) -> NamedEffect | CarDeviation | None:
    """Return what a diagnosis names first of what a term of a model can hold."""
    return find_leading(replace(result, deviations=[one for one in result.deviations if one.columns]))
