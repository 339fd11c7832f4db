"""Names and credible sets are graded against what is hidden."""

import pytest
from socast.core.diagnose.posterior.probabilities import NONE, UNKNOWN

from socast.tools.bench.hidden.cases import Case, get_right_names
from socast.tools.bench.hidden.grading import grade_names, list_credible_sets, list_truths
from socast.tools.simulator.settings import Hidden
from tests.support.diagnosed_names import make_name, make_result

SNOW = Case(5, (Hidden("snow~bent5", 0.03),))
BOTH = Case(5, (Hidden("snow", 0.03), Hidden("headwind", 0.03)))


@pytest.mark.parametrize(
    ("result", "outcome", "holds"),
    [
        (make_result(), "none", False),
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


def test_truth_of_an_empty_data_set_is_no_effect():
    assert grade_names(Case(5), make_result())["set_holds"]
    assert grade_names(Case(5), make_result(make_name("snow")))["outcome"] == "wrong"


def test_truth_of_an_effect_without_a_candidate_is_outside_the_library():
    case = Case(5, (Hidden("drivetrain_loss", 0.03),), without=get_right_names("drivetrain_loss"))
    assert list_truths(case) == [(UNKNOWN,)]
    assert grade_names(case, make_result(further=[NONE, UNKNOWN]))["set_holds"]
    assert grade_names(case, make_result(make_name("snow")))["outcome"] == "wrong"


def test_two_effects_are_sought_in_the_credible_sets_of_two_steps():
    assert grade_names(BOTH, make_result(make_name("headwind"), make_name("snow")))["found"] == 2
    later = make_result(make_name("headwind"), make_name("payload"), make_name("snow"))
    assert grade_names(BOTH, later)["found"] == 1


def test_step_that_selects_nothing_has_a_credible_set_too():
    result = make_result(make_name("headwind"), further=["snow", NONE])
    assert list_credible_sets(result) == [["headwind"], ["snow", NONE]]
    assert grade_names(BOTH, result)["found"] == 2
    assert list_credible_sets(make_result()) == [[NONE]]
