"""Test that forged and truncated recordings are read within limits of time and memory, and that losses are told."""

import os
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from socast.core.errors import RecordingError
from socast.core.wire.messages import Message
from socast.stream import mcap_channels, mcap_reader, waiting_messages
from socast.stream.mcap_format import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    SCHEMA,
    STATISTICS,
)
from socast.stream.mcap_reader import McapSource
from tests.support.mcap_recordings import BEGIN, SECOND, make_telemetry, write_recording

SENT = make_telemetry(40, cars=1)
SPARSE = 200 * 2**30


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def channel(number: int = 1, topic: bytes = b"fleet/car-0/telemetry", schema: int = 0) -> bytes:
    return record(CHANNEL, struct.pack("<HH", number, schema) + text(topic) + text(b"json") + text(b""))


def schema(data: bytes, number: int = 1) -> bytes:
    return record(SCHEMA, struct.pack("<H", number) + text(b"Telemetry") + text(b"jsonschema") + text(data))


def message(sent: Message) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", 1, 0, sent.receipt_ns, sent.receipt_ns) + sent.payload)


def chunk(
    records: bytes,
    size: int | None = None,
    span: tuple[int, int] = (BEGIN, BEGIN + 40 * SECOND),
    pack: Callable[[bytes], bytes] = zstandard.compress,
    name: bytes = b"zstd",
) -> bytes:
    packed = pack(records)
    claimed = len(records) if size is None else size
    return record(CHUNK, struct.pack("<QQQI", *span, claimed, 0) + text(name) + struct.pack("<Q", len(packed)) + packed)


def index(span: tuple[int, int], offset: int, length: int) -> bytes:
    return record(CHUNK_INDEX, struct.pack("<QQQQ", *span, offset, length))


def finish(data: bytes, summary: bytes, start: int | None = None) -> bytes:
    """Return a whole file of records and a summary that may be a lie."""
    body = MAGIC + record(1, text(b"") + text(b"")) + data + record(DATA_END, struct.pack("<I", 0))
    place = len(body) if start is None else start
    return body + summary + record(FOOTER, struct.pack("<QQI", place, 0, 0)) + MAGIC


def read(path: Path) -> tuple[list[Message], McapSource]:
    source = McapSource(path)
    return [each for block in source for each in block], source


def read_data(path: Path, data: bytes) -> tuple[list[Message], McapSource]:
    path.write_bytes(data)
    return read(path)


GOOD = chunk(channel() + b"".join(map(message, SENT)))
ZEROS = bytes(1 << 20)


def zstd_bomb(size: int) -> bytes:
    """Return a zstd frame that expands to zeros."""
    packer = zstandard.ZstdCompressor(level=3).compressobj(size=size)
    parts = [packer.compress(ZEROS) for _ in range(size >> 20)]
    return b"".join([*parts, packer.flush()])


@pytest.mark.parametrize(
    ("name", "pack", "claimed", "is_oversized"),
    [
        (b"zstd", lambda _: zstd_bomb(1 << 30), 1 << 30, True),
        (b"zstd", lambda _: zstd_bomb(1 << 30), 1000, False),  # the frame claims more than the chunk
        (b"zstd", lambda _: zstd_bomb(1 << 30), 1 << 62, True),
        (b"lz4", lambda _: lz4.frame.compress(bytes(100 << 20)), 100 << 20, True),
        (b"lz4", lambda _: lz4.frame.compress(bytes(100 << 20)), 1000, False),
        (b"zstd", lambda _: zstd_bomb(32 << 20), 32 << 20, False),  # within the limit, but no records
    ],
)
def test_chunk_that_expands_without_limit_is_left_out_and_the_rest_is_read(tmp_path, name, pack, claimed, is_oversized):
    bomb = chunk(b"", claimed, pack=pack, name=name)
    got, source = read_data(tmp_path / "r.mcap", finish(bomb + GOOD, b""))
    assert got == SENT
    assert source.losses.oversized == is_oversized
    assert source.losses.damaged_chunks == (not is_oversized)
    if is_oversized:
        expected = f"1 chunks, {len(bomb):,} bytes, are left out: a chunk may have 64 MiB, and all may expand to "
        assert source.losses.lines() == [expected + "200 times the file and 64 MiB; write smaller chunks"]


def test_all_chunks_together_expand_to_a_multiple_of_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_reader, "ALLOWANCE", 1 << 20)
    empty = channel() + record(0x80, bytes(500_000))  # a record that the reader need not know
    got, source = read_data(tmp_path / "r.mcap", finish(20 * chunk(empty) + GOOD, b""))
    assert got == SENT
    assert 17 <= source.losses.oversized <= 19


def test_record_of_most_of_the_file_is_not_read_at_once(tmp_path):
    head = struct.pack("<BQ", CHUNK, SPARSE - 1000) + struct.pack("<QQQI", BEGIN, BEGIN, 1000, 0) + text(b"")
    for opcode, begin in ((CHUNK, head), (MESSAGE, struct.pack("<BQHIQQ", MESSAGE, SPARSE - 1000, 1, 0, BEGIN, 0))):
        path = tmp_path / f"{opcode}.mcap"
        path.write_bytes(MAGIC + GOOD + begin)
        os.truncate(path, SPARSE)
        got, source = read(path)
        assert got == SENT
        assert source.losses


@pytest.mark.parametrize("opcode", [SCHEMA, CHANNEL])
def test_description_of_most_of_the_file_is_not_read(tmp_path, opcode):
    path = tmp_path / "r.mcap"
    path.write_bytes(MAGIC + GOOD + struct.pack("<BQ", opcode, SPARSE))
    os.truncate(path, SPARSE + 5000)
    assert read(path)[0] == SENT


@pytest.mark.parametrize("begin", [MAGIC, MAGIC + GOOD, b""])
def test_sparse_file_is_read_or_refused_at_once(tmp_path, begin):
    path = tmp_path / "r.mcap"
    path.write_bytes(begin)
    os.truncate(path, SPARSE)
    if not begin:
        with pytest.raises(RecordingError, match="not an MCAP"):
            McapSource(path)
        return
    got, source = read(path)
    assert got == (SENT if GOOD in begin else [])
    assert source.losses.unfinished


def test_sparse_file_with_a_footer_is_scanned(tmp_path):
    path = tmp_path / "r.mcap"
    path.write_bytes(MAGIC + GOOD)
    footer = record(FOOTER, struct.pack("<QQI", len(MAGIC + GOOD), 0, 0)) + MAGIC
    os.truncate(path, SPARSE)
    with path.open("r+b") as file:
        file.seek(SPARSE - len(footer))
        file.write(footer)
    assert read(path)[0] == SENT


@pytest.mark.parametrize(
    "places",
    [
        [(0, 0)] * 2000,  # the same chunk again and again
        [(0, 0), (1, -1)],  # a chunk within another one
        [(0, 1 << 40)],
        [(-1000, 0)],
        [(1 << 62, 0)],
    ],
)
def test_index_that_contradicts_the_file_is_replaced_by_a_scan(tmp_path, places: Sequence[tuple[int, int]]):
    begin = len(finish(b"", b"")) - len(finish(b"", b"")[len(MAGIC + record(1, text(b"") + text(b""))) :])
    span = (BEGIN, BEGIN + SECOND)
    listed = b"".join(index(span, max(0, begin + at), len(GOOD) + more) for at, more in places)
    listed += record(STATISTICS, struct.pack("<QHIIIIQQ", 40, 0, 1, 0, 0, len(places), 0, 0) + text(b""))
    got, source = read_data(tmp_path / "r.mcap", finish(GOOD, listed))
    assert got == SENT
    assert source.losses.lines() == ["its summary contradicts the file: the chunks were found by a scan"]


def test_index_that_lacks_chunks_is_replaced_by_a_scan(tmp_path):
    begin = len(MAGIC + record(1, text(b"") + text(b"")))
    statistics = record(STATISTICS, struct.pack("<QHIIIIQQ", 40, 0, 1, 0, 0, 2, 0, 0) + text(b""))
    half = chunk(channel() + b"".join(map(message, SENT[:20]))), chunk(channel() + b"".join(map(message, SENT[20:])))
    listed = index((BEGIN, BEGIN + SECOND), begin, len(half[0])) + statistics
    got, source = read_data(tmp_path / "r.mcap", finish(b"".join(half), listed))
    assert got == SENT
    assert source.losses.is_contradicted


@pytest.mark.parametrize(("share", "is_read"), [(1, True), (1 << 40, False)])
def test_summary_is_read_up_to_a_share_of_the_file(tmp_path, monkeypatch, share: int, is_read: bool):
    sent = make_telemetry(400, cars=2)
    path = write_recording(tmp_path / "r.mcap", sent, 2000)
    monkeypatch.setattr(mcap_reader, "LARGEST_SUMMARY", 100)
    monkeypatch.setattr(mcap_reader, "SUMMARY_SHARE", share)
    source = McapSource(path)
    assert source.count == (len(sent) if is_read else None)
    assert source.blocks > 1
    assert [each for messages in source for each in messages] == sent
    assert not source.losses


def test_footer_with_any_place_of_the_summary_loses_no_message(tmp_path):
    path = write_recording(tmp_path / "r.mcap", SENT, 1000)
    data = bytearray(path.read_bytes())
    place = len(data) - len(MAGIC) - 20
    for start in (*range(0, len(data), 211), len(data), 1 << 40, (1 << 64) - 1):
        struct.pack_into("<QQI", data, place, start, 0, 0)
        got, _ = read_data(path, bytes(data))
        assert got == SENT, start


def test_forged_time_spans_keep_the_order_or_are_told(tmp_path, monkeypatch):
    parts = [chunk(channel() + message(each), span=(0, 1 << 63)) for each in reversed(SENT)]
    got, source = read_data(tmp_path / "r.mcap", finish(b"".join(parts), b""))
    assert got == SENT
    assert not source.losses
    monkeypatch.setattr(waiting_messages, "MOST_HELD", 2000)
    got, source = read(tmp_path / "r.mcap")
    assert sorted(got) == sorted(SENT)
    assert 0 < source.losses.disordered < 40
    assert "messages come out of order" in source.losses.lines()[0]


def test_messages_that_wait_are_sorted_in_linear_time(tmp_path, monkeypatch):
    sizes: list[int] = []

    class Counted(waiting_messages.WaitingMessages):
        def release(self, messages: list[Message], following: float) -> list[Message]:
            before = len(self._sorted)
            ready = super().release(messages, following)
            sizes.append(len(self._sorted) if len(self._sorted) != before else 0)
            return ready

    monkeypatch.setattr(mcap_reader, "WaitingMessages", Counted)
    sent = make_telemetry(1500, cars=1)
    parts = [chunk(channel() + message(each), span=(0, 1)) for each in sent]
    got, _ = read_data(tmp_path / "r.mcap", finish(b"".join(parts), b""))
    assert got == sent
    assert sum(sizes) < 12 * len(sent)


def test_descriptions_that_change_without_end_are_left_out(tmp_path, monkeypatch):
    monkeypatch.setattr(mcap_channels, "MOST_DESCRIPTIONS", 50)
    changing = b"".join(channel(7, b"fleet/car-%d/telemetry" % i) for i in range(60))
    got, source = read_data(tmp_path / "r.mcap", finish(GOOD + chunk(changing), b""))
    assert got == SENT
    assert source.losses.oversized == 1


@pytest.mark.parametrize(
    "data", [b"[" * 100_000, b'{"properties": 5}', b'{"properties": "time_s"}', b"9" * 5000, b"\xff", b" " * (2 << 20)]
)
@pytest.mark.parametrize("is_chunked", [True, False])
def test_strange_schema_does_not_stop_the_reader(tmp_path, data, is_chunked):
    strange = schema(data) + channel(2, b"fleet/a/telemetry", 1)
    begin = chunk(strange) if is_chunked else strange
    got, _ = read_data(tmp_path / "r.mcap", finish(begin + GOOD, b""))
    assert got == SENT


@given(junk=st.binary(max_size=60), opcode=st.sampled_from([SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS]))
@settings(max_examples=200, deadline=None)
def test_record_of_junk_raises_only_recording_errors(tmp_path_factory, junk, opcode):
    path = tmp_path_factory.mktemp("junk") / "r.mcap"
    for data in (finish(record(opcode, junk) + GOOD, b""), finish(GOOD, record(opcode, junk))):
        got, _ = read_data(path, data)
        assert set(SENT) <= set(got)


def test_recording_is_readable_wherever_it_ends(tmp_path):
    sent = make_telemetry(400)
    whole = write_recording(tmp_path / "whole.mcap", sent, 20_000).read_bytes()
    with (tmp_path / "whole.mcap").open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
        last, length = max((each.chunk_start_offset, each.chunk_length) for each in chunks)
    shortest = 0
    for end in sorted(
        {*range(8, last, 1000), *range(last, last + length + 1), *range(last, len(whole), 50), len(whole)}
    ):
        got, source = read_data(tmp_path / "cut.mcap", whole[:end])
        assert got == sent[: len(got)], end
        assert len(got) >= shortest, end
        assert len(got) == 400 or source.losses.unfinished
        shortest = len(got)
    assert shortest == 400
