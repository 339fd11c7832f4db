"""Test the wire contract: encoding and decoding leave every struct unchanged."""

import math
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.columns import POWER_SPANS
from socast.core.wire.keys import identify_model, identity
from socast.core.wire.messages import (
    OF_VEHICLES,
    Cause,
    Finding,
    Forecast,
    Gain,
    Interval,
    Leg,
    LegOutlook,
    ModelErrors,
    NextCharge,
    Outlook,
    Plan,
    QualityCounts,
    Ride,
    RideErrors,
    Telemetry,
    Vehicle,
    Weather,
    address,
    encode,
)

number = st.floats(allow_nan=False, allow_infinity=False)
maybe = st.none() | number
name = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
count = st.integers(0, 2**53)


def struct(kind: Any, **known: Any) -> st.SearchStrategy[Any]:
    """Return a strategy for a struct whose optional fields are numbers or unknown."""
    fields = {field: known.get(field, maybe) for field in kind.__struct_fields__}
    return st.builds(kind, **fields)


TELEMETRY = struct(
    Telemetry,
    vehicle_id=name,
    time_s=number,
    ride_id=st.none() | st.text(max_size=20),
    seq=st.none() | count,
    occupants=st.none() | count,
    charging=st.none() | st.booleans(),
)
INTERVAL = st.none() | st.builds(Interval, number, number, number)
GAIN = struct(Gain, rides=count, vehicle_days=count, verdict=st.sampled_from(["better", "worse", "undecided"]))
ERRORS = struct(RideErrors, vehicle_model=st.none() | name, rides=count, unpredicted_rides=count, gain=st.none() | GAIN)
CHARGE = st.none() | st.just(msgspec.UNSET) | st.builds(NextCharge, number, st.builds(Interval, *[number] * 3), maybe)
LEG = struct(Leg, duration_s=number)
LEG_OUTLOOK = struct(LegOutlook, distance_km=number, duration_s=number, energy_kwh=INTERVAL, soc_pct=INTERVAL)
OUTLOOK = struct(
    Outlook,
    vehicle_id=name,
    time_s=number,
    model=name,
    asked=st.none() | LEG_OUTLOOK,
    legs=st.lists(LEG_OUTLOOK, max_size=4),
    soc_end_of_shift_pct=INTERVAL,
    reserve_soc_pct=number,
    why_not=st.none() | st.text(max_size=20),
    next_charge=CHARGE,
)
STRUCTS = st.one_of(
    TELEMETRY,
    struct(
        Vehicle,
        vehicle_id=name,
        time_s=number,
        model=name,
        power_covers=st.none() | st.sampled_from(POWER_SPANS),
        in_service_date=st.none() | st.text(max_size=10),
    ),
    struct(
        Ride,
        vehicle_id=name,
        time_s=number,
        ride_id=name,
        event=st.sampled_from(["start", "end"]),
        driver_id=st.none() | name,
    ),
    struct(
        Plan, vehicle_id=name, time_s=number, shift_end_s=number, reserve_soc_pct=number, legs=st.lists(LEG, max_size=4)
    ),
    struct(Weather, station_id=name, time_s=number, latitude_deg=number, longitude_deg=number),
    struct(
        Forecast,
        vehicle_id=name,
        time_s=number,
        ride_id=st.none() | name,
        model=name,
        ride_distance_km=number,
        ride_duration_s=number,
        range_km=INTERVAL,
        soc_end_of_shift_pct=INTERVAL,
        quality=st.builds(QualityCounts, *[count] * 5),
        next_charge=CHARGE,
    ),
    struct(
        ModelErrors,
        model=name,
        first=name,
        time_s=number,
        overall=ERRORS,
        by_vehicle_model=st.lists(ERRORS, max_size=3),
    ),
    struct(
        Finding,
        who=name,
        effect=name,
        time_s=number,
        status=st.sampled_from(["proposed", "sure", "gone"]),
        probability=number,
        causes=st.lists(st.builds(Cause, name, number), max_size=3),
        first_seen=name,
        sure_since=st.none() | name,
        since=st.none() | name,
        words=st.text(max_size=20),
        commands=st.lists(st.text(max_size=20), max_size=2),
    ),
)


@given(STRUCTS)
def test_every_struct_is_unchanged_by_a_round_trip(value):
    payload = encode(value)
    assert msgspec.json.decode(payload, type=type(value)) == value
    assert encode(msgspec.json.decode(payload, type=type(value))) == payload


@given(OUTLOOK)
def test_outlook_is_unchanged_by_a_round_trip_and_includes_unknown_fields(value):
    payload = encode(value)
    assert msgspec.json.decode(payload, type=Outlook) == value
    optional = {"next_charge"} if value.next_charge is msgspec.UNSET else set()
    assert set(msgspec.json.decode(payload)) == set(Outlook.__struct_fields__) - optional


@given(TELEMETRY)
def test_unknown_telemetry_fields_are_not_sent(value):
    sent = msgspec.json.decode(encode(value))
    for field in Telemetry.__struct_fields__[3:]:
        assert (field in sent) == (getattr(value, field) is not None)


def test_forecast_includes_unknown_fields_as_null():
    quality = QualityCounts(0, 0, 0, 0, 0)
    unknown = Forecast("a", 0.0, None, "m/1", 0.0, 0.0, *[None] * 7, quality)
    sent = msgspec.json.decode(encode(unknown))
    assert set(sent) == set(Forecast.__struct_fields__) - {"next_charge"}
    assert sent["soc_pct"] is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_value_that_is_not_finite_is_never_sent_as_a_number(value):
    assert msgspec.json.decode(encode(Telemetry("a", 0.0, soc_pct=value))).get("soc_pct") is None


@given(STRUCTS)
def test_every_message_has_a_valid_identity(value):
    assert all(0 < len(chunk) <= 64 for chunk in identity(value).split("/"))


@given(st.text(max_size=80), st.text(max_size=80))
def test_model_of_any_name_has_a_valid_key(label, version):
    key = f"a/b/models/{identify_model(f'{label}/{version}')}/errors"
    assert address(key) == ("errors", identify_model(f"{label}/{version}"))
    for other in (key.removesuffix("/errors"), key.replace("/errors", "/lunch"), f"fleet/{key}/x", "models/a/errors"):
        assert address(other) is None


@pytest.mark.parametrize("kind", OF_VEHICLES)
def test_key_is_parsed_to_kind_and_identity(kind):
    assert address(f"fleet/x.y-Z_9/{kind}") == (kind, "x.y-Z_9")
    assert address(f"a/b/fleet/x/{kind}") == (kind, "x")
    for key in (
        f"fleet/{'x' * 65}/{kind}",
        f"fleet//{kind}",
        f"fleet/é/{kind}",
        f"x/{kind}",
        f"fleet/x/{kind}/",
        f"{kind}",
    ):
        assert address(key) is None
