"""A plan that can be driven is used; any other is refused, with one cause and one line."""

from math import inf, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.forecast.plan_checks import AHEAD_S, LEG_LIMITS, MOST_LEGS, PAST_S, beyond, older, refusal
from core.wire.messages import Leg, Plan

NOW = 1_705_320_000.0
GOOD = {"vehicle_id": "a", "time_s": NOW, "shift_end_s": NOW + 3600.0, "reserve_soc_pct": 20.0, "legs": []}


def plan(**changed) -> Plan:
    return Plan(**(GOOD | changed))


durations = st.floats(1.0, 86_400.0)
climbs = st.none() | st.floats(0.0, 5000.0)
legs = st.builds(
    lambda duration, share, gained, lost: Leg(min(1000.0, share * duration / 18.0), duration, gained, lost),
    durations,
    st.floats(0.0, 0.999),
    climbs,
    climbs,
)


@given(st.lists(legs, max_size=20), st.floats(0.0, 100.0), st.floats(-PAST_S, AHEAD_S))
def test_what_can_be_driven_is_not_refused(legs, reserve, ahead):
    assert refusal(plan(legs=legs, reserve_soc_pct=reserve, shift_end_s=NOW + ahead), NOW) is None


@given(st.lists(legs, max_size=5), legs, st.sampled_from(list(LEG_LIMITS)), st.data())
def test_one_leg_beyond_a_limit_refuses_the_plan_and_is_named(before, leg, name, data):
    most = LEG_LIMITS[name].most
    wrong = data.draw(
        st.floats(max_value=0.0, exclude_max=True) | st.floats(min_value=most, exclude_min=True) | st.just(nan)
    )
    bad = Leg(**{field: getattr(leg, field) for field in Leg.__struct_fields__} | {name: wrong})
    refused = refusal(plan(legs=[*before, bad]), NOW)
    assert refused.cause == "out_of_range"
    assert refused.words.startswith(f"leg {len(before) + 1} of the plan: {name} is {wrong:g}, must be 0 to {most:g};")
    assert "\n" not in refused.words


@pytest.mark.parametrize(
    ("changed", "cause", "told"),
    [
        ({"legs": [Leg(1.0, 60.0)] * (MOST_LEGS + 1)}, "too_many_legs", "501 legs, at most 500"),
        ({"legs": [Leg(1.0, 60.0)] * 10_000}, "too_many_legs", "10000 legs"),
        ({"legs": [Leg(18.0, 60.0)]}, "out_of_range", "more than 200 km/h"),
        ({"legs": [Leg(1.0, 0.0)]}, "out_of_range", "more than 200 km/h"),
        ({"reserve_soc_pct": -1.0}, "out_of_range", "reserve_soc_pct is -1"),
        ({"reserve_soc_pct": 100.5}, "out_of_range", "reserve_soc_pct is 100.5"),
        ({"reserve_soc_pct": nan}, "out_of_range", "reserve_soc_pct is nan"),
        ({"shift_end_s": nan}, "out_of_range", "shift_end_s is nan"),
        ({"shift_end_s": inf}, "out_of_range", "shift_end_s is inf"),
        ({"shift_end_s": -inf}, "out_of_range", "shift_end_s is -inf"),
        ({"shift_end_s": NOW - PAST_S - 1.0}, "plan_in_the_past", "0.1 h before"),
        ({"shift_end_s": 3600.0}, "plan_in_the_past", "Unix seconds"),
        ({"shift_end_s": NOW + AHEAD_S + 3600.0}, "plan_too_far_ahead", "49.0 h after"),
        ({"shift_end_s": NOW * 1000.0}, "plan_too_far_ahead", "Unix seconds"),
        ({"shift_end_s": 1e308}, "plan_too_far_ahead", "1e+308"),
        ({"shift_end_s": -1e308}, "plan_in_the_past", "1e+308"),
    ],
)
def test_what_is_wrong_with_a_plan_is_told(changed, cause, told):
    refused = refusal(plan(**changed), NOW)
    assert refused.cause == cause
    assert told in refused.words
    assert len(refused.words) < 200


def test_as_many_legs_as_are_allowed_and_a_pause_between_are_no_reason():
    assert refusal(plan(legs=[Leg(1.0, 60.0), Leg(0.0, 600.0), Leg(0.0, 0.0)] + [Leg(1.0, 60.0)] * 497), NOW) is None


def test_legs_that_need_more_time_than_there_is_are_no_reason():
    assert refusal(plan(legs=[Leg(100.0, 7200.0)] * 3), NOW) is None


@pytest.mark.parametrize("end", [0.0, NOW - 1e6, NOW, NOW + 1e6])
def test_where_the_time_is_not_known_a_shift_may_end_at_any(end):
    assert refusal(plan(shift_end_s=end), nan) is None
    assert refusal(plan(shift_end_s=end, reserve_soc_pct=101.0), nan) is not None


def test_the_speed_that_is_allowed_is_that_of_the_leg():
    assert beyond(Leg(200.0, 3600.0)) is None
    assert beyond(Leg(200.1, 3600.0)) is not None


@pytest.mark.parametrize("ahead", [1800.0, AHEAD_S])
def test_how_far_ahead_a_shift_may_end_is_told_as_it_is_asked_for(ahead):
    assert refusal(plan(shift_end_s=NOW + ahead), NOW, ahead) is None
    refused = refusal(plan(shift_end_s=NOW + ahead + 1.0), NOW, ahead)
    assert refused.cause == "plan_too_far_ahead"
    assert f"at most {ahead / 3600.0:g} h" in refused.words


@pytest.mark.parametrize(
    ("newest", "found"), [(-1.0, False), (0.0, False), (1.0, True), (AHEAD_S, True), (AHEAD_S + 1.0, False)]
)
def test_a_plan_is_older_than_the_newest_one_unless_that_is_of_a_wrong_clock(newest, found):
    assert older(plan(time_s=NOW), NOW + newest) is found
