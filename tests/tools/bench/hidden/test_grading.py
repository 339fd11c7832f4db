"""Names and credible sets are graded against what is hidden."""

import pytest

from socast.core.diagnose.records import NONE
from socast.core.records import to_json_values
from socast.tools.bench.hidden.cases import Case
from socast.tools.bench.hidden.evaluation import grade_names, list_truths
from socast.tools.simulator.hidden_shapes import get_right_names
from socast.tools.simulator.settings import Hidden
from tests.support.diagnosed_names import make_name, make_result
from tests.support.diagnosis_result import make_deviation

SNOW = Case(5, (Hidden("snow~bent5", 0.03),))
BOTH = Case(5, (Hidden("snow", 0.03), Hidden("headwind", 0.03)))


@pytest.mark.parametrize(
    ("result", "outcome", "holds"),
    [
        (make_result(), "none", None),
        (make_result(make_name("snow")), "right", True),
        (make_result(make_name("wet_road", credible=["wet_road", "snow"])), "wrong", True),
        (make_result(make_name("wet_road")), "wrong", False),
    ],
)
def test_outcome_grades_the_first_name_and_its_credible_set(result, outcome, holds):
    grade = grade_names(SNOW, result)
    assert (grade["outcome"], grade["set_holds"]) == (outcome, holds)


def test_every_name_keeps_its_probability():
    names = grade_names(SNOW, make_result(make_name("snow", 0.7), make_name("age", 0.6)))["names"]
    assert [(each["effect"], each["probability"], each["right"]) for each in names] == [
        ("snow", 0.7, True),
        ("age", 0.6, False),
    ]


def test_no_name_is_right_where_nothing_is_hidden():
    assert list_truths(Case(5)) == [(NONE,)]
    grade = grade_names(Case(5), make_result(make_name("snow")))
    assert (grade["outcome"], grade["set_holds"], grade["found"]) == ("wrong", False, 0)


def test_no_name_is_right_where_the_library_lacks_the_effect():
    case = Case(5, (Hidden("drivetrain_loss", 0.03),), without=get_right_names("drivetrain_loss"))
    assert list_truths(case) == [(NONE,)]
    assert grade_names(case, make_result())["outcome"] == "none"
    assert grade_names(case, make_result(make_name("snow")))["outcome"] == "wrong"


def test_hidden_effects_are_found_if_named_with_half_or_more():
    assert grade_names(BOTH, make_result(make_name("headwind"), make_name("snow")))["found"] == 2
    later = make_result(make_name("headwind"), make_name("payload"), make_name("snow", 0.5))
    assert grade_names(BOTH, later)["found"] == 2
    assert grade_names(BOTH, make_result(make_name("headwind"), make_name("snow", 0.49)))["found"] == 1


def test_cars_that_are_blamed_are_kept():
    (blamed,) = grade_names(SNOW, make_result(deviations=[to_json_values(make_deviation())]))["deviations"]
    assert (blamed["who"], blamed["effect"], blamed["since"]) == ("taxi-005", "tyre_pressure", "2018-11-14")
