"""Test that JSON schemas describe what the decoder accepts, field by field."""

from typing import Any

import msgspec
import pytest

from socast.core.batch import Lanes
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import KINDS, Finding, Leg, LegOutlook, Message, Outlook, Ride, Telemetry, Vehicle, Wire
from socast.core.wire.schema import describe_struct, make_schema

STRUCTS = KINDS | {"outlook": Outlook, "leg": Leg, "leg_outlook": LegOutlook}
PLAIN = {"string": "x", "number": 1.0, "integer": 1, "boolean": True, "array": []}
INTAKE = ("telemetry", "vehicle", "ride", "plan", "weather")


def accepts_null(struct: type[Wire], field: str, value: dict[str, Any]) -> bool:
    """Return whether the decoder of a struct accepts null in a field of a valid message."""
    try:
        msgspec.convert(value | {field: None}, struct)
    except msgspec.ValidationError:
        return False
    return True


def build(schema: dict[str, Any]) -> Any:
    """Return the simplest value that a schema allows, with every field present."""
    kind = schema["type"] if isinstance(schema["type"], str) else schema["type"][0]
    if kind == "object":
        return {name: build(child) for name, child in schema["properties"].items()}
    return PLAIN[kind]


def valid(kind: str) -> dict[str, Any]:
    """Return a valid message of a kind, with every field present."""
    value: dict[str, Any] = build(describe_struct(STRUCTS[kind]))
    for part in (value, value.get("overall", {})):
        if "gain" in part:
            part["gain"]["verdict"] = "better"
    value |= {"status": "sure"} if STRUCTS[kind] is Finding else {}
    value |= {"power_covers": "before"} if STRUCTS[kind] is Vehicle else {}
    return value | ({"event": "start"} if STRUCTS[kind] is Ride else {})


@pytest.mark.parametrize("kind", STRUCTS)
def test_schema_allows_null_exactly_where_the_wire_does(kind):
    value = valid(kind)
    msgspec.convert(value, STRUCTS[kind])
    properties = describe_struct(STRUCTS[kind])["properties"]
    assert set(properties) == set(STRUCTS[kind].__struct_fields__)
    for field, schema in properties.items():
        assert ("null" in schema["type"]) == accepts_null(STRUCTS[kind], field, value), field


@pytest.mark.parametrize("kind", INTAKE)
def test_message_with_every_optional_field_null_equals_one_without_them(kind):
    schema = make_schema(kind)
    required = {name: value for name, value in valid(kind).items() if name in schema["required"]}
    subject = required.get("vehicle_id") or required["station_id"]
    key = f"weather/{subject}" if kind == "weather" else f"fleet/{subject}/{kind}"
    optional = [name for name in schema["properties"] if name not in required]
    results = []
    for message in (required, required | dict.fromkeys(optional)):
        decoder = Decoder(Lanes())
        batch, events = decoder.decode([Message(key, msgspec.json.encode(message), 0)])
        assert decoder.received[kind] == 1
        assert not decoder.rejected
        results.append((repr(batch), [(event.row, event.lane, event.value) for event in events]))
    assert results[0] == results[1]


def test_ride_of_telemetry_may_be_null():
    assert "null" in make_schema("telemetry")["properties"]["ride_id"]["type"]


@pytest.mark.parametrize("kind", STRUCTS)
def test_every_field_has_a_meaning_and_a_number_its_unit(kind):
    for name, schema in describe_struct(STRUCTS[kind])["properties"].items():
        assert schema["description"].endswith((".", "]")), name
        suffix = name.rpartition("_")[2]
        if suffix in {"kmh", "km", "kwh", "pct", "s", "m", "c", "w", "v", "a", "deg", "kg", "hpa", "mm"}:
            assert schema["description"].endswith("]"), name


def test_schemas_have_no_references_so_that_viewers_can_plot():
    properties = make_schema("forecast")["properties"]
    assert properties["range_km"]["type"] == ["object", "null"]
    assert properties["range_km"]["properties"]["p05"]["type"] == "number"
    assert make_schema("plan")["properties"]["legs"]["items"]["properties"]["duration_s"]["type"] == "number"
    assert properties["next_charge"]["properties"]["soc_pct"]["properties"]["p05"]["type"] == "number"
    for kind in KINDS:
        text = msgspec.json.encode(make_schema(kind)).decode()
        assert "$ref" not in text
        assert "anyOf" not in text
    assert set(make_schema("telemetry")["required"]) == {"vehicle_id", "time_s"}
    assert Telemetry.__struct_fields__[0] == "vehicle_id"
