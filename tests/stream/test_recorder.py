"""Recording while live: all of it, in files of bounded size and time, whatever the disk does."""

from pathlib import Path

import pytest

from core.errors import RecordingError, SettingsError
from core.wire.messages import Message
from stream.mcap_reader import McapSource
from stream.mcap_writer import McapSink
from stream.recorder import Recorder
from stream.source import merge_sources

SECOND = 1_000_000_000
BEGIN = 1_769_903_999 * SECOND + 123_000_000  # 2026-01-31T23:59:59.123Z


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def messages(count: int, begin: int = 0, payload: bytes = b'{"time_s": 1}') -> list[Message]:
    return [
        Message("fleet/a/telemetry", payload + b" " * (i % 5), BEGIN + i * SECOND) for i in range(begin, begin + count)
    ]


def recorded(folder: Path) -> list[Message]:
    return [m for block in merge_sources([McapSource(path) for path in sorted(folder.iterdir())]) for m in block]


def test_every_payload_is_kept_as_it_came_good_or_not(tmp_path: Path):
    sent = [Message("fleet/a/telemetry", payload, BEGIN + i) for i, payload in enumerate([b"{}", b"", b"\xff", b"{"])]
    recorder = Recorder(tmp_path)
    recorder.put(sent)
    recorder.put([])
    recorder.close()
    assert recorded(tmp_path) == sent
    assert recorder.recorded == 4


def test_a_file_is_named_by_the_utc_time_of_its_first_message(tmp_path: Path):
    for _ in range(2):
        recorder = Recorder(tmp_path)
        recorder.put(messages(1))
        recorder.close()
    assert [path.name for path in sorted(tmp_path.iterdir())] == [
        "20260131T235959.123Z-1.mcap",
        "20260131T235959.123Z.mcap",
    ]


def test_files_rotate_by_time_and_nothing_is_lost(tmp_path: Path):
    recorder = Recorder(tmp_path, file_s=60.0)
    for begin in range(0, 300, 10):
        recorder.put(messages(10, begin))
    recorder.close()
    assert len(recorder.files) == 5
    assert recorded(tmp_path) == messages(300)
    assert not any(McapSource(path).losses for path in recorder.files)


def test_files_rotate_by_size(tmp_path: Path):
    recorder = Recorder(tmp_path, file_bytes=10_000)
    for begin in range(0, 1000, 50):
        recorder.put(messages(50, begin, b"x" * 100))
    recorder.close()
    assert len(recorder.files) >= 10
    assert recorded(tmp_path) == messages(1000, payload=b"x" * 100)


def test_more_keys_than_a_file_can_number_go_to_the_next(tmp_path: Path):
    sent = [Message(f"fleet/car-{i}/telemetry", b"{}", BEGIN + i) for i in range(70_000)]
    recorder = Recorder(tmp_path)
    recorder.put(sent)
    recorder.put(sent[:3])
    recorder.close()
    assert len(recorder.files) == 2
    assert recorder.recorded == 70_003
    assert sum(len(block) for path in recorder.files for block in McapSource(path)) == 70_003


def test_what_was_received_is_on_disk_after_a_while_though_nothing_more_comes(tmp_path: Path):
    clock = Clock()
    recorder = Recorder(tmp_path, flush_s=5.0, clock=clock)
    recorder.put(messages(7))
    assert recorded(tmp_path) == []
    clock.now = 5.0
    recorder.put([])
    assert recorded(tmp_path) == messages(7)
    recorder.close()
    assert recorded(tmp_path) == messages(7)


def test_a_disk_that_refuses_costs_what_came_meanwhile_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    clock = Clock()
    recorder = Recorder(tmp_path, clock=clock)
    recorder.put(messages(5))
    clock.now = 6.0
    recorder.put([])

    def full(self: McapSink, _: object) -> None:
        raise RecordingError(f"{self.path} cannot be written: no space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(McapSink, "put", full)
        recorder.put(messages(4, 5))
        recorder.put(messages(3, 9))
    clock.now = 20.0
    recorder.put(messages(2, 12))
    recorder.close()
    assert (recorder.recorded, recorder.unrecorded) == (7, 7)
    assert recorded(tmp_path) == messages(5) + messages(2, 12)


@pytest.mark.parametrize("ends", ["flush", "close"])
def test_what_a_disk_refuses_only_when_the_chunk_ends_is_counted_and_stops_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: str
):
    clock = Clock()
    recorder = Recorder(tmp_path, clock=clock)
    recorder.put(messages(5))
    clock.now = 6.0
    recorder.put([])
    recorder.put(messages(4, 5))

    def full(self: McapSink, _: bytes, *, flush: bool = False) -> None:  # noqa: ARG001
        raise RecordingError(f"{self.path} cannot be written: no space left on device")

    monkeypatch.setattr(McapSink, "_write", full)
    if ends == "flush":
        clock.now = 12.0
        recorder.put([])
    recorder.close()
    assert (recorder.recorded, recorder.unrecorded) == (5, 4)
    assert recorded(tmp_path) == messages(5)


def test_closing_twice_does_no_harm(tmp_path: Path):
    recorder = Recorder(tmp_path)
    recorder.put(messages(1))
    recorder.close()
    recorder.close()
    assert recorded(tmp_path) == messages(1)


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingsError, match="cannot be made"):
        Recorder(tmp_path / "file" / "recordings")


def test_limits_are_checked(tmp_path: Path):
    with pytest.raises(SettingsError, match="above 0"):
        Recorder(tmp_path, file_s=0.0)
