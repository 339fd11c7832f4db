"""The recorder of live telemetry: it stores every payload unchanged, in files of bounded size and time span.

The recording is a write-ahead log. The state of a consumer names its place in it, and the consumer syncs the recording
before it saves its state. After a crash it loads the state and reads the messages that were recorded after that place.
"""

import logging
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final

import msgspec

from socast.core.errors import RecordingError, SettingsError
from socast.core.files import sync
from socast.core.wire.messages import Message
from socast.stream.closeable import Closeable
from socast.stream.file_lock import FileLock
from socast.stream.mcap_format import RECORDING
from socast.stream.mcap_reader import McapSource
from socast.stream.mcap_writer import McapSink
from socast.stream.structured_log import event_fields

FILE_BYTES: Final = 256 << 20
"""Size at which the recorder closes a file and starts the next one. [B]"""
FILE_S: Final = 3600.0
"""Longest span of receipt times in one file. [s]"""
FLUSH_S: Final = 5.0
"""Age after which a received message is synced to disk. [s]"""
RETRY_S: Final = 10.0
"""Time between attempts to write after the disk refused data. [s]"""

WHOLE: Final = 2**53
"""Number of messages in a place that stands for a whole file."""

_log = logging.getLogger("socast.record")


class Place(msgspec.Struct, frozen=True):
    """Name a place in the files of a recorder: a number of messages into a file.

    Parameters
    ----------
    file : str
        Name of the file, without its folder; an empty name stands before all files.
    messages : int
        Number of messages from the beginning of the file.
    """

    file: str = ""
    messages: Annotated[int, msgspec.Meta(ge=0, le=WHOLE)] = WHOLE


class Recorder(Closeable):
    """Write messages into consecutive files in a folder, as a sink.

    The name of a file is the UTC time of receipt of its first message, such as `20260131T235959.123Z.mcap`. A new file
    comes after all others in the order of names, even if the system clock was set back. A disk that refuses data does
    not stop the consumer. The recorder counts the messages that it could not write, and tries another file after
    `RETRY_S`; so it does where the file that it writes was removed or moved, which a flush notices. A lock keeps a
    second process out of the folder.

    Parameters
    ----------
    folder : Path
        Folder of the files; created if it does not exist.
    file_bytes : int
        Size at which the recorder closes a file and starts the next one. [B]
    file_s : float
        Longest span of receipt times in one file. [s]
    flush_s : float
        Age after which a received message is synced to disk. [s] A crash or a power failure loses only younger
        messages.
    clock : callable
        Function that returns monotonic time. [s]
    metadata : mapping of str to str, optional
        What every file says about its origin, see `socast.stream.recording_metadata.make_metadata`.

    Attributes
    ----------
    files : list of Path
        Files written so far, the newest last.
    recorded, unrecorded : int
        Number of messages that are written or will be written at the next flush, and number that the disk refused.
    place : Place
        End of what is synced to disk.
    synced_s : float
        Monotonic time up to which every recorded message is on disk. [s]
    """

    def __init__(
        self,
        folder: Path,
        file_bytes: int = FILE_BYTES,
        file_s: float = FILE_S,
        flush_s: float = FLUSH_S,
        clock: Callable[[], float] = time.monotonic,
        *,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        if not (file_bytes > 0 and file_s > 0 and flush_s > 0):
            raise SettingsError(f"limits of {file_bytes} B, {file_s:g} s and {flush_s:g} s must all be above 0")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SettingsError(f"--record {folder} cannot be made: {error.strerror}; choose another folder") from error
        self._lock = FileLock(folder / ".lock", f"--record {folder}")
        self.files: list[Path] = []
        before = list_recordings(folder)
        self.place = Place(before[-1].name if before else "")
        self.recorded = self.unrecorded = 0
        self._folder, self._file_bytes, self._file_ns, self._flush_s = folder, file_bytes, round(file_s * 1e9), flush_s
        self._clock, self._metadata = clock, metadata
        self._sink: McapSink | None = None
        self._first_ns = self._newest_ns = self._taken = 0
        self._flushed_s = clock()
        self._retry_s = self.synced_s = self._flushed_s
        self._rotates = False

    def put(self, messages: Sequence[Message]) -> None:
        """Write messages, and flush the file when a flush is due."""
        now = self._clock()
        if self._rotates:
            self._rotates = False
            self._end_file()
            _log.info("recording rotated", extra=event_fields(files=len(self.files)))
        if messages and now >= self._retry_s:
            before = self.recorded + self.unrecorded
            try:
                self._write(messages)
            except RecordingError as error:
                self._give_up(error, len(messages) - (self.recorded + self.unrecorded - before), now)
        elif messages:
            self.unrecorded += len(messages)
        if now - self._flushed_s >= self._flush_s:
            self.sync()

    def sync(self) -> None:
        """Return once every recorded message is on disk; a disk that refuses data is logged and counted."""
        self._flushed_s = self._clock()
        if self._sink is not None:
            try:
                self._sink.sync()
                self.place = Place(self._sink.path.name, self._sink.kept)
            except RecordingError as error:
                self._give_up(error, 0, self._flushed_s)
                return
        if self._flushed_s >= self._retry_s:
            self.synced_s = self._flushed_s

    def request_rotation(self) -> None:
        """Let the next `put` begin another file; a signal handler may call this."""
        self._rotates = True

    def read_after(self, place: Place) -> Iterator[Sequence[Message]]:
        """Yield the messages that were recorded after a place, in their order."""
        files = list_recordings(self._folder)
        if place.file and place.file not in {path.name for path in files}:
            _log.warning("%s is gone: samples that only it holds are not in the state", self._folder / place.file)
        for path in files:
            if _order(path.name) < _order(place.file):
                continue
            skip = place.messages if path.name == place.file else 0
            if skip == WHOLE:
                continue
            try:
                source = McapSource(path)
            except RecordingError as error:  # the process ended before the first chunk
                _log.warning("not read: %s", error)
                continue
            for messages in source:
                if skip < len(messages):
                    yield messages[skip:]
                skip = max(0, skip - len(messages))
            if skip:
                _log.warning(
                    "%s was cut off: it holds %d of %d messages that are in the state",
                    path,
                    place.messages - skip,
                    place.messages,
                )

    def close(self) -> None:
        """Close the current file and free the folder; a second call has no effect."""
        self._end_file()
        self._lock.close()

    def _end_file(self) -> None:
        """Close the current file."""
        if self._sink is None:
            return
        try:
            self._sink.sync()
            self._sink.close()
            self.place = Place(self._sink.path.name)
            self._sink = None
        except RecordingError as error:
            self._give_up(error, 0, self._clock())

    def _write(self, messages: Sequence[Message]) -> None:
        """Write messages to the current file, or to the next one if the current file has reached a limit."""
        if self._clock() < self._retry_s:  # the disk has just refused the end of a file
            self.unrecorded += len(messages)
            return
        first_ns = messages[0].receipt_ns
        sink = self._sink
        is_full = sink is not None and sink.written >= self._file_bytes
        is_old = first_ns - self._first_ns >= self._file_ns or first_ns < self._newest_ns  # the clock was set back
        if sink is not None and (is_full or is_old):
            self._end_file()
            self._write(messages)
            return
        if sink is None:
            sink = self._sink = McapSink(self._find_fresh_path(first_ns), metadata=self._metadata)
            self._sync_folder()
            self.files.append(sink.path)
            _log.info("recording", extra=event_fields(file=str(sink.path)))
            self._first_ns = self._newest_ns = first_ns
            self._taken = 0
        room = sink.room(messages)
        sink.put(messages[:room])
        self._newest_ns = messages[-1].receipt_ns
        self._taken += room
        self.recorded += room
        if room < len(messages):  # the format cannot number more keys in one file
            self._end_file()
            self._write(messages[room:])

    def _sync_folder(self) -> None:
        """Wait until the name of a new file is on disk; raise `RecordingError` if the disk refuses it."""
        try:
            sync(self._folder)
        except OSError as error:
            raise RecordingError(f"{self._folder} cannot be written: {error.strerror}; make room") from error

    def _find_fresh_path(self, receipt_ns: int) -> Path:
        """Return a path that does not exist and comes after all files, named by the time of receipt."""
        moment = datetime.fromtimestamp(receipt_ns // 10**9, UTC)
        stem, number = f"{moment:%Y%m%dT%H%M%S}.{receipt_ns // 10**6 % 1000:03}Z", 0
        if (before := list_recordings(self._folder)) and (last := _order(before[-1].name)) >= (stem, 0):
            stem, number = last[0], last[1] + 1
        return self._folder / (f"{stem}-{number}.mcap" if number else f"{stem}.mcap")

    def _give_up(self, error: RecordingError, count: int, now: float) -> None:
        """Abandon the file, count the messages that it lacks, and schedule an attempt with another file."""
        _log.error("recording fails: %s", error)
        self.unrecorded += count
        self._retry_s = now + RETRY_S
        if self._sink is not None:
            lost = self._taken - self._sink.kept
            self.recorded -= lost
            self.unrecorded += lost
            self._sink.abandon()
            self._sink = None


def list_recordings(folder: Path) -> list[Path]:
    """Return the recordings in a folder by name; the files of a recorder are then in the order of their times."""
    return sorted(folder.glob(f"*{RECORDING}"), key=lambda path: _order(path.name))


def _order(name: str) -> tuple[str, int]:
    """Return the time in the name of a file, and its number among files of the same time."""
    stem = name.removesuffix(RECORDING)
    numbered = re.fullmatch(r"(.*Z)-(\d+)", stem)
    return (numbered[1], int(numbered[2])) if numbered else (stem, 0)
