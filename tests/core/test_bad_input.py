"""Test bad payloads among valid ones: none raises an error, no valid sample is lost, and every message is counted."""

import json

import numpy as np
import pytest

from socast.core.columns import KMH
from socast.core.pipeline import Pipeline
from socast.core.wire.messages import Message
from tests.support.telemetry import drive, leaf, make_message, observed, ran, telemetry

FUZZED = 10_000
KEYS = (
    "fleet/a/telemetry",
    "fleet/a/vehicle",
    "fleet/a/ride",
    "fleet/a/plan",
    "fleet/a/forecast",
    "weather/yul",
    "fleet/b/telemetry",
    "fleet//telemetry",
    "fleet/a b/telemetry",
    "lunch",
    "",
    "fleet/" + "x" * 65 + "/telemetry",
)


def good(n=400):
    columns = drive(n, seed=4, soc_pct=70.0, battery_voltage_v=350.0, battery_current_a=30.0 + np.arange(n) % 2)
    return telemetry(columns)


SEEDS = [
    json.loads(good(2)[1].payload),
    {"vehicle_id": "a", "time_s": 1.7e9, "model": "nissan-leaf-2013", "mass_kg": 1600.0},
    {"vehicle_id": "a", "time_s": 1.7e9, "ride_id": "r1", "event": "start", "driver_id": "ana"},
    {
        "vehicle_id": "a",
        "time_s": 1.7e9,
        "shift_end_s": 1.7e9,
        "reserve_soc_pct": 10,
        "legs": [{"distance_km": 3, "duration_s": 9}],
    },
    {"station_id": "yul", "time_s": 1.7e9, "latitude_deg": 45.5, "longitude_deg": -73.6, "temperature_c": 4},
]
STRANGE = (
    *(None, True, "", "now", "é\u0000", "1705305600", [], {}, [1, [2]]),
    *(-1, 0, 2**53, 2**63, 2**64, 10**400, -(10**30), 1e308, -1e308, 1e-320, 5e10, 91.0, -181.0, 1.5),
)
LITERALS = (
    b"NaN",
    b"Infinity",
    b"-Infinity",
    b"1e999",
    b"-0",
    b"01",
    b"tru",
    b"'a'",
    b"[" * 3000,
    b'{"a":' * 3000,
    b"null",
    b"",
)


def mutate_payload(rng):
    """Return a valid payload with a random change."""
    kind = int(rng.integers(0, 9))
    value = dict(SEEDS[int(rng.integers(0, len(SEEDS)))])
    name = list(value)[int(rng.integers(0, len(value)))]
    if kind == 0:
        return rng.bytes(int(rng.integers(0, 200)))
    if kind == 1:
        return LITERALS[int(rng.integers(0, len(LITERALS)))]
    text = json.dumps(value).encode()
    if kind == 2:
        at = int(rng.integers(0, len(text)))
        return text[:at] + rng.bytes(int(rng.integers(0, 3))) + text[at + int(rng.integers(0, 3)) :]
    if kind == 3:
        return text[: int(rng.integers(0, len(text)))]
    if kind == 4:
        literal = LITERALS[int(rng.integers(0, 6))]
        return text[:-1] + b', "' + name.encode() + b'": ' + literal + b"}"
    if kind == 5:
        return json.dumps([value, STRANGE[int(rng.integers(0, len(STRANGE)))], value, value]).encode()
    if kind == 6:
        del value[name]
        return json.dumps(value).encode()
    value[name] = STRANGE[int(rng.integers(0, len(STRANGE)))]
    return json.dumps(value).encode()


def make_bad_messages(seed, n=FUZZED):
    """Return messages with random keys and changed payloads."""
    rng = np.random.default_rng(seed)
    return [
        Message(KEYS[int(rng.integers(0, len(KEYS)))], mutate_payload(rng), int(rng.integers(-(2**62), 2**62)))
        for _ in range(n)
    ]


def count_samples(message):
    """Return the number of samples in a telemetry payload, valid or not."""
    try:
        value = json.loads(message.payload)
    except (ValueError, RecursionError):
        return 1
    return len(value) if isinstance(value, list) else 1


def count_messages(pipeline):
    """Return the number of messages that a pipeline has counted as received or rejected."""
    quality = pipeline.quality()
    return sum(quality["received"].values()) + sum(quality["undecodable"].values()) + quality["duplicates"]


@pytest.mark.parametrize("seed", [0, 1])
def test_fuzzed_payloads_raise_nothing_and_lose_no_valid_sample(seed):
    rng = np.random.default_rng(seed)
    bad = [message._replace(key=message.key.replace("/a/", "/other/")) for message in make_bad_messages(seed)]
    fine = [leaf(), *good()]
    places = np.sort(rng.integers(0, len(bad), len(fine)))
    mixed = list(bad)
    for at, message in zip(places[::-1], fine[::-1], strict=True):
        mixed.insert(int(at), message)
    pipeline, out = ran(mixed, range(0, len(mixed), 997))
    alone, expected = ran(fine)
    assert [m for m in out if m.key == "fleet/a/forecast"] == [
        m for m in expected if m.key == "fleet/a/forecast"
    ] or pipeline.quality()["received"].get("weather")  # a changed weather station may be valid
    rides = pipeline.take_rides()
    mine = rides[rides["vehicle_id"] == "a"].reset_index(drop=True)
    whole = alone.take_rides()
    for name in ("distance_km", "duration_s", "energy_kwh", "samples"):
        assert mine[name].tolist() == whole[name].tolist()
    quality = pipeline.quality()
    assert set(quality["undecodable"]) <= {"unknown_key", "not_json", "wrong_type", "key_mismatch", "out_of_range"}
    assert (
        min(quality["undecodable"][cause] for cause in ("unknown_key", "not_json", "wrong_type", "key_mismatch")) > 100
    )


def test_every_payload_is_either_received_or_rejected():
    bad = make_bad_messages(3, 3000)
    pipeline = Pipeline()
    for message in bad:
        before = count_messages(pipeline)
        pipeline.push([message])
        telemetry_key = message.key.endswith("telemetry") and message.key.count("/") == 2
        lists = count_samples(message) if telemetry_key else 1
        grown = count_messages(pipeline) - before
        assert grown == lists or (1 <= grown <= lists and telemetry_key), message
    pipeline.finish()


def test_fuzzed_payloads_of_the_same_car_never_raise():
    mixed = [message for pair in zip(make_bad_messages(5, 3000), good(400) * 8, strict=False) for message in pair]
    pipeline, out = ran(mixed, range(0, len(mixed), 331))
    for message in out:
        forecast = json.loads(message.payload)
        assert forecast["ride_distance_km"] >= 0
    rides = pipeline.take_rides()
    assert np.isfinite(rides["distance_km"]).all()
    assert (rides["duration_s"] >= 0).all()


@pytest.mark.parametrize("name", ["vehicle_id", "time_s"])
@pytest.mark.parametrize("value", STRANGE, ids=repr)
def test_invalid_identities_and_times_raise_nothing(name, value):
    sample = {"vehicle_id": "a", "time_s": 1.7e9, "speed_kmh": 10.0} | {name: value}
    pipeline, _ = ran([leaf(), Message("fleet/a/telemetry", json.dumps(sample).encode(), 0), *good(30)])
    assert count_messages(pipeline) == 32


@pytest.mark.parametrize("kind", ["vehicle", "plan", "ride"])
@pytest.mark.parametrize("value", STRANGE, ids=repr)
def test_invalid_fields_of_other_messages_raise_nothing(kind, value):
    fields = {
        "vehicle": {
            "model": "nissan-leaf-2013",
            "mass_kg": value,
            "nominal_capacity_kwh": value,
            "in_service_date": value,
        },
        "plan": {"shift_end_s": value, "reserve_soc_pct": value, "legs": value},
        "ride": {"ride_id": value, "event": value, "driver_id": value},
    }[kind]
    pipeline, _ = ran([make_message(kind, **fields), *good(30)])
    assert count_messages(pipeline) == 31
    restored = Pipeline()
    restored.restore(pipeline.snapshot())
    assert restored.quality() == pipeline.quality()


@pytest.mark.parametrize(
    "name", ["time_s", "latitude_deg", "longitude_deg", "temperature_c", "wind_speed_kmh", "pressure_hpa"]
)
@pytest.mark.parametrize("value", [1e308, -1e308, 1e-320, 2**63, 0], ids=repr)
def test_invalid_weather_raises_nothing_and_changes_no_distance(name, value):
    fine = good(60)
    strange = observed(**{name: value})
    pipeline, _ = ran([leaf(), *fine[:30], strange, *fine[30:]])
    plain, _ = ran([leaf(), *fine])
    assert pipeline.take_rides()["distance_km"].tolist() == plain.take_rides()["distance_km"].tolist()
    assert all(np.isfinite(pipeline.take_windows()["effect_rolling"]))


def test_huge_values_are_counted_out_of_range_and_do_not_change_the_ride():
    fine = good(100)
    for at, field in ((20, "latitude_deg"), (40, "longitude_deg"), (60, "elevation_m"), (80, "odometer_km")):
        sample = json.loads(fine[at].payload) | {field: 1e308}
        fine[at] = fine[at]._replace(payload=json.dumps(sample).encode())
    pipeline, _ = ran([leaf(), *fine])
    plain, _ = ran([leaf(), *good(100)])
    assert pipeline.quality()["samples"]["out_of_range"] == 4
    one, other = pipeline.take_rides(), plain.take_rides()
    assert one["distance_km"].tolist() == pytest.approx(other["distance_km"].tolist())
    assert one["average_speed_kmh"][0] < 130 * KMH * 3.6
