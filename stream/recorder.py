"""The recorder of live telemetry: it stores every payload unchanged, in files of bounded size and time span."""

import logging
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from core.errors import RecordingError, SettingsError
from core.wire.messages import Message
from stream.mcap_writer import McapSink

FILE_BYTES: Final = 256 << 20
"""Size at which the recorder closes a file and starts the next one. [B]"""
FILE_S: Final = 3600.0
"""Longest span of receipt times in one file. [s]"""
FLUSH_S: Final = 5.0
"""Age after which a received message is on disk. [s]"""
RETRY_S: Final = 10.0
"""Time between attempts to write after the disk refused data. [s]"""

_log = logging.getLogger("socast.record")


class Recorder:
    """Write messages into consecutive files in a folder, as a sink.

    The name of a file is the UTC time of receipt of its first message, such as `20260131T235959.123Z.mcap`. A disk that
    refuses data does not stop the consumer. The recorder counts the messages that it could not write, and tries another
    file after `RETRY_S`.

    Parameters
    ----------
    folder : Path
        Folder of the files; created if it does not exist.
    file_bytes : int
        Size at which the recorder closes a file and starts the next one. [B]
    file_s : float
        Longest span of receipt times in one file. [s]
    flush_s : float
        Age after which a received message is on disk. [s] A killed process loses only younger messages.
    clock : callable
        Function that returns monotonic time. [s]

    Attributes
    ----------
    files : list of Path
        Files written so far, the newest last.
    recorded, unrecorded : int
        Number of messages that are written or will be written at the next flush, and number that the disk refused.

    Raises
    ------
    SettingsError
        If the folder cannot be created, or if a limit is not positive.
    """

    def __init__(
        self,
        folder: Path,
        file_bytes: int = FILE_BYTES,
        file_s: float = FILE_S,
        flush_s: float = FLUSH_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not (file_bytes > 0 and file_s > 0 and flush_s > 0):
            raise SettingsError(f"limits of {file_bytes} B, {file_s:g} s and {flush_s:g} s must all be above 0")
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SettingsError(f"{folder} cannot be made: {error.strerror}; choose another folder") from error
        self.files: list[Path] = []
        self.recorded = self.unrecorded = 0
        self._folder, self._file_bytes, self._file_ns, self._flush_s = folder, file_bytes, round(file_s * 1e9), flush_s
        self._clock = clock
        self._sink: McapSink | None = None
        self._first_ns = self._taken = 0
        self._flushed_s = clock()
        self._retry_s = self._flushed_s

    def put(self, messages: Sequence[Message]) -> None:
        """Write messages, and flush the file when a flush is due.

        Parameters
        ----------
        messages : sequence of Message
            Messages in order of receipt; an empty sequence only flushes.
        """
        now = self._clock()
        if messages and now >= self._retry_s:
            before = self.recorded
            try:
                self._write(messages)
            except RecordingError as error:
                self._give_up(error, len(messages) - (self.recorded - before), now)
        elif messages:
            self.unrecorded += len(messages)
        if now - self._flushed_s >= self._flush_s:
            self._flush(now)

    def close(self) -> None:
        """Close the current file."""
        if self._sink is None:
            return
        try:
            self._sink.close()
            self._sink = None
        except RecordingError as error:
            self._give_up(error, 0, self._clock())

    def _write(self, messages: Sequence[Message]) -> None:
        """Write messages to the current file, or to the next one if the current file has reached a limit."""
        first_ns = messages[0].receipt_ns
        sink = self._sink
        if sink is not None and (sink.written >= self._file_bytes or first_ns - self._first_ns >= self._file_ns):
            self.close()
            sink = None
        if sink is None:
            sink = self._sink = McapSink(self._find_fresh_path(first_ns))
            self.files.append(sink.path)
            self._first_ns, self._taken = first_ns, 0
        room = sink.room(messages)
        sink.put(messages[:room])
        self._taken += room
        self.recorded += room
        if room < len(messages):  # the format cannot number more keys in one file
            self.close()
            self._write(messages[room:])

    def _find_fresh_path(self, receipt_ns: int) -> Path:
        """Return a path that does not exist, named by the time of receipt."""
        moment = datetime.fromtimestamp(receipt_ns // 10**9, UTC)
        stem = f"{moment:%Y%m%dT%H%M%S}.{receipt_ns // 10**6 % 1000:03}Z"
        path, number = self._folder / f"{stem}.mcap", 1
        while path.exists():
            path, number = self._folder / f"{stem}-{number}.mcap", number + 1
        return path

    def _flush(self, now: float) -> None:
        """Write the received messages to disk."""
        self._flushed_s = now
        if self._sink is not None:
            try:
                self._sink.flush()
            except RecordingError as error:
                self._give_up(error, 0, now)

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
