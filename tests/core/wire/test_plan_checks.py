"""Test the checks of plans, and the parsing of the vehicle, the ride and the plan of an outlook query."""

import json
from math import inf, isnan, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.errors import AskError
from socast.core.wire.messages import Leg, Plan
from socast.core.wire.plan_checks import (
    AHEAD_S,
    LEG_LIMITS,
    MOST_BYTES,
    MOST_LEGS,
    PAST_S,
    ShownParameter,
    find_leg_fault,
    find_refusal,
    is_outdated,
    parse_leg,
    parse_parameters,
    parse_plan,
    parse_vehicle,
)

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
def test_drivable_plan_is_accepted(legs, reserve, ahead):
    assert find_refusal(plan(legs=legs, reserve_soc_pct=reserve, shift_end_s=NOW + ahead), NOW) is None


@given(st.lists(legs, max_size=5), legs, st.sampled_from(list(LEG_LIMITS)), st.data())
def test_leg_beyond_a_limit_refuses_the_plan_and_is_named(before, leg, name, data):
    most = LEG_LIMITS[name].most
    wrong = data.draw(
        st.floats(max_value=0.0, exclude_max=True) | st.floats(min_value=most, exclude_min=True) | st.just(nan)
    )
    bad = Leg(**{field: getattr(leg, field) for field in Leg.__struct_fields__} | {name: wrong})
    refused = find_refusal(plan(legs=[*before, bad]), NOW)
    assert refused.cause == "out_of_range"
    value = "not given" if name == "duration_s" and isnan(wrong) else f"{wrong:g}"
    assert refused.message.startswith(f"leg {len(before) + 1} of the plan: {name} is {value}, must be 0 to {most:g};")
    assert "\n" not in refused.message


def test_plan_with_a_charge_is_accepted():
    assert find_refusal(plan(legs=[Leg(3.0, 600.0), Leg(duration_s=1800.0, charge_to_soc_pct=80.0)]), NOW) is None


@pytest.mark.parametrize(
    ("changed", "cause", "message"),
    [
        ({"legs": [Leg(1.0, 60.0)] * (MOST_LEGS + 1)}, "too_many_legs", "501 legs, at most 500"),
        ({"legs": [Leg(1.0, 60.0)] * 10_000}, "too_many_legs", "10000 legs"),
        ({"legs": [Leg(18.0, 60.0)]}, "out_of_range", "more than 200 km/h"),
        ({"legs": [Leg(1.0, 0.0)]}, "out_of_range", "more than 200 km/h"),
        (
            {"legs": [Leg(duration_s=60.0)]},
            "out_of_range",
            "distance_km is not given; a ride needs distance_km, a charge",
        ),
        ({"legs": [Leg(3.0)]}, "out_of_range", "duration_s is not given, must be 0 to 86400; give seconds"),
        ({"legs": [Leg(charge_to_soc_pct=80.0)]}, "out_of_range", "duration_s is not given"),
        (
            {"legs": [Leg(3.0, 600.0, charge_to_soc_pct=80.0)]},
            "out_of_range",
            "distance_km is 3 and charge_to_soc_pct 80;",
        ),
        ({"legs": [Leg(None, 600.0, 5.0, charge_to_soc_pct=80.0)]}, "out_of_range", "gained_m is 5 and charge_to"),
        (
            {"legs": [Leg(None, 600.0, charge_to_soc_pct=101.0)]},
            "out_of_range",
            "charge_to_soc_pct is 101, must be 0 to",
        ),
        ({"legs": [Leg(None, -1.0, charge_to_soc_pct=80.0)]}, "out_of_range", "duration_s is -1, must be 0 to 86400;"),
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
def test_unusable_plan_is_refused_with_cause_and_message(changed, cause, message):
    refused = find_refusal(plan(**changed), NOW)
    assert refused.cause == cause
    assert message in refused.message
    assert len(refused.message) < 200


def test_largest_number_of_legs_and_empty_legs_are_accepted():
    assert (
        find_refusal(plan(legs=[Leg(1.0, 60.0), Leg(0.0, 600.0), Leg(0.0, 0.0)] + [Leg(1.0, 60.0)] * 497), NOW) is None
    )


def test_legs_longer_than_the_shift_are_accepted():
    assert find_refusal(plan(legs=[Leg(100.0, 7200.0)] * 3), NOW) is None


@pytest.mark.parametrize("end", [0.0, NOW - 1e6, NOW, NOW + 1e6])
def test_without_known_time_any_shift_end_is_accepted(end):
    assert find_refusal(plan(shift_end_s=end), nan) is None
    assert find_refusal(plan(shift_end_s=end, reserve_soc_pct=101.0), nan) is not None


def test_speed_limit_applies_to_the_mean_of_a_leg():
    assert find_leg_fault(Leg(200.0, 3600.0)) is None
    assert find_leg_fault(Leg(200.1, 3600.0)) is not None


@pytest.mark.parametrize("ahead", [1800.0, AHEAD_S])
def test_refusal_names_the_given_limit_of_the_shift_end(ahead):
    assert find_refusal(plan(shift_end_s=NOW + ahead), NOW, ahead) is None
    refused = find_refusal(plan(shift_end_s=NOW + ahead + 1.0), NOW, ahead)
    assert refused.cause == "plan_too_far_ahead"
    assert f"at most {ahead / 3600.0:g} h" in refused.message


@pytest.mark.parametrize(
    ("newest", "outdated"), [(-1.0, False), (0.0, False), (1.0, True), (AHEAD_S, True), (AHEAD_S + 1.0, False)]
)
def test_plan_is_outdated_unless_the_newest_one_has_a_wrong_clock(newest, outdated):
    assert is_outdated(plan(time_s=NOW), NOW + newest) is outdated


# parsing of a query

RIDE = {"distance_km": "18", "duration_s": "1500"}
QUERY_PLAN = {"shift_end_s": 7200.0, "reserve_soc_pct": 20.0, "legs": [{"distance_km": 3.0, "duration_s": 300.0}]}


def one_line(error: AskError) -> bool:
    return "\n" not in str(error) and len(str(error)) < 300


def call_or_error(call, *arguments):
    """Return the result of a call, or the AskError that it raises."""
    try:
        return call(*arguments)
    except AskError as error:
        return error


@given(st.floats(0.0, 75.0), st.floats(1350.0, 86_400.0), st.floats(0.0, 5000.0), st.sampled_from("&;"))
def test_ride_parameters_round_trip(distance, duration, gained, between):
    text = between.join((f"distance_km={distance!r}", f"gained_m={gained!r}", f"duration_s={duration!r}"))
    assert parse_leg(parse_parameters(text)) == Leg(distance, duration, gained)


@pytest.mark.parametrize("text", ["", "_time=[now(-1h)..]", "&;", "_anyke"])
def test_query_without_ride_parameters_has_no_leg(text):
    assert parse_leg(parse_parameters(text)) is None


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"distance_km": "far"}, "distance_km is 'far', must be a number"),
        ({"distance_km": ""}, "distance_km is ''"),
        ({"distance_km": "18 km"}, "'18 km'"),
        ({"distance_km": "1_8"}, "'1_8'"),
        ({"distance_km": "١٨"}, "must be a number"),
        ({"distance_km": "."}, "'.'"),
        ({"distance_km": "nan"}, "'nan'"),
        ({"duration_s": "inf"}, "duration_s is 'inf'"),
        ({"duration_s": "1e999"}, "'1e999'"),
        ({"gained_m": "-Infinity"}, "gained_m is '-Infinity'"),
        ({"distance_km": "-3"}, "distance_km is -3, must be 0 to 1000; give kilometres"),
        ({"distance_km": "1000.1", "duration_s": "86400"}, "distance_km is 1000.1"),
        ({"duration_s": "0", "distance_km": "0"}, "duration_s is 0, must be above 0"),
        ({"duration_s": "-1"}, "duration_s is -1"),
        ({"duration_s": "86401"}, "duration_s is 86401, must be 0 to 86400; give seconds"),
        ({"gained_m": "5001"}, "gained_m is 5001"),
        ({"lost_m": "-0.5"}, "lost_m is -0.5"),
        ({"duration_s": "60"}, "18 km in 1 min are more than 200 km/h: check distance_km"),
        ({"speed_kmh": "50"}, "'speed_kmh' is no parameter; those are distance_km, duration_s, gained_m, lost_m"),
        ({"distance_km": "\n" + "9" * 100_000 + "x"}, "…"),
        ({"x" * 100_000: "1"}, "…"),
    ],
)
def test_unusable_ride_is_refused_in_one_line(changed, message):
    with pytest.raises(AskError) as caught:
        parse_leg(RIDE | changed)
    assert message in str(caught.value)
    assert one_line(caught.value)


def test_messages_have_the_words_and_units_of_the_surface():
    shown = {
        "distance_km": ShownParameter("Distance", "kilometres"),
        "duration_s": ShownParameter("Duration", "h", 3600.0),
    }
    for leg, words in (
        ({"distance_km": "18"}, "Duration is not given; a ride needs Distance and Duration"),
        (RIDE | {"distance_km": "-3"}, "Distance is -3, must be 0 to 1000; give kilometres"),
        (RIDE | {"duration_s": "90000"}, "Duration is 25, must be 0 to 24; give h"),
        (RIDE | {"duration_s": "0"}, "Duration is 0, must be above 0; give h"),
        (RIDE | {"duration_s": "60"}, "18 km in 1 min are more than 200 km/h: check Distance and Duration"),
        (RIDE | {"duration_s": "long"}, "Duration is 'long', must be a number from 0 to 24; give h"),
    ):
        with pytest.raises(AskError) as caught:
            parse_leg(leg, shown)
        assert str(caught.value) == words


@pytest.mark.parametrize("given", [{"distance_km": "18"}, {"duration_s": "1500"}, {"gained_m": "4"}])
def test_ride_needs_distance_and_duration(given):
    with pytest.raises(AskError, match="not given; a ride needs distance_km and duration_s"):
        parse_leg(given)


def test_repeated_parameter_is_refused():
    with pytest.raises(AskError, match="'distance_km' is given twice"):
        parse_parameters("distance_km=1&duration_s=60&distance_km=2")


@given(st.text(max_size=60))
def test_any_text_parses_or_is_refused_in_one_line(text):
    got = call_or_error(lambda: parse_leg(parse_parameters(text)))
    assert one_line(got) if isinstance(got, AskError) else got is None or got.duration_s > 0.0


@pytest.mark.parametrize("text", ["", "*", "**", "taxi 7", "a/b", "é", "x" * 65, "a\n"])
def test_vehicle_must_be_one_name(text):
    with pytest.raises(AskError) as caught:
        parse_vehicle(text)
    assert one_line(caught.value)
    assert parse_vehicle("taxi-0.1_2") == "taxi-0.1_2"


@pytest.mark.parametrize("payload", [None, b""])
def test_query_without_payload_has_no_plan(payload):
    assert parse_plan(payload, "a") is None


def test_plan_of_a_query_may_leave_out_vehicle_and_time():
    plan = parse_plan(json.dumps(QUERY_PLAN).encode(), "a")
    assert (plan.vehicle_id, plan.shift_end_s, plan.reserve_soc_pct) == ("a", 7200.0, 20.0)
    assert plan.legs == [Leg(3.0, 300.0)]
    assert isnan(plan.time_s)
    whole = parse_plan(json.dumps(QUERY_PLAN | {"vehicle_id": "a", "time_s": 5.0, "lunch": "noon"}).encode(), "a")
    assert whole.time_s == 5.0


@pytest.mark.parametrize(
    ("payload", "cause", "message"),
    [
        (b"\xff\x00", "payload", "no plan"),
        (b"rubbish", "payload", "no plan"),
        (b"[" * 100_000, "payload", "no plan"),
        (b"[1]", "payload", "Expected `object`"),
        (b"{}", "payload", "missing required field `shift_end_s`"),
        (json.dumps(QUERY_PLAN | {"legs": "many"}).encode(), "payload", "$.legs"),
        (
            json.dumps(QUERY_PLAN | {"legs": [{"distance_km": "x", "duration_s": 3}]}).encode(),
            "payload",
            "legs[0].distance",
        ),
        (json.dumps(QUERY_PLAN | {"vehicle_id": "b"}).encode(), "payload", "of 'b', the question of a"),
        (json.dumps(QUERY_PLAN | {"reserve_soc_pct": float("nan")}).encode(), "payload", "malformed"),
        (json.dumps(QUERY_PLAN | {"reserve_soc_pct": 120}).encode(), "out_of_range", "reserve_soc_pct is 120"),
        (
            json.dumps(QUERY_PLAN | {"legs": QUERY_PLAN["legs"] * 10_000}).encode(),
            "too_many_legs",
            "10000 legs, at most 500",
        ),
        (b" " * (MOST_BYTES + 1), "payload", f"{MOST_BYTES + 1} bytes"),
    ],
)
def test_unusable_plan_of_a_query_is_refused_in_one_line(payload, cause, message):
    with pytest.raises(AskError) as caught:
        parse_plan(payload, "a")
    assert caught.value.cause == cause
    assert message in str(caught.value)
    assert one_line(caught.value)


@given(st.binary(max_size=80))
def test_any_payload_parses_or_is_refused_in_one_line(payload):
    got = call_or_error(parse_plan, payload, "a")
    assert one_line(got) if payload else got is None
