"""The MCAP reader returns every intact message in order of receipt and counts the data that it cannot read."""

import json
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from socast.core.errors import RecordingError
from socast.core.wire.messages import Message, Weather, encode
from socast.core.wire.schema import make_schema
from socast.stream.mcap_reader import McapSource
from tests.support.mcap_recordings import BEGIN, SECOND, make_telemetry, read_recording, write_recording


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "shift.mcap", make_telemetry(500))


keys = st.sampled_from(["fleet/a/telemetry", "p/fleet/b/ride", "weather/yul", "fleet/a/lunch", "anything", "fleet/é/x"])
messages = st.lists(st.builds(Message, keys, st.binary(max_size=60), st.integers(0, 2**63)), max_size=60)


@given(messages=messages, chunk_bytes=st.integers(1, 600))
@settings(max_examples=60, deadline=None)
def test_written_messages_are_read_back_verbatim_in_order_of_receipt(tmp_path_factory, messages, chunk_bytes):
    path = tmp_path_factory.mktemp("trip") / "r.mcap"
    write_recording(path, messages, chunk_bytes)
    source = McapSource(path)
    got = [m for block in source for m in block]
    assert [m.receipt_ns for m in got] == sorted(m.receipt_ns for m in messages)
    assert sorted(got) == sorted(messages)
    assert not source.losses


def test_messages_with_equal_receipt_keep_their_order(tmp_path: Path):
    sent = [message._replace(receipt_ns=BEGIN + i // 40) for i, message in enumerate(make_telemetry(400))]
    assert read_recording(write_recording(tmp_path / "r.mcap", sent)) == sent


@given(keep=st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_unfinished_recording_is_read_to_last_whole_chunk(tmp_path_factory, keep: float):
    folder = tmp_path_factory.mktemp("killed")
    whole = write_recording(folder / "whole.mcap", make_telemetry(300)).read_bytes()
    cut = folder / "cut.mcap"
    cut.write_bytes(whole[: 8 + round(keep * (len(whole) - 9))])
    source = McapSource(cut)
    got = [m for block in source for m in block]
    assert got == make_telemetry(300)[: len(got)]
    assert McapSource(cut).span_ns == ((got[0].receipt_ns, got[-1].receipt_ns) if got else None)
    if len(got) < 300:
        assert source.losses.unfinished
        assert "its writer was killed" in source.losses.lines()[0]


@pytest.mark.parametrize("indexed", [True, False])
def test_damaged_chunk_loses_only_its_own_messages(recording: Path, indexed: bool):
    data = bytearray(recording.read_bytes())
    with recording.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    damaged = chunks[0]
    data[damaged.chunk_start_offset + damaged.chunk_length // 2] ^= 0xFF
    if not indexed:
        data = data[: chunks[-1].chunk_start_offset + chunks[-1].chunk_length]
    recording.write_bytes(data)
    source = McapSource(recording)
    got = [m for block in source for m in block]
    lost = 500 - len(got)
    assert got == make_telemetry(500)[lost:]
    assert 0 < lost < 100
    assert source.losses.damaged_chunks == 1
    assert source.losses.damaged_bytes == damaged.chunk_length
    assert source.losses.missing_messages == (lost if indexed else 0)


@given(at=st.floats(0, 1), flip=st.integers(1, 255))
@settings(max_examples=150, deadline=None)
def test_damaged_byte_raises_only_recording_error_or_is_counted(tmp_path_factory, at: float, flip: int):
    path = write_recording(tmp_path_factory.mktemp("flip") / "r.mcap", make_telemetry(60), 1500)
    data = bytearray(path.read_bytes())
    data[round(at * (len(data) - 1))] ^= flip
    path.write_bytes(data)
    sent = set(make_telemetry(60))
    try:
        source = McapSource(path)
        got = [m for block in source for m in block]
    except RecordingError:
        return
    assert set(got) <= sent
    assert len(got) == 60 or source.losses


def write_with_mcap_package(path: Path, **settings) -> Path:
    """Write a recording with the mcap package: one channel, and chunks out of order."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=600, **settings)
        writer.start()
        described = writer.register_schema("Telemetry", "jsonschema", json.dumps(make_schema("telemetry")).encode())
        channel = writer.register_channel("fleet/car-0/telemetry", "json", described)
        sent = make_telemetry(60, cars=1)
        for message in sent[30:] + sent[:30]:
            writer.add_message(channel, message.receipt_ns, message.payload, message.receipt_ns)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "repeat_channels": False, "repeat_schemas": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False, "enable_crcs": False},
    ],
)
def test_recordings_of_mcap_package_are_read_in_order_of_receipt(tmp_path: Path, settings):
    path = write_with_mcap_package(tmp_path / "r.mcap", **settings)
    source = McapSource(path)
    assert [m for block in source for m in block] == make_telemetry(60, cars=1)
    assert not source.losses
    assert source.schemas == {"fleet/car-0/telemetry": "Telemetry"}
    assert source.span_ns == (BEGIN, BEGIN + 59 * SECOND)


def write_foreign_recording(path: Path, topic: str, encoding: str, form: str, data: bytes) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        described = writer.register_schema("Foreign", form, data)
        writer.add_message(writer.register_channel(topic, encoding, described), BEGIN, b"{}", BEGIN)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("topic", "encoding", "form", "data", "expected"),
    [
        ("/camera", "cdr", "ros2msg", b"uint8[] data", "/camera holds cdr messages"),
        ("fleet/a/telemetry", "protobuf", "protobuf", b"\x00", "protobuf"),
        ("fleet/a/telemetry", "json", "jsonschema", b'{"properties": {"time_s": {}}}', "lacks `vehicle_id`"),
    ],
)
def test_recording_of_other_contract_is_refused_with_reason(tmp_path: Path, topic, encoding, form, data, expected):
    path = write_foreign_recording(tmp_path / "r.mcap", topic, encoding, form, data)
    with pytest.raises(RecordingError, match=expected):
        read_recording(path)


def test_foreign_topic_beside_contract_is_counted_and_left_out(tmp_path: Path):
    with (tmp_path / "r.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        ours = writer.register_channel("fleet/a/telemetry", "json", 0)
        theirs = writer.register_channel("/camera", "cdr", writer.register_schema("Image", "ros2msg", b"x"))
        for i in range(5):
            writer.add_message(ours, BEGIN + i, b"{}", BEGIN)
            writer.add_message(theirs, BEGIN + i, b"\x00", BEGIN)
        writer.finish()
    source = McapSource(tmp_path / "r.mcap")
    assert sum(map(len, source)) == 5
    assert source.losses.foreign == {"/camera": 5}
    assert source.losses.missing_messages == 0


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "empty"),
        (b"PAR1" * 9, "not an MCAP"),
        (b"\x89MCA", "not an MCAP"),
        (None, "directory"),
        ("none", "no such"),
    ],
)
def test_file_that_is_no_recording_is_refused_in_one_line(tmp_path: Path, content, expected):
    path = tmp_path / "r.mcap"
    if content is None:
        path.mkdir()
    elif content != "none":
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=expected) as caught:
        McapSource(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_recording_without_messages_yields_none_and_no_losses(tmp_path: Path):
    path = write_recording(tmp_path / "r.mcap", [])
    source = McapSource(path)
    assert [m for block in source for m in block] == []
    assert source.span_ns is None
    assert not source.losses


def test_chunk_with_excessive_length_is_left_out(recording: Path):
    with recording.open("rb") as file:
        first = make_reader(file).get_summary().chunk_indexes[0]
    data = bytearray(recording.read_bytes())
    struct.pack_into("<Q", data, first.chunk_start_offset + 25, 1 << 62)  # uncompressed size in the head of the chunk
    recording.write_bytes(data)
    source = McapSource(recording)
    assert 0 < sum(map(len, source)) < 500
    assert source.losses.oversized == 1


def test_recording_can_be_read_repeatedly(recording: Path):
    source = McapSource(recording)
    assert list(source) == list(source)
    assert source.blocks_read == source.blocks


def test_weather_and_telemetry_share_recording(tmp_path: Path):
    seen = Message("weather/yul", encode(Weather("yul", 1.7e9, 45.5, -73.7, temperature_c=-12.0)), BEGIN - 1)
    assert read_recording(write_recording(tmp_path / "r.mcap", [seen, *make_telemetry(5)])) == [
        seen,
        *make_telemetry(5),
    ]
