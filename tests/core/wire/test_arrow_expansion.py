"""Memory that a batch of a stranger takes is bounded by its size, whatever its encodings could expand to."""

import struct
import tracemalloc
from collections import Counter

import numpy as np
import pyarrow as pa
import pytest

from socast.core.batch import Lanes
from socast.core.settings import Limits
from socast.core.wire.arrow_batch import BatchError, read_rows, select_rows, write_rows
from socast.core.wire.decoder import Decoder
from socast.core.wire.duplicate_filter import DuplicateFilter
from socast.core.wire.messages import Message

GATEWAY = "fleet/depot/batch"
ROWS = 20_000
TIMES = 1.7e9 + np.arange(ROWS)
EXPANSION = 20
"""Largest ratio of memory to the size of a payload."""
ALLOWANCE = 100_000
"""Memory that any payload may take. [B]"""


def code(value, codes=ROWS, kind="int32", text="string"):
    """Return one text as a dictionary, to which all rows refer."""
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(codes), kind), pa.array([value], text))


def write(**columns):
    return write_rows(pa.table({"vehicle_id": code("a", kind="int8"), "time_s": TIMES} | columns))


def write_parts(parts, *, deltas=False):
    """Return a payload of several parts, given as dictionaries of names."""
    batches = [
        pa.record_batch(
            {"vehicle_id": pa.DictionaryArray.from_arrays(pa.array([0], "int32"), names), "time_s": [1.7e9 + at]}
        )
        for at, names in enumerate(parts)
    ]
    sink = pa.BufferOutputStream()
    options = pa.ipc.IpcWriteOptions(emit_dictionary_deltas=deltas)
    with pa.ipc.new_stream(sink, batches[0].schema, options=options) as writer:
        for batch in batches:
            writer.write_batch(batch)
    return sink.getvalue().to_pybytes()


def view(value):
    """Return one text, at which the views of all rows look."""
    views = struct.pack("<i4sii", len(value), value[:4].encode(), 0, 0) * ROWS
    buffers = [None, pa.py_buffer(views), pa.py_buffer(value.encode())]
    return pa.Array.from_buffers(pa.string_view(), ROWS, buffers)


def encode_runs(value):
    return pa.RunEndEncodedArray.from_arrays(pa.array([ROWS], "int32"), pa.array([value]))


NAMES = [f"car-{at}" for at in range(5_000)]
LONG = "x" * 100_000
BOMBS = {
    "long name of a vehicle": (write(vehicle_id=code(LONG)), {"wrong_type": ROWS}),
    "long name of a ride": (write(ride_id=code(LONG)), {"too_long": ROWS}),
    "long name of a ride in large text": (
        write(ride_id=code(LONG, text="large_string")),
        {"too_long": ROWS},
    ),
    "longest name of a ride": (write(ride_id=code("\U0001f697" * 256)), {}),
    "rows of few bytes": (write(time_s=pa.array(np.zeros(ROWS), "int8")), {"too_many_samples": 1}),
    "rows without bytes": (write(vehicle_id=pa.nulls(ROWS), time_s=pa.nulls(ROWS)), {"too_many_samples": 1}),
    "runs of a name": (write(vehicle_id=encode_runs(LONG)), {"wrong_type": 1}),
    "runs of a number": (write(soc_pct=encode_runs(50.0)), {"wrong_type": 1}),
    "runs of a time": (write(time_s=encode_runs(1.7e9)), {"wrong_type": 1}),
    "views of a name": (
        write(ride_id=view(LONG)),
        {"wrong_type": 1},
    ),
    "coded numbers": (
        write(soc_pct=pa.DictionaryArray.from_arrays(pa.array([0] * ROWS, "int8"), pa.array([5.0]))),
        {"wrong_type": 1},
    ),
    "nested dictionary": (
        write(ride_id=pa.DictionaryArray.from_arrays(pa.array([0] * ROWS, "int8"), code("x", 1))),
        {"not_arrow": 1},
    ),
    "lists of a number": (
        write(soc_pct=pa.FixedSizeListArray.from_arrays(pa.array([1.0] * ROWS), 1)),
        {"wrong_type": 1},
    ),
    "parts that share a dictionary": (write_parts([pa.array(NAMES)] * 1000), {}),
    "parts with a dictionary each": (write_parts([pa.array([name]) for name in NAMES[:1000]]), {}),
    "dictionary that grows": (
        write_parts([pa.array(NAMES[: 4_000 + at]) for at in range(200)], deltas=True),
        {"too_large": 1},
    ),
}


def measure(function, *given):
    """Return the largest memory that a call takes, in Python, numpy and Arrow together. [B]"""
    before = pa.default_memory_pool()
    pool = pa.proxy_memory_pool(pa.system_memory_pool())
    pa.set_memory_pool(pool)
    tracemalloc.start()
    try:
        function(*given)
        return tracemalloc.get_traced_memory()[1] + (pool.max_memory() or 0)
    finally:
        tracemalloc.stop()
        pa.set_memory_pool(before)


def read(payload):
    """Read a batch as far as it can be used."""
    try:
        read_rows(payload, Limits().list_samples).hash()
    except BatchError as error:
        return str(error)
    return None


@pytest.fixture(scope="module", autouse=True)
def compiled():
    """Compile what reads batches, which takes memory of its own."""
    read(write())


@pytest.mark.parametrize("name", BOMBS)
def test_no_encoding_takes_more_memory_than_twenty_times_the_payload(name):
    payload, _ = BOMBS[name]
    assert measure(read, payload) <= EXPANSION * len(payload) + ALLOWANCE


@pytest.mark.parametrize("name", BOMBS)
def test_expanding_batches_are_counted_by_cause(name):
    payload, counts = BOMBS[name]
    decoder = Decoder(Lanes())
    decoder.decode([Message(GATEWAY, payload, 0)])
    assert decoder.rejected == counts


@pytest.mark.parametrize("name", ["long name of a vehicle", "long name of a ride", "longest name of a ride"])
def test_filter_and_decoder_take_no_more_memory_than_twenty_times_the_payload(name):
    payload = BOMBS[name][0]
    decoder = Decoder(Lanes("a"))
    new = DuplicateFilter(decoder.lanes, batches=decoder.batches)
    decoder.decode(DuplicateFilter(decoder.lanes).select_new([Message(GATEWAY, write(), 0)])[0])

    def take():
        decoder.decode(new.select_new([Message(GATEWAY, payload, 0)])[0], refusals := [])
        assert len(refusals) <= 1

    assert measure(take) <= EXPANSION * len(payload) + ALLOWANCE


@pytest.mark.parametrize("name", ["longest name of a ride", "parts that share a dictionary"])
def test_some_rows_of_a_batch_are_no_larger_than_the_batch(name):
    payload = BOMBS[name][0]
    mask = [True] + [False] * (read_rows(payload, ROWS).table.shape[1] - 1)
    kept = select_rows(payload, mask)
    assert len(kept) <= len(payload)
    assert read_rows(kept, ROWS).hash().tolist() == read_rows(payload, ROWS).hash()[:1].tolist()
    assert measure(select_rows, payload, mask) <= EXPANSION * len(payload) + ALLOWANCE


def test_texts_in_any_encoding_are_the_same_samples():
    names, rides = ["a", "b", None, "a", "c"], [None, "é" * 200, "", "x", "x" * 200]
    plain = pa.table({"vehicle_id": names, "ride_id": rides, "time_s": [1.7e9 + at for at in range(5)]})
    hashes = read_rows(write_rows(plain), 5).hash().tolist()
    for kind in (pa.large_string(), pa.dictionary("int8", pa.string()), pa.dictionary("uint64", pa.large_string())):
        coded = plain.set_column(0, "vehicle_id", plain["vehicle_id"].cast(kind))
        coded = coded.set_column(1, "ride_id", coded["ride_id"].cast(kind))
        parts = pa.concat_tables([coded.slice(0, 2), coded.slice(2, 2), coded.slice(4)])
        for table in (coded, parts):
            found = read_rows(write_rows(table), 5)
            assert found.hash().tolist() == hashes
            assert [found.rides.get(at) for at in range(5)] == [ride or "" for ride in rides]


def test_dictionary_may_hold_nulls_and_grow():
    values = pa.DictionaryArray.from_arrays(pa.array([1, 0, None], "int8"), pa.array([None, "a"]))
    found = read_rows(write_rows(pa.table({"vehicle_id": values, "time_s": [1.0, 2.0, 3.0]})), 3)
    assert found.is_usable.tolist() == [True, False, False]
    grown = read_rows(write_parts([pa.array(["a", "b"]), pa.array(["a", "b", "c"])], deltas=True), 2)
    assert [grown.vehicles.get(at) for at in range(2)] == ["a", "a"]


def test_code_of_no_text_of_its_dictionary_is_refused():
    for code_of in (2, -1):
        values = pa.DictionaryArray.from_arrays(pa.array([0, code_of], "int8"), pa.array(["a", "b"]), safe=False)
        payload = write_rows(pa.table({"vehicle_id": values, "time_s": [1.0, 2.0]}))
        with pytest.raises(BatchError, match="not_arrow"):
            read_rows(payload, 2)


def test_same_batch_in_one_poll_is_decoded_twice():
    payload = write_rows(pa.table({"vehicle_id": ["a", "b"], "time_s": [1.0, 2.0]}))
    decoder = Decoder(Lanes("ab"))
    sent = [Message(GATEWAY, payload, 0), Message("fleet/a/telemetry", payload, 0), Message(GATEWAY, payload, 0)]
    decoded, _ = decoder.decode(sent)
    assert (decoded.lane.tolist(), decoder.rejected) == ([0, 1, 0, 0, 1], Counter(key_mismatch=1))
    assert decoded.stamp.tolist() == [1.0, 2.0, 1.0, 1.0, 2.0]
