"""Test recordings that are made of a few lines."""

import json
from math import isclose

import pytest

from socast.core.errors import SettingsError
from socast.tools.testing.made_recording import START_S, gather_messages, make_car, make_messages


def samples(messages):
    return [json.loads(each.payload) for each in messages if each.key.endswith("/telemetry")]


def test_car_drives_at_a_constant_speed_by_default():
    made = make_car("taxi-7")
    assert [each.key for each in made[:2]] == ["fleet/taxi-7/vehicle", "fleet/taxi-7/telemetry"]
    assert len(samples(made)) == 201
    assert samples(made)[1] == {
        "vehicle_id": "taxi-7",
        "time_s": START_S + 3.0,
        "ride_id": "ride-1",
        "seq": 1,
        "speed_kmh": 36.0,
        "soc_pct": 80.0,
    }


def test_values_follow_points_and_functions():
    made = samples(
        make_car(speed_kmh=[(0, 0), (60, 50)], soc_pct=lambda age: 80 - age, period_s=30, vehicle_model=None)
    )
    assert [each["speed_kmh"] for each in made] == [0.0, 25.0, 50.0]
    assert [each["soc_pct"] for each in made] == [80.0, 50.0, 20.0]


@pytest.mark.parametrize(
    ("fault", "count", "condition"),
    [
        ("lost", 191, lambda of: not any(30 <= each["time_s"] - START_S < 60 for each in of)),
        ("repeated", 211, lambda of: of[10] == of[11]),
        ("late", 201, lambda of: of[10]["time_s"] == START_S + 60.0),
        ("clock_ahead", 201, lambda of: of[10]["time_s"] == START_S + 3630.0),
        ("missing_soc_pct", 201, lambda of: "soc_pct" not in of[10] and "soc_pct" in of[20]),
        ("spike_speed_kmh", 201, lambda of: isclose(of[10]["speed_kmh"], 655.35)),
        ("frozen_speed_kmh", 201, lambda of: of[19]["speed_kmh"] == of[10]["speed_kmh"] != of[20]["speed_kmh"]),
    ],
)
def test_faults_hold_for_their_span(fault, count, condition):
    made = samples(make_car(speed_kmh=lambda age: age / 100, duration_s=600, faults={fault: (30, 60)}))
    assert len(made) == count
    assert condition(made)


def test_damaged_payloads_are_no_json():
    made = make_car(faults={"not_json": (0, 3)})
    with pytest.raises(json.JSONDecodeError):
        json.loads(made[1].payload)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sped_kmh": 3}, "'sped_kmh' is no field of the telemetry; did you mean speed_kmh"),
        ({"faults": {"lst": (0, 1)}}, "there is no fault 'lst'; known are lost, repeated"),
        ({"faults": {"spike_occupants": (0, 1)}}, "spike is not possible for 'occupants'"),
        ({"period_s": 0}, "period_s=0"),
        ({"soc_pct": [(60, 1), (0, 2)]}, "soc_pct: the times of the points"),
    ],
)
def test_wrong_car_is_refused(options, message):
    with pytest.raises(SettingsError, match=message):
        make_car(**options)


@pytest.mark.parametrize(
    "sample", [{"vehicle_id": "a", "time_s": 1.0, "sped": 3}, {"vehicle_id": "a", "time_s": "now"}]
)
def test_wrong_sample_is_refused_with_its_number(sample):
    with pytest.raises(SettingsError, match="sample 1: "):
        make_messages([sample])


def test_cars_and_samples_are_gathered_in_the_order_of_their_receipt():
    gathered = gather_messages(
        make_car("b"), make_car("c"), [{"vehicle_id": "a", "time_s": START_S - 1.0, "speed_kmh": 3}]
    )
    assert gathered[0].key == "fleet/a/telemetry"
    assert [each.receipt_ns for each in gathered] == sorted(each.receipt_ns for each in gathered)
