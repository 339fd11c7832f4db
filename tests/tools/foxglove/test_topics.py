"""Telemetry becomes positions, and forecasts and findings that warn become lines of a log."""

import json
from typing import Any

import msgspec
import pytest

from socast.core.wire.messages import Cause, Finding, Forecast, Message, QualityCounts, Telemetry, encode
from socast.tools.foxglove.topics import ERROR, INFO, SCHEMAS, WARNING, ViewerTopics
from tests.support.batched_recordings import make_batch

NONE = QualityCounts(0, 0, 0, 0, 0)


def make_forecast(risk: float | None = None, quality: QualityCounts = NONE, time_s: float = 1.5e9 + 0.25) -> Message:
    forecast = Forecast("a", time_s, None, "m/1", 0.0, 0.0, None, None, 50.0, 1.0, None, None, risk, quality)
    return Message("north/fleet/a/forecast", encode(forecast), 7)


def make_sample(**fields: Any) -> Telemetry:
    return Telemetry(
        **{"vehicle_id": "a", "time_s": 1.5e9 + 0.25, "latitude_deg": 45.5, "longitude_deg": -73.6} | fields
    )


def convert(*messages: Message) -> list[tuple[str, dict[str, Any]]]:
    """Return the topics and the payloads of the messages for viewers."""
    made = ViewerTopics().make_messages(messages)
    assert {each.receipt_ns for each in made} <= {each.receipt_ns for each in messages}
    for each in made:
        check(json.loads(each.payload), SCHEMAS[each.key.rpartition("/")[2]])
    return [(each.key, json.loads(each.payload)) for each in made]


def check(value: Any, schema: dict[str, Any]) -> None:
    """Check a value against a JSON schema that has only the words of `SCHEMAS`."""
    if "oneOf" in schema:
        assert value in [option["const"] for option in schema["oneOf"]]
        return
    kind = {"object": dict, "array": list, "string": str, "integer": int, "number": (int, float)}[schema["type"]]
    assert isinstance(value, kind), (value, schema)
    if schema["type"] == "object":
        assert set(schema["required"]) == set(schema["properties"]) == set(value)
        for name, child in value.items():
            check(child, schema["properties"][name])
    if schema["type"] == "array":
        assert schema["minItems"] <= len(value) <= schema["maxItems"]
        for child in value:
            check(child, schema["items"])
    if "minimum" in schema:
        assert schema["minimum"] <= value <= schema.get("maximum", value)


def test_schemas_have_the_names_and_fields_of_foxglove():
    assert {schema["title"]: list(schema["properties"]) for schema in SCHEMAS.values()} == {
        "foxglove.LocationFix": [
            *("timestamp", "frame_id", "latitude", "longitude", "altitude"),
            *("position_covariance", "position_covariance_type"),
        ],
        "foxglove.Log": ["timestamp", "level", "message", "name", "file", "line"],
    }
    levels = [option["title"] for option in SCHEMAS["log"]["properties"]["level"]["oneOf"]]
    assert levels == ["UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"]
    assert levels[WARNING] == "WARNING"


def test_sample_becomes_a_position_of_its_car():
    ((topic, fix),) = convert(Message("north/fleet/a/telemetry", encode(make_sample(elevation_m=31.0)), 7))
    assert topic == "north/fleet/a/location"
    assert fix == {
        "timestamp": {"sec": 1_500_000_000, "nsec": 250_000_000},
        "frame_id": "a",
        "latitude": 45.5,
        "longitude": -73.6,
        "altitude": 31.0,
        "position_covariance": [0.0] * 9,
        "position_covariance_type": 0,
    }


def test_every_sample_of_a_list_becomes_a_position():
    payload = msgspec.json.encode([make_sample(), make_sample(time_s=1.5e9 + 3.0)])
    made = convert(Message("fleet/a/telemetry", payload, 7))
    assert [fix["timestamp"]["sec"] for _, fix in made] == [1_500_000_000, 1_500_000_003]


@pytest.mark.parametrize("key", ["north/fleet/depot-3/batch", "north/fleet/a/telemetry"])
def test_every_sample_of_a_batch_becomes_a_position_of_its_car(key):
    samples = [make_sample(elevation_m=31.0), make_sample(time_s=1.5e9 + 3.0), make_sample(latitude_deg=None)]
    other = [make_sample(vehicle_id="b")] if key.endswith("batch") else []
    batch = make_batch([msgspec.structs.asdict(each) for each in samples + other], key, 7)
    single = [Message(f"north/fleet/{each.vehicle_id}/telemetry", encode(each), 7) for each in samples + other]
    made = convert(batch)
    assert made == convert(*single)
    assert [topic for topic, _ in made] == [f"north/fleet/{car}/location" for car in ["a", "a", *"b" * len(other)]]


def test_positions_and_warnings_stay_in_the_order_of_their_messages():
    one, other = (Message(f"fleet/{car}/telemetry", encode(make_sample(vehicle_id=car)), 7) for car in "ab")
    made = convert(one, make_forecast(0.9), make_batch([msgspec.structs.asdict(make_sample())], receipt_ns=8), other)
    assert [topic for topic, _ in made] == [
        *("fleet/a/location", "north/fleet/a/log", "fleet/a/location", "fleet/b/location")
    ]


@pytest.mark.parametrize(
    "fields",
    [
        {"latitude_deg": None},
        {"longitude_deg": None},
        {"latitude_deg": 90.5},
        {"longitude_deg": -180.5},
        {"latitude_deg": 0.0, "longitude_deg": 0.0},
    ],
)
def test_sample_without_a_possible_position_gives_none(fields):
    assert convert(Message("fleet/a/telemetry", encode(make_sample(**fields)), 7)) == []


@pytest.mark.parametrize("payload", [b"", b"{", b"\xff", b"[]", b"[1]", b'{"time_s": "noon"}', b"[" * 9999])
@pytest.mark.parametrize("kind", ["fleet/a/telemetry", "fleet/a/forecast", "findings/a/b", "fleet/a/lunch"])
def test_undecodable_payload_gives_nothing(kind, payload):
    assert convert(Message(kind, payload, 7)) == []


@pytest.mark.parametrize("time_s", [-5.0, 1e300])
def test_time_that_no_clock_shows_becomes_zero(time_s):
    ((_, fix),) = convert(Message("fleet/a/telemetry", encode(make_sample(time_s=time_s)), 7))
    assert fix["timestamp"] == {"sec": 0, "nsec": 0}


def test_log_has_a_line_when_the_risk_changes_its_range():
    risks = [None, 0.01, 0.06, 0.2, None, 0.7, 0.9, 0.04, 0.01]
    lines = convert(*(make_forecast(risk) for risk in risks))
    assert {topic for topic, _ in lines} == {"north/fleet/a/log"}
    assert [(line["level"], line["message"].rpartition("is ")[2]) for _, line in lines] == [
        (WARNING, "6 %"),
        (ERROR, "70 %"),
        (INFO, "4 %"),
    ]
    assert {line["name"] for _, line in lines} == {"reserve"}


def test_log_has_a_line_when_faults_become_ten_times_as_many_and_again_in_the_next_ride():
    counts = [0, 1, 9, 10, 10, 0, 2]
    lines = convert(*(make_forecast(quality=QualityCounts(0, count, 0, 0, 0)) for count in counts))
    assert [line["message"] for _, line in lines] == [
        f"a: samples with a rejected speed since the ride began: {count}" for count in (1, 10, 2)
    ]
    assert {(line["name"], line["level"]) for _, line in lines} == {("quality", WARNING)}


def test_finding_is_a_line_in_the_log_of_its_car():
    finding = Finding(
        *("a", "tyre_pressure", 1.5e9, "sure", 0.97, [Cause("tyre_pressure", 0.97)], "2017-07-13", "2017-07-13"),
        *(None, 0.05, 0.04, 0.06, 10.0, 50.0, "a takes 5 % more by low tyre pressure", []),
    )
    ((topic, line),) = convert(Message("north/findings/a/tyre_pressure", encode(finding), 7))
    assert topic == "north/fleet/a/log"
    assert (line["level"], line["name"]) == (WARNING, "finding")
    assert line["message"] == "a takes 5 % more by low tyre pressure"
