"""A cause outside the library is told with its form and the meanings of its symbols."""

from socast.tools.report.diagnosis import sentences
from tests.support.diagnosis_result import make_unknown_cause


def test_one_form_outside_the_library_is_certain():
    line, symbols = sentences.describe_unknown(make_unknown_cause(forms={"P = c · d · r": 1.0}))
    assert line.startswith("Something outside the library is missing (probability 97 %)")
    assert symbols == "With d: darkness; r: rain or melted snow that falls in a time."


def test_resemblance_and_the_slope_are_told():
    cause = make_unknown_cause(resembles="cold_regen_limit", formula="P = c · m g max(sin θ, 0) v")
    first, *_, last = sentences.describe_unknown(cause)
    assert first.endswith("It resembles cold_regen_limit, but no form of it fits as well.")
    assert last.startswith("It belongs to climbs and descents")
