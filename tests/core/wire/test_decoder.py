"""Test the decoder: units, unknown values, and counts of rejected messages by cause."""

import json
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from socast.core.batch import NO_RIDE, Lanes
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import KINDS, Message, Telemetry, Vehicle, Weather, address, encode
from socast.core.wire.schema import make_schema
from tests.support.telemetry import chunked, drive, leaf, make_message, observed, telemetry

KEY = "fleet/a/telemetry"


def sample(**fields):
    return Message(KEY, json.dumps({"vehicle_id": "a", "time_s": 1.7e9} | fields).encode(), 0)


def decode(*messages):
    decoder = Decoder(Lanes())
    batch, events = decoder.decode(messages)
    return decoder, batch, events


WIRE = {
    "latitude_deg": (180.0, "latitude", np.pi),
    "longitude_deg": (-90.0, "longitude", -np.pi / 2),
    "elevation_m": (12.5, "elevation", 12.5),
    "speed_kmh": (36.0, "speed", 10.0),
    "odometer_km": (1.5, "odometer", 1500.0),
    "soc_pct": (50.0, "soc", 0.5),
    "battery_voltage_v": (360.0, "voltage", 360.0),
    "battery_current_a": (-20.0, "current", -20.0),
    "battery_temperature_c": (20.0, "battery_temperature", 293.15),
    "ambient_c": (-10.0, "ambient", 263.15),
    "hvac_w": (500.0, "hvac", 500.0),
    "occupants": (2, "occupants", 2.0),
    "charging": (True, "charging", 1.0),
    "seq": (7, "seq", 7.0),
}


@pytest.mark.parametrize("field", WIRE)
@pytest.mark.parametrize("others", [0, 1, 700], ids=["alone", "one other", "a block"])
def test_units_are_converted_and_unknown_values_are_nan(field, others):
    sent, column, expected = WIRE[field]
    messages = [sample(**{field: sent}), sample(**{field: None}), *[sample()] * others]
    _, batch, _ = decode(*messages)
    values = getattr(batch, column)
    assert values[0] == pytest.approx(expected)
    assert np.all(np.isnan(values[1:]))


def test_every_telemetry_field_is_decoded():
    assert {"vehicle_id", "time_s", "ride_id", *WIRE} == set(Telemetry.__struct_fields__)


def test_ride_is_a_name_or_none():
    _, batch, _ = decode(sample(ride_id="x"), sample(ride_id=None), sample(), sample(ride_id="y"), sample(ride_id="x"))
    assert batch.ride.tolist() == [0, NO_RIDE, NO_RIDE, 1, 0]


BAD = {
    "unknown_key": [
        Message("fleet/a/lunch", b"{}", 0),
        Message("a", b"{}", 0),
        Message("fleet/a b/telemetry", b"{}", 0),
    ],
    "not_json": [
        Message(KEY, payload, 0) for payload in (b"", b"{", b"\xff\xfe", b"NaN", b'{"time_s": NaN}', b"{" * 9999)
    ],
    "wrong_type": [
        sample(time_s="now"),
        sample(seq=-1),
        sample(seq=2**63),
        sample(seq=1.5),
        sample(occupants=-2),
        sample(ride_id=5),
        sample(charging="yes"),
        sample(speed_kmh=[1]),
        Message(KEY, b'{"vehicle_id": "a"}', 0),
        Message(KEY, b"3", 0),
        Message(KEY, b"null", 0),
        Message(KEY, b'"a"', 0),
    ],
    "key_mismatch": [sample(vehicle_id="b"), sample(vehicle_id="")],
}


@pytest.mark.parametrize("cause", BAD)
def test_rejected_messages_are_counted_by_cause(cause):
    good = sample(speed_kmh=1.0)
    for bad in BAD[cause]:
        decoder, batch, events = decode(good, bad, good)
        assert dict(decoder.rejected) == {cause: 1}, bad
        assert batch.size == decoder.received["telemetry"] == 2
        assert events == []


def test_list_is_split_into_samples_and_its_bad_ones_are_counted():
    one, two = (json.loads(sample(seq=i).payload) for i in (1, 2))
    gateway = Message(KEY, json.dumps([one, {"vehicle_id": "b", "time_s": 1.0}, 5, two, {"time_s": 3}]).encode(), 0)
    decoder, batch, _ = decode(gateway)
    assert batch.seq.tolist() == [1.0, 2.0]
    assert dict(decoder.rejected) == {"key_mismatch": 1, "wrong_type": 2}
    decoder, batch, _ = decode(Message(KEY, b"[]", 0))
    assert batch.size == 0
    assert dict(decoder.rejected) == {"empty_list": 1}


@given(st.lists(st.integers(1, 5), min_size=1, max_size=12), st.integers(1, 40))
def test_list_decodes_as_its_single_samples(sizes, seed):
    messages = telemetry(drive(sum(sizes), seed=seed, soc_pct=50.0))
    at = np.cumsum([0, *sizes])
    lists = [Message(KEY, b"[" + b",".join(m.payload for m in messages[a:b]) + b"]", 0) for a, b in pairwise(at)]
    for one, other in zip(decode(*messages)[1], decode(*lists)[1], strict=True):
        assert np.array_equal(one, other, equal_nan=True)


def test_event_holds_the_row_before_which_it_came():
    _, batch, events = decode(
        leaf(), sample(), observed(), sample(), sample(), make_message("ride", ride_id="x", event="start")
    )
    assert batch.size == 3
    assert [(event.row, event.lane) for event in events] == [(0, 0), (1, -1), (3, 0)]
    assert [type(event.value).__name__ for event in events] == ["Vehicle", "Weather", "Ride"]


MIXED = [
    sample(vehicle_id="b"),
    leaf(),
    observed(),
    make_message("plan", shift_end_s=1.7e9, reserve_soc_pct=20.0, legs=[]),
    make_message("ride", ride_id="x", event="start"),
    make_message("ride", ride_id="x", event="lunch"),
    sample()._replace(key="fleet/b/telemetry"),
    sample()._replace(key="fleet/b/lunch"),
    *(Message(KEY, payload, 0) for payload in (b"[]", b"[", b"3", b"", b"[" + sample(seq=1).payload + b", 7]")),
]
"""Messages of every kind, valid and invalid, to mix with telemetry samples."""


@given(st.lists(st.integers(0, 1300), max_size=6), st.lists(st.integers(0, 1200), max_size=40), st.integers(0, 2**32))
def test_any_chunking_decodes_the_same(cuts, places, seed):
    messages = telemetry(drive(1200, seed=2))
    random = np.random.default_rng(seed)
    for place in places:
        messages.insert(place, MIXED[random.integers(len(MIXED))])
    one, other = Decoder(Lanes()), Decoder(Lanes())
    whole, events = one.decode(messages)
    parts, joined, rows, sent = [], [], 0, 0
    for chunk in chunked(messages, cuts):
        batch, chunk_events = other.decode(chunk)
        parts.append(batch)
        joined += [event._replace(row=event.row + rows, number=event.number + sent) for event in chunk_events]
        rows, sent = rows + batch.size, sent + len(chunk)
    for i, column in enumerate(whole):
        assert np.array_equal(column, np.concatenate([part[i] for part in parts]), equal_nan=True)
    assert joined == events
    assert (one.received, one.rejected, one.lanes.names) == (other.received, other.rejected, other.lanes.names)


def test_key_prefix_and_unknown_field_are_ignored():
    message = sample(speed_kmh=3.6, colour="red")._replace(key="montreal/east/fleet/a/telemetry")
    decoder, batch, _ = decode(message)
    assert batch.speed[0] == pytest.approx(1.0)
    assert decoder.lanes.names == ["a"]


def test_last_of_duplicate_fields_is_used():
    _, batch, _ = decode(Message(KEY, b'{"vehicle_id":"a","time_s":1,"speed_kmh":7.2,"speed_kmh":3.6}', 0))
    assert batch.speed[0] == pytest.approx(1.0)


def test_only_kept_ride_names_survive():
    decoder = Decoder(Lanes())
    _, batch = 0, decoder.decode([sample(ride_id=f"r{i}") for i in range(5)])[0]
    decoder.rides.keep({1.0, 3.0})
    assert decoder.rides.names(range(5)) == [None, "r1", None, "r3", None]
    later = decoder.decode([sample(ride_id=name) for name in ("r1", "r0", "r3")])[0]
    assert later.ride.tolist() == [1, 5, 3]
    assert batch.ride.tolist() == [0, 1, 2, 3, 4]


def test_wire_structs_are_unchanged_by_a_round_trip():
    for struct, message in ((Vehicle, leaf(mass_kg=1600.5)), (Weather, observed(temperature_c=-1.25))):
        value = msgspec.json.decode(message.payload, type=struct)
        assert msgspec.json.decode(encode(value), type=struct) == value


@pytest.mark.parametrize("kind", KINDS)
def test_schemas_have_no_references_or_alternatives(kind):
    text = json.dumps(make_schema(kind))
    assert "$ref" not in text
    assert "anyOf" not in text
    assert set(make_schema(kind)["properties"]) == set(KINDS[kind].__struct_fields__)


@given(st.text(max_size=30))
def test_any_key_has_a_valid_address_or_none(text):
    for key in (text, f"fleet/{text}/telemetry", f"weather/{text}", f"fleet/a/{text}"):
        parsed = address(key)
        assert parsed is None or (parsed.kind in KINDS and 0 < len(parsed.identity) <= 64)


def test_empty_list_and_ride_with_unknown_event_are_counted():
    decoder = Decoder(Lanes())
    ride = b'{"vehicle_id": "a", "time_s": 1.0, "ride_id": "r", "event": "%s"}'
    sent = [("telemetry", b"[]"), ("ride", ride % b"start"), ("ride", ride % b"lunch")]
    batch, events = decoder.decode([Message(f"fleet/a/{kind}", payload, 0) for kind, payload in sent])
    assert (batch.size, len(events)) == (0, 1)
    assert decoder.rejected == {"empty_list": 1, "wrong_type": 1}
