"""The MCAP writer makes indexed recordings that every MCAP reader can read."""

import json
from pathlib import Path

import pytest
from mcap.reader import make_reader

from socast.core.errors import RecordingError
from socast.core.wire.messages import Message
from socast.core.wire.schema import make_schema
from socast.stream.mcap_writer import McapSink
from tests.support.mcap_recordings import BEGIN, SECOND, make_telemetry, read_recording, write_recording


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "shift.mcap", make_telemetry(500))


def test_mcap_package_reads_every_message_and_complete_summary(recording: Path):
    with recording.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        records = list(reader.iter_messages())
        summary = reader.get_summary()
    assert [Message(c.topic, m.data, m.log_time) for _, c, m in records] == make_telemetry(500)
    assert [m.publish_time for _, _, m in records] == [m.log_time - SECOND // 4 for _, _, m in records]
    assert {(c.message_encoding, s.encoding, s.name) for s, c, _ in records} == {("json", "jsonschema", "Telemetry")}
    assert json.loads(records[0][0].data) == make_schema("telemetry")
    assert summary.statistics.message_count == 500
    assert sum(summary.statistics.channel_message_counts.values()) == 500
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 5
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}


def test_index_finds_time_range(recording: Path):
    with recording.open("rb") as file:
        records = list(
            make_reader(file).iter_messages(
                "fleet/car-1/telemetry", starting_at=BEGIN + 100 * SECOND, ending_before=BEGIN + 110 * SECOND
            )
        )
    assert [m.log_time for _, _, m in records] == [BEGIN + i * SECOND for i in range(100, 110) if i % 3 == 1]


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
def test_publish_time_of_payload_without_valid_time_is_receipt(tmp_path: Path, payload: bytes):
    message = Message("fleet/a/telemetry", payload, BEGIN)
    path = write_recording(tmp_path / "r.mcap", [message])
    with path.open("rb") as file:
        assert [m.publish_time for _, _, m in make_reader(file).iter_messages()] == [BEGIN]
    assert read_recording(path) == [message]


def test_publish_time_of_batch_is_time_of_first_sample(tmp_path: Path):
    path = write_recording(tmp_path / "r.mcap", [Message("fleet/a/telemetry", b'[{"time_s":7.5},{"time_s":9}]', BEGIN)])
    with path.open("rb") as file:
        assert [m.publish_time for _, _, m in make_reader(file).iter_messages()] == [7_500_000_000]


def test_key_outside_contract_has_no_schema(tmp_path: Path):
    path = write_recording(tmp_path / "r.mcap", [Message("fleet/a/lunch", b"soup", BEGIN)])
    with path.open("rb") as file:
        assert [(s, c.topic, m.data) for s, c, m in make_reader(file).iter_messages()] == [
            (None, "fleet/a/lunch", b"soup")
        ]


def test_flushed_messages_survive_kill(tmp_path: Path):
    sink = McapSink(tmp_path / "r.mcap")
    sink.put(make_telemetry(50))
    sink.flush()
    sink.put(make_telemetry(9))
    assert read_recording(tmp_path / "r.mcap") == make_telemetry(50)
    sink.close()


def test_path_that_cannot_be_written_raises_recording_error(tmp_path: Path):
    with pytest.raises(RecordingError, match="cannot be written"):
        McapSink(tmp_path / "nowhere" / "r.mcap")


def test_keys_beyond_limit_of_format_raise_recording_error(tmp_path: Path):
    with McapSink(tmp_path / "r.mcap") as sink:
        sink.put([Message(f"k/{i}", b"", BEGIN) for i in range(65_535)])
        assert sink.full
        with pytest.raises(RecordingError, match="65,535"):
            sink.put([Message("one/more", b"", BEGIN)])
