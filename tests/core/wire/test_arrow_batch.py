"""Test batches in Arrow's stream format: they give what their samples give in JSON, and no stranger does harm."""

import json
from collections import Counter

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from socast.core.batch import Lanes
from socast.core.pipeline import Pipeline
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import PREFIX, BatchError, read_rows, read_times, select_rows, write_rows
from socast.core.wire.decoder import Decoder
from socast.core.wire.messages import Message, Telemetry
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from tests.support.telemetry import chunked, drive, make_message, telemetry

GATEWAY = "fleet/depot/batch"


def make_batch(samples, key=GATEWAY, **columns):
    """Return a batch of samples, given as mappings of fields."""
    names = dict.fromkeys(name for sample in samples for name in sample)
    table = pa.table({name: [sample.get(name) for sample in samples] for name in names} | columns)
    return Message(key, write_rows(table), 0)


def batch(*cars, **fields):
    return make_batch([{"vehicle_id": car, "time_s": 1.7e9 + at} | fields for at, car in enumerate(cars)])


def compress_batch(codec):
    table = pa.table({"vehicle_id": ["a"] * 100, "time_s": [1.0] * 100})
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema, options=pa.ipc.IpcWriteOptions(compression=codec)) as writer:
        writer.write_table(table)
    return Message(GATEWAY, sink.getvalue().to_pybytes(), 0)


def fleet():
    """Return samples of three cars that drive at once, in JSON."""
    cars = [telemetry(drive(200, ride_id=np.full(200, f"{car}-1", object)), car) for car in "abc"]
    return [message for turn in zip(*cars, strict=True) for message in turn]


def in_batches(messages, size):
    """Return samples in JSON as batches of a gateway."""
    samples = [json.loads(message.payload) for message in messages]
    return [make_batch(samples[at : at + size]) for at in range(0, len(samples), size)]


def test_batches_give_the_tables_of_their_samples_in_json():
    messages, tables = fleet(), []
    for sent in (messages, in_batches(messages, 7), in_batches(messages, 10_000)):
        pipeline = Pipeline()
        pipeline.push([make_message("vehicle", car, model="nissan-leaf-2016") for car in "abc"])
        pipeline.push(sent)
        pipeline.finish()
        tables.append(pipeline.take_rides())
    assert len(tables[0]) == 3
    for table in tables[1:]:
        pd.testing.assert_frame_equal(table, tables[0], check_exact=True)


@given(st.lists(st.integers(0, 60), max_size=5), st.integers(1, 9))
@settings(max_examples=20, deadline=None)
def test_any_division_and_repetition_of_batches_gives_the_same_state(cuts, size):
    sent = in_batches(fleet()[:180], size)
    mixed = [*sent[:3], make_message("telemetry", "b", ride_id="late"), *sent, *sent[-2:]]
    states = []
    for parts in ([mixed], chunked(mixed, cuts)):
        pipeline = Pipeline()
        for part in parts:
            pipeline.take(part)
        states.append(pipeline.snapshot())
        assert pipeline.quality()["received"]["telemetry"] == 181
    assert states[0] == states[1]


def test_sample_in_another_batch_of_another_gateway_is_dropped_and_only_new_rows_are_recorded():
    rows = [{"vehicle_id": car, "time_s": 1.7e9 + 3.0 * at, "soc_pct": 50.0} for at in range(4) for car in "ab"]
    recorded = []
    pipeline = Pipeline()
    pipeline.take([make_batch(rows[:4])], recorded.extend)
    pipeline.take([make_batch(rows[2:], "fleet/other/batch")], recorded.extend)
    assert pipeline.quality()["duplicates"] == 2
    assert [read_rows(message.payload, 10).table.shape[1] for message in recorded] == [4, 4]


REFUSED = {
    "not_arrow": [
        Message(GATEWAY, PREFIX, 0),
        Message(GATEWAY, b'{"vehicle_id":"a","time_s":1}', 0),
        Message(GATEWAY, batch("a").payload[:-40], 0),
    ],
    "compressed": [compress_batch("zstd"), compress_batch("lz4")],
    "empty_list": [Message(GATEWAY, select_rows(batch("a").payload, [False]), 0)],
    "too_many_samples": [batch(*"abcdefgh")],
    "too_large": [batch("a", ride_id="x" * 5000)],
    "wrong_type": [
        batch("a b"),
        batch(""),
        make_batch([{"vehicle_id": "a"}]),
        make_batch([{"time_s": 1.0}]),
        make_batch([{"vehicle_id": None, "time_s": 1.0}]),
        batch("a", seq=-1),
        batch("a", seq=1.5),
        batch("a", occupants=2**60),
        batch("a", soc_pct="full"),
        batch("a", charging=1.0),
        batch("a", speed_kmh=float("inf")),
        make_batch([{"vehicle_id": "a", "time_s": None}]),
        make_batch([{"vehicle_id": 5, "time_s": 1.0}]),
    ],
    "too_long": [batch("a", ride_id="x" * 257)],
    "key_mismatch": [batch("b")._replace(key="fleet/a/telemetry")],
    "unknown_key": [batch("a")._replace(key="fleet/a/plan"), batch("a")._replace(key="nowhere")],
    "too_many_vehicles": [batch("d")],
}


@pytest.mark.parametrize(("cause", "message"), [(cause, each) for cause, many in REFUSED.items() for each in many])
def test_unusable_batches_are_counted_by_cause(cause, message):
    decoder = Decoder(Lanes("abc"), Limits(payload_bytes=5000, list_samples=6, vehicles=3))
    decoded, events = decoder.decode([message], refusals := [])
    assert (decoded.size, events, decoder.rejected) == (0, [], {cause: 1})
    assert [each.message for each in refusals] == [message]


def test_unusable_rows_leave_the_others():
    decoder = Decoder(Lanes())
    decoded, _ = decoder.decode([batch("a", "b c", "b", None)], refusals := [])
    assert [decoder.lanes.names[lane] for lane in decoded.lane] == ["a", "b"]
    assert (decoder.rejected, refusals[0].samples) == (Counter(wrong_type=2), (1, 3))


def test_batch_under_the_key_of_a_car_is_of_this_car():
    decoder = Decoder(Lanes())
    decoded, _ = decoder.decode([batch("a", "b", "a")._replace(key="fleet/a/telemetry")])
    assert (decoded.size, decoder.lanes.names, decoder.rejected) == (2, ["a"], Counter(key_mismatch=1))


def test_columns_may_have_any_type_of_number_and_coded_names():
    fields = [name for name in Telemetry.__struct_fields__ if name not in {"vehicle_id", "ride_id", "charging"}]
    columns = {name: pa.array([1, None, 3], pa.float32() if at % 2 else pa.uint8()) for at, name in enumerate(fields)}
    columns |= {"time_s": [1, 2, 3], "charging": [True, None, False], "unknown": [[1], [2], None]}
    columns |= {name: pa.array(["a", "b", "a"]).dictionary_encode() for name in ("vehicle_id", "ride_id")}
    decoder = Decoder(Lanes())
    decoded, _ = decoder.decode([Message(GATEWAY, write_rows(pa.table(columns)), 0)])
    assert decoded.lane.tolist() == decoded.ride.tolist() == [0, 1, 0]
    assert decoded.charging.tolist()[::2] == [1.0, 0.0]
    assert np.isnan(decoded.soc[1])
    assert decoder.rejected == {}


def test_times_are_read_alone():
    whole = pa.table({"vehicle_id": [1, 2], "time_s": [5, None], "soc_pct": ["much", "little"]})
    np.testing.assert_array_equal(read_times(write_rows(whole), 2), [5.0, np.nan])
    for table, cause in (
        (whole.drop(["time_s"]), "wrong_type"),
        (whole.append_column("time_s", [[1, 2]]), "wrong_type"),
        (whole.set_column(1, "time_s", [["noon", "night"]]), "wrong_type"),
        (pa.concat_tables([whole, whole]), "too_many_samples"),
    ):
        with pytest.raises(BatchError, match=cause):
            read_times(write_rows(table), 2)


def test_damaged_batches_raise_nothing():
    rng = np.random.default_rng(11)
    rows = [{"vehicle_id": car, "time_s": 1.0, "seq": 1, "ride_id": None, "charging": True} for car in "abca"]
    whole, counts = make_batch(rows).payload, Counter()
    for _ in range(2000):
        payload = bytearray(whole)
        for at in rng.integers(0, len(payload), rng.integers(1, 4)):
            payload[at] = rng.choice([0, 1, 255, rng.integers(0, 256)])
        decoder = Decoder(Lanes())
        decoded, _ = decoder.decode([Message(GATEWAY, bytes(payload), 0)])
        counts.update(decoder.rejected.keys() or ["sound"])
        assert decoded.size + decoder.rejected.total() >= 1
    assert counts["not_arrow"] > 100 < counts["sound"]


def test_recording_keeps_batches_verbatim(tmp_path):
    sent = [batch("a", "b"), make_message("telemetry", "a")]
    with McapSink(tmp_path / "a.mcap") as sink:
        sink.put(sent)
    source = McapSource(tmp_path / "a.mcap")
    assert [message for messages in source for message in messages] == sorted(sent, key=lambda each: each.receipt_ns)
    assert not source.losses
