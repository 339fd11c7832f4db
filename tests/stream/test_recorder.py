"""The recorder keeps every payload in files of bounded size and time, and survives a full disk."""

import shutil
from pathlib import Path

import pytest

from socast.core.errors import RecordingError, SettingsError
from socast.core.wire.messages import Message
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.recorder import Place, Recorder, list_recordings
from socast.stream.source import merge_sources

SECOND = 1_000_000_000
BEGIN = 1_769_903_999 * SECOND + 123_000_000  # 2026-01-31T23:59:59.123Z


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def make_messages(count: int, begin: int = 0, payload: bytes = b'{"time_s": 1}') -> list[Message]:
    return [
        Message("fleet/a/telemetry", payload + b" " * (i % 5), BEGIN + i * SECOND) for i in range(begin, begin + count)
    ]


def read_folder(folder: Path) -> list[Message]:
    return [m for block in merge_sources([McapSource(path) for path in list_recordings(folder)]) for m in block]


def test_every_payload_is_recorded_verbatim_even_if_invalid(tmp_path: Path):
    sent = [Message("fleet/a/telemetry", payload, BEGIN + i) for i, payload in enumerate([b"{}", b"", b"\xff", b"{"])]
    recorder = Recorder(tmp_path)
    recorder.put(sent)
    recorder.put([])
    recorder.close()
    assert read_folder(tmp_path) == sent
    assert recorder.recorded == 4


def test_file_name_is_utc_time_of_first_message(tmp_path: Path):
    for _ in range(2):
        recorder = Recorder(tmp_path)
        recorder.put(make_messages(1))
        recorder.close()
    assert [path.name for path in list_recordings(tmp_path)] == [
        "20260131T235959.123Z.mcap",
        "20260131T235959.123Z-1.mcap",
    ]


def test_files_rotate_by_time_without_loss(tmp_path: Path):
    recorder = Recorder(tmp_path, file_s=60.0)
    for begin in range(0, 300, 10):
        recorder.put(make_messages(10, begin))
    recorder.close()
    assert len(recorder.files) == 5
    assert read_folder(tmp_path) == make_messages(300)
    assert not any(McapSource(path).losses for path in recorder.files)


def test_files_rotate_by_size(tmp_path: Path):
    recorder = Recorder(tmp_path, file_bytes=10_000)
    for begin in range(0, 1000, 50):
        recorder.put(make_messages(50, begin, b"x" * 100))
    recorder.close()
    assert len(recorder.files) >= 10
    assert read_folder(tmp_path) == make_messages(1000, payload=b"x" * 100)


def test_keys_beyond_limit_of_format_go_to_next_file(tmp_path: Path):
    sent = [Message(f"fleet/car-{i}/telemetry", b"{}", BEGIN + i) for i in range(70_000)]
    recorder = Recorder(tmp_path)
    recorder.put(sent)
    recorder.put([message._replace(receipt_ns=BEGIN + SECOND) for message in sent[:3]])
    recorder.close()
    assert len(recorder.files) == 2
    assert recorder.recorded == 70_003
    assert sum(len(block) for path in recorder.files for block in McapSource(path)) == 70_003


def test_messages_reach_disk_after_flush_period_without_further_messages(tmp_path: Path):
    clock = Clock()
    recorder = Recorder(tmp_path, flush_s=5.0, clock=clock)
    recorder.put(make_messages(7))
    assert read_folder(tmp_path) == []
    clock.now = 5.0
    recorder.put([])
    assert read_folder(tmp_path) == make_messages(7)
    recorder.close()
    assert read_folder(tmp_path) == make_messages(7)


def test_full_disk_loses_only_messages_of_that_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clock = Clock()
    recorder = Recorder(tmp_path, clock=clock)
    recorder.put(make_messages(5))
    clock.now = 6.0
    recorder.put([])

    def full(self: McapSink, _: object) -> None:
        raise RecordingError(f"{self.path} cannot be written: no space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(McapSink, "put", full)
        recorder.put(make_messages(4, 5))
        recorder.put(make_messages(3, 9))
    clock.now = 20.0
    recorder.put(make_messages(2, 12))
    recorder.close()
    assert (recorder.recorded, recorder.unrecorded) == (7, 7)
    assert read_folder(tmp_path) == make_messages(5) + make_messages(2, 12)


@pytest.mark.parametrize("ends", ["flush", "close"])
def test_refusal_at_end_of_chunk_is_counted_and_raises_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: str
):
    clock = Clock()
    recorder = Recorder(tmp_path, clock=clock)
    recorder.put(make_messages(5))
    clock.now = 6.0
    recorder.put([])
    recorder.put(make_messages(4, 5))

    def full(self: McapSink, _: bytes, *, flush: bool = False) -> None:  # noqa: ARG001
        raise RecordingError(f"{self.path} cannot be written: no space left on device")

    monkeypatch.setattr(McapSink, "_write", full)
    if ends == "flush":
        clock.now = 12.0
        recorder.put([])
    recorder.close()
    assert (recorder.recorded, recorder.unrecorded) == (5, 4)
    assert read_folder(tmp_path) == make_messages(5)


def test_refusal_at_a_rotation_counts_each_message_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clock = Clock()
    recorder = Recorder(tmp_path, file_s=60.0, clock=clock)
    recorder.put(make_messages(5))

    def full(self: McapSink) -> None:
        raise RecordingError(f"{self.path} cannot be written: no space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(McapSink, "sync", full)
        recorder.put(make_messages(3, 100))
    assert (recorder.recorded, recorder.unrecorded) == (0, 8)
    assert len(recorder.files) == 1
    clock.now = 20.0
    recorder.put(make_messages(2, 110))
    recorder.close()
    assert (recorder.recorded, recorder.unrecorded) == (2, 8)


def test_recording_that_was_cut_off_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    recorder = Recorder(tmp_path)
    recorder.put(make_messages(5))
    recorder.close()
    recorder = Recorder(tmp_path)
    name = recorder.files[0].name if recorder.files else list_recordings(tmp_path)[0].name
    assert list(recorder.read_after(Place(name, 9))) == []
    recorder.close()
    assert "was cut off: it holds 5 of 9 messages that are in the state" in caplog.text


def test_second_close_has_no_effect(tmp_path: Path):
    recorder = Recorder(tmp_path)
    recorder.put(make_messages(1))
    recorder.close()
    recorder.close()
    assert read_folder(tmp_path) == make_messages(1)


def test_folder_that_cannot_be_made_raises_settings_error(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingsError, match="cannot be made"):
        Recorder(tmp_path / "file" / "recordings")


def test_limit_of_zero_raises_settings_error(tmp_path: Path):
    with pytest.raises(SettingsError, match="above 0"):
        Recorder(tmp_path, file_s=0.0)


def test_requested_rotation_begins_another_file_without_loss(tmp_path: Path):
    recorder = Recorder(tmp_path)
    recorder.request_rotation()
    recorder.put(make_messages(2))
    assert len(recorder.files) == 1
    recorder.request_rotation()
    recorder.put([])
    assert read_folder(tmp_path) == make_messages(2)
    recorder.put(make_messages(3, 2))
    recorder.put(make_messages(3, 5))
    recorder.close()
    assert len(list_recordings(tmp_path)) == len(recorder.files) == 2
    assert read_folder(tmp_path) == make_messages(8)


def test_time_of_the_last_sync_stands_still_while_the_disk_refuses_data(tmp_path: Path, monkeypatch):
    clock = Clock()
    recorder = Recorder(tmp_path, flush_s=5.0, clock=clock)
    clock.now = 6.0
    recorder.put(make_messages(2))
    assert recorder.synced_s == 6.0

    def refuse(_):
        raise RecordingError("no space left on device")

    monkeypatch.setattr(McapSink, "sync", refuse)
    for clock.now in (12.0, 18.0):
        recorder.put(make_messages(2))
        assert recorder.synced_s == 6.0
    monkeypatch.undo()
    for clock.now in (24.0, 30.0):
        recorder.put(make_messages(2))
    assert recorder.synced_s == 30.0


@pytest.mark.parametrize("change", ["removed", "moved", "another file"])
def test_recording_that_vanishes_is_noticed_at_the_next_flush_and_begun_anew(tmp_path: Path, caplog, change):
    clock, folder = Clock(), tmp_path / "kept"
    recorder = Recorder(folder, flush_s=5.0, clock=clock)
    recorder.put(make_messages(10))
    recorder.sync()
    if change == "another file":
        recorder.files[0].unlink()
        recorder.files[0].touch()
    else:
        folder.rename(tmp_path / "elsewhere")
    if change == "removed":
        shutil.rmtree(tmp_path / "elsewhere")
    clock.now = 5.0
    recorder.put(make_messages(10, 10))
    assert (recorder.recorded, recorder.unrecorded) == (10, 10)
    assert "was removed or moved" in caplog.text
    for now in (20.0, 40.0):  # without its folder, with it
        clock.now = now
        recorder.put(make_messages(5, int(now)))
        folder.mkdir(exist_ok=True)
    assert recorder.recorded + recorder.unrecorded == 30
    assert recorder.recorded >= 5
    recorder.close()
    kept = [m for block in McapSource(list_recordings(folder)[-1]) for m in block]
    assert kept[-5:] == make_messages(5, 40)
