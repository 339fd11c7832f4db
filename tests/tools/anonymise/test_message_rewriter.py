"""Only fields of the wire contract pass, each in its disguise."""

import json
from random import Random

import pytest

from socast.core.wire.messages import Message
from socast.tools.anonymise.disguise import make_disguise
from socast.tools.anonymise.message_rewriter import MessageRewriter

NOW = 1_516_100_000.0
CENTRE = 45.5, -73.6


@pytest.fixture
def disguise():
    return make_disguise(Random(1), NOW, NOW, CENTRE, [True] * 24)


@pytest.fixture
def rewriter(disguise):
    return MessageRewriter(disguise)


def rewrite(rewriter, key, **fields):
    """Return key and fields of a rewritten message."""
    message = rewriter.rewrite(Message(key, json.dumps(fields).encode(), round(NOW * 1e9)))
    assert message is not None
    return message.key, json.loads(message.payload), message.receipt_ns


def test_sample_keeps_what_was_measured_and_nothing_else(rewriter, disguise):
    measured = {"speed_kmh": 50.0, "soc_pct": 80.5, "seq": 7, "elevation_m": 33.0, "odometer_km": 12.5}
    place = {"latitude_deg": CENTRE[0], "longitude_deg": CENTRE[1]}
    key, fields, receipt_ns = rewrite(
        rewriter, "montreal/3/fleet/taxi-1/telemetry", vehicle_id="taxi-1", time_s=NOW, ride_id="r7", plate="XYZ",
        **measured, **place,
    )  # fmt: skip
    car = disguise.rename("car", "taxi-1")
    latitude, longitude = disguise.places.move(*CENTRE)
    assert key == f"fleet/{car}/telemetry"
    assert receipt_ns == round(NOW * 1e9) + disguise.shift_s * 10**9
    assert fields == {
        "vehicle_id": car, "time_s": NOW + disguise.shift_s, "ride_id": disguise.rename("ride", "r7"),
        "latitude_deg": latitude, "longitude_deg": longitude, **measured,
    }  # fmt: skip


def test_list_of_samples_stays_a_list(rewriter, disguise):
    payload = json.dumps([{"vehicle_id": "a", "time_s": NOW + at} for at in range(2)]).encode()
    message = rewriter.rewrite(Message("fleet/a/telemetry", payload, 0))
    assert [each["time_s"] - NOW for each in json.loads(message.payload)] == [disguise.shift_s, disguise.shift_s + 1]


def test_half_a_position_leaves_only_its_presence(rewriter):
    _, fields, _ = rewrite(rewriter, "fleet/a/telemetry", vehicle_id="a", time_s=NOW, latitude_deg=45.5)
    assert fields["latitude_deg"] == 0.0
    assert "longitude_deg" not in fields


def test_vehicle_keeps_a_known_model_and_its_figures(rewriter):
    _, fields, _ = rewrite(
        rewriter, "fleet/a/vehicle", vehicle_id="a", time_s=NOW, model="bmw-i3-2014", mass_kg=1300.0,
        in_service_date="2014-05-01",
    )  # fmt: skip
    assert (fields["model"], fields["mass_kg"], "in_service_date" in fields) == ("bmw-i3-2014", 1300.0, False)
    _, fields, _ = rewrite(rewriter, "fleet/a/vehicle", vehicle_id="a", time_s=NOW, model="van of Anna")
    assert fields["model"].startswith("model-")


def test_ride_and_plan_are_renamed_and_moved_in_time(rewriter, disguise):
    _, ride, _ = rewrite(
        rewriter, "fleet/a/ride", vehicle_id="a", time_s=NOW, ride_id="r7", event="start", driver_id="Anna"
    )
    assert ride["driver_id"] == disguise.rename("driver", "Anna")
    legs = [{"distance_km": 5.0, "duration_s": 600.0}]
    _, plan, _ = rewrite(
        rewriter, "fleet/a/plan", vehicle_id="a", time_s=NOW, shift_end_s=NOW + 3600, reserve_soc_pct=10.0, legs=legs
    )
    assert (plan["shift_end_s"] - plan["time_s"], plan["legs"]) == (3600.0, legs)


def test_weather_moves_with_the_cars_and_its_wind_turns(rewriter, disguise):
    known = {"temperature_c": -3.0, "wind_speed_kmh": 20.0}
    key, fields, _ = rewrite(
        rewriter, "weather/yul", station_id="yul", time_s=NOW, latitude_deg=45.4, longitude_deg=-73.7,
        wind_from_deg=350.0, issued_s=NOW - 60.0, **known,
    )  # fmt: skip
    assert key == f"weather/{disguise.rename('station', 'yul')}"
    assert (fields["latitude_deg"], fields["longitude_deg"]) == disguise.places.move(45.4, -73.7)
    assert fields["wind_from_deg"] == disguise.turn(350.0)
    assert fields["time_s"] - fields["issued_s"] == 60.0
    assert known.items() <= fields.items()


@pytest.mark.parametrize(
    ("key", "payload", "cause"),
    [
        ("depot/lunch", b'{"who": "Anna"}', "unknown key"),
        ("fleet/a/telemetry", b"taxi-1 was here", "unreadable"),
        ("fleet/a/telemetry", b'{"vehicle_id": "a"}', "unreadable"),
        ("fleet/a/telemetry", b"[7]", "unreadable"),
        ("fleet/a/telemetry", b"\xff", "unreadable"),
        ("fleet/a/forecast", b"{}", "of consumers"),
        ("models/of-anna/1/errors", b"{}", "of consumers"),
        ("findings/taxi-1/rolling", b"{}", "of consumers"),
    ],
)
def test_message_that_does_not_pass_is_counted(rewriter, key, payload, cause):
    assert rewriter.rewrite(Message(key, payload, 0)) is None
    assert rewriter.dropped == {cause: 1}
