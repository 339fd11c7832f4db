"""From text to a ride and a plan, or to one line that tells what is wrong."""

import json
from math import isnan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.errors import AskError
from core.forecast.ask import MOST_BYTES, asked_leg, asked_plan, asked_vehicle, parameters
from core.wire.messages import Leg

RIDE = {"distance_km": "18", "duration_s": "1500"}
PLAN = {"shift_end_s": 7200.0, "reserve_soc_pct": 20.0, "legs": [{"distance_km": 3.0, "duration_s": 300.0}]}


def one_line(error: AskError) -> bool:
    return "\n" not in str(error) and len(str(error)) < 300


def answered(call, *arguments):
    """Return what a call returns, or the error that it told."""
    try:
        return call(*arguments)
    except AskError as error:
        return error


@given(st.floats(0.0, 75.0), st.floats(1350.0, 86_400.0), st.floats(0.0, 5000.0), st.sampled_from("&;"))
def test_a_ride_is_read_as_it_was_written(distance, duration, gained, between):
    text = between.join((f"distance_km={distance!r}", f"gained_m={gained!r}", f"duration_s={duration!r}"))
    assert asked_leg(parameters(text)) == Leg(distance, duration, gained)


@pytest.mark.parametrize("text", ["", "_time=[now(-1h)..]", "&;", "_anyke"])
def test_where_no_ride_is_asked_for_there_is_none(text):
    assert asked_leg(parameters(text)) is None


@pytest.mark.parametrize(
    ("changed", "told"),
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
        ({"duration_s": "60"}, "18 km in 60 s are more than 200 km/h"),
        ({"speed_kmh": "50"}, "'speed_kmh' is no parameter; those are distance_km, duration_s, gained_m, lost_m"),
        ({"distance_km": "\n" + "9" * 100_000 + "x"}, "…"),
        ({"x" * 100_000: "1"}, "…"),
    ],
)
def test_what_is_wrong_with_a_ride_is_one_line(changed, told):
    with pytest.raises(AskError) as caught:
        asked_leg(RIDE | changed)
    assert told in str(caught.value)
    assert one_line(caught.value)


@pytest.mark.parametrize("given", [{"distance_km": "18"}, {"duration_s": "1500"}, {"gained_m": "4"}])
def test_a_ride_is_asked_for_by_distance_and_duration_together(given):
    with pytest.raises(AskError, match="not given; a ride needs distance_km and duration_s"):
        asked_leg(given)


def test_a_parameter_given_twice_is_refused():
    with pytest.raises(AskError, match="'distance_km' is given twice"):
        parameters("distance_km=1&duration_s=60&distance_km=2")


@given(st.text(max_size=60))
def test_any_text_is_a_ride_or_none_or_one_line(text):
    got = answered(lambda: asked_leg(parameters(text)))
    assert one_line(got) if isinstance(got, AskError) else got is None or got.duration_s > 0.0


@pytest.mark.parametrize("text", ["", "*", "**", "taxi 7", "a/b", "é", "x" * 65, "a\n"])
def test_a_vehicle_is_one_name(text):
    with pytest.raises(AskError) as caught:
        asked_vehicle(text)
    assert one_line(caught.value)
    assert asked_vehicle("taxi-0.1_2") == "taxi-0.1_2"


@pytest.mark.parametrize("payload", [None, b""])
def test_without_a_payload_there_is_no_plan(payload):
    assert asked_plan(payload, "a") is None


def test_vehicle_and_time_of_a_plan_may_be_left_out():
    plan = asked_plan(json.dumps(PLAN).encode(), "a")
    assert (plan.vehicle_id, plan.shift_end_s, plan.reserve_soc_pct) == ("a", 7200.0, 20.0)
    assert plan.legs == [Leg(3.0, 300.0)]
    assert isnan(plan.time_s)
    whole = asked_plan(json.dumps(PLAN | {"vehicle_id": "a", "time_s": 5.0, "lunch": "noon"}).encode(), "a")
    assert whole.time_s == 5.0


@pytest.mark.parametrize(
    ("payload", "cause", "told"),
    [
        (b"\xff\x00", "payload", "no plan"),
        (b"rubbish", "payload", "no plan"),
        (b"[" * 100_000, "payload", "no plan"),
        (b"[1]", "payload", "Expected `object`"),
        (b"{}", "payload", "missing required field `shift_end_s`"),
        (json.dumps(PLAN | {"legs": "many"}).encode(), "payload", "$.legs"),
        (json.dumps(PLAN | {"legs": [{"distance_km": "x", "duration_s": 3}]}).encode(), "payload", "legs[0].distance"),
        (json.dumps(PLAN | {"vehicle_id": "b"}).encode(), "payload", "of 'b', the question of a"),
        (json.dumps(PLAN | {"reserve_soc_pct": float("nan")}).encode(), "payload", "malformed"),
        (json.dumps(PLAN | {"reserve_soc_pct": 120}).encode(), "out_of_range", "reserve_soc_pct is 120"),
        (json.dumps(PLAN | {"legs": PLAN["legs"] * 10_000}).encode(), "too_many_legs", "10000 legs, at most 500"),
        (b" " * (MOST_BYTES + 1), "payload", f"{MOST_BYTES + 1} bytes"),
    ],
)
def test_what_is_wrong_with_a_plan_is_one_line(payload, cause, told):
    with pytest.raises(AskError) as caught:
        asked_plan(payload, "a")
    assert caught.value.cause == cause
    assert told in str(caught.value)
    assert one_line(caught.value)


@given(st.binary(max_size=80))
def test_any_payload_is_a_plan_or_none_or_one_line(payload):
    got = answered(asked_plan, payload, "a")
    assert one_line(got) if payload else got is None
