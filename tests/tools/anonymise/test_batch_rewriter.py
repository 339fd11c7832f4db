"""Batches of gateways pass in the same disguise as samples in JSON, and with nothing but their fields."""

import json
from collections import Counter
from random import Random

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from socast.core.pipeline import Pipeline
from socast.core.wire.arrow_batch import PREFIX, read_rows, write_rows
from socast.core.wire.messages import Message, Telemetry
from socast.tools.anonymise import message_rewriter
from socast.tools.anonymise.disguise import make_disguise
from socast.tools.anonymise.message_rewriter import MessageRewriter
from tests.support.batched_recordings import GATEWAY, make_batch
from tests.support.telemetry import PLACE, START, drive, make_message, observed, telemetry

CARS = "van-of-anna", "van-of-bob"


@pytest.fixture
def disguise():
    return make_disguise(Random(1), START, START, PLACE, [True] * 24)


@pytest.fixture
def rewriter(disguise):
    return MessageRewriter(disguise)


def read_back(message):
    """Return the columns of a batch."""
    with pa.ipc.open_stream(message.payload) as reader:
        return reader.read_all()


def make_samples():
    """Return samples in JSON of cars that drive, with faults: no fix, half a fix, a wrong fix, and an unset clock."""
    lists = []
    for number, car in enumerate(CARS):
        columns = drive(200, seed=number, soc_pct=80.5, battery_voltage_v=360.25, ride_id=f"{car}-7")
        columns["latitude_deg"][[5, 6, 7]] = 0.0, np.nan, 91.0
        columns["longitude_deg"][[5, 8, 9]] = 0.0, np.nan, np.nan
        columns["latitude_deg"][9] = np.nan
        columns["time_s"][[20, 21]] = 946_684_812.0, START + 3.0 * 21 + 0.1234567
        lists.append(telemetry(columns, car))
    return [message for turn in zip(*lists, strict=True) for message in turn]


def make_tables(rewriter, messages):
    """Return the tables of messages after they are rewritten."""
    about = [make_message("vehicle", car, model="nissan-leaf-2016") for car in CARS]
    pipeline = Pipeline()
    pipeline.push([rewriter.rewrite(each) for each in [*about, observed(wind_from_deg=30.0, wind_speed_kmh=9.0)]])
    pipeline.push([rewriter.rewrite(each) for each in messages])
    pipeline.finish()
    return pipeline.take_rides(), pipeline.take_windows()


@pytest.mark.parametrize("size", [7, 10_000])
def test_rewritten_batches_give_the_tables_of_the_rewritten_samples_in_json(disguise, size):
    messages = make_samples()
    samples = [json.loads(each.payload) for each in messages]
    batches = [make_batch(samples[at : at + size]) for at in range(0, len(samples), size)]
    one, other = MessageRewriter(disguise), MessageRewriter(disguise)
    expected, found = make_tables(one, messages), make_tables(other, batches)
    assert len(expected[0]) >= 2
    assert len(expected[1]) >= 2
    for table, same in zip(expected, found, strict=True):
        pd.testing.assert_frame_equal(same, table, check_exact=True)
    assert (other.positions, other.dropped) == (one.positions, one.dropped) == (one.positions, Counter())
    assert other.names | {"gateway": set()} == one.names
    assert other.kept["batch"] == len(batches)


def test_columns_in_a_batch_move_as_the_fields_in_json(rewriter, disguise):
    place = {"latitude_deg": PLACE[0], "longitude_deg": PLACE[1], "elevation_m": 31.5}
    sample = {"vehicle_id": CARS[0], "time_s": START, "ride_id": "r7", "seq": 5, "charging": False} | place
    key, payload, receipt_ns = rewriter.rewrite(make_batch([sample, {**sample, "ride_id": None}], receipt_ns=9))
    assert key == f"fleet/{disguise.rename('gateway', 'depot-3')}/batch"
    assert receipt_ns == 9 + disguise.shift_s * 10**9
    single = rewriter.rewrite(Message(f"fleet/{CARS[0]}/telemetry", json.dumps(sample).encode(), 9))
    expected = json.loads(single.payload)
    assert read_back(Message(key, payload, 0)).to_pylist() == [expected, {**expected, "ride_id": None}]


def test_batch_of_one_car_keeps_its_key_and_rows_of_others_stay_those_of_others(rewriter, disguise):
    samples = [{"vehicle_id": car, "time_s": START} for car in CARS]
    message = rewriter.rewrite(make_batch(samples, f"montreal/fleet/{CARS[1]}/telemetry"))
    names = [disguise.rename("car", car) for car in CARS]
    assert message.key == f"fleet/{names[1]}/telemetry"
    assert read_back(message)["vehicle_id"].to_pylist() == names
    assert rewriter.kept == {"telemetry": 1}


def test_types_of_columns_stay_but_for_times_and_positions(rewriter):
    fields = [name for name in Telemetry.__struct_fields__ if name not in {"vehicle_id", "ride_id", "charging"}]
    kinds = pa.float32(), pa.uint8(), pa.float16(), pa.int64(), pa.null()
    changed = {"time_s", "latitude_deg", "longitude_deg"}
    kind_of = {name: kinds[0 if name in changed else at % 5] for at, name in enumerate(fields)}
    columns = {
        name: pa.array([None] * 3 if kind == pa.null() else [1, None, 3]).cast(kind) for name, kind in kind_of.items()
    }
    columns |= {"time_s": pa.array([1, 2, 3]), "charging": pa.array([True, None, False])}
    columns["vehicle_id"] = pa.array(["a", "b", "a"]).dictionary_encode()
    columns["ride_id"] = pa.array(["a", None, "c"], pa.large_string())
    table = pa.table(columns)
    found = read_back(rewriter.rewrite(Message(GATEWAY, write_rows(table), 0)))
    assert found.column_names == table.column_names
    for name in table.column_names:
        assert found[name].type == (pa.float64() if name in changed else table[name].type), name
        if name not in changed | {"vehicle_id", "ride_id"}:
            assert found[name].to_pylist() == table[name].to_pylist(), name


def test_integers_that_floats_do_not_hold_pass_as_consumers_read_them(rewriter):
    table = pa.table({"vehicle_id": ["a"], "time_s": [START], "elevation_m": [2**63 - 1]})
    assert read_back(rewriter.rewrite(Message(GATEWAY, write_rows(table), 0)))["elevation_m"].to_pylist() == [2.0**63]


def test_output_holds_no_byte_of_names_times_places_other_columns_or_metadata(rewriter):
    hidden = pa.py_buffer(np.array([1111.5, 2222.5]))  # the second value is under a null
    speed = pa.Array.from_buffers(pa.float64(), 2, [pa.py_buffer(b"\x01"), hidden])
    times, latitudes, longitudes = [START + 0.125, START + 3.125], [45.5123, 45.5124], [-73.6123, -73.6124]
    columns = {
        "vehicle_id": pa.array(CARS).dictionary_encode(),
        "ride_id": ["trip-of-anna", "trip-of-bob"],
        "time_s": times,
        "latitude_deg": latitudes,
        "longitude_deg": longitudes,
        "speed_kmh": speed,
        "plate": ["XYZ-123", "XYZ-456"],
    }
    table = pa.table(columns).replace_schema_metadata({"owner": "anna"})
    field = table.schema.field("speed_kmh").with_metadata({"sensor": "anna"})
    table = table.cast(table.schema.set(5, field))
    message = rewriter.rewrite(Message("depot-of-anna/fleet/depot-3/batch", write_rows(table), 0))
    data = message.key.encode() + message.payload
    for text in (b"anna", b"bob", b"depot", b"van", b"trip", b"XYZ", b"plate", b"owner", b"sensor"):
        assert text not in data
    for number in (*times, *latitudes, *longitudes, 2222.5):
        assert np.float64(number).tobytes() not in data
    assert np.float64(1111.5).tobytes() in data


def test_rows_that_cannot_be_used_are_left_out_and_counted(rewriter, disguise):
    good = {"vehicle_id": "a", "time_s": START, "ride_id": "r", "seq": 1}
    faults = {"vehicle_id": "van of Anna"}, {"vehicle_id": None}, {"time_s": None}, {"seq": -1}, {"ride_id": "r" * 257}
    message = rewriter.rewrite(make_batch([good, *(good | fault for fault in faults), good]))
    assert read_back(message)["vehicle_id"].to_pylist() == [disguise.rename("car", "a")] * 2
    assert rewriter.dropped == {"unusable rows of batches": len(faults)}
    assert {kind: len(names) for kind, names in rewriter.names.items() if names} == {"car": 1, "gateway": 1, "ride": 1}
    assert rewriter.rewrite(make_batch([good | {"time_s": None}])) is None
    assert rewriter.kept == {"batch": 1}


@pytest.mark.parametrize(
    ("payload", "cause"),
    [
        (PREFIX, "damaged batches"),
        (b'{"vehicle_id": "a", "time_s": 1.0}', "damaged batches"),
        (make_batch([{"vehicle_id": "a"}]).payload, "batches with a column missing or of a wrong type"),
        (write_rows(pa.table({"vehicle_id": ["a"] * 20_001, "time_s": [1.0] * 20_001})), "batches of too many rows"),
        (
            write_rows(pa.table({"vehicle_id": pa.array([], pa.string()), "time_s": pa.array([], pa.float64())})),
            "empty batches",
        ),
    ],
)
def test_batch_that_cannot_be_used_is_dropped_and_counted_by_cause(rewriter, payload, cause):
    assert rewriter.rewrite(Message(GATEWAY, payload, 0)) is None
    assert rewriter.dropped == {cause: 1}


def test_batch_that_is_too_large_is_dropped_and_counted(rewriter, monkeypatch):
    message = make_batch([{"vehicle_id": "a", "time_s": START}])
    limits = message_rewriter.LIMITS._replace(payload_bytes=len(message.payload) - 1)
    monkeypatch.setattr(message_rewriter, "LIMITS", limits)
    assert rewriter.rewrite(message) is None
    assert rewriter.dropped == {"batches too large": 1}


def test_damaged_batches_raise_nothing_and_what_passes_can_be_read(rewriter):
    rng = np.random.default_rng(5)
    rows = [{"vehicle_id": car, "time_s": 1.0, "seq": 1, "ride_id": None, "charging": True} for car in "abca"]
    whole, passed = make_batch(rows).payload, 0
    for _ in range(500):
        payload = bytearray(whole)
        for at in rng.integers(0, len(payload), rng.integers(1, 4)):
            payload[at] = rng.choice([0, 1, 255, rng.integers(0, 256)])
        if (message := rewriter.rewrite(Message(GATEWAY, bytes(payload), 0))) is not None:
            assert read_rows(message.payload, 20_000).is_usable.all()
            passed += 1
    assert 50 < passed < 500
    assert rewriter.dropped["damaged batches"] > 50
