"""A recording gives back what was put, in order of receipt, and says what it cannot give back."""

import json
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from core.errors import RecordingError
from core.wire.messages import Message, Telemetry, Weather, encode
from core.wire.schema import make_schema
from stream.mcap_reader import McapSource
from stream.mcap_writer import McapSink

SECOND = 1_000_000_000
BEGIN = 1_700_000_000 * SECOND


def telemetry(count: int, cars: int = 3) -> list[Message]:
    return [
        Message(
            f"fleet/car-{i % cars}/telemetry",
            encode(Telemetry(vehicle_id=f"car-{i % cars}", time_s=1.7e9 + i - 0.25, speed_kmh=float(i % 90))),
            BEGIN + i * SECOND,
        )
        for i in range(count)
    ]


def written(path: Path, messages: list[Message], chunk_bytes: int = 4096) -> Path:
    with McapSink(path, chunk_bytes) as sink:
        sink.put(messages)
    return path


def read(path: Path) -> list[Message]:
    return [message for block in McapSource(path) for message in block]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return written(tmp_path / "shift.mcap", telemetry(500))


keys = st.sampled_from(["fleet/a/telemetry", "p/fleet/b/ride", "weather/yul", "fleet/a/lunch", "anything", "fleet/é/x"])
messages = st.lists(st.builds(Message, keys, st.binary(max_size=60), st.integers(0, 2**63)), max_size=60)


@given(messages=messages, chunk_bytes=st.integers(1, 600))
@settings(max_examples=60, deadline=None)
def test_what_was_put_is_read_back_to_the_byte_in_order_of_receipt(tmp_path_factory, messages, chunk_bytes):
    path = tmp_path_factory.mktemp("trip") / "r.mcap"
    written(path, messages, chunk_bytes)
    source = McapSource(path)
    got = [m for block in source for m in block]
    assert [m.receipt_ns for m in got] == sorted(m.receipt_ns for m in messages)
    assert sorted(got) == sorted(messages)
    assert not source.losses


def test_messages_in_order_are_read_in_their_very_order(tmp_path: Path):
    sent = [message._replace(receipt_ns=BEGIN + i // 40) for i, message in enumerate(telemetry(400))]
    assert read(written(tmp_path / "r.mcap", sent)) == sent


def test_any_reader_of_the_format_finds_everything(recording: Path):
    with recording.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = list(reader.iter_messages())
        summary = reader.get_summary()
    assert [Message(c.topic, m.data, m.log_time) for _, c, m in found] == telemetry(500)
    assert [m.publish_time for _, _, m in found] == [m.log_time - SECOND // 4 for _, _, m in found]
    assert {(c.message_encoding, s.encoding, s.name) for s, c, _ in found} == {("json", "jsonschema", "Telemetry")}
    assert json.loads(found[0][0].data) == make_schema("telemetry")
    assert summary.statistics.message_count == 500
    assert sum(summary.statistics.channel_message_counts.values()) == 500
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 5
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}


def test_a_time_range_is_found_by_the_index(recording: Path):
    with recording.open("rb") as file:
        found = list(
            make_reader(file).iter_messages(
                "fleet/car-1/telemetry", starting_at=BEGIN + 100 * SECOND, ending_before=BEGIN + 110 * SECOND
            )
        )
    assert [m.log_time for _, _, m in found] == [BEGIN + i * SECOND for i in range(100, 110) if i % 3 == 1]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[]",
        b"[1]",
        b'{"time_s": "noon"}',
        b'{"time_s": 1e300}',
        b'{"time_s": -5}',
        b"[" * 9999,
    ],
)
def test_a_payload_that_tells_no_time_is_published_at_its_receipt(tmp_path: Path, payload: bytes):
    message = Message("fleet/a/telemetry", payload, BEGIN)
    path = written(tmp_path / "r.mcap", [message])
    with path.open("rb") as file:
        assert [m.publish_time for _, _, m in make_reader(file).iter_messages()] == [BEGIN]
    assert read(path) == [message]


def test_a_gateways_batch_is_published_at_its_first_samples_time(tmp_path: Path):
    path = written(tmp_path / "r.mcap", [Message("fleet/a/telemetry", b'[{"time_s":7.5},{"time_s":9}]', BEGIN)])
    with path.open("rb") as file:
        assert [m.publish_time for _, _, m in make_reader(file).iter_messages()] == [7_500_000_000]


def test_a_key_outside_the_contract_has_no_schema(tmp_path: Path):
    path = written(tmp_path / "r.mcap", [Message("fleet/a/lunch", b"soup", BEGIN)])
    with path.open("rb") as file:
        assert [(s, c.topic, m.data) for s, c, m in make_reader(file).iter_messages()] == [
            (None, "fleet/a/lunch", b"soup")
        ]


@given(keep=st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_an_unfinished_recording_is_read_to_its_last_whole_chunk(tmp_path_factory, keep: float):
    folder = tmp_path_factory.mktemp("killed")
    whole = written(folder / "whole.mcap", telemetry(300)).read_bytes()
    cut = folder / "cut.mcap"
    cut.write_bytes(whole[: 8 + round(keep * (len(whole) - 9))])
    source = McapSource(cut)
    got = [m for block in source for m in block]
    assert got == telemetry(300)[: len(got)]
    assert McapSource(cut).span_ns == ((got[0].receipt_ns, got[-1].receipt_ns) if got else None)
    if len(got) < 300:
        assert source.losses.unfinished
        assert "bytes after the last whole chunk are lost" in source.losses.lines()[0]


def test_what_was_flushed_survives_a_kill(tmp_path: Path):
    sink = McapSink(tmp_path / "r.mcap")
    sink.put(telemetry(50))
    sink.flush()
    sink.put(telemetry(9))
    assert read(tmp_path / "r.mcap") == telemetry(50)
    sink.close()


@pytest.mark.parametrize("indexed", [True, False])
def test_a_damaged_chunk_costs_no_more_than_itself(recording: Path, indexed: bool):
    data = bytearray(recording.read_bytes())
    with recording.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    victim = chunks[0]
    data[victim.chunk_start_offset + victim.chunk_length // 2] ^= 0xFF
    if not indexed:
        data = data[: chunks[-1].chunk_start_offset + chunks[-1].chunk_length]
    recording.write_bytes(data)
    source = McapSource(recording)
    got = [m for block in source for m in block]
    lost = 500 - len(got)
    assert got == telemetry(500)[lost:]
    assert 0 < lost < 100
    assert source.losses.damaged_chunks == 1
    assert source.losses.damaged_bytes == victim.chunk_length
    assert source.losses.missing_messages == (lost if indexed else 0)


@given(at=st.floats(0, 1), flip=st.integers(1, 255))
@settings(max_examples=150, deadline=None)
def test_no_damaged_byte_raises_anything_but_a_recording_error(tmp_path_factory, at: float, flip: int):
    path = written(tmp_path_factory.mktemp("flip") / "r.mcap", telemetry(60), 1500)
    data = bytearray(path.read_bytes())
    data[round(at * (len(data) - 1))] ^= flip
    path.write_bytes(data)
    sent = set(telemetry(60))
    try:
        source = McapSource(path)
        got = [m for block in source for m in block]
    except RecordingError:
        return
    assert set(got) <= sent
    assert len(got) == 60 or source.losses


def other_writer(path: Path, **settings) -> Path:
    """Write as another program would: chunks out of order, one channel."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=600, **settings)
        writer.start()
        described = writer.register_schema("Telemetry", "jsonschema", json.dumps(make_schema("telemetry")).encode())
        channel = writer.register_channel("fleet/car-0/telemetry", "json", described)
        sent = telemetry(60, cars=1)
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
def test_recordings_of_other_programs_are_read_in_order_of_receipt(tmp_path: Path, settings):
    path = other_writer(tmp_path / "r.mcap", **settings)
    source = McapSource(path)
    assert [m for block in source for m in block] == telemetry(60, cars=1)
    assert not source.losses
    assert source.schemas == {"fleet/car-0/telemetry": "Telemetry"}
    assert source.span_ns == (BEGIN, BEGIN + 59 * SECOND)


def foreign(path: Path, topic: str, encoding: str, form: str, data: bytes) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        described = writer.register_schema("Foreign", form, data)
        writer.add_message(writer.register_channel(topic, encoding, described), BEGIN, b"{}", BEGIN)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("topic", "encoding", "form", "data", "told"),
    [
        ("/camera", "cdr", "ros2msg", b"uint8[] data", "/camera holds cdr messages"),
        ("fleet/a/telemetry", "protobuf", "protobuf", b"\x00", "protobuf"),
        ("fleet/a/telemetry", "json", "jsonschema", b'{"properties": {"time_s": {}}}', "lacks `vehicle_id`"),
    ],
)
def test_a_recording_of_another_contract_is_refused(tmp_path: Path, topic, encoding, form, data, told):
    path = foreign(tmp_path / "r.mcap", topic, encoding, form, data)
    with pytest.raises(RecordingError, match=told):
        read(path)


def test_a_foreign_topic_among_ours_is_counted(tmp_path: Path):
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
    ("content", "told"),
    [
        (b"", "empty"),
        (b"PAR1" * 9, "not an MCAP"),
        (b"\x89MCA", "not an MCAP"),
        (None, "directory"),
        ("none", "no such"),
    ],
)
def test_what_is_no_recording_is_one_line(tmp_path: Path, content, told):
    path = tmp_path / "r.mcap"
    if content is None:
        path.mkdir()
    elif content != "none":
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=told) as caught:
        McapSource(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_recording_is_read_as_empty(tmp_path: Path):
    path = written(tmp_path / "r.mcap", [])
    source = McapSource(path)
    assert [m for block in source for m in block] == []
    assert source.span_ns is None
    assert not source.losses


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path):
    with pytest.raises(RecordingError, match="cannot be written"):
        McapSink(tmp_path / "nowhere" / "r.mcap")


def test_more_keys_than_the_format_numbers_are_refused(tmp_path: Path):
    with McapSink(tmp_path / "r.mcap") as sink:
        sink.put([Message(f"k/{i}", b"", BEGIN) for i in range(65_535)])
        assert sink.full
        with pytest.raises(RecordingError, match="65,535"):
            sink.put([Message("one/more", b"", BEGIN)])


def test_a_length_that_claims_too_much_is_damage(recording: Path):
    with recording.open("rb") as file:
        first = make_reader(file).get_summary().chunk_indexes[0]
    data = bytearray(recording.read_bytes())
    struct.pack_into("<Q", data, first.chunk_start_offset + 25, 1 << 62)  # what the chunk says that it unpacks to
    recording.write_bytes(data)
    source = McapSource(recording)
    assert 0 < sum(map(len, source)) < 500
    assert source.losses.damaged_chunks == 1


def test_a_recording_can_be_read_again(recording: Path):
    source = McapSource(recording)
    assert list(source) == list(source)
    assert source.blocks_read == source.blocks


def test_weather_travels_beside_telemetry(tmp_path: Path):
    seen = Message("weather/yul", encode(Weather("yul", 1.7e9, 45.5, -73.7, temperature_c=-12.0)), BEGIN - 1)
    assert read(written(tmp_path / "r.mcap", [seen, *telemetry(5)])) == [seen, *telemetry(5)]
